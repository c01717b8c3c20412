"""Pose of a live rover in the world, from pose messages and the IMU.

The functions that read messages accept any object with a message's attributes, such as ROS's own classes. They raise
``ValueError`` for numbers that are not finite.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rover_rl.rotations import quaternion_product, quaternion_to_euler
from rover_rl.sims.ros2.messages import Odometry, PoseArray, PoseStamped, PoseWithCovarianceStamped
from rover_rl.sims.ros2.pose_reset import TargetPose
from rover_rl.sims.ros2.settings import PoseSource

IDENTITY_ORIENTATION = torch.tensor([0.0, 0.0, 0.0, 1.0])
"""Level orientation with yaw 0, as (x, y, z, w)."""
YAW_TOLERANCE = 0.3
"""Maximum yaw error of a rover that has reached its target pose, rad."""


class MeasuredPose(NamedTuple):
    """A position ``[3]`` (m) and an orientation ``[4]`` as (x, y, z, w); ``None`` if it is unknown.

    ``imu_yaw_offset`` is the yaw of the IMU's frame in the frame of the pose, rad.
    """

    position: Tensor
    orientation: Tensor | None
    imu_yaw_offset: float = 0.0


ORIGIN_POSE = MeasuredPose(torch.zeros(3), IDENTITY_ORIENTATION)
"""Pose before the first pose message."""


def read_finite(name: str, *numbers: float) -> Tensor:
    """Returns numbers of a message as float32 ``[n]``."""
    values = torch.tensor(numbers, dtype=torch.float32)
    if not torch.isfinite(values).all():
        raise ValueError(f"a {name} must be finite, got {values.tolist()}")
    return values


def read_orientation(q: Any) -> Tensor:
    """Reads and normalizes a ``geometry_msgs/Quaternion`` other than zero: float32 ``[4]`` as (x, y, z, w)."""
    quaternion = torch.tensor([q.x, q.y, q.z, q.w], dtype=torch.float64)
    norm = torch.linalg.vector_norm(quaternion)
    if not 0.0 < norm < math.inf:
        raise ValueError(f"an orientation must be a finite quaternion other than zero, got {quaternion.tolist()}")
    return (quaternion / norm).float()


def read_pose(pose: Any) -> MeasuredPose:
    """Reads a ``geometry_msgs/Pose``."""
    point = pose.position
    return MeasuredPose(read_finite("position", point.x, point.y, point.z), read_orientation(pose.orientation))


def read_pose_array(msg: Any) -> MeasuredPose:
    """Reads the first pose of a ``geometry_msgs/PoseArray``. Its orientation may be missing or invalid."""
    if not len(msg.poses):
        raise ValueError("a pose array must have at least one pose, got none")
    point = msg.poses[0].position
    position = read_finite("position", point.x, point.y, point.z)
    try:
        return MeasuredPose(position, read_orientation(msg.poses[0].orientation))
    except (ValueError, AttributeError):
        return MeasuredPose(position, None)


POSE_MESSAGES: dict[PoseSource, tuple[Any, Callable[[Any], MeasuredPose]]] = {
    "pose_array": (PoseArray, read_pose_array),
    "pose_stamped": (PoseStamped, lambda msg: read_pose(msg.pose)),
    "odometry": (Odometry, lambda msg: read_pose(msg.pose.pose)),
    "pose_with_covariance": (PoseWithCovarianceStamped, lambda msg: read_pose(msg.pose.pose)),
    "wheels": (Odometry, lambda msg: read_pose(msg.pose.pose)),
}
"""Type of the pose message of each source, and the function that reads it."""


class PoseEstimator:
    """Combines measured poses and IMU orientations into poses in the world.

    The positions of a pose array and the IMU's heading are in the world's frame. A localizer provides the heading in
    its map; between two of its poses the IMU provides the change. Wheel odometry has a frame of its own, which is
    aligned with the world at the start of each episode. All orientations of the IMU are the latest ones, ``[4]``.
    """

    def __init__(self, source: PoseSource) -> None:
        self._source = source
        self._frame = _OdometryFrame()

    def align_imu(self, pose: MeasuredPose, imu_orientation: Tensor) -> MeasuredPose:
        """Adds the yaw offset of the IMU to a localizer's pose that has just arrived; returns other poses unchanged."""
        if self._source not in ("pose_array", "wheels"):
            return pose._replace(imu_yaw_offset=yaw_of(pose.orientation) - yaw_of(imu_orientation))
        return pose

    def estimate(self, pose: MeasuredPose, imu_orientation: Tensor) -> tuple[Tensor, Tensor]:
        """Returns position ``[3]`` and orientation ``[4]`` in the world for a pose from :meth:`align_imu`."""
        if self._source == "wheels":
            return self._frame.to_world(pose.position), _rotate_yaw(imu_orientation, self._frame.imu_yaw_offset)
        offset = pose.imu_yaw_offset
        return pose.position, _rotate_yaw(imu_orientation, offset) if offset else imu_orientation

    def frame_in_world(self) -> tuple[Tensor, Tensor]:
        """Returns position ``[3]`` (m) and orientation ``[4]`` in the world of the frame of the measured poses."""
        if self._source != "wheels":
            return torch.zeros(3), IDENTITY_ORIENTATION
        return self._frame.to_world(torch.zeros(3)), _rotate_yaw(IDENTITY_ORIENTATION, self._frame.yaw)

    def start_episode(
        self, pose: MeasuredPose, imu_orientation: Tensor, target: TargetPose | None, ground: float
    ) -> None:
        """Aligns the frame of the wheel odometry with the world.

        The rover is at ``target``, where the ground is at height ``ground`` (m). If it was not moved, ``target`` is
        ``None``, and the odometry's frame is the world's.
        """
        odometry_yaw, imu_yaw = yaw_of(pose.orientation), yaw_of(imu_orientation)
        if target is None:
            self._frame = _OdometryFrame(imu_yaw_offset=odometry_yaw - imu_yaw)
        else:
            world_origin = torch.tensor([target.x, target.y, ground])
            self._frame = _OdometryFrame(target.yaw - odometry_yaw, pose.position, world_origin, target.yaw - imu_yaw)

    def matches_target(self, pose: MeasuredPose, target: TargetPose, tolerance: float) -> bool:
        """Whether a pose is within ``tolerance`` (m) of a target; always true for wheel odometry, which cannot tell."""
        if self._source == "wheels":
            return True
        x, y, _ = pose.position.tolist()
        near = math.hypot(x - target.x, y - target.y) <= tolerance
        yaw_error = 0.0 if pose.orientation is None else yaw_of(pose.orientation) - target.yaw
        return near and abs(math.remainder(yaw_error, 2 * math.pi)) <= YAW_TOLERANCE


class _OdometryFrame(NamedTuple):
    """Frame of the wheel odometry in the world: its yaw, and the origin of the episode in either frame, ``[3]``, m.

    ``imu_yaw_offset`` is the yaw of the IMU's frame in the world, rad.
    """

    yaw: float = 0.0
    origin: Tensor = torch.zeros(3)
    world_origin: Tensor = torch.zeros(3)
    imu_yaw_offset: float = 0.0

    def to_world(self, position: Tensor) -> Tensor:
        dx, dy, dz = (position - self.origin).tolist()
        cosine, sine = math.cos(self.yaw), math.sin(self.yaw)
        return self.world_origin + torch.tensor([cosine * dx - sine * dy, sine * dx + cosine * dy, dz])


def yaw_of(orientation: Tensor | None) -> float:
    """Returns the yaw of an orientation ``[4]``, rad; 0 for ``None``."""
    return 0.0 if orientation is None else quaternion_to_euler(orientation)[2].item()


def _rotate_yaw(orientation: Tensor, yaw: float) -> Tensor:
    return quaternion_product(torch.tensor([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]), orientation)
