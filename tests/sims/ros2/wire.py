"""In-process transport, and rovers on it, whose time passes while the simulator waits for their messages."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from rover_rl.envs.config import EnvConfig, LidarConfig
from rover_rl.envs.served_rover import ServedRover
from rover_rl.robots import get_robot
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims import make_simulator
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.robot import RobotNode
from rover_rl.sims.ros2.sensors import LatestMessages, ReceivedMessage
from rover_rl.sims.ros2.simulator import Ros2Simulator
from rover_rl.sims.settings import Connection
from rover_rl.worlds import World, get_world

BEAMS, TURN = 8, 2 * math.pi
ALL = torch.ones(1, dtype=torch.bool)
STEP = 0.05  # time between two messages of a rover, s


class Wire:
    """In-process transport: a published message reaches its subscribers in the publishing thread.

    It also stands for the module ``time``: ``now`` is the time in s. By topic, it has the callbacks of subscriptions
    (``receivers``) and of those who overhear others (``ears``), the messages that were ``sent``, the types of
    publishers (``kinds``) and of subscribers (``received``), and functions that ``tamper`` with messages. ``rovers``
    are functions that step the rovers, which then publish; ``robots`` is what :meth:`publishers` reports.
    """

    def __init__(self) -> None:
        self.receivers, self.ears = defaultdict(list), defaultdict(list)
        self.sent, self.kinds, self.received = defaultdict(list), defaultdict(set), defaultdict(set)
        self.tamper: dict[str, Callable[[Any], Any]] = {}
        self.rovers: list[Callable[[], object]] = []
        self.latched: set[str] = set()
        self.robots, self.closed, self.now = 1, False, 1000.0

    def monotonic(self) -> float:
        return self.now

    time = monotonic

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def subscribe(
        self, topic: str, kind: Any, receive: Callable[[Any], None], *, reliable: bool = False, latched: bool = False
    ) -> None:
        self.receivers[topic].append(receive)
        for message in self.sent[topic][-1:] if latched and topic in self.latched else ():
            receive(message)
        self.received[topic].add(kind.ros_type)

    def publisher(self, topic: str, kind: Any, *, latched: bool = False):
        self.kinds[topic].add(kind.ros_type)
        self.latched |= {topic} if latched else set()

        def publish(message: Any) -> None:
            assert isinstance(message, kind)
            message = self.tamper.get(topic, lambda unchanged: unchanged)(message)
            self.sent[topic].append(message)
            for receive in self.receivers[topic]:
                receive(message)

        return publish

    def overhear(self, topic: str, kind: Any, receive: Callable[[Any, str], object]) -> None:
        self.ears[topic].append(receive)

    def name_of(self, sender: str, topic: str) -> str:
        return sender

    def subscribers(self, topic: str) -> int:
        return len(self.receivers[topic])

    def publishers(self, topic: str) -> int:
        return self.robots

    def types(self, topic: str, receivers: bool = False) -> set[str]:
        return (self.received if receivers else self.kinds)[topic]

    def close(self) -> None:
        self.closed = True

    def say(self, topic: str, message: Any, sender: str) -> None:
        """Lets another node send a message."""
        for receive in self.receivers[topic]:
            receive(message)
        for hear in self.ears[topic]:
            hear(message, sender)

    def wait(self, messages: LatestMessages, kind: str, after: int, timeout: float) -> ReceivedMessage | None:
        """Replaces :meth:`LatestMessages.wait`: steps the rovers for the given time."""
        for _ in range(math.ceil(timeout / STEP)):
            self.now += STEP
            for step in [*self.rovers]:
                step()
            if messages.count(kind) > after:
                return messages.latest(kind)
        return None


class QuietWatchdog:
    """Stands for a watchdog."""

    may_be_stopping = False

    def __init__(self, *_: Any, **__: Any) -> None: ...

    def __getattr__(self, name: str) -> Callable[[], None]:
        return lambda: None


class Rover:
    """A rover that follows commands immediately, without moving."""

    def __init__(self, wire: Wire) -> None:
        self.x, self.y, self.z, self.yaw, self.speed, self.turn = 1.0, 2.0, 0.1, 0.5, 0.0, 0.0
        self.imu_offset, self.climb, self.stamp, self.stamp_step = 0.0, 0.0, 0.0, STEP
        self.ranges = np.full(BEAMS, 5.0, np.float32)
        self.silent: set[str] = set()
        self.scan_first = self.frozen = False  # whether the scan comes before the other messages, and never changes
        self._odd = True
        self._publish = {
            "scan": wire.publisher("/scan", ros.LaserScan),
            "imu": wire.publisher("/imu/data", ros.Imu),
            "odometry": wire.publisher("/odometry/wheels", ros.Odometry),
            "pose": wire.publisher("/rover/pose_array", ros.PoseArray),
            "localizer": wire.publisher("/pose", ros.PoseStamped),
            "amcl": wire.publisher("/amcl_pose", ros.PoseWithCovarianceStamped),
        }
        wire.subscribe("/cmd_vel", ros.Twist, self.obey)
        wire.subscribe("/rover/set_pose", ros.PoseStamped, self.move_to)
        wire.rovers.append(self.publish)

    def obey(self, twist: ros.Twist) -> None:
        self.speed, self.turn = twist.linear.x, twist.angular.z

    def move_to(self, msg: ros.PoseStamped) -> None:
        self.x, self.y = msg.pose.position.x, msg.pose.position.y
        self.yaw = 2 * math.atan2(msg.pose.orientation.z, msg.pose.orientation.w)

    def publish(self) -> None:
        self.stamp += self.stamp_step
        header = ros.Header(ros.Time.from_seconds(self.stamp))
        heading = ros.Quaternion(z=math.sin(self.yaw / 2), w=math.cos(self.yaw / 2))
        imu_yaw = self.yaw + self.imu_offset
        self.z += self.climb
        pose = ros.Pose(ros.Point(self.x, self.y, self.z), heading)
        twist = ros.Twist(ros.Vector3(x=self.speed), ros.Vector3(z=self.turn))
        messages = {
            "imu": ros.Imu(header, ros.Quaternion(z=math.sin(imu_yaw / 2), w=math.cos(imu_yaw / 2))),
            "odometry": ros.Odometry(header, pose=ros.PoseWithCovariance(pose), twist=ros.TwistWithCovariance(twist)),
            "pose": ros.PoseArray(header, [pose]),
            "localizer": ros.PoseStamped(header, pose),
            "amcl": ros.PoseWithCovarianceStamped(header, ros.PoseWithCovariance(pose)),
            "scan": self.scan(header, self._noisy()),
        }
        for kind in sorted(messages, key=lambda kind: (kind == "scan") != self.scan_first):
            if kind not in self.silent:
                self._publish[kind](messages[kind])

    def _noisy(self) -> np.ndarray:
        """Returns the ranges, of which the second differs in its last bit from scan to scan while the rover drives."""
        self._odd = not self._odd and not self.frozen and (self.speed, self.turn) != (0.0, 0.0)
        ranges = self.ranges.copy()
        ranges[1:2] = np.nextafter(ranges[1:2], np.float32(100.0)) if self._odd else ranges[1:2]
        return ranges

    def scan(self, header: ros.Header, ranges: np.ndarray) -> ros.LaserScan:
        increment = TURN / len(ranges)
        limits = {"angle_min": -math.pi, "angle_max": math.pi - increment, "angle_increment": increment}
        return ros.LaserScan(header, **limits, ranges=ranges)


class SimulatedRobot:
    """The node of a rover in PyBullet. ``driven`` has its x after each step, ``poses`` place and yaw by the time."""

    def __init__(
        self,
        wire: Wire,
        world: World,
        start: tuple[float, float, float],
        view: float = TURN,
        robot: str = "rover_zero",
        **config: Any,
    ) -> None:
        kind, lidar = replace(get_robot(robot), lidar_view=view), LidarConfig(beams=128)
        self.rover = ServedRover(EnvConfig(world=world, robot=kind, lidar=lidar, seed=0, **config))
        self._node = RobotNode(self.rover, wire, start=start)
        self.driven: list[float] = []
        self.poses: dict[float, tuple[torch.Tensor, float]] = {}
        wire.rovers.append(self._step)

    @property
    def position(self) -> torch.Tensor:
        return self.rover.env.simulator.state().position[0]

    def _step(self) -> None:
        self._node.step()
        rover = self.rover.env.rover_state
        self.poses[round(rover.stamp.item(), 3)] = (rover.position[0], yaw_of(rover))
        self.driven.append(self.position[0].item())


def simulator(timeout: float = 2.0, beams: int = BEAMS, **settings: Any) -> Ros2Simulator:
    """Connects to the rovers on the wire, and sends commands without limits of the accelerations."""
    quick = {"max_acceleration": 100.0, "max_yaw_acceleration": 100.0}
    settings = {"reset": "topic", "settle": 0.05, **quick, **settings}
    made = make_simulator(
        Ros2Settings(**settings),
        worlds=[get_world("maze")],
        robot=get_robot("rover_zero"),
        connection=Connection(timeout=timeout),
    )
    assert isinstance(made, Ros2Simulator)
    made.scanner(beams)
    return made


def drive(sim: Ros2Simulator, steps: int = 1, speed: float = 0.5) -> None:
    for _ in range(steps):
        sim.step(torch.tensor([[speed, 0.2]]))


def yaw_of(state) -> float:
    return quaternion_to_euler(state.orientation)[0, 2].item()
