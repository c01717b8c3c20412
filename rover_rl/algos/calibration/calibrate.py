"""Calibration of a robot: all numbers that a drive tells, with intervals, and how well they predict it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid

from rover_rl.algos.calibration import dynamics as base
from rover_rl.algos.calibration import sensors
from rover_rl.algos.calibration.reading import SENSORS, Recording
from rover_rl.algos.calibration.sensors import Alignment, Curve, Estimate, align
from rover_rl.robots import Robot
from rover_rl.robots.drives import SkidSteer

HORIZONS = (0.2, 1.0, 3.0)  # of prediction, s
TIME_ERROR, RELATIVE_ERROR = 0.01, 0.02  # least half widths of intervals: of times, s, and of others, a share of them
STEPS = "drive ten steps from rest to full speed and back to a full stop"
TURNS = "turn in place for 10 s both ways, in steps from rest to the full yaw rate"
WITH_POSE = "record a pose that is not computed from the wheels"
STAND = "stand for 15 s"
REPEATED = "the pose repeats the odometry, so it tells nothing of the wheels"


class Number(NamedTuple):
    """A number of the robot: what it is, its unit, what to drive to tell it, and its estimate."""

    label: str
    unit: str
    advice: str
    estimate: Estimate | None = None


def _of_channel(name: str, called: str, unit: str, advice: str) -> dict[str, Number]:
    return {
        f"{name}_gain": Number(f"{called} by odometry for each commanded", "", advice),
        f"{name}_lag": Number(f"lag of the {called}", "s", advice),
        f"{name}_acceleration": Number(f"acceleration of the {called}", f"{unit}^2", advice),
        f"{name}_deceleration": Number(f"deceleration of the {called}", f"{unit}^2", advice),
        f"{name}_top": Number(f"largest {called}", unit, f"command a larger {called} than the robot can drive"),
    }


_SYNCHRONIZED = "record its topic, with synchronized clocks of the robot and the recorder"
NUMBERS = {
    **{f"{name}_age": Number(f"delay of {name}, from stamp to arrival", "s", _SYNCHRONIZED) for name in SENSORS},
    "command_delay": Number("delay of commands", "s", STEPS),
    **_of_channel("speed", "speed", "m/s", STEPS),
    **_of_channel("turn", "yaw rate", "rad/s", TURNS),
    "wheel_scale": Number("odometry for each meter", "", f"{WITH_POSE}, and drive straight"),
    "yaw_ratio": Number("yaw rate for each of odometry", "", f"record an IMU or a pose, and {TURNS}"),
    "slip": Number("effective track for each of the drive", "", f"{WITH_POSE}, and {TURNS}"),
    "track": Number("effective track", "m", f"{WITH_POSE}, and {TURNS}"),
    "friction": Number("friction", "", f"{WITH_POSE}, and drive arcs on level ground"),
    **{f"{name}_late": Number(f"stamps of {name} after those of odometry", "s", TURNS) for name in SENSORS[1:]},
    "odometry_noise": Number("noise of odometry, relative", "", STEPS),
    "imu_noise": Number("noise of the yaw of the IMU", "rad", STAND),
    "yaw_bias": Number("bias of the yaw rate of the IMU", "rad/s", STAND),
    "range_noise": Number("noise of a range", "m", STAND),
    "lost_beams": Number("beams without a return, share", "", STAND),
}


class Calibration(NamedTuple):
    """Numbers by name; velocities as measured and as predicted; errors of prediction.

    ``time`` ``[T]`` (s), ``measured``, ``before`` and ``after`` ``[T, 2]`` (m/s and rad/s). ``errors`` are the medians
    of the distance between the predicted and the measured place at :data:`HORIZONS`, m, before and after. ``restless``
    ``[3]`` are medians of how far the measured place goes in these times while the robot stands: a pose that drifts and
    jumps adds that to both errors. NaN if it never stands so long.
    """

    numbers: dict[str, Number]
    time: np.ndarray
    measured: np.ndarray
    before: np.ndarray
    after: np.ndarray
    errors: np.ndarray
    restless: np.ndarray


def calibrate(recording: Recording, robot: Robot) -> Calibration:
    """Finds the numbers of a robot that its drive tells.

    ``robot`` has the limits and the track that are compared with. Raises ``ValueError`` if commands pause too often.
    """
    windows = base.make_windows(recording.commands, recording.odometry)
    dynamics = base.fit_dynamics(windows)
    bodies, repeated = _of_bodies(recording, robot, dynamics)
    fitted = {name: _widened(name, each) for name, each in {**bodies, **dynamics.told}.items()}
    estimates: dict[str, Estimate | None] = {**fitted, **sensors.noise(recording)}
    numbers = {name: number._replace(estimate=estimates.get(name)) for name, number in NUMBERS.items()}
    for name in repeated:
        numbers[name] = numbers[name]._replace(advice=f"{REPEATED}: {numbers[name].advice}")
    scale, ratio, late = (estimates.get(name) for name in ("wheel_scale", "yaw_ratio", "pose_late"))
    body = np.array([1 / scale.value if scale else 1.0, ratio.value if ratio else 1.0])
    place = _places(recording, late.value if late else 0.0)
    told, errors, kept, drive = [], [], windows.weight.astype(bool), robot.drive
    # Before, the robot follows the limits of its drive at once.
    speed = [1.0, 0.0, *[drive.max_linear_acceleration] * 2, drive.max_speed]
    before = np.array([0.0, *speed, 1.0, 0.0, *[drive.max_angular_acceleration] * 2, drive.max_yaw_rate])
    for values, lag_first, part in ((before, False, 1.0), (dynamics.values, dynamics.lag_first, body)):
        told.append(base.predict(values[None], windows, lag_first)[0][kept])
        errors.append(_errors(base.simulate(values[None], windows, lag_first)[0] * part, windows, *place))
    measured = windows.at[kept], windows.measured[kept]
    restless = _restless(recording, *place[:2])
    return Calibration(numbers, *measured, told[0], told[1], np.array(errors), restless)


def _widened(name: str, estimate: Estimate) -> Estimate:
    """Returns an estimate whose interval is as wide as the model's own error at least."""
    value, low, high = estimate
    wide = TIME_ERROR if NUMBERS[name].unit == "s" else RELATIVE_ERROR * abs(value)
    low = min(low, value - wide)
    return Estimate(value, low if name.endswith("_late") else max(low, 0.0), max(high, value + wide))


def _of_bodies(recording: Recording, robot: Robot, dynamics: base.Dynamics) -> tuple[dict[str, Estimate], set[str]]:
    """What other sensors tell of the wheels and stamps, and names of what they cannot, as they repeat the odometry."""
    odometry, pose, imu, scan = recording.odometry, recording.pose, recording.imu, recording.scan
    wheels, turned = (Curve.integral(odometry.stamp, column) for column in odometry.values.T)
    still, one = sensors.pure(odometry, 0, sensors.IN_PLACE), Estimate(1.0, 1.0, 1.0)
    path = None if pose is None else sensors.way_of(pose, imu)
    way, found = None if path is None else Curve(path.time, path.total.real), dict[str, Alignment | None]()
    if way is not None:
        # In bows, the wheels of a skid-steer base slip along the way, too.
        straight = sensors.pure(odometry, 1, sensors.STRAIGHT)
        found["way"] = align(wheels, way, straight) or align(wheels, way)
    yaws = ("imu", imu, 1), ("pose", pose, 2)
    curves = {name: Curve(each.stamp, each.values[:, column]) for name, each, column in yaws if each}
    curves = {name: curve for name, curve in curves.items() if not np.isnan(curve.total).any()}
    found |= {name: align(turned, curve) for name, curve in curves.items()}
    if scan is not None:
        found["scan"] = align(turned, sensors.scan_turn(scan, recording.increment, still), still)
    aligned = {name: each for name, each in found.items() if each is not None}
    # The yaw of a pose, which comes after the way, tells better how late it is.
    late = {f"{'pose' if name == 'way' else name}_late": each.late for name, each in aligned.items()}
    told = {name: each for name, each in aligned.items() if not each.repeats}
    ratios = [told[name].ratio for name in ("imu", "pose") if name in told]
    numbers = {"yaw_ratio": ratios[0]} if ratios else {}
    name = next((name for name in curves if name in told or name not in aligned), "")
    if path is not None and way is not None and "way" in told:
        numbers["wheel_scale"] = scale = one.per(told["way"].ratio)
        turning = align(turned, curves[name], still) if name else None
        if turning is not None:
            # Odometry overstates both velocities by its scale.
            numbers["slip"] = slip = one.per(turning.ratio).per(scale)
            if isinstance(robot.drive, SkidSteer):
                width = robot.drive.track(robot.wheels)
                numbers["track"] = Estimate(*(width * each for each in slip))
                left = Curve(path.time - late["pose_late"].value, path.total.imag)
                slide = sensors.slide(odometry, imu, left, scale.value, turning.ratio.value)
                if slide is not None:
                    numbers["friction"] = _friction(robot, numbers["track"], slide)
        fastest = max(float(dynamics.values[base.NAMES.index(f"speed_{name}")]) for name in base.LIMITS[:2])
        if (slipped := sensors.friction(odometry, way, scale.value, fastest)) is not None:
            # A body that slips turns late, too, and its yaw does not tell whether stamps are.
            numbers["friction"], late = slipped[0], {"pose_late": slipped[1]}
    repeated = {"wheel_scale", "slip", "track", "friction"} if "way" in aligned.keys() - told else set[str]()
    if curves and not name:
        repeated |= {"yaw_ratio", "slip", "track"}
    return numbers | late, repeated


def _friction(robot: Robot, track: Estimate, slide: Estimate) -> Estimate:
    """Returns the friction by how far a skid-steer base slides in turns, and its effective track, m.

    A patch of a wheel slips by ``s = (track / 2 - |y|, x)`` for each rad. Coulomb friction ``mu N s / |s|`` changes
    with the velocity to the left by ``mu N s_x^2 / |s|^3``, and the sum over all patches holds the force to that side.
    """
    hubs = np.array(robot.wheels.hubs)[:, :2] - np.mean(robot.wheels.hubs, 0)[:2]
    half = np.array((0.0, robot.wheels.width / math.sqrt(12)))
    x, y = np.concatenate((hubs - half, hubs + half)).T
    ahead = np.array(track)[:, None] / 2 - np.abs(y)
    value, low, high = 1 / (ahead**2 / np.hypot(ahead, x) ** 3).mean(1)
    one, other = sorted((low, high))
    return Estimate(float(value / slide.value), float(one / slide.high), float(other / slide.low))


def _places(recording: Recording, late: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns times, places (x + iy) and yaws by the pose, else by odometry, with the yaw of an IMU if it is there."""
    odometry, pose, imu = recording.odometry, recording.pose, recording.imu
    if pose is not None and not np.isnan(pose.values).any():
        x, y, yaw = pose.values.T
        return pose.stamp - late, x + 1j * y, yaw
    speed, rate = odometry.values.T
    yaw = Curve.integral(odometry.stamp, rate).total
    if imu is not None:
        yaw = np.interp(odometry.stamp, imu.stamp, imu.values[:, 1])
    return odometry.stamp, cumulative_trapezoid(speed * np.exp(1j * yaw), odometry.stamp, initial=0), yaw


def _restless(recording: Recording, time: np.ndarray, place: np.ndarray) -> np.ndarray:
    moves, ways = ~sensors.at_rest(recording, time), []
    for horizon in HORIZONS:
        stands = sensors.never(moves, time, time, 0.0, horizon) & (time + horizon < time[-1])
        gone = np.abs(np.interp(time + horizon, time, place) - place)[stands]
        ways.append(np.median(gone) if gone.size else np.nan)
    return np.array(ways)


def _errors(
    twists: np.ndarray, windows: base.Windows, time: np.ndarray, place: np.ndarray, yaw: np.ndarray
) -> list[float]:
    """Returns medians of the errors of the place after each horizon, from velocities ``[W, N, 2]``, m.

    They are those of the windows in which the robot drives or turns, of all if it never does.
    """
    speed, rate = np.moveaxis(base.STEP * twists[:, round(base.WARMUP / base.STEP) :], -1, 0)
    way, start = np.cumsum(speed * np.exp(1j * np.cumsum(rate, 1)), 1), windows.start
    moves = np.abs(windows.measured).max((1, 2)) > 0.1
    moves |= not moves.any()
    errors = []
    for horizon in HORIZONS:
        gone = np.interp(start + horizon, time, place) - np.interp(start, time, place)
        told = way[:, round(min(horizon, base.HORIZON) / base.STEP) - 1]
        turned = gone * np.exp(-1j * np.interp(start, time, yaw))
        errors.append(float(np.median(np.abs(told - turned)[moves])))
    return errors
