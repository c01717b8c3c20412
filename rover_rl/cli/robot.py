"""The command ``rover-rl robot``."""

from __future__ import annotations

import math
import signal
import threading
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from rover_rl.checks import check_at_least, check_positive, check_seed
from rover_rl.cli.policies import ROBOT_OPTIONS, read_env
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.imperfections import imperfect
from rover_rl.envs.sensors.suite import CONTACT, DEPTH, EFFORT, HEIGHTS, LIDAR3D, own_sensors
from rover_rl.robots.options import RobotOptions
from rover_rl.sims.ros2.settings import Ros2Settings

MAX_RATE = 1000.0
"""Largest simulation speed, as a multiple of real time."""
MAX_BEAMS = 16_383
"""Largest number of rays that Bullet casts in one call."""


@dataclass(frozen=True)
class RobotCommand:
    """Run a simulated ROS 2 robot that publishes scan, IMU, odometry, pose array, clock and images.

    Drive it with backend="ros2", rover-rl drive, or any ROS 2 tool. Ctrl-C stops it.
    """

    env: Path | None = None
    """YAML file of EnvConfig, or a run's config.yaml, for world, robot, simulator and topics. Options override it."""
    world: str | None = None
    """World that the rover is in: inspect, moon, maze ("maze:7" is the maze of seed 7), or module:attribute.
    Default: maze."""
    rate: float = 1.0
    """Simulation speed as a multiple of real time."""
    seed: int = 0
    """Seed of the start pose."""
    robot: str | None = None
    """Robot: a name, a URDF file, or module:attribute. Default: rover_zero."""
    robot_options: Annotated[RobotOptions, ROBOT_OPTIONS] = field(default_factory=RobotOptions)
    """What a URDF does not tell of the robot."""
    backend: str | None = None
    """Simulator: bullet, warp, mujoco (an extra), or module:attribute. Default: bullet."""
    physics: str | None = None
    """Preset of Bullet's physics: default, accurate or fast (docs/simulators.md#bullet-speed-and-accuracy)."""
    lidar_beams: int = 640
    """Number of lidar beams in a full turn; the original environment has 640."""
    harsh: bool = False
    """Delay, drop and distort what is published, delay the commands, and vary friction, mass and motors, as
    rover-rl train --randomize harsh does (docs/randomization.md)."""
    camera: tuple[Literal["depth", "colors"], ...] | None = None
    """Publish the images of the sensors depth and colors, too; without a name, those of depth. A robot whose --env has
    such cameras publishes theirs."""
    elevation_map: bool = False
    """Publish the ground around the rover too, as the sensor heights reads it. A robot whose --env has height scans
    publishes theirs."""
    points: bool = False
    """Publish a point cloud too, that of the sensor lidar3d. A robot whose --env has 3D lidars publishes theirs."""
    effort: bool = False
    """Publish the torques of the wheel motors too, which the sensor effort reads."""
    contact: bool = False
    """Publish the contacts too, which the sensor contact reads."""
    lidar_view: float | None = None
    """Field of view of the lidar, centered straight ahead, degrees. Default: that of the robot."""
    scan_topic: str | None = None
    """Topic that the sensor_msgs/LaserScan is published to. Default: /scan."""
    imu_topic: str | None = None
    """Topic that the sensor_msgs/Imu is published to. Default: /imu/data."""
    camera_topic: str | None = None
    """Topic that the sensor_msgs/Image of the depth camera is published to. Default: /camera/image_raw. On one that
    ends in /compressed or /compressedDepth, it is a sensor_msgs/CompressedImage."""
    color_topic: str | None = None
    """Topic of the color camera, likewise. Default: /camera/color/image_raw."""
    elevation_topic: str | None = None
    """Topic that the grid_map_msgs/GridMap is published to. Default: /elevation_map."""
    points_topic: str | None = None
    """Topic that the sensor_msgs/PointCloud2 is published to. Default: /points."""
    joint_topic: str | None = None
    """Topic that the sensor_msgs/JointState is published to. Default: /joint_states."""
    contact_topic: str | None = None
    """Topic that the ros_gz_interfaces/Contacts is published to. Default: /contacts."""
    cmd_vel_topic: str | None = None
    """Topic that commands are received from, geometry_msgs/Twist. Default: /cmd_vel."""
    stamped: bool = False
    """Receive TwistStamped instead of Twist."""
    odometry_topic: str = Ros2Settings.odometry_topic
    """Topic that the wheel odometry is published to, nav_msgs/Odometry."""
    pose_topic: str = Ros2Settings.pose_topic
    """Topic that the geometry_msgs/PoseArray is published to."""
    reset_topic: str = Ros2Settings.reset_topic
    """Topic that poses to move the rover to are received from, geometry_msgs/PoseStamped in the frame world."""

    def __call__(self) -> int:
        """Runs the robot until it is interrupted."""
        check_positive(MAX_RATE, rate=self.rate)
        check_at_least(1, MAX_BEAMS, lidar_beams=self.lidar_beams)
        if self.lidar_view is not None:
            check_positive(360, lidar_view=self.lidar_view)
        check_seed(self.seed)
        described = self._environment()
        from rover_rl.algos.evaluation.episodes import draw_episodes
        from rover_rl.envs.served_rover import ServedRover
        from rover_rl.robots import get_robot
        from rover_rl.sims.ros2.robot import RobotNode
        from rover_rl.sims.ros2.transport import make_transport
        from rover_rl.worlds import get_world

        # An unknown world is told before an unknown robot.
        get_world(described.worlds[0])
        described = described.fitted()
        stop = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        world, robot, connection = get_world(described.worlds[0]), get_robot(described.robot), described.connection
        start = draw_episodes(world, 1, self.seed, robot=robot).start[0].tolist()
        transport = make_transport("dds", robot.name)
        settings = Ros2Settings(
            odometry_topic=self.odometry_topic,
            pose_topic=self.pose_topic,
            reset_topic=self.reset_topic,
            command="twist_stamped" if self.stamped else "twist",
        )
        view = robot.lidar_view if self.lidar_view is None else math.radians(self.lidar_view)
        lidar, kind = replace(described.lidar, beams=self.lidar_beams), replace(robot, lidar_view=view)
        rover = ServedRover(replace(described, world=world, robot=kind, lidar=lidar, seed=self.seed))
        try:
            node = RobotNode(rover, transport, robot.lidar_range, settings, connection, tuple(start), view)
            print(
                f"Rover in {described.world_names[0]} on ROS 2: publishes {connection.scan_topic}, receives "
                f"{connection.cmd_vel_topic}",
                flush=True,
            )
            node.run(self.rate, stop)
        finally:
            transport.close()
            rover.close()
        return 0

    def _environment(self) -> EnvConfig:
        """Returns the description of the environment: the file's, else the default, with the options on top."""
        config = EnvConfig(world="maze") if self.env is None else read_env(self.env)
        topics = {"scan_topic": self.scan_topic, "imu_topic": self.imu_topic, "cmd_vel_topic": self.cmd_vel_topic}
        topics |= {"camera_topic": self.camera_topic, "color_topic": self.color_topic}
        topics |= {"elevation_topic": self.elevation_topic, "points_topic": self.points_topic}
        topics |= {"joint_topic": self.joint_topic, "contact_topic": self.contact_topic}
        given: dict[str, Any] = {name: topic for name, topic in topics.items() if topic}
        parts = {"world": self.world, "robot": self.robot, "backend": self.backend, "physics": self.physics}
        changes: dict[str, Any] = {name: part for name, part in parts.items() if part}
        connection = replace(config.connection, **given)
        # The flag alone is the depth camera.
        asked = [] if self.camera is None else [*(self.camera or (DEPTH,))]
        asked += [LIDAR3D] * self.points + [HEIGHTS] * self.elevation_map + [EFFORT] * self.effort
        asked += [CONTACT] * self.contact
        there = own_sensors(config.sensors)
        changes["sensors"] = (*config.sensors, *(name for name in asked if name not in there))
        described = replace(config, connection=connection, robot_options=self.robot_options, **changes)
        return imperfect(described, "harsh") if self.harsh else described
