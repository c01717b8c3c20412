"""Calibration of a robot: all numbers that a drive tells, with intervals, and how well they predict it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rover_rl.algos.calibration import sensors
from rover_rl.algos.calibration.dynamics import Dynamics, fit_dynamics, make_windows
from rover_rl.algos.calibration.model import HORIZON, LIMITS, NAMES, STEP, WARMUP, Windows, predict, simulate
from rover_rl.algos.calibration.reading import Recording, Stream
from rover_rl.algos.calibration.sensors import Curve, Estimate
from rover_rl.robots import Robot
from rover_rl.robots.drives import SkidSteer

HORIZONS = (0.2, 1.0, 3.0)
"""Horizons of prediction, s."""
TIME_ERROR, RELATIVE_ERROR = 0.01, 0.02
"""Least half widths of intervals: of times, two steps of the model (s), and of other numbers, a share of them."""
STEPS = "drive ten steps from rest to full speed and back to a full stop"
TURNS = "turn in place for 10 s both ways, in steps from rest to the full yaw rate"
WITH_POSE = "record a pose that is not computed from the wheels"
STAND = "stand for 15 s"


class Number(NamedTuple):
    """A number of the robot: what it is, its unit, its estimate, and what to drive if there is none."""

    label: str
    unit: str
    estimate: Estimate | None
    advice: str


class Calibration(NamedTuple):
    """Numbers by name; velocities as measured and as predicted; errors of prediction.

    ``time`` ``[T]`` (s), ``measured``, ``before`` and ``after`` ``[T, 2]`` (m/s and rad/s). ``errors`` are the medians
    of the distance between the predicted and the measured place at :data:`HORIZONS`, m, before and after.
    """

    numbers: dict[str, Number]
    time: np.ndarray
    measured: np.ndarray
    before: np.ndarray
    after: np.ndarray
    errors: np.ndarray


def calibrate(recording: Recording, robot: Robot) -> Calibration:
    """Finds the numbers of a robot that its drive tells.

    ``robot`` has the limits and the track that are compared with. Raises ``ValueError`` if commands pause too often.
    """
    windows = make_windows(recording.commands, recording.odometry)
    dynamics = fit_dynamics(windows)
    numbers = _ages(recording) | _of_dynamics(dynamics) | _of_bodies(recording, robot, dynamics) | _of_noise(recording)
    candidates = torch.stack((nominal(robot), dynamics.values))
    told = [
        predict(each[None], windows, first)[0]
        for each, first in zip(candidates, (False, dynamics.lag_first), strict=True)
    ]
    kept = windows.weight.bool()
    scale, ratio = (numbers[name].estimate for name in ("wheel_scale", "yaw_ratio"))
    body = torch.tensor([1 / scale.value if scale else 1.0, ratio.value if ratio else 1.0])
    late = numbers["pose_late"].estimate
    place = _places(recording, late.value if late else 0.0)
    errors = [
        _errors(simulate(each[None], windows, first)[0] * part, windows, place)
        for each, first, part in zip(candidates, (False, dynamics.lag_first), (torch.ones(2), body), strict=True)
    ]
    time, measured, before, after = (each[kept].numpy() for each in (windows.at, windows.measured, *told))
    return Calibration(numbers, time, measured, before, after, np.array(errors))


def nominal(robot: Robot) -> Tensor:
    """Returns the parameters of the model for a robot that follows its drive's limits at once."""
    drive = robot.drive
    speed = [1.0, 0.0, *[drive.max_linear_acceleration] * 2, drive.max_speed]
    return torch.tensor([0.0, *speed, 1.0, 0.0, *[drive.max_angular_acceleration] * 2, drive.max_yaw_rate]).double()


def _ages(recording: Recording) -> dict[str, Number]:
    numbers = {}
    for name in ("odometry", "imu", "pose", "scan"):
        stream: Stream | None = getattr(recording, name)
        age = None if stream is None else stream.age
        told = None if age is None else Estimate(float(np.median(age)), *map(float, np.quantile(age, (0.025, 0.975))))
        advice = "record its topic" if stream is None else "synchronize the clocks of the robot and the recorder"
        numbers[f"{name}_age"] = Number(f"delay of {name}, from stamp to arrival", "s", told, advice)
    return numbers


LABELS = {
    "command_delay": ("delay of commands", "s", STEPS),
    "gain": ("{0} by odometry for each commanded", "", "{1}"),
    "lag": ("lag of the {0}", "s", "{1}"),
    "acceleration": ("acceleration of the {0}", "{2}^2", "{1}"),
    "deceleration": ("deceleration of the {0}", "{2}^2", "{1}"),
    "top": ("largest {0}", "{2}", "command a larger {0} than the robot can drive"),
}
"""Label, unit and advice of a parameter, with the name of its channel (0), its advice (1) and its unit (2)."""


def _of_dynamics(dynamics: Dynamics) -> dict[str, Number]:
    numbers = {}
    for name, told, *values in zip(NAMES, dynamics.told, dynamics.values, dynamics.low, dynamics.high, strict=True):
        channel = ("yaw rate", TURNS, "rad/s") if name.startswith("turn") else ("speed", STEPS, "m/s")
        row = LABELS.get(name) or LABELS[name.split("_")[1]]
        label, unit, advice = (part.format(*channel) for part in row)
        value, low, high = map(float, values)
        wide = TIME_ERROR if unit == "s" else RELATIVE_ERROR * value
        estimate = Estimate(value, max(min(low, value - wide), 0.0), max(high, value + wide))
        numbers[name] = Number(label, unit, estimate if told else None, advice)
    return numbers


def _of_bodies(recording: Recording, robot: Robot, dynamics: Dynamics) -> dict[str, Number]:
    """What the other sensors tell of the wheels: scale, ratio of yaw rates, track, slip, and shifts of stamps."""
    odometry, pose, imu, scan = recording.odometry, recording.pose, recording.imu, recording.scan
    wheels, turned = (Curve.integral(odometry.stamp, odometry.values[:, index]) for index in (0, 1))
    still, nothing = sensors.in_place(odometry), (None, None)
    way = None if pose is None else sensors.way_of(pose, imu)
    yaws = [None if each is None or np.isnan(each.values[:, -1]).any() else each for each in (pose, imu)]
    by_pose, by_imu = (None if each is None else Curve(each.stamp, each.values[:, -1]) for each in yaws)
    seen = None if scan is None else sensors.scan_turn(scan, recording.increment, still)
    way_late, speed_ratio = sensors.align(wheels, way) or nothing
    (pose_late, pose_ratio), (imu_late, imu_ratio) = (
        sensors.align(turned, each) or nothing for each in (by_pose, by_imu)
    )
    scan_late, _ = sensors.align(turned, seen, still) or nothing
    _, turn_ratio = sensors.align(turned, by_imu or by_pose, still) or nothing
    one, pose_late = Estimate(1.0, 1.0, 1.0), pose_late or way_late
    scale = None if speed_ratio is None else one.per(speed_ratio)
    # Odometry overstates both velocities by its scale.
    slip = None if turn_ratio is None or scale is None else one.per(turn_ratio).per(scale)
    width = robot.drive.track(robot.wheels) if isinstance(robot.drive, SkidSteer) else None
    track = None if slip is None or width is None else Estimate(*(width * each for each in slip))
    slid = None
    if way is not None and scale is not None:
        fastest = max(float(dynamics.values[NAMES.index(f"speed_{name}")]) for name in LIMITS[:2])
        slid, slid_late = sensors.friction(odometry, way, scale.value, fastest) or nothing
        if slid is not None:
            # A body that slips turns late, too, and its yaw does not tell whether stamps are.
            pose_late, imu_late, scan_late = slid_late, None, None
    turning = TURNS if by_imu or by_pose else "record an IMU or a pose"
    with_scale = turning if scale is not None else WITH_POSE
    slipping = f"{WITH_POSE}, and accelerate and brake until the wheels slip"
    return {
        "wheel_scale": Number("odometry for each meter", "", _widened(scale), f"{WITH_POSE}, and drive straight"),
        "yaw_ratio": Number("yaw rate for each of odometry", "", _widened(imu_ratio or pose_ratio), turning),
        "slip": Number("effective track for each of the drive", "", _widened(slip), with_scale),
        "track": Number("effective track", "m", _widened(track), with_scale),
        "friction": Number("friction", "", _widened(slid), slipping),
        **{
            f"{name}_late": Number(f"stamps of {name} after those of odometry", "s", _widened(late, TIME_ERROR), TURNS)
            for name, late in (("pose", pose_late), ("imu", imu_late), ("scan", scan_late))
        },
    }


def _widened(estimate: Estimate | None, least: float | None = None) -> Estimate | None:
    """Returns an estimate whose interval is as wide as the model's own error at least."""
    if estimate is None:
        return None
    value, low, high = estimate
    wide = RELATIVE_ERROR * abs(value) if least is None else least
    return Estimate(value, min(low, value - wide), max(high, value + wide))


def _of_noise(recording: Recording) -> dict[str, Number]:
    ranges, lost = sensors.scan_noise(recording)
    table: dict[str, tuple[Any, ...]] = {
        "odometry_noise": ("noise of odometry, relative", "", sensors.odometry_noise(recording), STEPS),
        "imu_noise": ("noise of the yaw of the IMU", "rad", sensors.imu_noise(recording), STAND),
        "yaw_bias": ("bias of the yaw rate of the IMU", "rad/s", sensors.yaw_bias(recording), STAND),
        "range_noise": ("noise of a range", "m", ranges, STAND),
        "lost_beams": ("beams without a return, share", "", lost, STAND),
    }
    return {name: Number(*row) for name, row in table.items()}


def _places(recording: Recording, late: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns times and poses ``[T, 3]`` by the pose, else by odometry with the yaw of the IMU, else by odometry."""
    odometry, pose, imu = recording.odometry, recording.pose, recording.imu
    if pose is not None and not np.isnan(pose.values).any():
        return pose.stamp - late, pose.values
    yaw = Curve.integral(odometry.stamp, odometry.values[:, 1]).total
    if imu is not None:
        yaw = np.interp(odometry.stamp, imu.stamp, imu.values[:, 1])
    speed = odometry.values[:, 0]
    x, y = (Curve.integral(odometry.stamp, speed * side).total for side in (np.cos(yaw), np.sin(yaw)))
    return odometry.stamp, np.stack((x, y, yaw), 1)


def _errors(twists: Tensor, windows: Windows, places: tuple[np.ndarray, np.ndarray]) -> list[float]:
    """Returns medians of the errors of the place after each horizon, from velocities ``[W, N, 2]``, m.

    They are those of the windows in which the robot drives or turns, of all if it never does.
    """
    twists = twists[:, round(WARMUP / STEP) :]
    yaw = (twists[..., 1] * STEP).cumsum(1)
    way = (twists[..., :1] * STEP * torch.stack((yaw.cos(), yaw.sin()), -1)).cumsum(1).numpy()
    start, errors = windows.start.numpy(), []
    moves = (windows.measured.abs().amax((1, 2)) > 0.1).numpy()
    moves |= not moves.any()
    x, y, heading = (np.interp(start, places[0], column) for column in places[1].T)
    for horizon in HORIZONS:
        ahead, left = (np.interp(start + horizon, places[0], places[1][:, k]) - (x, y)[k] for k in (0, 1))
        turned = np.cos(heading) * ahead + np.sin(heading) * left, np.cos(heading) * left - np.sin(heading) * ahead
        told = way[:, round(min(horizon, HORIZON) / STEP) - 1]
        errors.append(float(np.median(np.hypot(told[:, 0] - turned[0], told[:, 1] - turned[1])[moves])))
    return errors
