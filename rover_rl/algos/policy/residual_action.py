"""``RouteResidual``: action that a policy adds to that of a driver who follows the route on what has been seen."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.algos.policy.grid_planner import Follower, follow
from rover_rl.envs.actions import Action, Heading
from rover_rl.envs.config import SCAN_POSE, ActionConfig
from rover_rl.envs.sensors.suite import ROUTE
from rover_rl.envs.specs import Bounds
from rover_rl.robots.fleet import Fleet


class RouteResidual(Action):
    """Change of speed (m/s) and heading offset (rad) of a driver who follows the route, if it turns in place.

    A policy that adds nothing drives as ``gridplanner``: :func:`~rover_rl.algos.policy.grid_planner.follow`. The sum is
    clipped to the bounds of the contract's action (T. Silver, K. Allen, J. Tenenbaum, L. Kaelbling, "Residual policy
    learning", 2018).

    Raises:
        ValueError: if robots differ, or cannot turn in place.
    """

    needs = (ROUTE,)
    steered = True

    def __init__(self, limits: ActionConfig, fleet: Fleet) -> None:
        super().__init__(limits, fleet)
        robot = fleet.largest
        if len(fleet.robots) > 1 or not robot.drive.turns_in_place:
            raise ValueError(f"the action 'residual' needs one robot that turns in place, got {robot.name!r}")
        self._follower = Follower.of(robot)

    @staticmethod
    def bounds(limits: ActionConfig) -> Bounds:
        most = Heading.bounds(limits).high
        return Bounds(tuple(-end for end in most), most)

    def command(self, action: Tensor, observation: TensorDictBase) -> Tensor:
        lidar, imu, route = (observation.get(key) for key in ("lidar", "imu", ROUTE))
        driven = follow(lidar, imu, route, self._follower, observation.get(SCAN_POSE, None))
        action[..., :2] += driven
        return action
