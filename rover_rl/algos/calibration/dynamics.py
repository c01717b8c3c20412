"""Fits the model of the base to odometry: which candidates predict it best, and which numbers the drive tells."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from rover_rl.algos.calibration.model import FREE, HORIZON, LIMITS, NAMES, STEP, WARMUP, Windows, predict
from rover_rl.algos.calibration.reading import Stream

SILENCE = 0.5  # time without a command after which a base may stop by itself, s
LOWEST = torch.tensor([0.0, *[0.2, 0.0, 0.02, 0.02, 0.02] * 2], dtype=torch.float64)
HIGHEST = torch.tensor([1.0, *[5.0, 1.0, FREE, FREE, FREE] * 2], dtype=torch.float64)
"""Bounds of the parameters."""
DELAYS = torch.arange(0.0, 0.61, 0.05, dtype=torch.float64)
LAGS, ACCELERATIONS = (
    torch.tensor(each, dtype=torch.float64) for each in ((0.03, 0.1, 0.3), (0.5, 1.0, 2.0, 4.0, 8.0))
)
"""Candidates of the grid: s, s, and m/s^2 and rad/s^2."""
_LOGARITHMIC = torch.tensor([False, *[True, False, True, True, True] * 2])
_OUTLIER = 3.0  # residual, in standard deviations, from which on it counts linearly (Huber)
_TOLD = 1.5  # standard errors by which a limit must lower the error of prediction to be told: three windows


class Dynamics(NamedTuple):
    """Fitted parameters in the order of ``NAMES``, their 95 % intervals, and which the drive tells."""

    values: Tensor
    low: Tensor
    high: Tensor
    told: Tensor
    lag_first: bool


def make_windows(commands: Stream, odometry: Stream) -> Windows:
    """Cuts a drive into windows of ``HORIZON`` in which commands come without a pause."""
    time, values = (torch.from_numpy(each) for each in (commands.arrival, commands.values))
    # The last command holds, and nothing is commanded before the first.
    time = torch.cat((time[:1] - 10, time, time[-1:] + 10))
    held = torch.cat((torch.zeros(1, 2), values))
    area = torch.cat((torch.zeros(1, 2), (held * time.diff()[:, None]).cumsum(0)))
    begin = max(commands.arrival[0], odometry.stamp[0] + WARMUP)
    start = np.arange(begin, min(commands.arrival[-1], odometry.stamp[-1]) - HORIZON, HORIZON)
    start = start[[_is_commanded(commands, one) for one in start]]
    if len(start) < 5:
        raise ValueError("the drive has less than 15 s of commands without pauses of 0.5 s: record one that has more")
    first = [np.interp(start - WARMUP, odometry.stamp, column) for column in odometry.values.T]
    ends = np.searchsorted(odometry.stamp, np.stack((start, start + HORIZON)))
    index = ends[0][:, None] + np.arange((ends[1] - ends[0]).max())
    weight = (index < ends[1][:, None]).astype(float)
    index = index.clip(max=len(odometry.stamp) - 1)
    tables = start, np.stack(first, 1), odometry.stamp[index], odometry.values[index], weight
    return Windows(time, area, *map(torch.from_numpy, tables))


def _is_commanded(commands: Stream, start: float) -> bool:
    """Whether no command stands for longer than ``SILENCE`` unless it is a stop."""
    one, end = np.searchsorted(commands.arrival, (start - WARMUP, start + HORIZON))
    gaps = np.diff(commands.arrival[max(one - 1, 0) : end + 1])
    return not (gaps[commands.values[max(one - 1, 0) :][: len(gaps)].any(1)] > SILENCE).any()


def fit_dynamics(windows: Windows) -> Dynamics:
    """Returns the parameters that predict the velocities of odometry over windows of 3 s best.

    A grid of candidates gives the starts, from which a trust-region method goes on with the residuals of Huber.
    Intervals are 1.96 standard errors of the sandwich estimator with the windows as clusters (White, 1980), so that
    residuals of a window need not be independent.
    """
    # Standard deviation of odometry about its neighbors, and one hundredth of its size at least.
    bends = (windows.measured[:, 2:] - 2 * windows.measured[:, 1:-1] + windows.measured[:, :-2]).flatten(0, 1)
    scale = 1.48 / 6**0.5 * bends.abs().median(0).values + 0.01 * windows.measured.flatten(0, 1).std(0) + 1e-3
    problems = [Problem(windows, scale, lag_first) for lag_first in (False, True)]
    fits = [(problem, problem.solve(start)) for problem in problems for start in problem.starts()]
    problem, found = min(fits, key=lambda fit: fit[1].cost)
    best = torch.from_numpy(found.x)
    jacobian = problem.jacobian(best)
    inner = torch.linalg.pinv(jacobian.flatten(0, 1).T @ jacobian.flatten(0, 1), rtol=1e-9)
    scores = (jacobian * problem.residuals(best[None])[0, ..., None]).sum(1)
    error = 1.96 * (inner @ (scores.T @ scores) @ inner).diagonal().sqrt()
    told = problem.needs(best) & (error < torch.where(_LOGARITHMIC, 0.1, 0.05))
    values, low, high = (_numbers(best + sign * error) for sign in (0, -1, 1))
    return Dynamics(values, low.clamp(min=0), high, told, problem.lag_first)


def _numbers(x: Tensor) -> Tensor:
    return torch.where(_LOGARITHMIC, x.exp(), x)


class Problem(NamedTuple):
    """Least squares of a form of the model: ``scale`` ``[2]`` is that of the errors of odometry.

    Candidates ``x`` are ``[C, 11]``, the logarithms of the parameters but for times.
    """

    windows: Windows
    scale: Tensor
    lag_first: bool

    def residuals(self, x: Tensor) -> Tensor:
        """Returns residuals whose squares are Huber's loss, ``[C, W, 2 S]``."""
        windows = self.windows
        told = predict(_numbers(x), windows, self.lag_first)
        error = (told - windows.measured) / self.scale * windows.weight[..., None]
        size = error.abs()
        flat = torch.where(
            size > _OUTLIER, error.sign() * (2 * _OUTLIER * size - _OUTLIER**2).clamp(min=0).sqrt(), error
        )
        return flat.flatten(2)

    def jacobian(self, x: Tensor) -> Tensor:
        """Returns derivatives at ``x`` ``[11]`` by central differences, all in one batch, ``[W, 2 S, 11]``."""
        width = torch.where(_LOGARITHMIC, 0.01, 0.005).double()
        width[0] = 2 * STEP
        high, low = self.residuals(torch.cat((x + width.diag(), x - width.diag()))).chunk(2)
        return ((high - low) / (2 * width)[:, None, None]).permute(1, 2, 0)

    def solve(self, start: Tensor) -> Any:
        """Returns SciPy's result of a search from ``start``."""
        bounds = [torch.where(_LOGARITHMIC, bound.log(), bound).numpy() for bound in (LOWEST, HIGHEST)]
        return least_squares(
            lambda x: self.residuals(torch.from_numpy(x)[None]).flatten().numpy(),
            start.numpy(),
            lambda x: self.jacobian(torch.from_numpy(x)).flatten(0, 1).numpy(),
            bounds,
            **{"x_scale": "jac", "ftol": 1e-4, "xtol": 1e-4, "max_nfev": 30},
        )

    def starts(self) -> list[Tensor]:
        """Returns the best of a grid of candidates, and the best of those that accelerate most.

        Each channel has its own candidate, with the delay that suits both.
        """
        windows = self.windows
        most = windows.measured.abs().flatten(0, 1).max(0).values
        asked = (windows.area.diff(dim=0) / windows.time.diff()[:, None]).abs().max(0).values
        delay, lag, limit = torch.cartesian_prod(DELAYS, LAGS, ACCELERATIONS.log()).unbind(1)
        top, gain = torch.minimum(1.02 * most, asked).clamp(min=0.05).log(), torch.zeros_like(delay)
        columns = [(gain, lag, limit, limit, top[channel].expand_as(lag)) for channel in (0, 1)]
        x = torch.stack((delay, *columns[0], *columns[1]), 1).unflatten(0, (len(DELAYS), -1))
        losses = torch.stack([self.residuals(part).unflatten(2, (-1, 2)).square().sum((1, 2)) for part in x])
        fastest = (x[..., 3] == x[..., 3].max())[..., None]
        starts = []
        for loss in (losses, losses.where(fastest, torch.inf)):
            number = int(loss.amin(1).sum(-1).argmin())
            speed, turn = loss[number].argmin(0).tolist()
            starts.append(torch.cat((x[number, speed, :6], x[number, turn, 6:])))
        return starts

    def needs(self, x: Tensor) -> Tensor:
        """Returns whether windows are predicted worse without each limit, and with each other parameter changed."""
        without = x.repeat(len(x), 1)
        for index, name in enumerate(NAMES):
            without[index, index] = math.log(FREE) if name.split("_")[-1] in LIMITS else x[index] + 0.1
        loss = self.residuals(torch.cat((x[None], without))).square().sum(-1)
        worse = loss[1:] - loss[0]
        return worse.sum(1) > _TOLD * worse.square().sum(1).sqrt()
