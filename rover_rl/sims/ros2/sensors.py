"""Subscriptions to a live rover's sensors, and their latest values."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from rover_rl.sims.base import MAX_AGE
from rover_rl.sims.ros2 import poses
from rover_rl.sims.ros2.images import image_format
from rover_rl.sims.ros2.messages import Clock, Imu, LaserScan, Odometry, TFMessage, seconds_of
from rover_rl.sims.ros2.scans import Scan, read_scan
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.ros2.tf import FrameTree, RobotPose
from rover_rl.sims.ros2.transport import ThrottledLogger, Transport, other_types, short
from rover_rl.sims.sensor_report import ImageKind
from rover_rl.sims.settings import Connection

RATE_WINDOW = 20  # number of scan periods in a measurement of the scan rate
POSES = 64  # number of poses that are kept, in which the one of the time of a scan is looked up
COMPANY_TIME = 0.03  # longest time to wait for messages that were measured with a scan, and arrive after it, s
SUPPORTED_RATES = (0.75, 1.5)
"""Scan rates that policies support, in control rates of their training: 15 to 30 Hz for 20 Hz."""
STAMP_TOLERANCE = 0.005  # difference of stamps that count as the same, s

_log = logging.getLogger(__name__)


class ReceivedMessage(NamedTuple):
    """A value of the ``number``-th message of its kind, which arrived at ``time`` by :func:`time.monotonic`, s.

    ``company`` has the values of other kinds that belong to a scan: the latest when it arrived, or not newer by stamp.
    """

    value: Any
    time: float
    number: int
    company: dict[str, Any]

    @property
    def age(self) -> float:
        return time.monotonic() - self.time


class LatestMessages:
    """Latest value of each kind. The transport's thread writes; other threads read and wait."""

    def __init__(self) -> None:
        self._latest: dict[str, ReceivedMessage] = {}
        self._changed = threading.Condition()

    def put(self, kind: str, value: Any) -> None:
        with self._changed:
            company = {other: message.value for other, message in self._latest.items()} if kind == "scan" else {}
            self._latest[kind] = ReceivedMessage(value, time.monotonic(), self.count(kind) + 1, company)
            self._changed.notify_all()

    def latest(self, kind: str) -> ReceivedMessage | None:
        return self._latest.get(kind)

    def value(self, kind: str, default: Any) -> Any:
        message = self.latest(kind)
        return message.value if message else default

    def count(self, kind: str) -> int:
        message = self.latest(kind)
        return message.number if message else 0

    def wait(self, kind: str, after: int, timeout: float) -> ReceivedMessage | None:
        """Returns the latest message of a kind once its number exceeds ``after``; ``None`` after ``timeout`` (s)."""
        with self._changed:
            return self.latest(kind) if self._changed.wait_for(lambda: self.count(kind) > after, timeout) else None


class Source(NamedTuple):
    """A topic, the class of its messages, and functions that read values from them, by the kinds of the values."""

    topic: str
    message: Any
    readers: dict[str, Callable[[Any], Any]]


class Sensors:
    """Subscribes to scan, IMU, odometry and pose, and stores the latest valid values.

    The kinds of ``sources`` are ``"scan"``, ``"imu"``, ``"odometry"``, ``"pose"`` unless the pose comes from wheel
    odometry, and what is subscribed to later. ``pose_frame`` is the frame that poses are in; empty if it is not known.
    """

    def __init__(self, transport: Transport, settings: Ros2Settings, connection: Connection) -> None:
        self.transport, self._connection = transport, connection
        self.pose_estimator = poses.PoseEstimator(settings.pose)
        self.messages, self.rejected_scans, self.pose_frame = LatestMessages(), 0, ""
        self._tf_topics, self._follows_tf = (settings.tf_topic, settings.tf_static_topic), False
        by_tf = settings.pose == "tf"
        self._tf = RobotPose(settings.map_frame.strip("/"), settings.frame_id.strip("/") if by_tf else "")
        self._control_dt, self._old = settings.control_dt, settings.step_timeout
        self._scan_times: deque[tuple[float, float]] = deque(maxlen=RATE_WINDOW + 1)
        # Stamp, position and orientation. Written by the transport's thread.
        self._poses: deque[tuple[float, Tensor, Tensor]] = deque(maxlen=POSES)
        self._stamps: dict[str, tuple[float, float]] = {}  # of the last two messages of each kind, s
        self._rejections: dict[str, str] = {}
        self._throttled_log = ThrottledLogger(_log)
        pose_type, read_pose = poses.POSE_MESSAGES[settings.pose]
        put = self.messages.put

        def read_mounted(msg: Any) -> Scan:
            return read_scan(msg, settings.max_invalid).mounted(settings.lidar_yaw, settings.lidar_inverted)

        # The scan is last, as a rover publishes it last: when it wakes a step, the other messages have arrived.
        self.sources = {
            "imu": Source(connection.imu_topic, Imu, {"imu": lambda msg: poses.read_orientation(msg.orientation)}),
            "odometry": Source(settings.odometry_topic, Odometry, {"odometry": read_twist}),
            "pose": Source(settings.tf_topic if by_tf else settings.pose_topic, pose_type, {"pose": read_pose}),
            "scan": Source(connection.scan_topic, LaserScan, {"scan": read_mounted}),
        }
        if settings.pose == "wheels":
            self.sources["odometry"].readers.update(self.sources.pop("pose").readers)
        if by_tf:
            self.follow_tf()
        transport.subscribe(settings.clock_topic, Clock, lambda msg: put("clock", seconds_of(msg.clock)))
        for kind, source in self.sources.items():
            if source.message is not TFMessage:
                transport.subscribe(source.topic, source.message, partial(self.receive, kind))

    def follow_tf(self) -> FrameTree:
        """Returns the transforms of tf, as they are from the first call on."""
        if not self._follows_tf:
            self._follows_tf, (moving, fixed), receive = True, self._tf_topics, self._receive_tf
            self.transport.subscribe(fixed, TFMessage, partial(receive, fixed=True), reliable=True, latched=True)
            self.transport.subscribe(moving, TFMessage, receive)
        return self._tf.tree

    @property
    def pose(self) -> poses.MeasuredPose:
        return self.messages.value("pose", poses.ORIGIN_POSE)

    @property
    def imu_orientation(self) -> Tensor:
        return self.messages.value("imu", poses.IDENTITY_ORIENTATION)

    @property
    def wheel_velocity(self) -> Tensor:
        """Forward speed (m/s) and yaw rate (rad/s), ``[2]``."""
        return self.messages.value("odometry", torch.zeros(2))

    @property
    def world_pose(self) -> tuple[Tensor, Tensor]:
        """Position ``[3]`` and orientation ``[4]`` in the world by the latest messages."""
        return self.pose_estimator.estimate(self.pose, self.imu_orientation)

    def image(self, of: ImageKind, topic: str | None, size: tuple[int, int]) -> Tensor:
        """Returns the nearest pixels of the latest image on a topic in another size; zeros before the first image."""
        topic = topic or self._connection.image_topics[of]
        message, read, _ = image_format(of, topic)
        image = self.latest_on(topic, of, message, read)
        if image is None:
            return torch.zeros(size if of == "depth" else (3, *size))
        flat = image.reshape(1, -1, *image.shape[-2:])
        return interpolate(flat, size, mode="nearest-exact").reshape(*image.shape[:-2], *size)

    def latest_on(self, topic: str, what: str, message: Any, read: Callable[[Any], Any]) -> Any:
        """Returns what ``read`` reads from the latest usable message on a topic, else ``None``.

        The first call subscribes to the topic. ``what`` tells apart what is read from the same topic.
        """
        kind = f"{what} {topic}"
        if kind not in self.sources:
            self.sources[kind] = Source(topic, message, {kind: read})
            self.transport.subscribe(topic, message, partial(self.receive, kind))
        return self.messages.value(kind, None)

    def receive(self, kind: str, msg: Any) -> bool:
        """Reads a message; ignores a malformed one with a warning. Returns whether it is usable."""
        if kind not in self.sources:
            raise ValueError(f"kind must be one of {sorted(self.sources)}, got {kind!r}")
        try:
            values = {name: read(msg) for name, read in self.sources[kind].readers.items()}
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            self._rejections[kind] = str(error)
            self.rejected_scans += kind == "scan"
            self._throttled_log.warning(kind, "%s: ignored a message: %s", self.sources[kind].topic, error)
            return False
        self._rejections.pop(kind, None)
        if "scan" in values:
            self._check_scan_rate(values["scan"].stamp)
        if "pose" in values:
            values["pose"] = self.pose_estimator.align_imu(values["pose"], self.imu_orientation)
            self.pose_frame = read_frame(msg)
        stamp, scan = read_stamp(msg), self.messages.latest("scan")
        for name, value in values.items():
            self._stamps[name] = (self._stamps.get(name, (0.0, 0.0))[1], stamp)
            if scan is not None and stamp <= scan.value.stamp + STAMP_TOLERANCE:
                scan.company[name] = value
            self.messages.put(name, value)
        if "pose" in values or "imu" in values:
            self._poses.append((stamp, *self.world_pose))
        return True

    def _receive_tf(self, msg: Any, fixed: bool = False) -> bool:
        """Reads the pose after transforms. Returns whether they move the robot: other nodes move other frames."""
        try:
            pose = self._tf.after(msg, fixed)
        except ValueError as error:
            self._rejections["pose"] = str(error)
            self._throttled_log.warning("tf", "%s: ignored a message: %s", self._tf_topics[0], error)
            return False
        return pose is not None and self.receive("pose", pose)

    def wait_for_company(self, scan: ReceivedMessage) -> None:
        """Waits shortly for the messages that were measured with a scan, and arrive after it."""
        deadline = time.monotonic() + COMPANY_TIME
        for kind in ("imu", "odometry", "pose"):
            while self._is_due(kind, scan.value.stamp) and (left := deadline - time.monotonic()) > 0:
                self.messages.wait(kind, self.messages.count(kind), left)

    def _is_due(self, kind: str, stamp: float) -> bool:
        """Whether the next message of a kind is from the time of a stamp, unless it has ceased or has another clock."""
        before, last = self._stamps.get(kind, (0.0, 0.0))
        period, missing = last - before, stamp + STAMP_TOLERANCE - last
        return 0.0 < period <= missing < 2 * period + STAMP_TOLERANCE

    def pose_at(self, stamp: float) -> tuple[Tensor, Tensor]:
        """Returns the latest position ``[3]`` and orientation ``[4]`` in the world that are not newer than a stamp, s.

        If all are newer, as with clocks that differ, they are the latest.
        """
        known = (each[1:] for each in reversed([*self._poses]) if each[0] <= stamp + STAMP_TOLERANCE)
        return next(known, None) or self.world_pose

    def state_age(self) -> float | None:
        """Returns the time since the latest pose or IMU orientation was measured, s; ``None`` if it is not known.

        Now is the time of a simulation's clock, if it is received, else of this machine, with which the clock of the
        robot must be synchronized.
        """
        if not (known := [*self._poses]):
            return 0.0
        age = self.messages.value("clock", time.time()) - known[-1][0]
        return max(0.0, age) if abs(age) <= MAX_AGE else None

    def start_episode(self, target: poses.TargetPose | None, ground: float) -> None:
        """Aligns the frame of the pose: see :class:`PoseEstimator`. Forgets past poses, which may be in another."""
        self.pose_estimator.start_episode(self.pose, self.imu_orientation, target, ground)
        self._poses.clear()

    def arrivals(self) -> dict[str, tuple[int, float, str]]:
        """Returns the number of usable messages on each topic, the age of the last one (s), and words if it is old."""
        found = {}
        for kind, source in [*self.sources.items()]:
            message = self.messages.latest(kind)
            count, age = (0, math.inf) if message is None else (message.number, message.age)
            found[source.topic] = (count, age, self.describe_silence(kind) if age > self._old else "")
        return found

    def describe_silence(self, kind: str) -> str:
        if kind in self._rejections:
            return f"its messages cannot be used: {self._rejections[kind]}"
        if (latest := self.messages.latest(kind)) is not None:
            return f"the last message is {latest.age:.1f} s old"
        topic, message, _ = self.sources[kind]
        others = other_types(self.transport, topic, message)
        if not others:
            return "no message has arrived yet"
        silence = f"its messages are {others}, and {short(message.ros_type)} is read"
        fits = [name for name, (each, _) in poses.POSE_MESSAGES.items() if short(each.ros_type) == others]
        return f"{silence}: choose pose={fits[0]!r}, --pose {fits[0]}" if kind == "pose" and fits else silence

    def _check_scan_rate(self, stamp: float) -> None:
        self._scan_times.append((stamp, time.monotonic()))
        (first, arrived), (last, now) = self._scan_times[0], self._scan_times[-1]
        span = last - first if last > first else now - arrived
        low, high = (share / self._control_dt for share in SUPPORTED_RATES)
        if len(self._scan_times) > RATE_WINDOW and span > 0 and not low <= RATE_WINDOW / span <= high:
            text = "%s: %.1f scans per second; policies require %g to %g"
            self._throttled_log.warning("rate", text, self.sources["scan"].topic, RATE_WINDOW / span, low, high)


def read_stamp(msg: Any) -> float:
    stamp = getattr(getattr(msg, "header", None), "stamp", None)
    return 0.0 if stamp is None else seconds_of(stamp)


def read_frame(msg: Any) -> str:
    return str(getattr(getattr(msg, "header", None), "frame_id", "")).strip("/")


def read_twist(msg: Any) -> Tensor:
    """Reads forward speed (m/s) and yaw rate (rad/s) of a ``nav_msgs/Odometry``: float32 ``[2]``."""
    return poses.read_finite("velocity", msg.twist.twist.linear.x, msg.twist.twist.angular.z)
