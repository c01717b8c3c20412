"""``rover-rl robot``."""

from __future__ import annotations

import math
import signal
import threading
from dataclasses import dataclass
from types import FrameType

from rover_rl.checks import check_at_least, check_positive, check_seed
from rover_rl.envs.config import DEFAULT_PHYSICS, EnvConfig
from rover_rl.sims.connection import Connection
from rover_rl.sims.ros2.settings import Ros2Settings

MAX_RATE = 1000.0
"""Fastest simulation that can be asked for, as a multiple of real time."""
MAX_BEAMS = 16_383
"""Rays that Bullet casts in one call."""


@dataclass(frozen=True)
class RobotCommand:
    """Run a simulated ROS 2 robot that publishes scan, IMU, odometry, pose array and clock.

    Drive it with backend="ros2", rover-rl drive, or any ROS 2 tool. Ctrl-C ends it.
    """

    world: str = "maze"
    """World that the rover is in: inspect, moon or maze; "maze:7" is the maze of seed 7."""
    rate: float = 1.0
    """Simulation speed as a multiple of real time."""
    seed: int = 0
    """Seed of the place where the rover starts."""
    robot: str = "rover_zero"
    """Robot: rover_zero, or module:attribute."""
    backend: str = EnvConfig.backend
    """Simulator: bullet, warp (extra warp), or module:attribute."""
    physics: str = EnvConfig.physics
    """Preset of Bullet's physics: default, accurate or fast (docs/physics.md)."""
    lidar_beams: int = 640
    """Beams in a full turn of the lidar; the original's has 640."""
    lidar_view: float = 360.0
    """Angle that the lidar covers, half of it to either side of straight ahead, degrees."""
    scan_topic: str = Connection.scan_topic
    """Where it publishes sensor_msgs/LaserScan."""
    imu_topic: str = Connection.imu_topic
    """Where it publishes sensor_msgs/Imu."""
    cmd_vel_topic: str = Connection.cmd_vel_topic
    """Where it takes geometry_msgs/Twist."""
    odometry_topic: str = Ros2Settings.odometry_topic
    """Where it publishes nav_msgs/Odometry of its wheels."""
    pose_topic: str = Ros2Settings.pose_topic
    """Where it publishes geometry_msgs/PoseArray."""
    reset_topic: str = Ros2Settings.reset_topic
    """Where it takes a geometry_msgs/PoseStamped, and is put there."""

    def __call__(self) -> int:
        """Runs until it is interrupted.

        Raises:
            ValueError: for an option out of its range, before anything is published.
        """
        self._check()
        from rover_rl.algos.evaluation.episodes import draw_episodes
        from rover_rl.sims import make_simulator
        from rover_rl.sims.robots import get_robot
        from rover_rl.sims.ros2.robot import RobotNode
        from rover_rl.sims.ros2.transport import make_transport
        from rover_rl.sims.worlds import get_world

        stop = threading.Event()

        def end(number: int, frame: FrameType | None) -> None:
            stop.set()

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, end)
        world, robot = get_world(self.world), get_robot(self.robot)
        start = draw_episodes(world, 1, self.seed, robot=robot).start[0].tolist()
        transport = make_transport("dds", robot.name)
        simulator = make_simulator(
            self.backend,
            worlds=[world],
            robot=robot,
            lidar_beams=self.lidar_beams,
            physics=None if self.physics == DEFAULT_PHYSICS else self.physics,
        )
        settings = Ros2Settings(
            odometry_topic=self.odometry_topic, pose_topic=self.pose_topic, reset_topic=self.reset_topic
        )
        view = math.radians(self.lidar_view)
        connection = Connection(self.scan_topic, self.imu_topic, self.cmd_vel_topic)
        try:
            node = RobotNode(simulator, transport, world, robot.lidar_range, settings, connection, tuple(start), view)
            print(
                f"A rover in {self.world} on ROS 2: scan {self.scan_topic}, commands {self.cmd_vel_topic}", flush=True
            )
            node.run(self.rate, stop)
        finally:
            transport.close()
            simulator.close()
        return 0

    def _check(self) -> None:
        check_positive(MAX_RATE, rate=self.rate)
        check_at_least(1, MAX_BEAMS, lidar_beams=self.lidar_beams)
        check_positive(360, lidar_view=self.lidar_view)
        check_seed(self.seed)
