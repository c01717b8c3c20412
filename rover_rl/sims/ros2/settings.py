"""Settings of the ROS 2 backend."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

from rover_rl.sims.ros2.limits import CommandLimits

if TYPE_CHECKING:
    from rover_rl.sims.robots import Robot

PoseSource: TypeAlias = Literal["pose_array", "pose_stamped", "odometry", "wheels"]
PoseReset: TypeAlias = Literal["auto", "ign", "gz", "topic", "manual", "none"]
Command: TypeAlias = Literal["twist", "twist_stamped", "none"]
TransportName: TypeAlias = Literal["dds", "rclpy"]


@dataclass(frozen=True)
class Ros2Settings:
    """Settings of the connection to a live rover.

    The defaults are the original environment's topics. Topics of scan, IMU and command are the environment's own
    arguments.

    Example:
        >>> env = RoverEnv(backend=Ros2Settings(pose="wheels", reset="manual", lidar_yaw=0.0))  # a real rover

    Args:
        transport: ``"dds"`` needs no ROS (package ``cyclonedds``); ``"rclpy"`` is a node of a ROS that is sourced.
        odometry_topic: ``nav_msgs/Odometry`` of the wheels: velocities, and the pose where ``pose="wheels"``.
        pose: source of the pose: ``"pose_array"``, the first of a ``geometry_msgs/PoseArray``, its heading from the
            IMU, as in the original; ``"pose_stamped"`` or ``"odometry"``, pose and heading of a localiser's
            ``geometry_msgs/PoseStamped`` or ``nav_msgs/Odometry``; ``"wheels"``, wheel odometry alone, which is taken
            to be where the episode starts at each reset.
        pose_topic: topic of the pose, unless it is the wheels'.
        command: ``"twist"`` or ``"twist_stamped"``, what the rover's driver takes; ``"none"`` sends nothing, to try it
            out.
        frame_id: frame of stamped commands.
        lidar_yaw: direction of the zero of the scan's angles, counter-clockwise from straight ahead, rad. The
            original's lidar looks backwards; most others forward: 0.
        max_invalid: share of a scan's readings that may be invalid (NaN, outside of the scan's own limits, or missing),
            from 0 to 1. A scan with more of them counts as no scan.
        unseen_range: reading of directions that no valid beam covers, m. It is neither free nor a collision. The rover
            is never driven towards these directions.
        max_speed: highest forward speed that is sent, m/s; ``None``: the robot's.
        max_yaw_rate: highest yaw rate that is sent, rad/s; ``None``: the robot's.
        max_acceleration: largest change of the forward speed, m/s^2; ``None``: the robot's. Stops are sent at once.
        max_yaw_acceleration: largest change of the yaw rate, rad/s^2; ``None``: the robot's.
        reset: what moves the rover to the start of an episode: ``"ign"`` (Gazebo Fortress) or ``"gz"`` (Harmonic), by
            its command; ``"topic"``, a ``geometry_msgs/PoseStamped``; ``"manual"``, a person, who is asked on the
            terminal; ``"none"``, nothing: episodes start where the rover is; ``"auto"``: ``"topic"`` if a node listens
            to ``reset_topic``, else ``"ign"`` or ``"gz"`` if its command is installed, else ``"none"``.
        model: the rover's name in Gazebo.
        reset_topic: topic of ``reset="topic"``.
        reset_timeout: time in which the rover must come to rest where it was put, s.
        pose_tolerance: distance that it may be away from there, m.
        settle: time for which the rover must be at rest before an episode begins, s.
        step_timeout: time without a scan after which the rover is lost, s. It is stopped earlier: after 0.25 s.
        node: name of the node.

    Raises:
        ValueError: for an unknown choice, or a number out of its range.
    """

    transport: TransportName = "dds"
    odometry_topic: str = "/odometry/wheels"
    pose: PoseSource = "pose_array"
    pose_topic: str = "/rover/pose_array"
    command: Command = "twist"
    frame_id: str = "base_link"
    lidar_yaw: float = math.pi
    max_invalid: float = 0.1
    unseen_range: float = 1.0
    max_speed: float | None = None
    max_yaw_rate: float | None = None
    max_acceleration: float | None = None
    max_yaw_acceleration: float | None = None
    reset: PoseReset = "auto"
    model: str = "rover_zero4wd"
    reset_topic: str = "/rover/set_pose"
    reset_timeout: float = 5.0
    pose_tolerance: float = 0.3
    settle: float = 0.2
    step_timeout: float = 1.0
    node: str = "rover_rl"

    def __post_init__(self) -> None:
        positive = ("unseen_range", "reset_timeout", "pose_tolerance", "settle", "step_timeout")
        limits = [name for name in _LIMITS if getattr(self, name) is not None]
        for name in (*positive, *limits):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")
        if not math.isfinite(self.lidar_yaw):
            raise ValueError(f"lidar_yaw must be a finite angle in rad, got {self.lidar_yaw}")
        if not 0 <= self.max_invalid < 1:
            raise ValueError(f"max_invalid must be at least 0 and less than 1, got {self.max_invalid}")
        choices = {"transport": TransportName, "pose": PoseSource, "command": Command, "reset": PoseReset}
        for name, choice in choices.items():
            allowed = get_args(choice)
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {allowed}, got {getattr(self, name)!r}")

    def limits(self, robot: Robot) -> CommandLimits:
        """The limits of what is sent to ``robot``: its own, unless these settings have others."""
        given = {limit: getattr(self, name) for name, limit in _LIMITS.items() if getattr(self, name) is not None}
        return replace(CommandLimits.of(robot), **given)


_LIMITS = {
    "max_speed": "speed",
    "max_yaw_rate": "yaw_rate",
    "max_acceleration": "acceleration",
    "max_yaw_acceleration": "yaw_acceleration",
}
"""Settings that are limits of the command, and what :class:`~rover_rl.sims.ros2.limits.CommandLimits` calls them."""
