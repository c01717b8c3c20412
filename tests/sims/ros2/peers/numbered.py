"""A rover of ROS 2's own rclpy whose IMU and odometry tell the number of their step: heading 0.01 n, speed 0.001 n.

python numbered.py first|last     (whether the scan is published before the others or after them)
"""

from __future__ import annotations

import math
import sys
import time
from typing import Any

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseArray
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, LaserScan

BEAMS, PERIOD, WRAP = 640, 0.05, 600
"""Beams of a scan, time between two stamps (s), and the number of steps after which numbers begin anew."""

rclpy.init()
node = rclpy.create_node("numbered")
topics = {LaserScan: "/scan", Imu: "/imu/data", Odometry: "/odometry/wheels", PoseArray: "/rover/pose_array"}
publishers = {kind: node.create_publisher(kind, topic, 10) for kind, topic in topics.items()}
scans = np.random.default_rng(0).uniform(1.0, 10.0, (64, BEAMS)).astype(np.float32)


def messages(step: int) -> list[Any]:
    number = step % WRAP
    scan, imu, odometry = LaserScan(), Imu(), Odometry()
    scan.angle_min, scan.angle_increment = -math.pi, 2 * math.pi / BEAMS
    scan.range_min, scan.range_max = 0.1, 12.0
    scan.ranges.frombytes(scans[step % len(scans)].tobytes())
    imu.orientation.z, imu.orientation.w = math.sin(0.005 * number), math.cos(0.005 * number)
    odometry.twist.twist.linear.x = 0.001 * number
    made = [imu, odometry, PoseArray(poses=[Pose()])]
    made = [scan, *made] if sys.argv[1] == "first" else [*made, scan]
    for message in made:
        message.header.stamp = Time(sec=step // 20, nanosec=step % 20 * 50_000_000)
    return made


print('"up"', flush=True)
for step in range(10**9):
    for message in messages(step):
        publishers[type(message)].publish(message)
    time.sleep(PERIOD / 2)  # twice real time
