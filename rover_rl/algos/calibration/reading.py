"""Reads a recording of a drive: an MCAP file or a folder of rosbag2. Needs the extra ``ros2``."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import astuple
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.integrate import cumulative_trapezoid

from rover_rl.algos.deploy.bags import Bag
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.poses import pose_in
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.settings import Connection

SENSORS = ("odometry", "imu", "pose", "scan")
CLOCK, NEEDED = "/clock", ("commands", "odometry")
LEAST = 20.0  # shortest drive that is fitted, s
SYNCHRONIZED = 1.0  # largest age of a message whose stamp is of the clock of the recording, s
BACKWARD = 0.1  # time by which stamps may be out of order, s


class Stream(NamedTuple):
    """Messages of one topic in the order of their stamps: values ``[M, k]``, and times since the start, s.

    Where messages have no stamp, or one of another clock, ``stamp`` is the arrival, and ``age``, the delay, ``None``.
    """

    arrival: np.ndarray
    stamp: np.ndarray
    age: np.ndarray | None
    values: np.ndarray


class Recording(NamedTuple):
    """Commands and readings of a drive.

    ``commands`` and ``odometry`` have speed (m/s) and yaw rate (rad/s); ``imu`` yaw rate (rad/s), yaw (rad, unwrapped)
    and tilt (rad, if small); ``pose`` x, y (m) and yaw (rad, unwrapped; NaN without one); ``scan`` the ranges (m; not
    finite without a return), whose beams are ``increment`` apart, rad. Sensors that were not recorded are ``None``.
    """

    commands: Stream
    odometry: Stream
    imu: Stream | None
    pose: Stream | None
    scan: Stream | None
    increment: float


def read_recording(path: Path, connection: Connection, settings: Ros2Settings) -> Recording:
    """Reads the topics of a drive. Commands and odometry are needed.

    Raises ``FileNotFoundError`` if there is no such file or folder, and ``ValueError`` if it is no recording, has no
    commands or no odometry, a topic is of another type or of two robots, time goes back, or the drive is too short.
    """
    topics = {**vars(connection), **vars(settings)}
    bag, named = Bag(path), {name: topics[role.topic] for name, role in ROLES.items()}
    rows, increment = _read(bag, named)
    begin = min((row[0] for some in rows.values() for row in some), default=0.0)
    read = {role: _stream(topic, role, rows[role], np.array(rows[CLOCK]), begin) for role, topic in named.items()}
    for role in NEEDED:
        if read[role] is None:
            raise ValueError(f"{named[role]} in {path} has no finite {role}")
    recording = Recording(**read, increment=increment)  # type: ignore[arg-type]
    commands, odometry = recording.commands.arrival, recording.odometry.stamp
    shared = min(commands[-1], odometry[-1]) - max(commands[0], odometry[0])
    if shared < LEAST:
        raise ValueError(f"commands and odometry overlap for {max(shared, 0):.1f} s, and {LEAST:g} s are the least")
    return recording


def _read(bag: Bag, named: dict[str, str]) -> tuple[dict[str, list[Any]], float]:
    """Returns arrival, stamp (s) and values of the messages of each role, and the angle between beams, rad."""
    kinds = {CLOCK: ros.Clock}
    for role, topic in named.items():
        if role in NEEDED or topic in bag.types:
            option = f"--{ROLES[role].topic.replace('_', '-')}"
            kinds[topic] = bag.require(role, option, topic, *ROLES[role].kinds)
    rows, frames = defaultdict[str, list[Any]](list), defaultdict[str, set[str]](set)
    increment = 0.0
    for topic, at, message in bag.messages(kinds):
        if topic == CLOCK:
            rows[CLOCK].append((at, ros.seconds_of(message.clock)))
        header = getattr(message, "header", None)
        if header is not None:
            frames[topic].add(" ".join((header.frame_id, getattr(message, "child_frame_id", ""))).strip())
        for role in (role for role, its in named.items() if its == topic):
            increment = message.angle_increment if role == "scan" else increment
            stamp = math.nan if header is None or role == "commands" else ros.seconds_of(header.stamp)
            with suppress(ValueError):  # an array without a pose
                rows[role].append((at, stamp, ROLES[role].read(message)))
    for topic, names in frames.items():
        if len(names) > 1:
            text = f"of several robots or sensors, by their frames: {', '.join(map(repr, sorted(names)))}"
            raise ValueError(f"{topic} has messages {text}; record one")
    return rows, increment


def _stream(topic: str, role: str, rows: list[Any], clock: np.ndarray, begin: float) -> Stream | None:
    size, finite = max((len(row[2]) for row in rows), default=0), ROLES[role].finite
    rows = [row for row in rows if len(row[2]) == size and all(map(math.isfinite, row[2][:finite]))]
    if not rows:
        return None
    arrival, stamp, values = map(np.array, zip(*sorted(rows, key=itemgetter(0)), strict=True))
    if len(clock):
        # Stamps of simulated time: the arrival in the same clock.
        arrival, begin = np.interp(arrival, *clock.T), clock[0, 1]
    arrival, stamp = arrival - begin, stamp - begin
    back = np.append(np.diff(stamp), 0.0)
    if np.nanmin(back) < -BACKWARD:
        place = f"by {-np.nanmin(back):.2f} s, {arrival[np.nanargmin(back)]:.1f} s after the start"
        raise ValueError(f"time goes backward on {topic} {place}: the robot restarted, or two robots publish on it")
    age: np.ndarray | None = arrival - stamp
    if not abs(np.median(arrival - stamp)) <= SYNCHRONIZED:  # NaN, too
        stamp, age = arrival, None
    keep = np.append(True, stamp[1:] > np.maximum.accumulate(stamp)[:-1])
    stamp, values = stamp[keep], values[keep]
    if role in ("imu", "pose"):
        values, turn = values[:, :-4], values[:, -4:]
        yaw = quaternion_to_euler(torch.from_numpy(turn))[:, 2].numpy()
        tilt = (2 * np.hypot(*turn[:, :2].T),) if role == "imu" else ()
        # NaN from one on that is zero.
        values = np.column_stack((values, np.unwrap(np.where(turn.any(1), yaw, np.nan)), *tilt))
    if role == "imu" and np.isnan(values).any():
        # An IMU without orientation: its yaw rate adds up.
        values[:, 1] = cumulative_trapezoid(values[:, 0], stamp, initial=0)
    return Stream(arrival[keep], stamp, None if age is None else age[keep], values)


def _twist(message: Any) -> Sequence[float]:
    twist = getattr(message, "twist", message)
    return twist.linear.x, twist.angular.z


def _imu(message: Any) -> Sequence[float]:
    is_unknown = message.orientation_covariance[0] == -1
    return message.angular_velocity.z, *((0.0,) * 4 if is_unknown else astuple(message.orientation))


def _pose(message: Any) -> Sequence[float]:
    pose = pose_in(message)
    return pose.position.x, pose.position.y, *astuple(pose.orientation)


class Role(NamedTuple):
    """Setting that names a topic, classes of its messages, function that reads them, and number of finite values."""

    topic: str
    kinds: tuple[Any, ...]
    read: Callable[[Any], Any]
    finite: int


_POSES = ros.PoseStamped, ros.PoseWithCovarianceStamped, ros.PoseArray, ros.Odometry
ROLES = {
    "commands": Role("cmd_vel_topic", (ros.Twist, ros.TwistStamped), _twist, 2),
    "odometry": Role("odometry_topic", (ros.Odometry,), lambda message: _twist(message.twist), 2),
    "imu": Role("imu_topic", (ros.Imu,), _imu, 1),
    "pose": Role("pose_topic", _POSES, _pose, 2),
    "scan": Role("scan_topic", (ros.LaserScan,), lambda each: np.asarray(each.ranges, dtype=np.float32), 0),
}
