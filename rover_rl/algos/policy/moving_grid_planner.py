"""``MovingGridPlanner``: the planner on a map of what has been seen, among obstacles that it sees moving.

Example:
    >>> env = make_env(world_n="maze", num_envs=4, lidar_points=128)
    >>> runner = PolicyRunner(MovingGridPlanner())
    >>> runner(env.reset()).shape
    torch.Size([4, 2])
"""

from __future__ import annotations

from rover_rl.algos.policy.grid_planner import GridPlanner
from rover_rl.envs.config import RobotLike
from rover_rl.envs.sensors.suite import MOVERS


class MovingGridPlanner(GridPlanner):
    """The :class:`~rover_rl.algos.policy.grid_planner.GridPlanner` with routes around what moves.

    It also reads ``movers``, which a :class:`~rover_rl.algos.policy.runner.PolicyRunner` adds: see
    :class:`~rover_rl.envs.sensors.movers.Movers`.
    """

    def __init__(self, robot: RobotLike = "rover_zero") -> None:
        super().__init__(robot)
        self.in_keys.append(MOVERS)
