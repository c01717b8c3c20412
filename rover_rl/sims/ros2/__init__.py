"""ROS 2 backend: a real rover, one in Gazebo, or ``rover-rl robot``."""

from __future__ import annotations

from rover_rl.sims.ros2.errors import PoseResetError, RobotLostError
from rover_rl.sims.ros2.settings import Ros2Settings

__all__ = ["PoseResetError", "RobotLostError", "Ros2Settings"]
