"""What sensors tell of each other: delays, scales, noise, bias and friction.

A function returns an :class:`Estimate`, or ``None`` if the drive does not tell the number.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import t as student

from rover_rl.algos.calibration.reading import Recording, Stream

GRID = 0.05  # distance of the times at which sensors are compared, s
SPAN = 0.5  # time over which a change of the pose is compared, s
FARTHEST, FINE = 0.5, 0.01  # largest shift between two sensors, and the step of its search, s
BLOCK = 60  # number of times in a block of the bootstrap: 3 s
DRAWS = 200  # number of bootstrap samples
STANDING = 0.02  # largest speed of a base at rest, m/s and rad/s
IN_PLACE = 0.05  # largest speed of a turn in place, m/s
MOVING = 0.05  # root mean square of the changes in a block with motion, m and rad
LEAST_BLOCKS = 4  # least number of blocks with motion
GRAVITY = 9.81  # m/s^2


class Estimate(NamedTuple):
    """A number and its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def of(cls, value: Any, draws: np.ndarray) -> Estimate:
        """Takes the interval from bootstrap samples."""
        return cls(float(value), *map(float, np.quantile(draws, (0.025, 0.975))))

    def per(self, other: Estimate) -> Estimate:
        """Returns the ratio of two independent positive numbers, to first order."""
        value = self.value / other.value
        mine, others = ((one.high - one.low) / 2 / one.value for one in (self, other))
        half = abs(value) * math.hypot(mine, others)
        return Estimate(value, value - half, value + half)


class Curve(NamedTuple):
    """Something that adds up along the drive: the way, m, or the yaw, rad."""

    time: np.ndarray
    total: np.ndarray

    @classmethod
    def integral(cls, time: np.ndarray, rate: np.ndarray) -> Curve:
        return cls(time, np.concatenate(([0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(time)))))

    def change(self, at: np.ndarray) -> np.ndarray:
        """Change over ``SPAN`` about the times ``at``."""
        return np.interp(at + SPAN / 2, *self) - np.interp(at - SPAN / 2, *self)


def align(reference: Curve, other: Curve | None, weight: Curve | None = None) -> tuple[Estimate, Estimate] | None:
    """Returns by how much a sensor is late beside a reference, s, and its changes by those of the reference.

    The shift is that with the least squared difference of changes over half a second, where residuals above three
    robust standard deviations are left out. Intervals are a bootstrap over blocks of 3 s. ``None`` if there is too
    little motion where ``weight`` is 1, the sensors do not agree, or there is no other one.
    """
    if other is None:
        return None
    begin, end = max(reference.time[0], other.time[0]), min(reference.time[-1], other.time[-1])
    at = np.arange(begin + 1, end - 1, GRID)
    at = at[: len(at) // BLOCK * BLOCK]
    shifts = np.arange(-FARTHEST, FARTHEST + FINE / 2, FINE)
    if len(at) < LEAST_BLOCKS * BLOCK:
        return None
    seen = other.change(at)
    told = np.stack([reference.change(at - shift) for shift in shifts])
    keep = np.ones(len(at)) if weight is None else (np.interp(at, *weight) > 0.5).astype(float)
    for _ in range(3):
        product, square = (_by_block(keep * each) for each in (told * seen, told**2))
        shift, gain = _best(product.sum(-1), square.sum(-1), shifts)
        rest = np.abs(seen - gain * np.interp(at - shift, at, told[len(shifts) // 2]))
        usual = 1.48 * np.median(rest[keep > 0]) if keep.any() else 0.0
        keep = keep * (rest < 3 * usual + 0.05 * np.abs(seen).max())
    moving = (square[len(shifts) // 2] > MOVING**2 * BLOCK).sum()
    if moving < LEAST_BLOCKS or not (keep * rest**2).sum() < 0.3 * (keep * seen**2).sum():
        return None
    samples = np.array([_best(product @ draw, square @ draw, shifts) for draw in _resampled(product.shape[1])])
    late, ratio = Estimate.of(shift, samples[:, 0]), Estimate.of(gain, samples[:, 1])
    return (late, ratio) if late.high - late.low < 0.1 else None


def _by_block(values: np.ndarray) -> np.ndarray:
    return values.reshape(*values.shape[:-1], -1, BLOCK).sum(-1)


def _resampled(blocks: int) -> np.ndarray:
    """Returns how often a bootstrap sample draws each block, ``[DRAWS, blocks]``."""
    return np.random.default_rng(0).multinomial(blocks, [1 / blocks] * blocks, DRAWS)


def _best(product: np.ndarray, square: np.ndarray, shifts: np.ndarray) -> tuple[float, float]:
    """Returns the shift that explains most, by a parabola about the best one, and the ratio there."""
    score = product**2 / np.maximum(square, 1e-12)
    index = int(score[1:-1].argmax()) + 1
    left, middle, right = score[index - 1 : index + 2]
    bend = left - 2 * middle + right
    part = 0.5 * (left - right) / bend if bend < 0 else 0.0
    return float(shifts[index] + np.clip(part, -1, 1) * FINE), float(product[index] / max(square[index], 1e-12))


def way_of(pose: Stream, imu: Stream | None) -> Curve | None:
    """Returns the way that a pose tells along its heading, else along that of the IMU, m."""
    x, y, yaw = pose.values.T
    if np.isnan(yaw).any():
        if imu is None:
            return None
        yaw = np.interp(pose.stamp, imu.stamp, imu.values[:, 1])
    middle = (yaw[1:] + yaw[:-1]) / 2
    ahead = np.diff(x) * np.cos(middle) + np.diff(y) * np.sin(middle)
    return Curve(pose.stamp, np.concatenate(([0.0], np.cumsum(ahead))))


def in_place(odometry: Stream) -> Curve:
    """Returns 1 where the base has turned in place for 0.8 s before and after, else 0."""
    fast = (np.abs(odometry.values[:, 0]) > IN_PLACE).astype(float)
    around = np.searchsorted(odometry.stamp, (odometry.stamp - 0.8, odometry.stamp + 0.8))
    count = np.concatenate(([0.0], np.cumsum(fast)))
    return Curve(odometry.stamp, (count[around[1]] - count[around[0]] == 0).astype(float))


def scan_turn(scan: Stream, increment: float, still: Curve) -> Curve:
    """Returns the yaw by the shift of each scan against the one before, rad, where the base turns in place.

    The shift has the least squared difference of ranges, at most 0.5 m each; a parabola gives parts of a beam.
    """
    rows = np.flatnonzero(np.interp(scan.stamp, *still)[1:] > 0.5)
    most = min(int(0.35 / abs(increment)) + 1, scan.values.shape[1] // 4)
    before, after = scan.values[rows], scan.values[rows + 1]
    inner, losses = slice(most, scan.values.shape[1] - most), []
    for shift in range(-most, most + 1):
        with np.errstate(invalid="ignore"):
            miss = np.clip((np.roll(before, -shift, 1) - after)[:, inner], -0.5, 0.5) ** 2
        known = np.isfinite(miss)
        losses.append(np.where(known, miss, 0).sum(1) / np.maximum(known.sum(1), 1))
    loss = np.stack(losses, 1)
    index, one = loss[:, 1:-1].argmin(1) + 1, np.arange(len(rows))
    left, middle, right = (loss[one, index + k] for k in (-1, 0, 1))
    part = 0.5 * (left - right) / np.maximum(left - 2 * middle + right, 1e-12)
    turns = np.zeros(len(scan.stamp))
    turns[rows + 1] = (index - most + np.clip(part, -1, 1)) * increment
    return Curve(scan.stamp, np.cumsum(turns))


def at_rest(recording: Recording, times: np.ndarray) -> np.ndarray:
    """Whether the base has been at rest and told to be for a second before and after each time."""
    moves = []
    for stream, time in (
        (recording.commands, recording.commands.arrival),
        (recording.odometry, recording.odometry.stamp),
    ):
        moving = np.concatenate(([0], np.cumsum((np.abs(stream.values) > STANDING).any(1))))
        one, end = np.searchsorted(time, (times - 1.0, times + 1.0))
        moves.append(moving[end] - moving[one] == 0)
    inside = (times > recording.commands.arrival[0]) & (times < recording.commands.arrival[-1])
    return moves[0] & moves[1] & inside


def yaw_bias(recording: Recording) -> Estimate | None:
    """Returns the mean yaw rate that the IMU tells at rest, rad/s, of at least three pieces of 3 s."""
    if (imu := recording.imu) is None:
        return None
    rest, pieces = at_rest(recording, imu.stamp), []
    for run in np.split(np.arange(len(rest)), np.flatnonzero(np.diff(rest.astype(int))) + 1):
        count = int((imu.stamp[run[-1]] - imu.stamp[run[0]]) / 3.0) if rest[run[0]] else 0
        pieces += [
            np.polyfit(imu.stamp[part], imu.values[part, 1], 1)[0]
            for part in np.array_split(run, max(count, 1))[:count]
        ]
    if len(pieces) < 3:
        return None
    half = student.ppf(0.975, len(pieces) - 1) * np.std(pieces, ddof=1) / len(pieces) ** 0.5
    return Estimate(float(np.mean(pieces)), *(float(np.mean(pieces) + sign * half) for sign in (-1, 1)))


def deviation(errors: np.ndarray) -> Estimate | None:
    """Returns the robust standard deviation of at least 50 errors."""
    if errors.size < 50:
        return None
    value = 1.4826 * float(np.median(np.abs(errors)))
    # The median absolute deviation has 37 % of the efficiency of the standard deviation, and neighbors share values.
    half = 1.96 * value / (0.37 * errors.size) ** 0.5
    return Estimate(value, value - half, value + half)


def bends(values: np.ndarray) -> np.ndarray:
    """Returns errors of values against the mean of their neighbors, scaled to the variance of one value."""
    return (values[2:] - 2 * values[1:-1] + values[:-2]) / 6**0.5


def odometry_noise(recording: Recording) -> Estimate | None:
    """Returns the relative standard deviation of the velocities at constant commands."""
    odometry, commands, errors = recording.odometry, recording.commands, []
    index = np.searchsorted(commands.arrival, (odometry.stamp - 1.0, odometry.stamp)).clip(1) - 1
    changes = np.concatenate(([0], np.cumsum((np.diff(commands.values, axis=0) != 0).any(1))))
    cruising = changes[index[0]] == changes[index[1]]
    for column in odometry.values.T:
        fast = (cruising & (np.abs(column) > 0.2))[1:-1]
        errors.append(bends(column)[fast] / column[1:-1][fast])
    return deviation(np.concatenate(errors))


def imu_noise(recording: Recording) -> Estimate | None:
    """Returns the standard deviation of the yaw at rest, rad."""
    if (imu := recording.imu) is None:
        return None
    return deviation(bends(imu.values[:, 1])[at_rest(recording, imu.stamp)[1:-1]])


def scan_noise(recording: Recording) -> tuple[Estimate | None, Estimate | None]:
    """Returns the standard deviation of a range at rest, m, and the share of beams that are lost."""
    if (scan := recording.scan) is None:
        return None, None
    still = scan.values[at_rest(recording, scan.stamp)][:400]
    if len(still) < 10:
        return None, None
    seen = np.isfinite(still)
    with np.errstate(invalid="ignore"):
        steps = np.diff(still, axis=0)
    usual = seen[:, seen.mean(0) > 0.5]
    lost = float(1 - usual.mean()) if usual.size else 0.0
    half = 1.96 * (lost * (1 - lost) / max(usual.size, 1)) ** 0.5
    return deviation(steps[np.isfinite(steps)] / 2**0.5), Estimate(lost, max(lost - half, 0.0), lost + half)


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
    at = np.arange(max(time[0], way.time[0]) + 1, min(time[-1], way.time[-1]) - 1, GRID)
    at = at[: len(at) // BLOCK * BLOCK]
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
