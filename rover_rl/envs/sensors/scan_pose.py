"""Pose of the scan: where the rover was when its lidar scanned, relative to where it knows itself now."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.config import SCAN_POSE
from rover_rl.envs.sensors.base import Sensor, SensorInput
from rover_rl.envs.specs import Bounds
from rover_rl.rotations import wrap_angle


@dataclass(frozen=True, kw_only=True)
class ScanPose(Sensor):
    """Pose at which the scan was taken, relative to the entries ``pose`` and ``imu``, ``[N, 6]``.

    How far ahead, to the left and up (m), pitch and roll at the scan, and the turn from the heading now to the one then
    (rad). An environment has this entry if its scans can be late, or if it is asked for. The map of what has been seen
    aligns scans by it, as ROS's tf does by their stamps.
    """

    name: str = SCAN_POSE
    delayed = None
    clips = False
    mirror_signs = (1.0, -1.0, 1.0, 1.0, -1.0, -1.0)
    bounds = Bounds((-10.0, -10.0, -10.0, *(-math.pi,) * 3), (10.0, 10.0, 10.0, *(math.pi,) * 3))

    def read(self, inputs: SensorInput) -> Tensor:
        assert inputs.scan_pose is not None
        return inputs.scan_pose

    def encode(self, value: Tensor) -> Tensor:
        """Returns the way and the turn in units of 20 cm and 0.2 rad, without the tilt and the height."""
        return torch.cat((value[..., :2], value[..., 5:]), -1) * 5


def taken_at(observation: TensorDictBase | Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
    """Returns where the scan of an observation was taken: ``pose [N, 3]`` (m) and ``imu [N, 3]`` (rad) of its time.

    If the observation has no ``scan_pose``, the scan is as new as the pose.
    """
    relative = observation.get(SCAN_POSE, None)
    if relative is None:
        return observation["pose"], observation["imu"]
    return pose_of_scan(observation["pose"], observation["imu"], relative)


def seen_from_now(x: Tensor, y: Tensor, scan_pose: Tensor) -> tuple[Tensor, Tensor]:
    """Returns x and y in the base frame now, ``[..., points]`` each, m, of points in that of the scan.

    ``scan_pose`` are values of the sensor, ``[..., 6]``.
    """
    ahead, left, turn = scan_pose[..., :1], scan_pose[..., 1:2], scan_pose[..., 5:]
    return ahead + x * turn.cos() - y * turn.sin(), left + x * turn.sin() + y * turn.cos()


def pose_of_scan(pose: Tensor, imu: Tensor, relative: Tensor) -> tuple[Tensor, Tensor]:
    """Returns what :func:`taken_at` does, of the entries ``pose``, ``imu`` and ``scan_pose``."""
    ahead, left, up, pitch, roll, turn = relative.split(1, -1)
    yaw = imu[..., 2:]
    cos, sin = yaw.cos(), yaw.sin()
    position = pose + torch.cat((cos * ahead - sin * left, sin * ahead + cos * left, up), -1)
    # Wrapping rounds. A scan that is as new as the pose was taken right there.
    return position, torch.cat((pitch, roll, torch.where(turn == 0, yaw, wrap_angle(yaw + turn))), -1)
