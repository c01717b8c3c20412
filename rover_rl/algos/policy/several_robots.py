"""``SeveralRobots``: a baseline for a batch of different robots, with a policy for each of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from rover_rl.envs.config import RobotLike
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.sensors.robot import robot_table
from rover_rl.envs.sensors.suite import ROBOT
from rover_rl.robots import get_robots
from rover_rl.robots.robot import Robot


class SeveralRobots(TensorDictModuleBase):
    """Drives each robot with the policy that was made for it. The sensor ``robot`` tells which one a row is.

    Args:
        make: returns the policy of a robot.
        robots: robots, as :func:`~rover_rl.robots.get_robots` takes them.

    Example:
        >>> policy = make_baseline("gridplanner", ("jackal", "racer"))  # one of these
    """

    def __init__(self, make: Callable[[Robot], Any], robots: RobotLike) -> None:
        super().__init__()
        members = get_robots(robots)
        self._policies, self._table = [make(robot) for robot in members], robot_table(members)
        self.in_keys = [*dict.fromkeys((*(key for one in self._policies for key in one.in_keys), ROBOT))]
        self.out_keys = ["action"]
        made_for = [one.made_for for one in self._policies if hasattr(one, "made_for")]
        if made_for:
            # One lidar serves all: some planners want each of its beams for some robots.
            self.made_for = replace(max(made_for, key=lambda env: env.lidar.points), robot=robots)
        self.trained_action_repeat = getattr(self._policies[0], "trained_action_repeat", 1)

    def enter(self, env: RoverEnv) -> None:
        for policy in self._policies:
            if hasattr(policy, "enter"):
                policy.enter(env)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        table = self._table.to(tensordict[ROBOT].device)
        member = (tensordict[ROBOT][:, None] - table).abs().sum(-1).argmin(-1)  # [N]
        action = table.new_zeros(len(member), 2)
        for index in member.unique().tolist():
            rows = member == index
            action[rows] = self._policies[index](tensordict[rows])["action"]
        return tensordict.set("action", action)
