"""Values of ROS messages, for the contract's callbacks. Any object with a message's attributes will do."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rover_rl.sims.rotations import quaternion_to_euler


def scan_ranges(msg: Any) -> NDArray[np.float32]:
    """Ranges of a ``sensor_msgs/LaserScan`` as it gives them, ``[beams]``, m.

    Raises:
        ValueError: for a scan without beams.
    """
    ranges = np.array(msg.ranges, np.float32)
    if ranges.ndim != 1 or not ranges.size:
        raise ValueError(f"a scan must have a list of ranges, got shape {ranges.shape}")
    return ranges


def imu_euler(msg: Any) -> NDArray[np.float32]:
    """Roll, pitch and yaw of a ``sensor_msgs/Imu``, ``[3]``, rad (transforms3d's ``'sxyz'``).

    Raises:
        ValueError: for a quaternion that is zero or not finite.
    """
    q = msg.orientation
    quaternion = torch.tensor([q.x, q.y, q.z, q.w], dtype=torch.float64)
    norm = torch.linalg.vector_norm(quaternion)
    if not 0.0 < norm < float("inf"):
        raise ValueError(f"an orientation must be a finite quaternion other than zero, got {quaternion.tolist()}")
    return quaternion_to_euler(quaternion / norm).numpy().astype(np.float32)


def first_position(msg: Any) -> NDArray[np.float32]:
    """Position of the first pose of a ``geometry_msgs/PoseArray``, ``[3]``, m.

    Raises:
        ValueError: for an array without poses.
    """
    if not len(msg.poses):
        raise ValueError("a pose array must have at least one pose, got none")
    position = msg.poses[0].position
    return np.array([position.x, position.y, position.z], np.float32)


def odometry_twist(msg: Any) -> tuple[float, float]:
    """Forward speed (m/s) and yaw rate (rad/s) of a ``nav_msgs/Odometry``."""
    twist = msg.twist.twist
    return float(twist.linear.x), float(twist.angular.z)
