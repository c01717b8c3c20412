"""Sensors: the entries of an observation, a file each.

``base``: ``Sensor``, what a sensor is, and ``SensorInput``, what it reads from.
``lidar``, ``imu``, ``wheel_odometry``, ``pose``, ``target``, ``route``: the sensors of every rover.
``suite``: the sensors of an environment and of a policy, and their readings. ``names``: the names of their entries.
``surroundings``: what sensors can measure of the worlds.

Importing this module does not import PyTorch.
"""

from __future__ import annotations

BUILT_IN = {
    "lidar": "rover_rl.envs.sensors.lidar:Lidar",
    "pose": "rover_rl.envs.sensors.pose:Pose",
    "imu": "rover_rl.envs.sensors.imu:Imu",
    "target": "rover_rl.envs.sensors.target:Target",
    "velocities": "rover_rl.envs.sensors.wheel_odometry:WheelOdometry",
    "route": "rover_rl.envs.sensors.route:Route",
}
"""Class of each sensor of every rover, by the key of its entry, in the order of the observation."""
