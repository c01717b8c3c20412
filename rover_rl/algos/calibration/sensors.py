"""What sensors tell of each other: delays, scales, noise, bias and friction.

A function returns an :class:`Estimate`, or ``None`` if the drive does not tell the number.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.stats import median_abs_deviation, ttest_1samp

from rover_rl.algos.calibration.reading import SENSORS, Recording, Stream

GRID = 0.05  # distance of the times at which sensors are compared, s
SPAN = 0.5  # time over which a change of the pose is compared, s
FARTHEST, FINE = 0.5, 0.01  # largest shift between two sensors, and the step of its search, s
BLOCK = 60  # number of times in a block of the bootstrap: 3 s
DRAWS = 200  # number of bootstrap samples
STANDING = 0.02  # largest speed of a base at rest, m/s and rad/s
IN_PLACE, STRAIGHT = 0.05, 0.1  # largest speed of a turn in place, m/s, and yaw rate of a drive straight ahead, rad/s
MOVING = 0.05  # root mean square of the changes in a block with motion, m and rad
LEAST_BLOCKS = 4  # least number of blocks with motion
PIECE, LEAST_PIECES = 3.0, 3  # duration (s) and least number of the pieces at rest that tell the bias of the IMU
SAME = 0.004  # difference to odometry of a pose that is made of it, m and rad, and of their ratio to 1
GRAVITY = 9.81  # m/s^2
LEVEL = 0.05  # largest median tilt of ground on which sliding in turns tells the friction, rad


class Estimate(NamedTuple):
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, value: Any, draws: np.ndarray) -> Estimate:
        """Takes the interval from bootstrap samples."""
        return cls(float(value), *map(float, np.quantile(draws, (0.025, 0.975))))

    @classmethod
    def around(cls, value: Any, half: Any) -> Estimate:
        return cls(float(value), float(value - half), float(value + half))

    def per(self, other: Estimate) -> Estimate:
        """Returns the ratio of two independent positive numbers, to first order."""
        mine, others = ((one.high - one.low) / 2 / one.value for one in (self, other))
        value = self.value / other.value
        return Estimate.around(value, abs(value) * math.hypot(mine, others))


class Curve(NamedTuple):
    """Something that adds up along the drive: the way, m, or the yaw, rad."""

    time: np.ndarray
    total: np.ndarray

    @classmethod
    def integral(cls, time: np.ndarray, rate: np.ndarray) -> Curve:
        return cls(time, cumulative_trapezoid(rate, time, initial=0))

    def change(self, at: np.ndarray) -> np.ndarray:
        """Change over ``SPAN`` about the times ``at``."""
        return np.interp(at + SPAN / 2, *self) - np.interp(at - SPAN / 2, *self)


class Alignment(NamedTuple):
    """By how much a sensor is late beside odometry, s, and its changes by those of odometry.

    ``repeats`` tells that it is made of odometry: what they add up to stays the same all along the drive.
    """

    late: Estimate
    ratio: Estimate
    repeats: bool


def align(reference: Curve, other: Curve, weight: Curve | None = None) -> Alignment | None:
    """Compares a sensor with odometry.

    The shift is that with the least squared difference of changes over half a second. Their weights fall with the
    residuals (Geman and McClure, 1987), as a pose that jumps has large ones. Intervals are a bootstrap over blocks of
    3 s. ``None`` if there is too little motion where ``weight`` is 1, or the sensors do not agree.
    """
    at, shifts = _shared(reference, other), np.arange(-FARTHEST, FARTHEST + FINE / 2, FINE)
    if len(at) < LEAST_BLOCKS * BLOCK:
        return None
    seen, told = other.change(at), np.stack([reference.change(at - shift) for shift in shifts])
    keep = allowed = np.ones(len(at)) if weight is None else (np.interp(at, *weight) > 0.5).astype(float)
    for _ in range(5):
        product, square = (_by_block(keep * each) for each in (told * seen, told**2))
        shift, gain = _best(product.sum(-1), square.sum(-1), shifts)
        rest = np.abs(seen - gain * reference.change(at - shift))
        keep = allowed * _weights(rest, allowed, 0.01 * np.abs(seen).max())
    moving = (square[len(shifts) // 2] > MOVING**2 * BLOCK).sum()
    if moving < LEAST_BLOCKS or not (keep * rest**2).sum() < 0.3 * (keep * seen**2).sum():
        return None
    samples = np.array([_best(product @ draw, square @ draw, shifts) for draw in _resampled(product.shape[1])])
    late, ratio = Estimate.of(shift, samples[:, 0]), Estimate.of(gain, samples[:, 1])
    apart = median_abs_deviation(np.interp(at, *other) - np.interp(at - shift, *reference), scale="normal")
    repeats = bool(apart < SAME and abs(gain - 1) < SAME)
    return Alignment(late, ratio, repeats) if late.high - late.low < 0.1 else None


def _weights(rest: np.ndarray, allowed: np.ndarray, least: float) -> np.ndarray:
    """Returns weights of residuals whose scale is three robust standard deviations, and ``least`` more."""
    usual = 1.48 * np.median(rest[allowed > 0]) if allowed.any() else 0.0
    return 1 / (1 + (rest / (3 * usual + least + 1e-9)) ** 2) ** 2


def _shared(one: Curve, other: Curve) -> np.ndarray:
    """Returns times at which both are known, in whole blocks."""
    at = np.arange(max(one.time[0], other.time[0]) + 1, min(one.time[-1], other.time[-1]) - 1, GRID)
    return at[: len(at) // BLOCK * BLOCK]


def _by_block(values: np.ndarray) -> np.ndarray:
    return values.reshape(*values.shape[:-1], -1, BLOCK).sum(-1)


def _resampled(blocks: int) -> np.ndarray:
    """Returns how often a bootstrap sample draws each block, ``[DRAWS, blocks]``."""
    return np.random.default_rng(0).multinomial(blocks, [1 / blocks] * blocks, DRAWS)


def _best(product: np.ndarray, square: np.ndarray, shifts: np.ndarray) -> tuple[float, float]:
    """Returns the shift that explains most, and the ratio there."""
    score = product**2 / np.maximum(square, 1e-12)
    index = int(score[1:-1].argmax()) + 1
    part = _vertex(*score[index - 1 : index + 2])
    return float(shifts[index] + part * FINE), float(product[index] / max(square[index], 1e-12))


def _vertex(left: Any, middle: Any, right: Any) -> Any:
    """Returns where the parabola through three points at -1, 0 and 1 has its vertex, at most one away."""
    bend = left - 2 * middle + right
    return np.clip(0.5 * (left - right) / np.where(bend == 0, np.inf, bend), -1, 1)


def way_of(pose: Stream, imu: Stream | None) -> Curve | None:
    """Returns the way that a pose tells ahead, and to the left (imaginary), by its heading, else by the IMU's, m."""
    x, y, yaw = pose.values.T
    if np.isnan(yaw).any():
        if imu is None:
            return None
        yaw = np.interp(pose.stamp, imu.stamp, imu.values[:, 1])
    ahead = np.diff(x + 1j * y) * np.exp(-0.5j * (yaw[1:] + yaw[:-1]))
    return Curve(pose.stamp, np.append(0.0, np.cumsum(ahead)))


def slide(odometry: Stream, imu: Stream | None, way: Curve, scale: float, ratio: float) -> Estimate | None:
    """Returns how far a skid-steer base slides to a side for each rad that it turns, m, by a force of its weight.

    Coulomb friction opposes the slip of the wheels in a turn. To another force, here the centrifugal one, the base then
    yields in proportion to how fast it turns. ``way`` is that to the left. ``None`` where the IMU tells a slope.
    """
    if imu is not None and np.median(np.abs(imu.values[:, 2])) > LEVEL:
        return None
    time, (speed, rate) = odometry.stamp, odometry.values.T
    yields = Curve.integral(time, -np.abs(rate) * ratio * speed / scale * rate * ratio / GRAVITY)
    at = _shared(yields, way)
    told, seen, keep = yields.change(at), way.change(at), np.ones(len(at))
    for _ in range(5):
        product, square = (_by_block(keep * each) for each in (told * seen, told**2))
        found = product.sum() / max(square.sum(), 1e-12)
        keep = _weights(np.abs(seen - found * told), np.abs(told) > 1e-4, 1e-3)
    draws = _resampled(len(product))
    estimate = Estimate.of(found, draws @ product / np.maximum(draws @ square, 1e-12))
    return estimate if estimate.high - estimate.low < 0.5 * found else None


def never(events: np.ndarray, time: np.ndarray, at: np.ndarray, before: float, after: float) -> np.ndarray:
    """Whether there is no event from ``before`` until ``after`` (s) each time ``at``."""
    count = np.append(0, np.cumsum(events))
    one, end = np.searchsorted(time, (at - before, at + after))
    return count[end] == count[one]


def pure(odometry: Stream, other: int, most: float) -> Curve:
    """Returns 1 where velocity ``other``, 0 or 1, has been at most ``most`` for 0.8 s before and after, else 0."""
    mixed, time = np.abs(odometry.values[:, other]) > most, odometry.stamp
    return Curve(time, never(mixed, time, time, 0.8, 0.8).astype(float))


def at_rest(recording: Recording, times: np.ndarray) -> np.ndarray:
    """Whether the base has been at rest and told to be for a second before and after each time."""
    odometry, (sent, *_, commands) = recording.odometry, recording.commands
    inside = (times > sent[0]) & (times < sent[-1])
    for time, values in ((sent, commands), (odometry.stamp, odometry.values)):
        inside &= never((np.abs(values) > STANDING).any(1), time, times, 1.0, 1.0)
    return inside


def scan_turn(scan: Stream, increment: float, still: Curve) -> Curve:
    """Returns the yaw by the shift of each scan against the one before, rad, where the base turns in place.

    The shift has the least squared difference of ranges, at most 0.5 m each; a parabola gives parts of a beam.
    """
    rows = np.flatnonzero(np.interp(scan.stamp, *still)[1:] > 0.5)
    most = min(int(0.35 / abs(increment)) + 1, scan.values.shape[1] // 4)
    ranges, losses = np.where(np.isfinite(scan.values), scan.values, np.nan), []
    for shift in range(-most, most + 1):
        miss = (np.roll(ranges[rows], -shift, 1) - ranges[rows + 1])[:, most : scan.values.shape[1] - most]
        known = np.isfinite(miss)
        losses.append(np.where(known, miss.clip(-0.5, 0.5) ** 2, 0).sum(1) / np.maximum(known.sum(1), 1))
    loss = np.stack(losses, 1)
    index, one = loss[:, 1:-1].argmin(1) + 1, np.arange(len(rows))
    turns = np.zeros(len(scan.stamp))
    turns[rows + 1] = (index - most + _vertex(*(loss[one, index + k] for k in (-1, 0, 1)))) * increment
    return Curve(scan.stamp, np.cumsum(turns))


def bends(values: np.ndarray, axis: int = 0) -> np.ndarray:
    """Returns errors of values against the mean of their neighbors, scaled to the variance of one value."""
    return np.diff(values, 2, axis) / 6**0.5


def deviation(errors: np.ndarray) -> Estimate | None:
    """Returns the robust standard deviation of at least 50 errors."""
    if errors.size < 50:
        return None
    value = median_abs_deviation(errors, scale="normal")
    # The median absolute deviation has 37 % of the efficiency of the standard deviation, and neighbors share values.
    return Estimate.around(value, 1.96 * value / (0.37 * errors.size) ** 0.5)


def noise(recording: Recording) -> dict[str, Estimate | None]:
    """Returns ages; relative noise of odometry at constant commands; noise and bias of IMU and scan at rest."""
    odometry, (sent, *_, commands), found = recording.odometry, recording.commands, dict[str, Estimate | None]()
    for name in SENSORS:
        if (stream := getattr(recording, name)) is not None and stream.age is not None:
            found[f"{name}_age"] = Estimate.of(np.median(stream.age), stream.age)
    changes = np.append(False, (np.diff(commands, axis=0) != 0).any(1))
    speeds = odometry.values[1:-1]
    cruising = never(changes, sent, odometry.stamp, 1.0, 0.0)[1:-1, None] & (np.abs(speeds) > 0.2)
    found["odometry_noise"] = deviation(bends(odometry.values)[cruising] / speeds[cruising])
    if (imu := recording.imu) is not None:
        rest, yaw = at_rest(recording, imu.stamp), imu.values[:, 1]
        found["imu_noise"] = deviation(bends(yaw)[rest[1:-1]])
        ends = np.searchsorted(imu.stamp, np.arange(imu.stamp[0], imu.stamp[-1], PIECE))
        pieces = [part for part in map(slice, ends, ends[1:]) if rest[part].all() and rest[part].size > 9]
        if len(pieces) >= LEAST_PIECES:
            slopes = [np.polyfit(imu.stamp[part], yaw[part], 1)[0] for part in pieces]
            interval = ttest_1samp(slopes, 0.0).confidence_interval()
            found["yaw_bias"] = Estimate(float(np.mean(slopes)), *map(float, interval))
    if (scan := recording.scan) is not None:
        still = scan.values[at_rest(recording, scan.stamp)][:400]
        still = np.where(np.isfinite(still), still, np.nan)
        steps, usual = np.diff(still, axis=0), np.isfinite(still[:, np.isfinite(still).mean(0) > 0.5])
        found["range_noise"] = deviation(steps[np.isfinite(steps)] / 2**0.5)
        if len(still) >= 10 and usual.size:
            lost = 1 - usual.mean()
            told = Estimate.around(lost, 1.96 * (lost * (1 - lost) / usual.size) ** 0.5)
            found["lost_beams"] = told._replace(low=max(told.low, 0.0))
    return found


def friction(odometry: Stream, way: Curve, scale: float, fastest: float) -> tuple[Estimate, Estimate] | None:
    """Returns the coefficient of friction, and by how much the way is late, s, if the wheels slipped.

    The body follows the wheels by ``mu g`` at most (Coulomb). Candidates of ``mu`` run at once; that which, with a
    shift, tells the way best over half a second counts, if several blocks are told better than without slip, and the
    interval is below what the wheels accelerate by at most, ``fastest`` (m/s^2): with more friction, none slipped.
    """
    step = 0.01
    time = np.arange(odometry.stamp[0], odometry.stamp[-1], step)
    wheels = np.interp(time, odometry.stamp, odometry.values[:, 0]) / scale
    candidates = np.append(np.geomspace(0.03, 1.5, 160), np.inf)
    now, speeds = np.zeros(len(candidates)), np.empty((len(candidates), len(time)))
    for index, goal in enumerate(wheels):
        now = now + np.clip(goal - now, -candidates * GRAVITY * step, candidates * GRAVITY * step)
        speeds[:, index] = now
    at = _shared(Curve(time, time), way)
    told = np.stack([Curve.integral(time, speed).change(at) for speed in speeds])
    shifts = np.arange(-10, 11) * FINE
    seen = [way.change(at + shift) for shift in shifts]
    usual = 1.48 * min(float(np.median(np.abs(each - told[-1]))) for each in seen)
    loss = np.stack([_by_block(np.minimum(np.abs(each - told), 6 * usual + 0.02) ** 2) for each in seen])
    shift, best = np.unravel_index(loss.sum(2).argmin(), loss.shape[:2])
    slips = loss[loss[:, -1].sum(1).argmin(), -1] - loss[shift, best] > 20 * usual**2
    if best in (0, len(candidates) - 1) or slips.sum() < LEAST_BLOCKS:
        return None
    picked = (loss @ _resampled(loss.shape[2]).T).reshape(-1, DRAWS).argmin(0)
    late, value = Estimate.of(shifts[shift], shifts[picked // len(candidates)]), candidates[picked % len(candidates)]
    estimate = Estimate.of(candidates[best], value)
    return (estimate, late) if estimate.high * GRAVITY < fastest else None
