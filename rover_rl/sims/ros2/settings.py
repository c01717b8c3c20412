"""Settings of the ROS 2 backend. Does not import PyTorch."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

from rover_rl.checks import NAME, check_positive, check_topics
from rover_rl.sims.settings import CONTROL_DT, MIN_REVERSAL

PoseSource: TypeAlias = Literal["pose_array", "pose_stamped", "odometry", "pose_with_covariance", "tf", "wheels"]
PoseReset: TypeAlias = Literal["auto", "ign", "gz", "topic", "manual", "none"]
Command: TypeAlias = Literal["twist", "twist_stamped", "none"]
TransportName: TypeAlias = Literal["dds", "rclpy"]
BAG = ".mcap"  # suffix of the bags of ``rover-rl drive``


@dataclass(frozen=True)
class Ros2Settings:
    """Settings of the connection to a live rover. The default topics are those of the original environment.

    Raises ``ValueError`` if a choice is unknown, a number is out of range, or ROS 2 does not allow a name.

    Example:
        With a rover that runs:

        >>> env = RoverEnv(backend=Ros2Settings(pose="wheels", reset="manual", lidar_yaw=0.0))  # doctest: +SKIP
    """

    transport: TransportName = "dds"
    """ROS 2 client: dds needs no ROS installation (extra ros2), rclpy that of PyPI or of a sourced ROS."""
    odometry_topic: str = "/odometry/wheels"
    """Topic of the wheel odometry, a nav_msgs/Odometry: velocities, and the pose with pose="wheels"."""
    pose: PoseSource = "pose_array"
    """Source of the pose: pose_array, the first pose of a geometry_msgs/PoseArray with the heading of the IMU, as in
    the original; pose_stamped, odometry or pose_with_covariance, pose and heading of a localizer's
    geometry_msgs/PoseStamped, nav_msgs/Odometry or geometry_msgs/PoseWithCovarianceStamped; tf, the transforms from
    map_frame to frame_id on /tf and /tf_static; wheels, wheel odometry, aligned with the start pose of the episode at
    each reset (docs/ros2.md)."""
    pose_topic: str = "/rover/pose_array"
    """Topic of the pose; unused with pose="wheels" and pose="tf"."""
    tf_topic: str = "/tf"
    """Topic of the transforms, a tf2_msgs/TFMessage."""
    tf_static_topic: str = "/tf_static"
    """Topic of the transforms that never change."""
    clock_topic: str = "/clock"
    """Topic of the time of a simulation, a rosgraph_msgs/Clock."""
    description_topic: str = "/robot_description"
    """Topic of the URDF of a simulated robot, a std_msgs/String."""
    map_topic: str = "/map"
    """Topic of the map of its world, a nav_msgs/OccupancyGrid."""
    plan_topic: str = "/plan"
    """Topic of the route that a policy plans, a nav_msgs/Path, for policies that plan one."""
    seen_map_topic: str = "/seen_map"
    """Topic of the map of what a policy has seen, a nav_msgs/OccupancyGrid, for policies with a map."""
    movers_topic: str = "/tracked_movers"
    """Topic of what a policy sees moving, a visualization_msgs/MarkerArray, for policies that track it."""
    diagnostics_topic: str = "/diagnostics"
    """Topic of rates, ages, decision times and the reason of a stop, a diagnostic_msgs/DiagnosticArray."""
    map_frame: str = "map"
    """Frame of tf that is that of the world, with pose="tf"."""
    command: Command = "twist"
    """Message type of the commands: twist or twist_stamped; none sends nothing (dry run)."""
    frame_id: str = "base_link"
    """Frame of the robot: of stamped commands, in tf, and of elevation maps and points that are in it."""
    give_way: bool = False
    """While another node sends commands, send none, until 0.5 s after its last. Default: stop, and name the node."""
    lidar_yaw: float = math.pi
    """Direction in which the lidar's zero angle points, counter-clockwise from straight ahead, rad. The default is
    backward: the original rover's lidar is mounted turned by 180 degrees. Most others face forward: 0."""
    lidar_inverted: bool = False
    """The lidar hangs upside down: it is rolled by pi before it is turned by lidar_yaw."""
    max_invalid: float = 0.1
    """Largest share of invalid readings (NaN, outside of the scan's own limits, or missing) in a usable scan."""
    unseen_range: float = 1.0
    """Range of directions that no valid beam covers, m. It is neither free space nor a collision. With inf, they have
    no return, as in training with hidden beams. The rover never drives towards them."""
    max_speed: float | None = None
    """Largest forward speed of a command, m/s. Default of the four limits: as in training, else the robot's."""
    max_yaw_rate: float | None = None
    """Largest yaw rate of a command, rad/s."""
    max_acceleration: float | None = None
    """Largest change of the forward speed, m/s^2. Stops are sent immediately."""
    max_yaw_acceleration: float | None = None
    """Largest change of the yaw rate, rad/s^2."""
    min_reversal: float = MIN_REVERSAL
    """Smallest yaw rate that changes the turning direction, rad/s. With less, the rover stops turning."""
    reset: PoseReset = "auto"
    """Means of moving the rover to its start: ign (Gazebo Fortress) or gz (Harmonic), Gazebo's command; topic, a
    geometry_msgs/PoseStamped; manual, a prompt to a person on the terminal; none: episodes start where the rover is;
    auto: topic if a node subscribes to reset_topic, else ign or gz if it is installed, else none."""
    model: str = "rover_zero4wd"
    """Name of the rover in Gazebo."""
    reset_topic: str = "/rover/set_pose"
    """Topic of poses to move the rover to, geometry_msgs/PoseStamped in the frame world."""
    reset_timeout: float = 5.0
    """Time limit for the rover to come to rest at the start pose, s."""
    pose_tolerance: float = 0.3
    """Largest distance from the start pose, m."""
    settle: float = 0.2
    """Duration of rest before an episode begins, s."""
    step_timeout: float = 1.0
    """Time without a usable scan after which the rover counts as lost, s. It is stopped earlier, after 0.25 s."""
    node: str = "rover_rl"
    """Name of the node, after its namespace if it has one: /robot1/rover_rl."""
    control_dt: float = CONTROL_DT
    """Control step in training, s. Scans that come sooner than three quarters of it after the last are skipped."""

    def __post_init__(self) -> None:
        values = vars(self)
        check_topics(**{name: topic for name, topic in values.items() if name.endswith("_topic")})
        if not (isinstance(self.node, str) and re.fullmatch(f"/?{NAME}(/{NAME})*", self.node)):
            raise ValueError(f"node must be letters, digits and _, and begin with no digit, got {self.node!r}")
        limits = "max_speed", "max_yaw_rate", "max_acceleration", "max_yaw_acceleration"
        for name in (*limits, "reset_timeout", "pose_tolerance", "settle", "step_timeout", "control_dt"):
            if values[name] is not None and not 0 < values[name] < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {values[name]}")
        check_positive(math.inf, unseen_range=self.unseen_range)
        if not 0 <= self.min_reversal < math.inf:
            raise ValueError(f"min_reversal must not be negative, got {self.min_reversal}")
        if not math.isfinite(self.lidar_yaw):
            raise ValueError(f"lidar_yaw must be a finite angle in rad, got {self.lidar_yaw}")
        if not 0 <= self.max_invalid < 1:
            raise ValueError(f"max_invalid must be at least 0 and less than 1, got {self.max_invalid}")
        choices = {"transport": TransportName, "pose": PoseSource, "command": Command, "reset": PoseReset}
        for name, choice in choices.items():
            if values[name] not in get_args(choice):
                raise ValueError(f"{name} must be one of {get_args(choice)}, got {values[name]!r}")


@dataclass(frozen=True)
class BagTopics:
    """Topics and frames of a bag that rover-rl drive has not recorded; its own bags need none of them.

    The defaults are those of a bag of rover-rl robot. A drive is what lies between a goal and the pose within the
    success distance, the next goal, or the end of the bag. Raises ValueError if ROS 2 does not allow a name.
    """

    scan: str = "/scan"
    """Topic of the scans, sensor_msgs/LaserScan, which films show; a bag needs none."""
    pose: str = Ros2Settings.pose_topic
    """Topic of the pose: geometry_msgs/PoseStamped, PoseWithCovarianceStamped, PoseArray (its first pose),
    nav_msgs/Odometry, or /tf."""
    goal: str = "/goal_pose"
    """Topic of the goals, geometry_msgs/PoseStamped. The same goal again is no new one."""
    odometry: str = Ros2Settings.odometry_topic
    """Topic of the wheel odometry, nav_msgs/Odometry, in bags of rover-rl drive: data sets have its velocities."""
    lidar_yaw: float = Ros2Settings.lidar_yaw
    """Direction in which the lidar's zero angle points, counter-clockwise from straight ahead, rad; 0 faces forward."""
    map_frame: str = Ros2Settings.map_frame
    """Frame of tf that is that of the world, with /tf."""
    base_frame: str = Ros2Settings.frame_id
    """Frame of tf that is that of the robot, with /tf."""

    def __post_init__(self) -> None:
        check_topics(scan=self.scan, pose=self.pose, goal=self.goal, odometry=self.odometry)
        if not math.isfinite(self.lidar_yaw):
            raise ValueError(f"lidar_yaw must be a finite angle in rad, got {self.lidar_yaw}")
