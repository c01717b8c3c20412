"""``MovingDynamicWindowPolicy``: the dynamic-window planner, among obstacles that it sees moving.

It follows what moves with a :class:`~rover_rl.envs.mover_tracker.MoverTracker`. A trajectory is rejected if the body
touches where a track will be at the time of a pose, at constant velocity. Readings that belong to such a track are no
obstacles at rest.

Example:
    >>> evaluate(MovingDynamicWindowPolicy(), draw_episodes("maze:10000", episodes=2), name="dwa-moving", seconds=5)
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase

from rover_rl.algos.policy.dwa import LIDAR, DynamicWindowPolicy
from rover_rl.envs.config import LidarConfig, RobotLike
from rover_rl.envs.mover_tracker import MoverTracker, in_base_frame, tracked
from rover_rl.sims.settings import CONTROL_DT

MARGIN = 0.05  # added to the radius of what moves, m
_FAR = 1e3  # coordinate of what does not move, m


class MovingDynamicWindowPolicy(DynamicWindowPolicy):
    """Dynamic-window planner that tracks what moves: see the module ``moving_dwa``.

    The policy reads ``lidar``, ``target``, ``velocities``, ``pose`` and ``imu``, and remembers tracks.

    Args:
        robot: name of a robot, or a robot.
        lidar: lidar that the policy reads.
        yaw_gain: yaw rate of the body relative to that of the wheel odometry.

    Attributes:
        trained_action_repeat: number of steps from one decision to the next.

    Raises:
        ValueError: for an unknown robot, or a ``yaw_gain`` that is not positive.
    """

    trained_action_repeat = 2

    def __init__(
        self, robot: RobotLike = "rover_zero", lidar: LidarConfig = LIDAR, yaw_gain: float | None = None
    ) -> None:
        super().__init__(robot, lidar, yaw_gain)
        self.in_keys = ["lidar", "target", "velocities", "pose", "imu", "is_init", "tracks"]
        self.out_keys = ["action", ("next", "tracks")]  # type: ignore[list-item]
        self._tracker = MoverTracker(self._robot, lidar, self.trained_action_repeat * CONTROL_DT)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sets ``action [N, 2]``: forward speed (m/s) and heading offset (rad)."""
        state, tracks = tracked(self._tracker, tensordict)
        moving = in_base_frame(tracks, tensordict)
        lidar = torch.where(tracks.readings, self.made_for.lidar.max_range, tensordict["lidar"])
        position = moving.position.masked_fill(~moving.moves[..., None], _FAR)
        inputs = [lidar, tensordict["target"], tensordict["velocities"]]
        action = self._act([*inputs, position, moving.velocity, moving.radius + MARGIN])
        return tensordict.set("action", action).set(("next", "tracks"), state)
