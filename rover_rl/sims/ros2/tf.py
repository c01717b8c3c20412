"""Frames of tf: the tree of transforms between them, and the pose that it tells of a robot."""

from __future__ import annotations

from collections import defaultdict, deque
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rover_rl.sims.ros2 import messages as ros

MAP, WORLD = "map", "world"
TF_TOPIC = "/tf"
KEPT = 1000  # number of transforms of a frame that are kept, 10 s at 100 Hz
SAME = {MAP, WORLD}  # names of the frame of the world, which are the same if no transform tells otherwise
RESTART = 0.5
"""Time by which a stamp is older than the last one from which on the clock has gone back, s. Else, it is late."""


class Transform(NamedTuple):
    """Pose of the frame ``child`` in ``parent``: position ``[3]``, m."""

    parent: str
    child: str
    position: np.ndarray
    rotation: Rotation

    @classmethod
    def read(cls, msg: Any) -> Transform:
        """Reads a ``geometry_msgs/TransformStamped``. Raises ``ValueError`` if it is not finite, or no rotation."""
        move, turn = msg.transform.translation, msg.transform.rotation
        frames = msg.header.frame_id.strip("/"), msg.child_frame_id.strip("/")
        position, quaternion = np.array([move.x, move.y, move.z]), np.array([turn.x, turn.y, turn.z, turn.w])
        if not (np.isfinite([*position, *quaternion]).all() and quaternion.any()):
            parent, child = frames
            raise ValueError(f"the transform from {parent!r} to {child!r} must be finite, and turn by a rotation")
        return cls(*frames, position, Rotation.from_quat(quaternion))

    def message(self, stamp: Any) -> Any:
        place = ros.Transform(ros.Vector3(*self.position.tolist()), ros.Quaternion(*self.rotation.as_quat().tolist()))
        return ros.TransformStamped(ros.Header(stamp, self.parent), self.child, place)


class FrameTree:
    """Latest transforms, by the frames that they tell the place of."""

    def __init__(self) -> None:
        self._known = defaultdict[str, deque[tuple[float, Transform]]](lambda: deque(maxlen=KEPT))

    def read(self, msg: Any, fixed: bool = False) -> None:
        """Adds the transforms of a ``tf2_msgs/TFMessage``, which hold at any time if they are ``fixed``.

        Late ones are ignored, and a clock that goes back begins anew. Raises ``ValueError`` for one that is unusable.
        """
        for each in msg.transforms:
            transform, stamp = Transform.read(each), ros.seconds_of(each.header.stamp)
            history, last = self._known[transform.child], self.stamp_of(transform.child)
            if not fixed and last - RESTART < stamp < last:
                continue
            while history and (fixed or history[-1][0] >= stamp):
                history.pop()
            history.append((stamp, transform))

    def stamp_of(self, frame: str) -> float:
        """Returns the stamp of the newest transform of a frame, s; ``-inf`` without one."""
        history = self._known.get(frame)
        return history[-1][0] if history else -np.inf

    def between(self, root: str, frame: str, stamp: float | None = None) -> Transform:
        """Returns the pose of ``frame`` in ``root`` at a stamp (s); ``None``: by the newest transforms.

        A transform holds until the next one. Raises ``ValueError`` if none lead there, or the stamp is too old.
        """
        way, position, rotation = self._way(frame, root, stamp)
        if way[-1] != root:
            back, origin, turn = self._way(root, way[-1], stamp)
            if back[-1] != way[-1] and not {back[-1], way[-1]} <= SAME:
                raise ValueError(f"no transform leads from {root!r} to {' in '.join(map(repr, reversed(way)))}")
            position, rotation = turn.inv().apply(position - origin), turn.inv() * rotation
        return Transform(root, frame, position, rotation)

    def _way(self, frame: str, end: str, stamp: float | None) -> tuple[list[str], np.ndarray, Rotation]:
        """Returns the frames from ``frame`` up to ``end`` or the root of its tree, and its pose there."""
        position, rotation, way = np.zeros(3), Rotation.identity(), [frame]
        while way[-1] != end and (history := self._known.get(way[-1])):
            known = [history[-1]] if stamp is None else [each for each in history if each[0] <= stamp]
            if not known and len(history) > 1:
                since = history[0][0]
                raise ValueError(f"where {way[-1]!r} was at {stamp:.1f} s is not known, but from {since:.1f} s on")
            _, transform = (known or history)[-1]  # one without others holds at any time
            if transform.parent in way:
                raise ValueError(f"the transforms of {' in '.join(map(repr, [*way, transform.parent]))} form a loop")
            position = transform.rotation.apply(position) + transform.position
            rotation = transform.rotation * rotation
            way.append(transform.parent)
        return way, position, rotation


class RobotPose:
    """Pose of the frame ``base`` in the frame ``root``, by the latest transforms in a ``tree``.

    A localizer tells where ``odom`` is more seldom and later than wheel odometry tells where the robot is in it: a pose
    has the stamp of the transform of ``base``.
    """

    def __init__(self, root: str, base: str) -> None:
        self._root, self._base, self.tree = root, base, FrameTree()
        self._stamp = -np.inf

    def after(self, msg: Any, fixed: bool = False) -> Any | None:
        """Returns the pose after a ``tf2_msgs/TFMessage``, a ``geometry_msgs/PoseStamped``; ``None`` if it is no other.

        Raises ``ValueError`` for a transform that cannot be used, or if none lead from ``root`` to ``base``.
        """
        self.tree.read(msg, fixed)
        if (stamp := self.tree.stamp_of(self._base)) == self._stamp:
            return None  # late, or repeated
        self._stamp = stamp
        found = self.tree.between(self._root, self._base)
        place = ros.Pose(ros.Point(*found.position.tolist()), ros.Quaternion(*found.rotation.as_quat().tolist()))
        return ros.PoseStamped(ros.Header(ros.Time.from_seconds(stamp), self._root), place)
