"""Model of a base that follows commands, and its fit to odometry, for a batch of candidates and windows of a drive.

A channel (speed or yaw rate) receives its command late by the delay, clips it to the top, changes it within the limits
of acceleration and deceleration, and follows with a lag of first order. Odometry tells the result times a gain. Of a
base whose limits act on the motor and not on the command, the lag comes first (``lag_first``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import median_abs_deviation

from rover_rl.algos.calibration.reading import Stream
from rover_rl.algos.calibration.sensors import Estimate, bends

STEP = 0.005  # duration of a step of the model, s
WARMUP = 1.0  # time that is simulated before a window begins, in which the model forgets its start, s
HORIZON = 3.0  # duration of a window, s
SILENCE = 0.5  # time without a command after which a base may stop by itself, s

LIMITS = ("acceleration", "deceleration", "top")
NAMES = ("command_delay", *(f"{one}_{name}" for one in ("speed", "turn") for name in ("gain", "lag", *LIMITS)))
FREE = 1e3  # value of a limit that limits nothing
# Bounds of the parameters in the order of their names: of times, s, and of the logarithms of the others.
BOUNDS = [
    np.array([most, *[math.log(gain), most, *[math.log(limit)] * 3] * 2])
    for most, gain, limit in ((0.0, 0.2, 0.02), (1.0, 5.0, FREE))
]
# Candidates of the grid: s, s, and m/s^2 and rad/s^2.
DELAYS, LAGS, ACCELERATIONS = np.arange(0.0, 0.61, 0.05), (0.03, 0.1, 0.3), (0.5, 1.0, 2.0, 4.0, 8.0)
_IS_TIME = np.array([True, *[False, True, False, False, False] * 2])
_OUTLIER = 3.0  # residual, in standard deviations, from which on it counts linearly (Huber)
_ALIKE = 1.005  # ratio of the costs of fits that predict nearly as well
_TOLD = 1.5  # standard errors by which a limit must lower the error of prediction to be told: three windows


class Windows(NamedTuple):
    """Windows of a drive: the commands until then, and odometry in each, padded with weight 0.

    ``time`` ``[K]`` and ``area`` ``[K, 2]`` are the integral of the commands; ``start`` ``[W]``; ``first`` ``[W, 2]``
    is odometry at the start of the warmup; ``at`` ``[W, S]``, ``measured`` ``[W, S, 2]`` and ``weight`` ``[W, S]``.
    """

    time: np.ndarray
    area: np.ndarray
    start: np.ndarray
    first: np.ndarray
    at: np.ndarray
    measured: np.ndarray
    weight: np.ndarray


class Dynamics(NamedTuple):
    """Fitted parameters in the order of ``NAMES``, those that the drive tells by name, and the cost of the fit."""

    values: np.ndarray
    told: dict[str, Estimate]
    lag_first: bool
    cost: float


def make_windows(commands: Stream, odometry: Stream) -> Windows:
    """Cuts a drive into windows in which no command other than a stop stands for longer than ``SILENCE``."""
    sent, values = commands.arrival, commands.values
    # The last command holds, and nothing is commanded before the first.
    time, gaps = np.concatenate((sent[:1] - 10, sent, sent[-1:] + 10)), np.diff(sent)
    area = np.vstack((np.zeros((2, 2)), np.cumsum(values * np.append(gaps, 10.0)[:, None], 0)))
    silent = np.append(0.0, np.cumsum(np.where((gaps > SILENCE) & values[:-1].any(1), gaps, 0.0)))
    begin = max(sent[0], odometry.stamp[0] + WARMUP)
    start = np.arange(begin, min(sent[-1], odometry.stamp[-1]) - HORIZON, HORIZON)
    start = start[np.interp(start - WARMUP, sent, silent) == np.interp(start + HORIZON, sent, silent)]
    if len(start) < 5:
        raise ValueError("the drive has less than 15 s of commands without pauses of 0.5 s: record one that has more")
    first = np.stack([np.interp(start - WARMUP, odometry.stamp, column) for column in odometry.values.T], 1)
    one, end = np.searchsorted(odometry.stamp, np.stack((start, start + HORIZON)))
    index = one[:, None] + np.arange((end - one).max())
    weight, index = (index < end[:, None]).astype(float), index.clip(max=len(odometry.stamp) - 1)
    return Windows(time, area, start, first, odometry.stamp[index], odometry.values[index], weight)


def simulate(parameters: np.ndarray, windows: Windows, lag_first: bool) -> np.ndarray:
    """Returns what odometry tells from the start of the warmup on, ``[C, W, N, 2]``, at steps of ``STEP``.

    ``parameters`` ``[C, 11]`` are those of :data:`NAMES`.
    """
    grid = windows.start[:, None] - WARMUP + STEP * np.arange(round((WARMUP + HORIZON) / STEP) + 1)
    gain, lag, up, down, top = np.moveaxis(parameters[:, 1:].reshape(-1, 1, 2, 5), -1, 0)
    # The mean of the command in a step is smooth in the delay, as its value at a time is not. Few delays differ.
    delays, which = np.unique(parameters[:, 0], return_inverse=True)
    times = grid - delays[:, None, None]
    area = np.stack([np.interp(times, windows.time, column) for column in windows.area.T], -1)
    asked = np.moveaxis(np.diff(area, axis=2) / STEP, 2, 0)
    up, down, share = up * STEP, down * STEP, 1 - np.exp(-STEP / np.maximum(lag, 1e-4))
    now = ramp = np.clip(windows.first / gain, -top, top)
    steps = np.empty((len(parameters), *grid[:, 1:].shape, 2))
    for index, commands in enumerate(asked):
        goal = np.minimum(np.maximum(commands[which], -top), top)
        change = share * (goal - now) if lag_first else goal - ramp
        most = np.where(change * ramp >= 0, up, down)
        before, ramp = ramp, ramp + np.minimum(np.maximum(change, -most), most)
        now = ramp if lag_first else now + share * ((before + ramp) / 2 - now)
        steps[:, :, index] = now * gain
    return steps


def predict(parameters: np.ndarray, windows: Windows, lag_first: bool) -> np.ndarray:
    """Returns what odometry tells at the times of its readings, ``[C, W, S, 2]``."""
    steps = simulate(parameters, windows, lag_first)
    # The first entry is the state at the end of the first step.
    place = ((windows.at - windows.start[:, None] + WARMUP) / STEP - 1).clip(0, steps.shape[2] - 1.001)
    low, rows = place.astype(int), np.arange(len(place))[:, None]
    share = (place - low)[..., None]
    return steps[:, rows, low] * (1 - share) + steps[:, rows, low + 1] * share


def fit_dynamics(windows: Windows) -> Dynamics:
    """Returns the parameters that predict the velocities of odometry over windows of 3 s best, and tell most."""
    # Standard deviation of odometry about its neighbors, and one hundredth of its size at least.
    noise = median_abs_deviation(bends(windows.measured, 1).reshape(-1, 2), scale="normal")
    scale = noise + 0.01 * windows.measured.std((0, 1)) + 1e-3
    problems = [Problem(windows, scale, lag_first) for lag_first in (False, True)]
    fits = [problem.solve(start) for problem in problems for start in problem.starts()]
    least = min(fit.cost for fit in fits)
    return max((fit for fit in fits if fit.cost <= _ALIKE * least), key=lambda fit: (len(fit.told), -fit.cost))


def _numbers(x: np.ndarray) -> np.ndarray:
    return np.where(_IS_TIME, x, np.exp(x))


class Problem(NamedTuple):
    """Least squares of a form of the model: ``scale`` ``[2]`` is that of the errors of odometry.

    Candidates ``x`` are ``[C, 11]``, the logarithms of the parameters but for times.
    """

    windows: Windows
    scale: np.ndarray
    lag_first: bool

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Returns residuals whose squares are Huber's loss, ``[C, W, 2 S]``."""
        told = predict(_numbers(x), self.windows, self.lag_first)
        error = (told - self.windows.measured) / self.scale * self.windows.weight[..., None]
        linear = np.sign(error) * np.sqrt(np.maximum(2 * _OUTLIER * np.abs(error) - _OUTLIER**2, 0))
        return np.where(np.abs(error) > _OUTLIER, linear, error).reshape(*error.shape[:2], -1)

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Returns derivatives at ``x`` ``[11]`` by central differences, all in one batch, ``[W, 2 S, 11]``."""
        width = np.where(_IS_TIME, 0.005, 0.01)
        width[0] = 2 * STEP
        high, low = np.split(self.residuals(np.vstack((x + np.diag(width), x - np.diag(width)))), 2)
        return np.moveaxis(high - low, 0, -1) / (2 * width)

    def solve(self, start: np.ndarray) -> Dynamics:
        """Returns what a trust-region method finds from ``start``, with intervals of 1.96 standard errors.

        These are of the sandwich estimator (White, 1980) with windows as clusters, whose residuals may depend.
        """
        found = least_squares(
            lambda x: self.residuals(x[None]).ravel(),
            start,
            lambda x: self.jacobian(x).reshape(-1, len(x)),
            BOUNDS,
            **{"x_scale": "jac", "ftol": 1e-4, "xtol": 1e-4, "max_nfev": 30},
        )
        jacobian = found.jac.reshape(len(self.windows.start), -1, len(start))
        inner = np.linalg.pinv(found.jac.T @ found.jac, rcond=1e-9)
        scores = (jacobian * found.fun.reshape(*jacobian.shape[:2], 1)).sum(1)
        error = 1.96 * np.sqrt((inner @ (scores.T @ scores) @ inner).diagonal().clip(min=0.0))
        is_told = self.needs(found.x) & (error < np.where(_IS_TIME, 0.05, 0.1))
        table = np.stack([_numbers(found.x + sign * error) for sign in (0, -1, 1)], 1).clip(min=0.0)
        told = {name: Estimate(*row) for name, row, told in zip(NAMES, table.tolist(), is_told, strict=True) if told}
        return Dynamics(table[:, 0], told, self.lag_first, found.cost)

    def starts(self) -> list[np.ndarray]:
        """Returns the best of a grid, and of those that accelerate most; each channel has its own, with one delay."""
        windows = self.windows
        most = np.abs(windows.measured).max((0, 1))
        asked = np.abs(np.diff(windows.area, axis=0) / np.diff(windows.time)[:, None]).max(0)
        top = np.log(np.minimum(1.02 * most, asked).clip(min=0.05))
        lag, limit = (each.ravel() for each in np.meshgrid(LAGS, np.log(ACCELERATIONS), indexing="ij"))
        columns = [np.stack((0 * lag, lag, limit, limit, np.full_like(lag, one)), 1) for one in top]
        x = np.stack([np.column_stack((np.full_like(lag, delay), *columns)) for delay in DELAYS])
        losses = np.stack([(self.residuals(part) ** 2).reshape(*lag.shape, -1, 2).sum(1) for part in x])
        starts = []
        for loss in (losses, np.where((limit == limit.max())[:, None], losses, np.inf)):
            number = loss.min(1).sum(-1).argmin()
            speed, turn = loss[number].argmin(0)
            starts.append(np.concatenate((x[number, speed, :6], x[number, turn, 6:])))
        return starts

    def needs(self, x: np.ndarray) -> np.ndarray:
        """Returns whether windows are predicted worse without each limit, and with each other parameter changed."""
        is_limit = [name.split("_")[-1] in LIMITS for name in NAMES]
        others = np.where(np.eye(len(x), dtype=bool), np.where(is_limit, math.log(FREE), x + 0.1), x)
        loss = (self.residuals(np.vstack((x, others))) ** 2).sum(-1)
        worse = loss[1:] - loss[0]
        return worse.sum(1) > _TOLD * np.sqrt((worse**2).sum(1))
