"""Reads a recording of a drive: an MCAP file or a folder of rosbag2. Needs the extra ``ros2``."""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rover_rl.algos.deploy.recorded_drives import Bag
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.ros2.transport import short
from rover_rl.sims.settings import Connection

CLOCK, NEEDED = "/clock", ("commands", "odometry")
LEAST = 20.0  # shortest drive that is fitted, s
SYNCHRONIZED = 1.0  # largest age of a message whose stamp is of the clock of the recording, s
BACKWARD = 0.1  # time by which stamps may be out of order, s


class Stream(NamedTuple):
    """Messages of one topic in the order of their stamps. Times are in seconds since the recording began.

    ``stamp`` is the arrival where messages have none, or one of another clock. ``age`` is the arrival minus the stamp,
    or ``None`` there. ``values`` are ``[M, k]``.
    """

    arrival: np.ndarray
    stamp: np.ndarray
    age: np.ndarray | None
    values: np.ndarray


class Topics(NamedTuple):
    """Topics to read. Commands and odometry are needed."""

    commands: str
    odometry: str
    imu: str
    pose: str
    scan: str

    @classmethod
    def of(cls, connection: Connection, settings: Ros2Settings) -> Topics:
        topics = connection.cmd_vel_topic, settings.odometry_topic, connection.imu_topic, settings.pose_topic
        return cls(*topics, connection.scan_topic)


class Recording(NamedTuple):
    """Commands and readings of a drive.

    ``commands`` and ``odometry`` have speed (m/s) and yaw rate (rad/s); ``imu`` yaw rate (rad/s) and yaw (rad,
    unwrapped); ``pose`` x, y (m) and yaw (rad, unwrapped; NaN without one); ``scan`` the ranges (m; not finite without
    a return), whose beams are ``increment`` apart, rad. Sensors that were not recorded are ``None``.
    """

    commands: Stream
    odometry: Stream
    imu: Stream | None
    pose: Stream | None
    scan: Stream | None
    increment: float


def read_recording(path: Path, topics: Topics) -> Recording:
    """Reads the topics of a drive.

    Raises:
        FileNotFoundError: if there is no such file or folder.
        ValueError: if it is no recording, has no commands or no odometry, a topic is of another type or of two robots,
            time goes backward, or the drive is too short.
    """
    bag, named = Bag(path), {topic: role for role, topic in topics._asdict().items()}
    kinds = {topic: _kind(bag, topic, role) for topic, role in named.items() if _is_there(bag, topic, role)}
    rows: dict[str, list[Any]] = {topic: [] for topic in (*named, CLOCK)}
    frames: dict[str, set[str]] = {topic: set() for topic in named}
    start, increment = math.nan, 0.0
    for topic, at, message in bag.messages({**kinds, CLOCK: ros.Clock}):
        start = at if math.isnan(start) else start
        if topic == CLOCK:
            rows[topic].append((at - start, ros.seconds_of(message.clock)))
            continue
        role, header = named[topic], getattr(message, "header", None)
        if header is not None:
            frames[topic].add(" ".join((header.frame_id, getattr(message, "child_frame_id", ""))).strip())
        increment = message.angle_increment if role == "scan" else increment
        if (values := ROLES[role].read(message)) is not None:
            stamp = math.nan if header is None or role == "commands" else ros.seconds_of(header.stamp)
            rows[topic].append((at - start, stamp, values))
    for topic, names in frames.items():
        if len(names) > 1:
            listed = ", ".join(map(repr, sorted(names)))
            raise ValueError(
                f"{topic} has messages of several robots or sensors, by their frames: {listed}; record one"
            )
    read = {role: _stream(topic, role, rows[topic], rows[CLOCK], start) for topic, role in named.items()}
    for role in NEEDED:
        if read[role] is None:
            raise ValueError(f"{getattr(topics, role)} in {path} has no finite {role}")
    recording = Recording(**read, increment=increment)  # type: ignore[arg-type]
    _check_length(recording)
    return recording


def _is_there(bag: Bag, topic: str, role: str) -> bool:
    """Whether a bag has a topic. Raises ``ValueError`` if it has not, and the topic is needed."""
    if topic not in bag.types and role in NEEDED:
        raise ValueError(
            f"{bag.path} has no {role} on {topic}: name the topic with {ROLES[role].option}; {bag.contents}"
        )
    return topic in bag.types


def _kind(bag: Bag, topic: str, role: str) -> Any:
    """Returns the class of the messages on a topic. Raises ``ValueError`` if it is not one of the role."""
    kinds = {kind.ros_type: kind for kind in ROLES[role].kinds}
    found = bag.types[topic]
    if len(found) > 1 or not found <= {*kinds}:
        types, wanted = (" or ".join(map(short, sorted(names))) for names in (found, kinds))
        raise ValueError(f"{topic} in {bag.path} has {types}, and {ROLES[role].option} takes {wanted}; {bag.contents}")
    return kinds[min(found)]


def _check_length(recording: Recording) -> None:
    commands, odometry = recording.commands.arrival, recording.odometry.stamp
    shared = min(commands[-1], odometry[-1]) - max(commands[0], odometry[0])
    if shared < LEAST:
        raise ValueError(f"commands and odometry overlap for {max(shared, 0):.1f} s, and {LEAST:g} s are the least")


def _stream(topic: str, role: str, rows: list[Any], clock: list[tuple[float, float]], start: float) -> Stream | None:
    size = max((len(values) for *_, values in rows), default=0)
    rows = sorted((row for row in rows if len(row[2]) == size), key=itemgetter(0))
    if not rows:
        return None
    arrival, stamp = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    if clock:
        # Stamps of simulated time: the arrival in the same clock.
        ticks = np.array(clock)
        arrival, start = np.interp(arrival, *ticks.T) - ticks[0, 1], ticks[0, 1]
    stamp = stamp - start
    back = np.diff(stamp)
    if np.nanmin(np.append(back, 0.0)) < -BACKWARD:
        place = f"by {-np.nanmin(back):.2f} s, {arrival[np.nanargmin(back)]:.1f} s after the start"
        raise ValueError(f"time goes backward on {topic} {place}: the robot restarted, or two robots publish on it")
    age: np.ndarray | None = arrival - stamp
    if not abs(np.median(arrival - stamp)) <= SYNCHRONIZED:  # NaN, too
        stamp, age = arrival, None
    keep = np.concatenate(([True], stamp[1:] > np.maximum.accumulate(stamp)[:-1]))
    stamp, values = stamp[keep], np.array([row[2] for row in rows])[keep]
    if role in ("imu", "pose"):
        values[:, -1] = np.unwrap(values[:, -1])
    if role == "imu" and np.isnan(values[:, -1]).any():
        # An IMU without orientation: its yaw rate adds up.
        values[1:, -1] = np.cumsum(values[:-1, 0] * np.diff(stamp))
        values[0, -1] = 0.0
    return Stream(arrival[keep], stamp, None if age is None else age[keep], values)


def _twist(message: Any) -> tuple[float, ...] | None:
    twist = getattr(message, "twist", message)
    return _finite(twist.linear.x, twist.angular.z)


def _finite(*values: float) -> tuple[float, ...] | None:
    return values if all(map(math.isfinite, values)) else None


def _yaw(q: Any) -> float:
    """Returns the yaw of a quaternion, rad; NaN if it is none."""
    norm = q.x**2 + q.y**2 + q.z**2 + q.w**2
    return math.atan2(2 * (q.w * q.z + q.x * q.y), norm - 2 * (q.y**2 + q.z**2)) if norm > 0 else math.nan


def _imu(message: Any) -> tuple[float, ...] | None:
    rate, unknown = message.angular_velocity.z, message.orientation_covariance[0] == -1
    return (rate, math.nan if unknown else _yaw(message.orientation)) if math.isfinite(rate) else None


def _pose(message: Any) -> tuple[float, ...] | None:
    poses = message.poses if hasattr(message, "poses") else [message.pose]
    if not len(poses):
        return None
    pose = getattr(poses[0], "pose", poses[0])
    place = _finite(pose.position.x, pose.position.y)
    return None if place is None else (*place, _yaw(pose.orientation))


class Role(NamedTuple):
    """Option that names a topic, classes of its messages, and the function that reads them.

    The function returns ``None`` for a message without finite values.
    """

    option: str
    kinds: tuple[Any, ...]
    read: Callable[[Any], Any]


_POSES = ros.PoseStamped, ros.PoseWithCovarianceStamped, ros.PoseArray, ros.Odometry
ROLES = {
    "commands": Role("--cmd-vel-topic", (ros.Twist, ros.TwistStamped), _twist),
    "odometry": Role("--odometry-topic", (ros.Odometry,), lambda message: _twist(message.twist)),
    "imu": Role("--imu-topic", (ros.Imu,), _imu),
    "pose": Role("--pose-topic", _POSES, _pose),
    "scan": Role("--scan-topic", (ros.LaserScan,), lambda each: np.asarray(each.ranges, dtype=np.float32)),
}
