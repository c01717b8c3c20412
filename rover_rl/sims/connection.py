"""The contract's way to a live rover."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Connection:
    """The contract's way to a live rover; simulators that make their own sensor data do without.

    Args:
        scan_topic: its ``sensor_msgs/LaserScan``.
        imu_topic: its ``sensor_msgs/Imu``.
        cmd_vel_topic: its command, ``geometry_msgs/Twist``.
        camera_topic: its camera, reserved for vision as in the original.
        timeout: seconds to wait for its first scan.
    """

    scan_topic: str = "/scan"
    imu_topic: str = "/imu/data"
    cmd_vel_topic: str = "/cmd_vel"
    camera_topic: str = "/camera/image_raw"
    timeout: float = 30.0
