"""State of the environment between two steps: rover state, quantities derived from it, and state of the task."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensordict import TensorDict
from torch import Tensor

from rover_rl.envs.task import TaskState
from rover_rl.sims.base import RoverState
from rover_rl.sims.rotations import quaternion_to_euler

if TYPE_CHECKING:
    from rover_rl.envs.localization import SensedPose
    from rover_rl.envs.sensors.lidar import LidarPooling


class Perception:
    """Rover state with the attitude, heading, position and pooled lidar scan derived from it.

    Args:
        rover: state of the rovers, ``[N]``.
        lidar: pooling of the raw scan.

    Attributes:
        rover: state of the rovers, ``[N]``.
        euler: roll, pitch and yaw, ``[N, 3]``, rad.
        yaw: heading, ``[N, 1]``, rad.
        position: horizontal position (x, y), ``[N, 2]``, m.
        readings: pooled lidar scan, ``[N, lidar_points]``, m.
    """

    def __init__(self, rover: RoverState, lidar: LidarPooling) -> None:
        self.rover = rover
        self.euler = quaternion_to_euler(rover.orientation)
        self.yaw = self.euler[:, 2:]
        self.position = rover.position[:, :2]
        self.readings = lidar(rover.ranges)


class StepState:
    """State of the environment between two steps.

    This is a plain object because ``EnvBase`` is a ``torch.nn.Module``, in which assigning attributes is slow.

    Attributes:
        truth: perception from the true state of the simulator.
        sensed: perception from the sensor readings. The same object as ``truth`` if there is no sensor noise.
        pose: pose as the sensors report it.
        reference: the one of ``truth`` and ``sensed`` that events and rewards are computed from.
        task: goals, targets and counters.
        world: index of each row's world in the pool, int64 ``[N, 1]``. ``None`` if there is only one.
        outcome: events and measurements of the last step.
        terminated, truncated: whether the last step ended the episode, bool ``[N, 1]``.
    """

    truth: Perception
    sensed: Perception
    pose: SensedPose
    reference: Perception
    task: TaskState
    world: Tensor | None
    outcome: TensorDict
    terminated: Tensor
    truncated: Tensor

    def __init__(self, task: TaskState, world: Tensor | None) -> None:
        self.task = task
        self.world = world
