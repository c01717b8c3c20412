"""Goals that a ROS 2 node sends one at a time, such as RViz with its button *2D Goal Pose*."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.tf import FrameTree
from rover_rl.sims.ros2.transport import Transport

POLL = 0.05  # time between two looks for a goal, s


class GoalGivenUp(Exception):
    """Ends the drive to a goal that was canceled or replaced by another one. Its text says which."""


class GoalTopic:
    """The newest goal on a topic, a ``geometry_msgs/PoseStamped`` whose heading does not count.

    A goal replaces the one that is driven to, and a ``std_msgs/Empty`` on ``TOPIC/cancel`` gives it up. A
    ``std_msgs/String`` on ``TOPIC/status``, which late subscribers get, too, tells what is done: ``waiting``,
    ``driving to X Y``, the ending of the last drive, or why a goal is refused. Goals are x and y, m. One in another
    frame than the rover's pose (``pose_frame``) is transformed by tf (``frames``): where that frame is at the stamp of
    the goal, or now for stamp 0. ``require`` raises ``ValueError`` for a goal that is refused.
    """

    def __init__(
        self,
        transport: Transport,
        topic: str,
        require: Callable[[tuple[float, float]], None],
        pose_frame: Callable[[], str],
        frames: FrameTree,
    ) -> None:
        self._require, self._pose_frame, self._frames = require, pose_frame, frames
        self._newest: deque[tuple[float, float]] = deque(maxlen=1)
        self._is_canceled = False
        self._publish = transport.publisher(f"{topic}/status", ros.String, latched=True)
        transport.subscribe(topic, ros.PoseStamped, self._receive, reliable=True)
        transport.subscribe(f"{topic}/cancel", ros.Empty, self._cancel, reliable=True)
        self.tell("waiting")

    def goals(self, idle: Callable[[], object]) -> Iterator[tuple[float, float]]:
        """Yields goals as they come, without an end. Calls ``idle`` while it waits."""
        while True:
            idle()
            if not self._newest:
                time.sleep(POLL)
                continue
            goal, self._is_canceled = self._newest.popleft(), False
            self.tell(f"driving to {goal[0]:.2f} {goal[1]:.2f}")
            yield goal

    def check(self) -> None:
        """Raises :class:`GoalGivenUp` if the goal that is driven to was canceled or replaced."""
        if self._is_canceled:
            raise GoalGivenUp("canceled")
        if self._newest:
            raise GoalGivenUp("replaced")

    def tell(self, status: str) -> None:
        self._publish(ros.String(status))

    def _cancel(self, _: Any) -> None:
        self._newest.clear()
        self._is_canceled = True

    def _receive(self, msg: Any) -> None:
        place, frame, own = msg.pose.position, msg.header.frame_id.strip("/"), self._pose_frame()
        goal = place.x, place.y
        try:
            if not all(map(math.isfinite, (*goal, place.z))):
                raise ValueError("it is not finite")
            if frame not in ("", own):
                there = self._frames.between(own, frame, ros.seconds_of(msg.header.stamp) or None)
                x, y, _ = (there.rotation.apply([*goal, place.z]) + there.position).tolist()
                goal = x, y
            self._require(goal)
            self._newest.append(goal)
        except ValueError as error:
            self.tell(f"refused {goal[0]:.2f} {goal[1]:.2f}: {error}")
