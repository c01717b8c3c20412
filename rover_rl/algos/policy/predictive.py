"""``PredictivePolicy``: planner in space and time, among what the lidar sees at rest and moving.

Example:
    >>> policy = PredictivePolicy()
    >>> env = make_env(sensors_for(policy, replace(policy.made_for, world="plaza", num_envs=2, backend="warp")))
    >>> runner = PolicyRunner(policy, env=env)
    >>> runner(env.reset()).shape
    torch.Size([2, 2])
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from rover_rl.algos.policy.space_time import Plans, SpaceTimePlanner, fixed_struct, moving_struct, window
from rover_rl.envs.config import EnvConfig, LidarConfig, RobotLike, TaskConfig
from rover_rl.envs.seen_map.scans import SIZE, goal_positions, in_world
from rover_rl.envs.sensors.movers import movers_of
from rover_rl.envs.sensors.suite import MOVERS, SEEN_DISTANCES
from rover_rl.envs.specs import action_bounds
from rover_rl.robots import get_robot
from rover_rl.robots.slip import estimated_yaw_gain

GOAL_RADIUS = 0.3  # distance from the goal that it drives to, m


class PredictivePolicy(TensorDictModuleBase):
    """Plans ways around what moves, each at the time at which the rover is there.

    Ten times a second, it plans on the map of what the lidar has seen with a
    :class:`~rover_rl.algos.policy.space_time.SpaceTimePlanner`. What moves is taken to keep its velocity.

    The policy reads ``pose``, ``imu``, ``target``, ``velocities``, ``movers`` and ``seen_distances``.

    Args:
        robot: name of a robot, or a robot.
        yaw_gain: yaw rate of the body relative to that of the wheel odometry; ``None``: an estimate from the drive.

    Attributes:
        made_for: environment that the policy drives in, with ``robot``, one lidar reading for each beam, and episodes
            that end when the body touches an obstacle.

    Raises:
        ValueError: for an unknown robot.
    """

    trained_action_repeat = 2
    row_by_row = True

    def __init__(self, robot: RobotLike = "rover_zero", yaw_gain: float | None = None) -> None:
        super().__init__()
        model, lidar = get_robot(robot), LidarConfig()
        task = TaskConfig(collision_from="contact", collision_window=0)
        self.made_for = EnvConfig(robot=robot, lidar=replace(lidar, points=lidar.beams), task=task)
        self.in_keys = ["pose", "imu", "target", "velocities", MOVERS, SEEN_DISTANCES]
        self.out_keys = ["action"]
        gain = estimated_yaw_gain(model) if yaw_gain is None else yaw_gain
        speed = min(model.drive.max_speed, action_bounds(self.made_for.bounded_action).high[0])
        self._planner = SpaceTimePlanner(model, gain, speed, GOAL_RADIUS)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sets ``action [N, 2]``: forward speed (m/s) and heading offset (rad)."""
        pose, imu, target = (tensordict[key] for key in ("pose", "imu", "target"))
        count, device = len(pose), pose.device
        rows = torch.arange(count, device=device)
        plans = Plans.empty(count, device)
        plans = plans._replace(origin=window(pose[:, :2])[0], goal=goal_positions(pose, imu, target))
        distances, frame = tensordict[SEEN_DISTANCES].split((SIZE**2, 3), -1)
        frame = torch.cat((frame, pose.new_full((count, 2), float(SIZE))), -1)
        fixed = fixed_struct(rows, frame, distances.contiguous())
        movers = _of_movers(tensordict[MOVERS])
        # Those that exist first, as the kernels read no others.
        order = (movers[..., 8] == 0).to(torch.int8).sort(dim=-1, stable=True).indices
        movers = movers.gather(1, order[..., None].expand_as(movers))
        planner = self._planner
        planner.begin(plans, rows, fixed)
        planner.plan(plans, rows, fixed, _predicted(movers, pose, imu, planner.plan_instants))
        place, since = torch.cat((pose[:, :2], imu[:, 2:]), -1), pose.new_zeros(count)
        moving = _predicted(movers, pose, imu, planner.drive_instants)
        action = planner.decide(plans, rows, since, place, tensordict["velocities"], fixed, moving)
        return tensordict.set("action", action.to(pose))


def _of_movers(value: Tensor) -> Tensor:
    """Returns discs: x, y, velocity along x and y, cosine and sine of the yaw, half the length and width, radius."""
    movers = movers_of(value)
    front = torch.tensor((1.0, 0.0, 0.0, 0.0), device=value.device).expand(*movers.shape[:-1], 4)
    return torch.cat((movers[..., :4], front, movers[..., 4:]), -1)


def _predicted(movers: Tensor, pose: Tensor, imu: Tensor, instants: list[float]) -> Any:
    """Returns where movers ``[N, M, 9]`` in the base frame will be, as the kernels read it.

    Args:
        movers: what :func:`_of_movers` returns. Those that do not exist are last.
        pose, imu: pose and attitude of the rovers.
        instants: times from now, s.
    """
    place, velocity, along = (in_world(movers[..., k : k + 2], imu) for k in (0, 2, 4))
    place, yaw = pose[:, None, :2] + place, torch.atan2(along[..., 1], along[..., 0])
    return moving_struct([place + time * velocity for time in instants], [yaw] * len(instants), movers[..., 6:])
