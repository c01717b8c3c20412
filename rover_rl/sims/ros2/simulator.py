"""The ROS 2 backend: one live rover as a :class:`Simulator`."""

from __future__ import annotations

import logging
import math
import time
import weakref
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeAlias

import torch
from torch import Tensor

from rover_rl.sims.base import Dynamics, RoverState, View
from rover_rl.sims.connection import Connection
from rover_rl.sims.robots import Robot
from rover_rl.sims.ros2.commands import Commands
from rover_rl.sims.ros2.errors import PoseResetError, RobotLostError
from rover_rl.sims.ros2.guard import UnseenGuard
from rover_rl.sims.ros2.latest_messages import Arrival, LatestMessages
from rover_rl.sims.ros2.limits import CommandLimiter
from rover_rl.sims.ros2.messages import Imu, LaserScan, Message, Odometry
from rover_rl.sims.ros2.pose_estimator import NOWHERE, POSE_MESSAGES, UPRIGHT, PoseEstimator
from rover_rl.sims.ros2.pose_reset import Target, make_placer
from rover_rl.sims.ros2.readings import AlignedScan, ScanAlignment, read_imu, read_scan, read_twist
from rover_rl.sims.ros2.scan_rate import USABLE, ScanRate
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.ros2.transport import Transport, make_transport
from rover_rl.sims.timing import CONTROL_DT
from rover_rl.sims.worlds import World

_log = logging.getLogger(__name__)

Readers: TypeAlias = dict[str, Callable[[Any], Any]]
"""What is read from a message, by the name that it is kept under."""

TOO_SOON = 0.75
"""Share of a control step before which a next scan is left out: lidars may be faster than control."""
LONGEST_DT = 1.0
"""A longer gap between two stamps is a clock that jumped, s."""
BRAKE_AFTER = 0.25
"""Seconds without a usable scan after which a rover is stopped, while it is still waited for."""
SLOW_PERIODS = 1.5
"""Or so many times the time between the last two scans, if that is longer."""
UNUSABLE = 20
"""Scans in a row that cannot be used, after which a usable one is no longer waited for."""
CHECK_EVERY = 1.0
"""Seconds between two looks at how many publishers there are."""
WARN_EVERY = 5.0
"""Seconds between two warnings of malformed messages on one topic, or of one kind."""
AT_REST = (0.05, 0.1)
"""Forward speed (m/s) and yaw rate (rad/s) below which a rover's wheels are at rest."""
STILL = 0.05
"""A rover that moves less than this in any direction while it settles is at rest, m."""


class Ros2Simulator:
    """A live rover: real, in Gazebo, or ``rover-rl robot``.

    Messages arrive in a thread of the transport; :meth:`step` sends a command, waits for the next scan, and takes the
    newest of the rest. A malformed message is refused with a warning, and the last good value stays.

    The command path limits speed, yaw rate and their changes (:class:`~rover_rl.sims.ros2.limits.CommandLimits`), and
    cancels the forward speed towards directions that no valid lidar beam covers
    (:class:`~rover_rl.sims.ros2.guard.UnseenGuard`). A rover without a usable scan is stopped after 0.25 s, and lost
    after ``step_timeout``.

    Args:
        worlds: the world that it drives in: one, whose name is that of Gazebo's.
        robot: the rover; its limits are those of the commands, unless the settings have others.
        lidar_beams: beams of the environment's scans.
        settings: settings of the connection.
        connection: topics, and the time to wait for the first scan.

    Attributes:
        latency: time from the arrival of the scan that the last step answers to its command, s.
        held: whether the last command's forward speed was cancelled, as it led towards unseen directions.

    Raises:
        ValueError: for more than one rover.
        ImportError: if what the transport needs is not installed.
    """

    def __init__(
        self,
        worlds: Sequence[World],
        robot: Robot,
        lidar_beams: int,
        settings: Ros2Settings | None = None,
        connection: Connection | None = None,
    ) -> None:
        if len(worlds) != 1:
            raise ValueError(f"backend 'ros2' drives one live rover, got num_envs={len(worlds)}")
        self.settings = settings = settings or Ros2Settings()
        connection = connection or Connection()
        self.num_envs = 1
        self.control_dt = CONTROL_DT
        self.device = torch.device("cpu")
        self.ray_angles = torch.arange(lidar_beams, dtype=torch.float32) * (2 * math.pi / lidar_beams)
        self._world = worlds[0]
        self._limiter = CommandLimiter(settings.limits(robot))
        self._align = ScanAlignment(lidar_beams, settings.lidar_yaw)
        self._guard = UnseenGuard(self.ray_angles)
        # Before the first scan: full range, as a simulator without obstacles; nothing is seen, so that nothing moves.
        self._view = AlignedScan(torch.full((lidar_beams,), math.inf), torch.zeros(lidar_beams, dtype=torch.bool))
        self._scan_rate = ScanRate()
        self._refused: dict[str, str] = {}
        self._unusable = 0
        self._checked = -math.inf
        self._pose_estimator = PoseEstimator(settings.pose)
        self._messages = LatestMessages()
        self._warned: dict[str, float] = {}
        self._scan: Arrival | None = None
        self._dt = self.control_dt
        self.latency = 0.0
        self.held = False
        self._transport = make_transport(settings.transport, settings.node)
        self._commands = Commands(self._transport, connection.cmd_vel_topic, settings.command, settings.frame_id)
        # A program that ends in an error, or forgets to close, leaves no rover that drives on.
        self._finalizer = weakref.finalize(self, _let_go, self._commands, self._transport)
        self._placer = make_placer(settings, self._world.name, self._transport)
        self._subscribe(connection)
        self.wait_for_robot(connection.timeout)

    def _subscribe(self, connection: Connection) -> None:
        """Listens to all that is needed of the rover."""
        settings = self.settings
        sources: dict[str, tuple[str, type[Message], Readers]] = {
            "imu": (connection.imu_topic, Imu, {"imu": read_imu}),
            "odometry": (settings.odometry_topic, Odometry, {"odometry": read_twist}),
        }
        pose = POSE_MESSAGES[settings.pose]
        if settings.pose == "wheels":
            sources["odometry"][2]["pose"] = pose.read
        else:
            sources["pose"] = (settings.pose_topic, pose.kind, {"pose": pose.read})
        # Last, as a rover sends it last: when it wakes a step, the rest of the same moment is there.
        scan = partial(read_scan, max_invalid=settings.max_invalid)
        sources["scan"] = (connection.scan_topic, LaserScan, {"scan": scan})
        self._readers = {kind: readers for kind, (_, _, readers) in sources.items()}
        self._topics = {kind: topic for kind, (topic, _, _) in sources.items()}
        receive = weakref.WeakMethod(self.receive)  # else the transport would keep the simulator alive
        for kind, (topic, message, _) in sources.items():
            self._transport.subscribe(topic, message, partial(_hand_over, receive, kind))

    @property
    def last_command(self) -> tuple[float, float]:
        """The command that was sent last, m/s and rad/s."""
        return self._commands.last

    @property
    def field_of_view(self) -> float:
        """Angle that the newest scan covers, rad; 0 before the first."""
        scan = self._messages.newest("scan")
        return 0.0 if scan is None else scan.value.field_of_view

    @property
    def robot_connected(self) -> bool:
        """Whether usable scans come in."""
        scan = self._messages.newest("scan")
        return scan is not None and scan.age < self.settings.step_timeout

    def wait_for_robot(self, timeout: float) -> bool:
        """Waits for a usable scan (s); whether there is one. If not, warns, and everything may go on."""
        deadline = time.monotonic() + timeout
        count, unusable = self._messages.count("scan"), self._unusable
        while not self.robot_connected and time.monotonic() < deadline and self._unusable < unusable + UNUSABLE:
            self._messages.wait("scan", count, min(0.1, max(0.0, deadline - time.monotonic())))
        if self.robot_connected:
            return True
        _log.warning(
            "no usable scan on %s within %g s: no robot is connected; it may still appear",
            self._topics["scan"],
            timeout,
        )
        return False

    def require_robot(self) -> None:
        """Checks that there is one robot that sends usable scans.

        Raises:
            RobotLostError: if there is none, or several; a stop was sent before.
        """
        if not self.robot_connected:
            raise self._lost("scan")
        self._require_one_robot()

    def receive(self, kind: str, msg: Any) -> bool:
        """Takes in a message: ``"scan"``, ``"imu"``, ``"odometry"`` or ``"pose"``.

        Any object with the message's attributes will do. A malformed message is left out with a warning, at most every
        five seconds for each kind.

        Returns:
            Whether the message could be used.

        Raises:
            ValueError: for another kind, which a pose is where it comes from the wheels.
        """
        if kind not in self._readers:
            raise ValueError(f"kind must be one of {sorted(self._readers)}, got {kind!r}")
        try:
            values = {name: read(msg) for name, read in self._readers[kind].items()}
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            self._refuse(kind, str(error))
            return False
        self._refused.pop(kind, None)
        if "scan" in values:
            self._watch_rate(values["scan"].stamp)
        if "pose" in values:
            values["pose"] = self._pose_estimator.located(values["pose"], self._newest("imu", UPRIGHT))
        for name, value in values.items():
            self._messages.put(name, value)
        return True

    def _refuse(self, kind: str, reason: str) -> None:
        """Remembers why a message was left out, and warns of it."""
        self._refused[kind] = reason
        self._unusable += kind == "scan"
        self._warn(kind, "%s: left out a message: %s", self._topics[kind], reason)

    def _watch_rate(self, stamp: float) -> None:
        rate = self._scan_rate.add(stamp, time.monotonic())
        if rate is not None and not USABLE[0] <= rate <= USABLE[1]:
            topic, (low, high) = self._topics["scan"], USABLE
            self._warn("rate", "%s: %.1f scans a second; policies need %g to %g", topic, rate, low, high)

    def _warn(self, kind: str, message: str, *values: object) -> None:
        """Warns, at most every five seconds for each kind."""
        if time.monotonic() - self._warned.get(kind, -math.inf) > WARN_EVERY:
            self._warned[kind] = time.monotonic()
            _log.warning(message, *values)

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        """Stops the rover, puts it at ``poses`` and waits until it rests there: see :meth:`Simulator.reset`.

        Without a robot there are zeros and full range, and a warning.

        Raises:
            PoseResetError: if it could not be put there in time.
            RobotLostError: if it stopped telling about itself.
        """
        if not mask.any():
            return self.state()
        if self._messages.newest("scan") is None:
            _log.warning("no robot has appeared on %s yet: observations are empty", self._topics["scan"])
            return self.state()
        self._require_one_robot()
        self.stop()
        target, poses_before = self._target(poses), self._messages.count("pose")
        self._placer.place(target)
        self._wait_until_at_rest(target, poses_before)
        self._take_scan(after=self._messages.count("scan"))
        ground = self._world.height_at(poses[0, :2]).item()
        there = target if self._placer.moves else None
        self._limiter.reset()
        self._pose_estimator.begin(self._newest("pose", NOWHERE), self._newest("imu", UPRIGHT), there, ground)
        self._dt = self.control_dt
        return self.state()

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        """Sends a command within the limits and waits for the next scan: see :meth:`Simulator.step`.

        A rover whose scans do not come is not driven, but told to stop.

        Raises:
            RobotLostError: if a topic brings nothing for ``step_timeout``, or several robots answer; a stop was sent
                before.
            ValueError: for a command that is not finite.
        """
        if active is not None and not active.any():
            return self.state()
        if time.monotonic() - self._checked > CHECK_EVERY:
            self._require_one_robot()
        seen = self._messages.count("scan")
        speed, turn = self._limiter(self._commands.last, tuple(commands[0].tolist()), self._dt)
        self.held = self._guard.blocked(speed, self._view.seen)
        if self.held:
            self._warn("held", "not driven %s: no beam covers all of it", "forwards" if speed > 0 else "backwards")
        if self.robot_connected:
            self._commands.send(0.0 if self.held else speed, turn)
        else:
            self.stop()
        self.latency = 0.0 if self._scan is None else self._scan.age
        self._take_scan(after=seen)
        return self.state()

    def stop(self) -> None:
        """Tells the rover to stop, more than once."""
        self._commands.stop()

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        """Refuses to: see :meth:`Simulator.set_dynamics`."""
        raise ValueError("a live rover's friction, mass and motors cannot be varied; sensors and latency can")

    def state(self) -> RoverState:
        """What the newest messages say; zeros and full range before there are any."""
        twist = self._newest("odometry", torch.zeros(2))[None]
        position, orientation = self._where()
        scan, view = self._scan.value if self._scan else None, self._view
        return RoverState.pack(
            position=position[None],
            orientation=orientation[None],
            linear_velocity=twist[:, :1],
            angular_velocity=twist[:, 1:],
            # What no beam covers is unknown, never free.
            ranges=view.ranges.masked_fill(~view.seen & (scan is not None), self.settings.unseen_range)[None],
            dt=torch.full((1, 1), self._dt),
            stamp=torch.full((1, 1), scan.stamp if scan else 0.0, dtype=torch.float64),
        )

    def render(self, row: int, view: View, width: int, height: int, goal: Tensor | None = None) -> Tensor:
        """A live rover has no picture of itself.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError("backend 'ros2' has no pictures: look at the rover, or use RViz")

    def close(self) -> None:
        """Stops the rover and closes the connection. Idempotent."""
        self._finalizer()

    def _newest(self, kind: str, otherwise: Any) -> Any:
        arrival = self._messages.newest(kind)
        return otherwise if arrival is None else arrival.value

    def _where(self) -> tuple[Tensor, Tensor]:
        """Position ``[3]`` and orientation ``[4]`` in the world."""
        return self._pose_estimator.of(self._newest("pose", NOWHERE), self._newest("imu", UPRIGHT))

    def _take_scan(self, after: int) -> None:
        """Waits for a scan that comes after number ``after``, and not too soon; the rest must not be old then."""
        while True:
            scan = self._await_scan(after)
            dt = scan.value.stamp - self._scan.value.stamp if self._scan else 0.0
            if not 0.0 < dt < TOO_SOON * self.control_dt:
                break
            after = scan.number
        self._require_news()
        self._dt = dt if 0.0 < dt <= LONGEST_DT else self.control_dt
        self._scan, self._view = scan, self._align(scan.value)

    def _await_scan(self, after: int) -> Arrival:
        """The first scan after number ``after``; the rover is stopped long before it is lost."""
        timeout = self.settings.step_timeout
        patience = min(timeout, max(BRAKE_AFTER, SLOW_PERIODS * self._dt))
        scan = self._messages.wait("scan", after, patience)
        if scan is None:
            self.stop()
            scan = self._messages.wait("scan", after, timeout - patience)
        if scan is None:
            raise self._lost("scan")
        return scan

    def _require_one_robot(self) -> None:
        """Refuses several publishers on a topic: their messages would be mixed, and all of them driven."""
        self._checked = time.monotonic()
        for topic in (self._topics["scan"], self._topics.get("pose", self._topics["odometry"])):
            count = self._transport.publishers(topic)
            if count > 1:
                self.stop()
                raise RobotLostError(
                    f"{count} publishers send on {topic}: there may be several robots in this ROS_DOMAIN_ID; the robot "
                    "was told to stop"
                )

    def _require_news(self) -> None:
        """No topic may have been silent for long; one of which nothing has come yet is given time, too."""
        deadline = time.monotonic() + self.settings.step_timeout
        for kind in self._topics:
            arrival = self._messages.newest(kind) or self._messages.wait(kind, 0, max(0.0, deadline - time.monotonic()))
            if arrival is None or arrival.age > self.settings.step_timeout:
                raise self._lost(kind)

    def _lost(self, kind: str) -> RobotLostError:
        """Stops the rover, and says what is missing."""
        self.stop()
        arrival = self._messages.newest(kind)
        silence = "nothing has come yet" if arrival is None else f"the last message is {arrival.age:.1f} s old"
        if kind in self._refused:
            silence = f"its messages cannot be used: {self._refused[kind]}"
        return RobotLostError(f"lost the robot: {self._topics[kind]} ({kind}): {silence}; it was told to stop")

    def _target(self, poses: Tensor) -> Target:
        x, y, yaw = poses[0].tolist()
        return Target(x, y, self._world.drop_height(poses[0, :2]).item(), yaw)

    def _wait_until_at_rest(self, target: Target, poses_before: int) -> None:
        """Waits until the rover has rested for a while, where it was put if that can be seen."""
        settings = self.settings
        deadline = time.monotonic() + settings.reset_timeout
        rested, anchor = time.monotonic(), self._where()[0]
        while time.monotonic() - rested < settings.settle:
            self._require_news()
            position = self._where()[0]
            # Its wheels stand still while it falls, and when it is carried.
            at_rest = self._wheels_at_rest() and torch.dist(position, anchor) < STILL
            if not (at_rest and self._arrived(target, poses_before)):
                rested, anchor = time.monotonic(), position
            if time.monotonic() > deadline:
                x, y, z = position.tolist()
                put = f"rest at x {target.x:.2f} m, y {target.y:.2f} m" if self._placer.moves else "come to rest"
                raise PoseResetError(
                    f"the rover was to {put}; after {settings.reset_timeout:g} s it is at x {x:.2f} m, y {y:.2f} m, "
                    f"z {z:.2f} m, and its wheels are {'at rest' if self._wheels_at_rest() else 'moving'}"
                )
            self._messages.wait("odometry", self._messages.count("odometry"), timeout=settings.settle / 4)

    def _wheels_at_rest(self) -> bool:
        speed, turn = self._newest("odometry", torch.zeros(2)).abs().tolist()
        return speed < AT_REST[0] and turn < AT_REST[1]

    def _arrived(self, target: Target, poses_before: int) -> bool:
        """Whether the rover is where it was put, by a later pose; always true for resets that do not move it."""
        if not self._placer.moves:
            return True
        place, fresh = self._newest("pose", NOWHERE), self._messages.count("pose") > poses_before
        return fresh and self._pose_estimator.arrived(place, target, self.settings.pose_tolerance)


def _let_go(commands: Commands, transport: Transport) -> None:
    if commands.last != (0.0, 0.0):
        commands.stop()
    transport.close()


def _hand_over(receive: weakref.WeakMethod[Any], kind: str, msg: Any) -> bool:
    """Gives a message to a simulator that may be gone; whether it could be used."""
    bound = receive()
    return bound is not None and bound(kind, msg)
