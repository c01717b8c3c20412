"""A rover of ROS 2's own rclpy whose IMU and odometry tell the number of their step: heading 0.01 n, speed 0.001 n.

It takes a step, and publishes, when it receives a command, or after a second without one: not faster than who drives it
reads. Of 50 steps each, the scan is published before the others and after them.
"""

from __future__ import annotations

import math

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseArray, Twist
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu, LaserScan

rclpy.init()
node = rclpy.create_node("numbered")
topics = {LaserScan: "/scan", Imu: "/imu/data", Odometry: "/odometry/wheels", PoseArray: "/rover/pose_array"}
publishers = {kind: node.create_publisher(kind, topic, 10) for kind, topic in topics.items()}
node.create_subscription(Twist, "/cmd_vel", lambda message: None, 10)
scans = np.random.default_rng(0).uniform(1.0, 10.0, (64, 640)).astype(np.float32)

print('"up"', flush=True)
for step in range(10**9):
    scan, imu, odometry = LaserScan(), Imu(), Odometry()
    scan.angle_min, scan.angle_increment = -math.pi, 2 * math.pi / 640
    scan.range_min, scan.range_max = 0.1, 12.0
    scan.ranges.frombytes(scans[step % 64].tobytes())
    imu.orientation.z, imu.orientation.w = math.sin(0.005 * step), math.cos(0.005 * step)
    odometry.twist.twist.linear.x = 0.001 * step
    others = [imu, odometry, PoseArray(poses=[Pose()])]
    for message in [scan, *others] if step // 50 % 2 else [*others, scan]:
        message.header.stamp = Time(sec=step // 20, nanosec=step % 20 * 50_000_000)
        publishers[type(message)].publish(message)
    rclpy.spin_once(node, timeout_sec=1.0)
