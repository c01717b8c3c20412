"""``RoutePrior``: driver who follows the route, to whose action a policy adds; and bounds of actions by robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torchrl.data import Bounded

from rover_rl.algos.config import entries_of_driver
from rover_rl.algos.policy.grid_planner import Follower, follow, follow_in_arcs
from rover_rl.envs.config import SCAN_POSE, HeadingGains
from rover_rl.envs.sensors.robot import RobotNumbers
from rover_rl.envs.sensors.suite import ROUTE
from rover_rl.robots import Robot


class RowBounds(nn.Module):
    """Bounds of the actions of different robots: those of an action spec, within what each robot can do.

    A share of them means the same effort for a slow robot and for a fast one.

    Args:
        spec: spec of actions, speed and turn.
        gain: largest yaw rate of a robot over its largest turn: the ``kp`` of the heading PID for heading offsets, 1
            for yaw rates.
        share: share of the turns within bounds that are used: the bounds are as much wider.
    """

    _low: Tensor
    _high: Tensor
    _wider: Tensor

    def __init__(self, spec: Bounded, gain: float = HeadingGains.kp, share: float = 1.0) -> None:
        super().__init__()
        self._gain = gain
        self.register_buffer("_low", spec.space.low, persistent=False)
        self.register_buffer("_high", spec.space.high, persistent=False)
        self.register_buffer("_wider", spec.space.high.new_tensor((1.0, 1 / share)), persistent=False)

    def forward(self, robot: Tensor | None) -> tuple[Tensor, Tensor]:
        """Returns the lower and upper bounds for values of the sensor ``robot``, ``[..., 2]`` each.

        ``None``: those of the action spec, ``[2]``.
        """
        if robot is None:
            return self._low, self._high
        numbers = RobotNumbers.of(robot)
        most = torch.cat((numbers.max_speed, numbers.max_yaw_rate / self._gain), -1)
        return torch.maximum(self._low, -most) * self._wider, torch.minimum(self._high, most) * self._wider


class RoutePrior(nn.Module):
    """Mean of a squashed normal distribution at which the action is that of a driver who follows the route.

    A policy that adds to it begins as that driver, and learns what to do better (T. Silver, K. Allen, J. Tenenbaum, L.
    Kaelbling, "Residual policy learning", 2018). The driver is :func:`~rover_rl.algos.policy.grid_planner.follow`, and
    for robots that do not turn in place :func:`~rover_rl.algos.policy.grid_planner.follow_in_arcs`.

    Args:
        robot: robot that drives.
        observation: entries that the policy reads. With ``scan_pose``, the driver reads where scans were taken.
        reach: largest change of the mean by the policy, before squashing. A policy that may change more takes back what
            the driver does in rare places, such as backing out of a dead end, and gets stuck there. Where things move,
            it needs more to wait and to give way.
        share: largest share of the range of an action that the driver uses. All of it would be an infinite mean.

    Attributes:
        keys: entries of the observation that the driver reads.
    """

    def __init__(self, robot: Robot, observation: Sequence[str] = (), reach: float = 1.0, share: float = 0.95) -> None:
        super().__init__()
        self._robot, self.reach, self._share = robot, reach, share
        self.keys = entries_of_driver(robot.drive.turns_in_place, observation)

    def forward(self, entry: Mapping[str, Tensor], low: Tensor, high: Tensor) -> Tensor:
        middle, half = (high + low) / 2, (high - low) / 2
        share = (self._action(entry) - middle) / half
        return torch.atanh(share.clamp(-self._share, self._share))

    def _action(self, entry: Mapping[str, Tensor]) -> Tensor:
        rows = {key: entry[key].reshape(-1, entry[key].shape[-1]) for key in self.keys}
        lidar, imu, route, scan_pose = rows["lidar"], rows["imu"], rows[ROUTE], rows.get(SCAN_POSE)
        if self._robot.drive.turns_in_place:
            action = follow(lidar, imu, route, Follower.of(self._robot), scan_pose)
        else:
            robot = RobotNumbers.of_robot(self._robot, lidar)
            action = follow_in_arcs(lidar, imu, route, rows["velocities"], robot, scan_pose)
        return action.reshape(*entry["lidar"].shape[:-1], 2)
