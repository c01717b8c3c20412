"""Recordings of drives whose numbers are known: a kinematic robot with lag, limits and delays, and a writer of MCAP."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from rover_rl.sims.ros2 import messages as ros

BEGIN = 1000.0  # time of the first command, s
FINE = 0.002  # step of the integration, s


@dataclass(frozen=True)
class Truth:
    """Numbers of a kinematic robot. ``order``: the lag comes after the limits of acceleration, or before them."""

    command_delay: float = 0.12
    speed_lag: float = 0.15
    turn_lag: float = 0.1
    acceleration: float = 1.2
    deceleration: float = 2.0
    turn_acceleration: float = 3.0
    turn_deceleration: float = 4.0
    max_speed: float = 0.9
    max_yaw_rate: float = 1.5
    wheel_scale: float = 1.04
    yaw_ratio: float = 0.45
    ages: tuple[float, float, float, float] = (0.02, 0.03, 0.06, 0.08)  # of odometry, IMU, pose and scan, s
    skews: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # by which their stamps are late, s
    odometry_noise: float = 0.02
    imu_noise: float = 0.005
    range_noise: float = 0.01
    pose_noise: float = 0.01
    yaw_bias: float = 0.0
    friction: float = math.inf
    order: str = "limits first"
    slide: float = 0.0  # to the side for each rad in turns by a force of the weight, m


def exciting(seed: int = 0, seconds: float = 150.0, top: float = 1.2, turn: float = 2.0) -> np.ndarray:
    """Commands at 20 Hz that excite everything after 14 s of rest, ``[K, 3]``: time (s), m/s and rad/s."""
    rng = np.random.default_rng(seed)
    parts = [(0.0, 0.0, 14.0)]
    while sum(part[2] for part in parts) < seconds:
        kind, hold = rng.integers(4), rng.uniform(1.0, 3.5)
        speed = rng.choice((-1, 1)) * top * rng.choice((0.3, 0.6, 1.0)) if kind != 1 else 0.0
        rate = rng.choice((-1, 1)) * turn * rng.choice((0.3, 0.6, 1.0)) if kind in (1, 2) else 0.0
        parts += [(speed, rate, hold)] + ([(0.0, 0.0, 1.5)] if kind != 3 else [])
    return held(parts)


def held(parts: Iterable[tuple[float, float, float]]) -> np.ndarray:
    """Commands at 20 Hz that hold speed (m/s) and yaw rate (rad/s) for some seconds each."""
    rows = [(v, w) for v, w, seconds in parts for _ in range(round(seconds * 20))]
    return np.column_stack((np.arange(len(rows)) / 20, np.array(rows)))


def drive(truth: Truth, commands: np.ndarray, seed: int = 0) -> dict[str, list[tuple[float, float, Any]]]:
    """Drives a kinematic robot: arrival (s), stamp (s) and message of each topic."""
    times, wheels, states = _motion(truth, commands)
    rng = np.random.default_rng(seed)

    def sampled(age: float, skew: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Times of the readings, of their arrivals and their stamps."""
        at = np.arange(rng.uniform(0, 0.05), times[-1] - 1.0, 0.05)
        return at, at + age + np.abs(rng.normal(0, 0.003, len(at))), at + skew

    def now(table: np.ndarray, at: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(at, times, column) for column in table.T])

    said: dict[str, list[tuple[float, float, Any]]] = {
        "/cmd_vel": [(t, t, ros.Twist(ros.Vector3(x=v), ros.Vector3(z=w))) for t, v, w in commands.tolist()]
    }
    (at, arrival, stamp), table = sampled(truth.ages[0], truth.skews[0]), []
    noisy = now(wheels, at) * truth.wheel_scale * (1 + truth.odometry_noise * rng.standard_normal((len(at), 2)))
    for a, s, (v, w) in zip(arrival, stamp, noisy.tolist(), strict=True):
        twist = ros.TwistWithCovariance(ros.Twist(ros.Vector3(x=v), ros.Vector3(z=w)))
        table.append((a, s, ros.Odometry(_header(s, "odom"), "base_link", twist=twist)))
    said["/odometry/wheels"], table = table, []
    at, arrival, stamp = sampled(truth.ages[1], truth.skews[1])
    yaws = now(states, at)[:, 2] + truth.yaw_bias * at + truth.imu_noise * rng.standard_normal(len(at))
    for a, s, yaw in zip(arrival, stamp, yaws.tolist(), strict=True):
        table.append((a, s, ros.Imu(_header(s, "imu_link"), _turned(yaw))))
    said["/imu/data"], table = table, []
    at, arrival, stamp = sampled(truth.ages[2], truth.skews[2])
    places = now(states, at) + truth.pose_noise * rng.standard_normal((len(at), 3)) * (1, 1, 0.3)
    for a, s, (x, y, yaw) in zip(arrival, stamp, places.tolist(), strict=True):
        table.append((a, s, ros.PoseArray(_header(s, "world"), [ros.Pose(ros.Point(x, y), _turned(yaw))])))
    said["/rover/pose_array"], table = table, []
    at, arrival, stamp = sampled(truth.ages[3], truth.skews[3])
    for a, s, state in zip(arrival, stamp, now(states, at), strict=True):
        ranges = _box(state) + truth.range_noise * rng.standard_normal(360)
        ranges[rng.random(360) < 0.02] = math.inf
        scan = ros.LaserScan(_header(s, "lidar_link"), angle_increment=math.tau / 360, ranges=ranges.astype(np.float32))
        table.append((a, s, scan))
    return {**said, "/scan": table}


def _motion(truth: Truth, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integrates times ``[T]``, true velocities of the wheels ``[T, 2]`` and poses ``[T, 3]``."""
    times = np.arange(0.0, commands[-1, 0] + 1.0, FINE)
    index = np.searchsorted(commands[:, 0], times - truth.command_delay, side="right") - 1
    asked = np.where(index[:, None] < 0, 0.0, commands[index.clip(0), 1:])
    columns = zip(
        np.clip(asked, *((sign * truth.max_speed, sign * truth.max_yaw_rate) for sign in (-1, 1))).T,
        (truth.acceleration, truth.turn_acceleration),
        (truth.deceleration, truth.turn_deceleration),
        (truth.speed_lag, truth.turn_lag),
        strict=True,
    )
    wheels = np.column_stack([_follow(*column, truth.order) for column in columns])
    speed = _follow(wheels[:, 0], *[9.81 * truth.friction] * 2, 1e-9, "limits first")
    yaw = np.cumsum(wheels[:, 1] * truth.yaw_ratio * truth.wheel_scale) * FINE
    rate = wheels[:, 1] * truth.yaw_ratio * truth.wheel_scale
    moved = (speed - 1j * truth.slide * np.abs(rate) * rate * speed / 9.81) * np.exp(1j * yaw) * FINE
    return times, wheels, np.column_stack((np.cumsum(moved.real), np.cumsum(moved.imag), yaw))


def _follow(asked: np.ndarray, up: float, down: float, lag: float, order: str) -> np.ndarray:
    share = 1 - math.exp(-FINE / lag)
    ramp = now = 0.0
    reached = []
    for goal in asked.tolist():
        most = FINE * (up if (goal - ramp) * ramp >= 0 else down)
        if order == "limits first":
            ramp += min(max(goal - ramp, -most), most)
            now += share * (ramp - now)
        else:
            ramp += min(max(share * (goal - ramp), -most), most)
            now = ramp
        reached.append(now)
    return np.array(reached)


def _box(state: np.ndarray, size: float = 6.0) -> np.ndarray:
    """Ranges of 360 beams in a room with walls at different distances, m."""
    angles = state[2] + np.arange(360) * math.tau / 360
    with np.errstate(divide="ignore"):
        x = np.where(np.cos(angles) > 0, 40 - state[0], -size - 30 - state[0]) / np.cos(angles)
        y = np.where(np.sin(angles) > 0, 1.5 * size - state[1], -3 * size - state[1]) / np.sin(angles)
    return np.minimum(np.abs(x), np.abs(y)).clip(0, 30)


def _header(stamp: float, frame: str) -> Any:
    return ros.Header(ros.Time.from_seconds(BEGIN + stamp), frame)


def _turned(yaw: float) -> Any:
    return ros.Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))


def write(folder: Path, said: dict[str, list[tuple[float, float, Any]]], leave_out: Sequence[str] = ()) -> Path:
    """Writes messages to a folder of rosbag2 with one MCAP file."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, rows in said.items():
            if topic in leave_out or not rows:
                continue
            link = writer.add_connection(topic, rows[0][2].ros_type, typestore=ros.TYPES)
            for arrival, _, message in rows:
                writer.write(link, round((BEGIN + arrival) * 1e9), ros.encode(message))
    return folder
