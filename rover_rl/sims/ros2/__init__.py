"""ROS 2 backend: a real rover, one in Gazebo, or ``rover-rl robot``."""

from rover_rl.sims.ros2.settings import Ros2Settings

__all__ = ["PoseResetError", "RobotLostError", "Ros2Settings"]


class RobotLostError(ConnectionError):
    """A live rover no longer sends usable sensor data. A stop command was sent."""


class PoseResetError(OSError):
    """A live rover could not be moved to the start pose of an episode."""
