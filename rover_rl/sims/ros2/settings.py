"""Settings of the ROS 2 backend."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

if TYPE_CHECKING:
    import torch

    from rover_rl.sims.connection import Connection
    from rover_rl.sims.robots import Robot
    from rover_rl.sims.ros2.simulator import Ros2Simulator
    from rover_rl.sims.worlds import World

PoseSource: TypeAlias = Literal["pose_array", "pose_stamped", "odometry", "wheels"]
PoseReset: TypeAlias = Literal["ign", "gz", "topic", "manual", "none"]
Command: TypeAlias = Literal["twist", "twist_stamped", "none"]
TransportName: TypeAlias = Literal["dds", "rclpy"]


@dataclass(frozen=True)
class Ros2Settings:
    """How a live rover is reached. The defaults are the original's: Gazebo Fortress, and its rover's topics.

    Scan, IMU and command topics are the environment's own arguments.

    Example:
        >>> env = RoverEnv(backend=Ros2Settings(pose="wheels", reset="manual", lidar_yaw=0.0))  # a real rover

    Args:
        transport: ``"dds"`` needs no ROS (package ``cyclonedds``); ``"rclpy"`` is a node of a ROS that is sourced.
        odometry_topic: ``nav_msgs/Odometry`` of the wheels: velocities, and the pose where ``pose="wheels"``.
        pose: where the pose comes from: ``"pose_array"``, the first of a ``geometry_msgs/PoseArray``, its heading from
            the IMU, as in the original; ``"pose_stamped"`` or ``"odometry"``, pose and heading of a localiser's
            ``geometry_msgs/PoseStamped`` or ``nav_msgs/Odometry``; ``"wheels"``, wheel odometry alone, which is taken
            to be where the episode starts at each reset.
        pose_topic: of the pose, unless it is the wheels'.
        command: ``"twist"`` or ``"twist_stamped"``, what the rover's driver takes; ``"none"`` sends nothing, to try it
            out.
        frame_id: of stamped commands.
        lidar_yaw: where the zero of the scan's angles points, counter-clockwise from straight ahead, rad. The
            original's lidar looks backwards; most others forward: 0.
        reset: what puts the rover back: ``"ign"`` (Gazebo Fortress) or ``"gz"`` (Harmonic), by its command;
            ``"topic"``, a ``geometry_msgs/PoseStamped``; ``"manual"``, a person, who is asked on the terminal;
            ``"none"``, nobody: episodes start where the rover is.
        model: the rover's name in Gazebo.
        reset_topic: of ``reset="topic"``.
        reset_timeout: once put back, the rover has to rest there in this time, s.
        pose_tolerance: how far from where it was put the rover may be, m.
        settle: the rover has to be at rest for so long before an episode begins, s.
        step_timeout: without a scan for so long the rover is lost, s.
        node: name of the node.
    """

    transport: TransportName = "dds"
    odometry_topic: str = "/odometry/wheels"
    pose: PoseSource = "pose_array"
    pose_topic: str = "/rover/pose_array"
    command: Command = "twist"
    frame_id: str = "base_link"
    lidar_yaw: float = math.pi
    reset: PoseReset = "ign"
    model: str = "rover_zero4wd"
    reset_topic: str = "/rover/set_pose"
    reset_timeout: float = 5.0
    pose_tolerance: float = 0.3
    settle: float = 0.2
    step_timeout: float = 1.0
    node: str = "rover_rl"

    def __post_init__(self) -> None:
        for name in ("reset_timeout", "pose_tolerance", "settle", "step_timeout"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}")
        choices = {"transport": TransportName, "pose": PoseSource, "command": Command, "reset": PoseReset}
        for name, choice in choices.items():
            allowed = get_args(choice)
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {allowed}, got {getattr(self, name)!r}")

    def make(
        self,
        *,
        worlds: Sequence[World],
        robot: Robot,
        lidar_beams: int,
        connection: Connection | None = None,
        device: torch.device | None = None,
    ) -> Ros2Simulator:
        """The simulator with these settings: see :func:`rover_rl.sims.make_simulator`."""
        from rover_rl.sims.ros2.simulator import Ros2Simulator

        return Ros2Simulator(worlds, robot, lidar_beams, self, connection)
