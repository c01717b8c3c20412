"""Frames of tf: transforms between them, and the pose that a tree of them tells of a robot."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rover_rl.sims.ros2 import messages as ros

TF_TOPIC = "/tf"
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
        if not (np.isfinite(position).all() and np.isfinite(quaternion).all() and quaternion.any()):
            raise ValueError(
                f"the transform from {frames[0]!r} to {frames[1]!r} must be finite, and turn by a rotation"
            )
        return cls(*frames, position, Rotation.from_quat(quaternion))

    def message(self, stamp: Any) -> Any:
        x, y, z, w = self.rotation.as_quat().tolist()
        place = ros.Transform(ros.Vector3(*self.position.tolist()), ros.Quaternion(x, y, z, w))
        return ros.TransformStamped(ros.Header(stamp, self.parent), self.child, place)


class RobotPose:
    """Pose of the frame ``base`` in the frame ``root``, by the latest transforms between them.

    A localizer tells where ``odom`` is more seldom, and later, than wheel odometry tells where the robot is in it, so
    that a pose has the stamp of the transform of ``base``.
    """

    def __init__(self, root: str, base: str) -> None:
        self._root, self._base = root, base
        self._known: dict[str, Transform] = {}
        self._stamp = 0.0

    def after(self, msg: Any) -> Any | None:
        """Returns the pose after a ``tf2_msgs/TFMessage``, a ``geometry_msgs/PoseStamped``; ``None`` if it is no other.

        Raises ``ValueError`` for a transform that cannot be used, or if none lead from ``root`` to ``base``.
        """
        stamp = None
        for each in msg.transforms:
            transform, at = Transform.read(each), ros.seconds_of(each.header.stamp)
            if transform.child == self._base:
                if self._stamp - RESTART < at <= self._stamp:
                    continue  # late, or repeated
                stamp, self._stamp = each.header.stamp, at
            self._known[transform.child] = transform
        return None if stamp is None else self._pose(stamp)

    def _pose(self, stamp: Any) -> Any:
        position, rotation, way = np.zeros(3), Rotation.identity(), [self._base]
        while way[-1] != self._root:
            if (transform := self._known.get(way[-1])) is None:
                raise ValueError(f"no transform leads from {self._root!r} to {' in '.join(map(repr, reversed(way)))}")
            if transform.parent in way:
                raise ValueError(f"the transforms of {' in '.join(map(repr, [*way, transform.parent]))} form a loop")
            position = transform.rotation.apply(position) + transform.position
            rotation = transform.rotation * rotation
            way.append(transform.parent)
        x, y, z, w = rotation.as_quat().tolist()
        place = ros.Pose(ros.Point(*position.tolist()), ros.Quaternion(x, y, z, w))
        return ros.PoseStamped(ros.Header(stamp, self._root), place)
