"""ROS 2 backend: one live rover as a :class:`Simulator`."""

from __future__ import annotations

import logging
import math
import time
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from rover_rl.robots import Robot
from rover_rl.sims.base import Feature, Simulator
from rover_rl.sims.command_limiter import CommandLimiter, CommandLimits
from rover_rl.sims.ros2 import PoseResetError, RobotLostError, scans
from rover_rl.sims.ros2.commands import STOP, Commands
from rover_rl.sims.ros2.ground import LivePoints
from rover_rl.sims.ros2.poses import Placer, TargetPose
from rover_rl.sims.ros2.sensors import ReceivedMessage, Sensors
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.ros2.transport import Tap, TappedTransport, ThrottledLogger, Transport, make_transport
from rover_rl.sims.rover_state import RoverState, beam_angles
from rover_rl.sims.settings import Connection
from rover_rl.worlds import World

_log = logging.getLogger(__name__)

MIN_STEP = 0.75  # shortest time between the scans of two steps, in control steps; scans of faster lidars are skipped
MAX_DT = 1.0  # longest time between two stamps, s; a longer time means that the clock has jumped
BRAKE_TIMEOUT = 0.25  # time without a usable scan after which the rover is stopped, s; the step still waits for a scan
BRAKE_PERIODS = 1.5  # the same time in periods of the last two scans; the longer of both applies
GUARD_BEAMS = 128  # beams of a simulator without a scanner: the guard looks at them
HEARTBEAT_INTERVAL = 0.1  # longest time between two heartbeats of the watchdog during a step, s
MAX_UNUSABLE_SCANS = 20  # unusable scans in a row after which waiting for the first usable one ends
PUBLISHER_CHECK_INTERVAL = 1.0  # time between two checks of the number of publishers, s
REST_VELOCITY = (0.05, 0.1)  # forward speed (m/s) and yaw rate (rad/s) below which the wheels are at rest
FROZEN_DISTANCE = 0.25  # distance (m) or angle (rad) that the wheels may go while the scan stays the same
FROZEN_SCANS = 5  # number of times that a scan may come again meanwhile; some drivers send each scan several times
REST_DISTANCE = 0.05  # distance below which a rover at rest may move while it settles, m


class Ros2Simulator(Simulator):
    """A live rover: a real one, one in Gazebo, or ``rover-rl robot``.

    :meth:`step` sends a command, waits for the next scan, and uses the latest of the other messages, which arrive in a
    thread. A malformed message is ignored with a warning; the last valid value remains.

    The command path limits speed, yaw rate and their rates of change, and cancels the forward speed towards directions
    that no valid lidar beam covers. A rover without a usable scan is stopped after 0.25 s, and counts as lost after
    ``step_timeout``. One whose program dies or hangs is stopped by a watchdog process, and goes on with the next step.

    Args:
        worlds: world of the rover: exactly one, whose name is that of Gazebo's world.
        robot: description of the rover; its limits apply to the commands, unless the settings override them.
        settings, connection: settings of the connection, its topics, and the time to wait for the first scan.
    """

    # It reports no contacts, but a policy of a task whose collision is the contact drives anyway.
    features: frozenset[Feature] = frozenset({"contacts", "lidar"})

    def __init__(
        self, worlds: Sequence[World], robot: Robot, settings: Ros2Settings, connection: Connection | None = None
    ) -> None:
        if len(worlds) != 1:
            raise ValueError(f"backend 'ros2' drives one live rover, got num_envs={len(worlds)}")
        self.settings = settings
        self._connection = connection = connection or Connection()
        self.num_envs, self.control_dt, self.device = 1, settings.control_dt, torch.device("cpu")
        self._world, self._dt = worlds[0], self.control_dt
        self._limits = torch.tensor([CommandLimits.of(robot, settings)], dtype=torch.float64)
        self._limiter, self._throttled_log = CommandLimiter(settings.min_reversal), ThrottledLogger(_log)
        self._publishers_checked = -math.inf
        self._scan: ReceivedMessage | None = None
        self.scanner(GUARD_BEAMS)
        self._repeated = (0, 0.0)  # how often the scan has come again while the wheels turned, and how far they went
        self.latency = 0.0  # time between the arrival of the scan and the command of the last step, s
        self.held = False  # whether the last forward speed was canceled, as it led towards unseen directions
        parameters = vars(connection) | vars(settings)
        tapped: Any = TappedTransport(make_transport(settings.transport, settings.node, parameters))
        self.transport: Transport = tapped
        self.tap: Callable[[Tap], None] = tapped.tap  # passes all messages to a function, such as DriveBag.add
        self._commands = Commands(self.transport, connection.cmd_vel_topic, settings)
        # The rover also stops if a program ends in an error, or does not call close().
        self._finalizer = weakref.finalize(self, self._commands.close)
        self._placer = Placer(settings, self._world.name, self.transport)
        # The transport refers to the sensors, which must not refer to the simulator, or it would never be finalized.
        self._sensors = Sensors(self.transport, settings, connection)
        points = LivePoints(self._sensors, settings, connection)
        self.point_cloud, self.ground_at, self.image = points.cloud, points.ground_at, self._sensors.image
        self.stop, self.halt, self.receive = self._commands.stop, self._commands.halt, self._sensors.receive
        self.follow_tf, self.arrivals = self._sensors.follow_tf, self._sensors.arrivals
        self.on_command: Callable[[], object] = lambda: None  # called in each step before the wait for the next scan
        self.wait_for_robot(connection.timeout)

    @property
    def live(self) -> Ros2Simulator:
        return self

    @property
    def last_command(self) -> tuple[float, float]:
        return self._commands.last

    @property
    def pose_frame(self) -> str:
        """Name of the frame of the pose; empty before the first one."""
        return self._sensors.pose_frame

    @property
    def gives_way(self) -> bool:
        """Whether another node drives, which wins."""
        return self._commands.gives_way

    @property
    def field_of_view(self) -> float:
        scan = self._sensors.messages.latest("scan")
        return scan.value.field_of_view if scan else 0.0

    @property
    def robot_connected(self) -> bool:
        """Whether the latest usable scan is younger than the step timeout."""
        scan = self._sensors.messages.latest("scan")
        return scan is not None and scan.age < self.settings.step_timeout

    def wait_for_robot(self, timeout: float) -> bool:
        """Waits at most ``timeout`` (s) for a usable scan, and warns if there is none. Returns whether there is one."""
        deadline, sensors = time.monotonic() + timeout, self._sensors
        count, rejectable = sensors.messages.count("scan"), sensors.rejected_scans + MAX_UNUSABLE_SCANS
        while not self.robot_connected and time.monotonic() < deadline and sensors.rejected_scans < rejectable:
            sensors.messages.wait("scan", count, min(0.1, max(0.0, deadline - time.monotonic())))
        if not self.robot_connected:
            text = "no usable scan on %s within %g s: no robot is connected; it may still appear"
            _log.warning(text, self._connection.scan_topic, timeout)
        return self.robot_connected

    def require_robot(self) -> None:
        """Checks that exactly one robot sends usable scans, and that nothing else drives it.

        Raises ``RobotLostError`` if there is no robot, there are several, or another node commands it, and
        ``ValueError`` if it receives commands of another type.
        """
        self._require_only_driver()
        if not self.robot_connected:
            raise self._lost("scan")
        self._require_one_robot()

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        """Stops the rover, moves it to ``poses``, and waits until it is at rest. Without a robot, warns.

        Raises ``PoseResetError`` if the rover does not come to rest at the pose in time, and ``RobotLostError`` if its
        messages cease, or another node commands it.
        """
        if not mask.any():
            return self.state()
        self._require_only_driver()
        sensors, messages = self._sensors, self._sensors.messages
        if not messages.count("scan"):
            _log.warning("no robot has appeared on %s yet: observations are empty", self._connection.scan_topic)
            return self.state()
        self._require_one_robot()
        self.stop()
        x, y, yaw = poses[0].tolist()
        target = TargetPose(x, y, self._world.drop_height(poses[0, :2]).item(), yaw)
        poses_before = messages.count("pose")
        self._placer.place(target)
        self._wait_until_at_rest(target, poses_before)
        self._take_next_scan(after=messages.count("scan"))
        self._limiter.reset()
        moved_to, ground = target if self._placer.moves else None, self._world.height_at(poses[0, :2]).item()
        sensors.start_episode(moved_to, ground)
        self._dt = self.control_dt
        return self.state()

    def scanner(self, beams: int) -> Ros2Simulator:
        """Returns the lidar, which scans when the rover's does: this simulator."""
        self.angles = beam_angles(beams).float()
        # Before the first scan, every range is infinite as in an empty world, but no beam is seen, so that the guard
        # blocks all motion.
        self._ranges, self._seen = torch.full((beams,), math.inf), torch.zeros(beams, dtype=torch.bool)
        if self._scan:
            self._ranges, self._seen = scans.aligned(self._scan.value, beams)
        return self

    def scan(self, rows: Tensor | None = None) -> Tensor:
        return self._ranges.masked_fill(~self._seen & (self._scan is not None), self.settings.unseen_range)[None]

    def covered(self) -> Tensor:
        return self._seen[None]

    def segments(self, points: int) -> Tensor | None:
        found = None if self._scan is None else scans.cut(self._scan.value, points)
        return None if found is None else found[None]

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        """Sends a command within the limits, without recent scans a stop command, and waits for the next scan.

        Raises ``RobotLostError`` if a topic is silent for ``step_timeout``, there are several robots, or another node
        commands the rover, after a stop command; ``ValueError`` if the command is not finite; ``ChildProcessError`` if
        the watchdog is gone.
        """
        if active is not None and not active.any():
            return self.state()
        self._require_only_driver()
        if time.monotonic() - self._publishers_checked > PUBLISHER_CHECK_INTERVAL:
            self._require_one_robot()
        scans_before = self._sensors.messages.count("scan")
        if not torch.isfinite(commands).all():
            raise ValueError(f"a command must be finite, got {commands[0, 0]} m/s and {commands[0, 1]} rad/s")
        last, dt = (torch.tensor([each], dtype=torch.float64) for each in (self._commands.last, (self._dt,)))
        speed, yaw_rate = self._limiter(last, commands.double(), dt, self._limits)[0].tolist()
        self.held = scans.is_blocked(speed, self._seen)
        if self.held:
            direction = "forward" if speed > 0 else "backward"
            self._throttled_log.warning("held", "%s motion canceled: no beam covers all of that direction", direction)
        if self.robot_connected:
            self._commands.send(0.0 if self.held else speed, yaw_rate)
        else:
            self.stop()
        self.latency = 0.0 if self._scan is None else self._scan.age
        self.on_command()
        self._take_next_scan(after=scans_before)
        return self.state()

    def state(self) -> RoverState:
        sensors, scan = self._sensors, self._scan
        company = scan.company if scan else {}
        twist = company.get("odometry", sensors.wheel_velocity)[None]
        pose, imu = company.get("pose", sensors.pose), company.get("imu", sensors.imu_orientation)
        position, orientation = sensors.pose_estimator.estimate(pose, imu)
        return RoverState.pack(
            position=position[None],
            orientation=orientation[None],
            linear_velocity=twist[:, :1],
            angular_velocity=twist[:, 1:],
            dt=torch.full((1, 1), self._dt),
            stamp=torch.full((1, 1), scan.value.stamp if scan else 0.0, dtype=torch.float64),
            contact=torch.zeros(1, 1, dtype=torch.bool),
        )

    def close(self) -> None:
        self._finalizer()

    def scan_pose(self) -> tuple[Tensor, Tensor]:
        position, orientation = self._sensors.pose_at(self._scan.value.stamp if self._scan else 0.0)
        return position[None], orientation[None]

    def state_age(self) -> Tensor:
        """Age of the latest pose or IMU orientation, ``[1, 1]``, s; 0 with a warning if it is not known."""
        age = self._sensors.state_age()
        if age is None and self._scan is not None:
            text = "late sensors are not compensated: their stamps are neither of %s nor of the clock of this machine"
            self._throttled_log.warning("age", text, self.settings.clock_topic)
        return torch.full((1, 1), age or 0.0)

    def _take_next_scan(self, after: int) -> None:
        """Waits for the scan of the next step, with a number above ``after``, and updates the time step."""
        while True:
            scan = self._wait_for_scan(after)
            dt = scan.value.stamp - self._scan.value.stamp if self._scan else 0.0
            if not 0.0 < dt < MIN_STEP * self.control_dt:
                break
            after = scan.number
        self._require_recent_messages()
        self._sensors.wait_for_company(scan)
        self._dt = dt if 0.0 < dt <= MAX_DT else self.control_dt
        self._require_changes(scan)
        self._scan = scan
        self._ranges, self._seen = scans.aligned(scan.value, len(self.angles))

    def _wait_for_scan(self, after: int) -> ReceivedMessage:
        """Waits for a scan with a number above ``after``. Stops the rover well before it counts as lost."""
        timeout, messages = self.settings.step_timeout, self._sensors.messages
        brake_timeout = min(timeout, max(BRAKE_TIMEOUT, BRAKE_PERIODS * self._dt))
        scan, left = None, brake_timeout
        while scan is None and left > 0:
            scan = messages.wait("scan", after, min(left, HEARTBEAT_INTERVAL))
            self._commands.keep_alive()
            left -= HEARTBEAT_INTERVAL
        if scan is None:
            self.stop()
            scan = messages.wait("scan", after, timeout - brake_timeout)
        if scan is None:
            raise self._lost("scan")
        return scan

    def _require_only_driver(self, since: float = -math.inf) -> None:
        if not self.settings.give_way and (other := self._commands.other(since)):
            if self._commands.last != STOP:
                self.stop()
            what = f"{other} also sends commands on {self._connection.cmd_vel_topic}, so that the rover is stopped"
            raise RobotLostError(f"{what}: end it, or let it win by Ros2Settings(give_way=True), --give-way")

    def _require_one_robot(self) -> None:
        """Raises an error if several robots publish, which would mix, or all receivers expect another type."""
        self._publishers_checked = time.monotonic()
        self._commands.require_receiver()
        sources = self._sensors.sources
        for topic in (sources["scan"].topic, sources.get("pose", sources["odometry"]).topic):
            if (count := self.transport.publishers(topic)) > 1:
                self.stop()
                text = "there may be several robots in this ROS_DOMAIN_ID; a stop command was sent"
                raise RobotLostError(f"{count} publishers send on {topic}: {text}")

    def _require_recent_messages(self) -> None:
        """Raises an error if a topic is silent for ``step_timeout``. Waits as long for a first message."""
        deadline, messages = time.monotonic() + self.settings.step_timeout, self._sensors.messages
        for kind in self._sensors.sources:
            message = messages.latest(kind) or messages.wait(kind, 0, max(0.0, deadline - time.monotonic()))
            if message is None or message.age > self.settings.step_timeout:
                raise self._lost(kind)

    def _require_changes(self, scan: ReceivedMessage) -> None:
        """Raises an error if the scan stays the same while the wheels turn. One without any return may."""
        after, before = scan.value.ranges, None if self._scan is None else self._scan.value.ranges
        # As bits, since NaN differs from itself.
        same = before is not None and torch.equal(before.view(torch.int32), after.view(torch.int32))
        if not same or not after.isfinite().any():
            self._repeated = (0, 0.0)
        elif not self._wheels_at_rest():
            count, way = self._repeated
            self._repeated = (count + 1, way + self._dt * self._sensors.wheel_velocity.abs().max().item())
        if self._repeated[0] > FROZEN_SCANS and self._repeated[1] > FROZEN_DISTANCE:
            self._repeated = (0, 0.0)
            self.stop()
            what = f"the scans on {self._connection.scan_topic} stay the same to the last bit while the wheels turn"
            raise RobotLostError(f"{what}, as of a lidar that hangs; a stop command was sent")

    def _lost(self, kind: str) -> RobotLostError:
        self.stop()
        topic, silence = self._sensors.sources[kind].topic, self._sensors.describe_silence(kind)
        return RobotLostError(f"lost the robot: {topic} ({kind}): {silence}; a stop command was sent")

    def _wait_until_at_rest(self, target: TargetPose, poses_before: int) -> None:
        """Waits for the rest, after more than ``poses_before`` messages of the pose."""
        settings, sensors, messages = self.settings, self._sensors, self._sensors.messages
        rest_start = began = time.monotonic()
        deadline, rest_position = began + settings.reset_timeout, sensors.world_pose[0]
        while time.monotonic() - rest_start < settings.settle:
            self._require_recent_messages()
            self._require_only_driver(since=began)
            if self.gives_way:
                deadline = time.monotonic() + settings.reset_timeout
            position = sensors.world_pose[0]
            arrived = not self._placer.moves or (
                messages.count("pose") > poses_before
                and sensors.pose_estimator.matches_target(sensors.pose, target, settings.pose_tolerance)
            )
            # The wheels also stand still while the rover falls or is carried.
            if not (self._wheels_at_rest() and torch.dist(position, rest_position) < REST_DISTANCE and arrived):
                rest_start, rest_position = time.monotonic(), position
            if time.monotonic() > deadline:
                x, y, z = position.tolist()
                place = f" at x {target.x:.2f} m, y {target.y:.2f} m" if self._placer.moves else ""
                now = f"at x {x:.2f} m, y {y:.2f} m, z {z:.2f} m"
                wheels = "at rest" if self._wheels_at_rest() else "moving"
                late = f"after {settings.reset_timeout:g} s it is {now}, and its wheels are {wheels}"
                raise PoseResetError(f"the rover did not come to rest{place}; {late}")
            messages.wait("odometry", messages.count("odometry"), timeout=settings.settle / 4)

    def _wheels_at_rest(self) -> bool:
        speed, yaw_rate = self._sensors.wheel_velocity.abs().tolist()
        return speed < REST_VELOCITY[0] and yaw_rate < REST_VELOCITY[1]
