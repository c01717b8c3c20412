"""The command ``rover-rl robot``."""

from __future__ import annotations

import math
import signal
import threading
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

from rover_rl.checks import check_at_least, check_positive, check_seed
from rover_rl.cli.help_text import FLAT
from rover_rl.cli.options import OptionsOfRobot, read_env
from rover_rl.cli.ros_arguments import RosArguments, node_name, renamed
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.imperfections import imperfect
from rover_rl.envs.sensors.suite import own_sensors
from rover_rl.robots.options import RobotOptions
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.settings import Connection

MAX_RATE = 1000.0  # largest simulation speed, as a multiple of real time
MAX_BEAMS = 16_383  # largest number of rays that Bullet casts in one call


@dataclass(frozen=True)
class Robot:
    """Run a simulated ROS 2 robot that publishes scan, IMU, odometry, pose array, tf, clock and images.

    Drive it with backend="ros2", rover-rl drive, or any ROS 2 tool. Ctrl-C stops it.

    ROS's own remaps end the line: --ros-args -r /scan:=/front/scan -r __ns:=/robot1 -r __node:=rover (docs/ros2.md).
    """

    shown: ClassVar = {
        Connection: {*Connection.__dataclass_fields__} - {"timeout"},
        Ros2Settings: {"command", "odometry_topic", "pose_topic", "reset_topic", "lidar_yaw", "tf_topic"}
        | {"tf_static_topic", "clock_topic", "description_topic", "map_topic"},
    }

    env: Path | None = None
    """YAML file of EnvConfig, or a run's config.yaml, for world, robot, simulator and topics. Options override it."""
    world: str | None = None
    """World that the rover is in: inspect, moon, maze ("maze:7": of seed 7), or module:attribute. Default: maze."""
    rate: float = 1.0
    """Simulation speed as a multiple of real time."""
    seed: int = 0
    """Seed of the start pose."""
    robot: str | None = None
    """Robot: a name, a URDF file, or module:attribute. Default: rover_zero."""
    robot_options: OptionsOfRobot = field(default_factory=RobotOptions)
    backend: str | None = None
    """Simulator: bullet, warp, mujoco (an extra), or module:attribute. Default: bullet."""
    physics: str | None = None
    """Preset of the physics: default, accurate or fast of Bullet, full or planar of Warp (docs/simulators.md)."""
    lidar_beams: int = 640
    """Number of lidar beams in a full turn; the original environment has 640."""
    lidar_view: float | None = None
    """Field of view of the lidar, centered straight ahead, degrees. Default: that of the robot."""
    harsh: bool = False
    """Delay, drop and distort what is published, delay the commands, and vary friction, mass and motors, as
    rover-rl train --randomize harsh does (docs/randomization.md)."""
    sensors: tuple[str, ...] = ()
    """Sensors whose readings are published, too: depth, colors, lidar3d (a point cloud), heights (an elevation map), or
    one of the same kind with settings. Those of --env are."""
    map: bool = False
    """Publish the obstacles of the world as a map, a nav_msgs/OccupancyGrid on /map."""
    localize: bool = True
    """Tell on /tf where odom is in the frame world, as a localizer does. With --no-localize, another node tells where
    it is in the frame map, such as slam_toolbox or amcl."""
    connection: Annotated[Connection, FLAT] = field(default_factory=Connection)
    settings: Annotated[Ros2Settings, FLAT] = field(default_factory=Ros2Settings)
    ros_args: RosArguments = field(default_factory=dict)

    def __call__(self) -> int:
        check_positive(MAX_RATE, rate=self.rate)
        check_at_least(1, MAX_BEAMS, lidar_beams=self.lidar_beams)
        if self.lidar_view is not None:
            check_positive(360, lidar_view=self.lidar_view)
        check_seed(self.seed)
        described = self._environment()
        from rover_rl.algos.evaluation.episodes import draw_episodes
        from rover_rl.envs.served_rover import ServedRover
        from rover_rl.robots import get_robot
        from rover_rl.sims.ros2.robot import RobotNode, world_map
        from rover_rl.sims.ros2.transport import make_transport
        from rover_rl.worlds import get_world

        get_world(described.worlds[0])  # an unknown world is told before an unknown robot
        described = described.fitted()
        stop = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
        world, robot = get_world(described.worlds[0]), get_robot(described.robot)
        connection, settings = renamed(self.ros_args, described.connection, self.settings)
        x, y, yaw = draw_episodes(world, 1, self.seed, robot=robot).start[0].tolist()
        transport = make_transport("dds", node_name(self.ros_args, robot.name))
        if self.lidar_view is not None:
            robot = replace(robot, lidar_view=math.radians(self.lidar_view))
        lidar, shown = replace(described.lidar, beams=self.lidar_beams), world_map(world) if self.map else None
        rover = ServedRover(replace(described, world=world, robot=robot, lidar=lidar, seed=self.seed))
        try:
            node = RobotNode(rover, transport, settings, connection, (x, y, yaw), self.localize, shown)
            topics = f"publishes {connection.scan_topic}, receives {connection.cmd_vel_topic}"
            print(f"Rover in {described.world_names[0]} on ROS 2: {topics}", flush=True)
            node.run(self.rate, stop)
        finally:
            transport.close()
            rover.close()
        return 0

    def _environment(self) -> EnvConfig:
        config = EnvConfig(world="maze") if self.env is None else read_env(self.env)
        parts = {"world": self.world, "robot": self.robot, "backend": self.backend, "physics": self.physics}
        changes: dict[str, Any] = {name: part for name, part in parts.items() if part}
        if self.connection != Connection():
            changes["connection"] = self.connection
        there = own_sensors(config.sensors)
        sensors = (*config.sensors, *(name for name in self.sensors if name not in there))
        described = replace(config, robot_options=self.robot_options, sensors=sensors, **changes)
        return imperfect(described, "harsh") if self.harsh else described
