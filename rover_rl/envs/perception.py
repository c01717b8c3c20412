"""What the task derives from a rover state, and what it keeps between two steps."""

from __future__ import annotations

from tensordict import TensorDict
from torch import Tensor

from rover_rl.envs.sensing import LidarPooling
from rover_rl.envs.task import TaskState
from rover_rl.sims.base import RoverState
from rover_rl.sims.rotations import quaternion_to_euler


class Perception:
    """A rover state, and the attitude, heading, position and pooled scan derived from it.

    Args:
        rover: state of the rovers, ``[N]``.
        lidar: pools the raw scan.

    Attributes:
        rover: the state.
        euler: roll, pitch and yaw, ``[N, 3]``, rad.
        yaw: heading, ``[N, 1]``, rad.
        position: ``[N, 2]``, m.
        readings: pooled scan, ``[N, lidar_points]``, m.
    """

    def __init__(self, rover: RoverState, lidar: LidarPooling) -> None:
        self.rover = rover
        self.euler = quaternion_to_euler(rover.orientation)
        self.yaw = self.euler[:, 2:]
        self.position = rover.position[:, :2]
        self.readings = lidar(rover.ranges)


class StepState:
    """The environment's state between two steps.

    A plain object, because EnvBase is a ``torch.nn.Module``, whose attributes are slow to assign.

    Attributes:
        truth: from the simulator's state.
        sensed: from what the sensors report; the same object as ``truth`` without sensor noise.
        judged: the one of the two that events and rewards follow.
        task: goals, targets and counters.
        outcome: what happened in the last step.
        terminated, truncated: whether the last step ended the episode, bool ``[N, 1]``.
    """

    truth: Perception
    sensed: Perception
    judged: Perception
    task: TaskState
    outcome: TensorDict
    terminated: Tensor
    truncated: Tensor

    def __init__(self, task: TaskState) -> None:
        self.task = task
