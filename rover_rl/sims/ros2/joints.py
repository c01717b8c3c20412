"""Motor torques of a live rover, from its ``sensor_msgs/JointState``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor

from rover_rl.sims.ros2.messages import Header, JointState
from rover_rl.sims.ros2.poses import read_finite


def read_efforts(msg: Any, wheels: Sequence[str]) -> Tensor:
    """Returns the efforts of wheels, float32 ``[wheels]``, N m, of a ``sensor_msgs/JointState``.

    Args:
        msg: message. It may have other joints, too.
        wheels: joints of the wheels, as in the description of the robot.

    Raises:
        ValueError: if a wheel is missing, or an effort is missing or not finite.
    """
    names = [*msg.name]
    if missing := [wheel for wheel in wheels if wheel not in names]:
        raise ValueError(f"the joint state lacks the wheels {missing}: it has {names}")
    if len(msg.effort) != len(names):
        raise ValueError(f"the joint state has {len(msg.effort)} efforts of {len(names)} joints")
    return read_finite("torque", *(msg.effort[names.index(wheel)] for wheel in wheels))


def joint_state_message(wheels: Sequence[str], efforts: Tensor, stamp: Any) -> Any:
    """Builds a ``sensor_msgs/JointState`` with the efforts of wheels ``[wheels]``, N m, and nothing else."""
    return JointState(Header(stamp), name=[*wheels], effort=efforts.double().numpy())
