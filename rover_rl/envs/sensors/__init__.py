"""Sensors: the entries of an observation.

``base``: ``Sensor``, what a sensor is, and ``SensorInput``, what it reads from. ``standard``: lidar, pose, IMU, target
and wheel odometry. ``route``: the way to the goal on a map of what the lidar has seen. ``robot``: size and
limits of the robot. ``forces``: contact forces and motor torques. ``scan_pose``: where a late scan was taken.
``lidar_mask``: which readings beams cover. ``suite``: sensors by name.
"""
