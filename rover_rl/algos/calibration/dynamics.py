"""Fits the model of the base to odometry: which candidates predict it best, and which numbers the drive tells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from rover_rl.algos.calibration.model import FREE, HORIZON, NAMES, STEP, WARMUP, Windows, predict
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

    A grid of candidates gives the start, from which Levenberg-Marquardt's method goes on with the residuals of Huber.
    Intervals are 1.96 standard errors of the sandwich estimator with the windows as clusters (White, 1980), so that
    residuals of a window need not be independent.
    """
    scale = _noise(windows)
    starts = [(start, first) for first in (False, True) for start in _starts(windows, scale, first)]
    fits = [(_fit(start, windows, scale, first), first) for start, first in starts]
    (solution, _), lag_first = min(fits, key=lambda fit: fit[0][1])
    best = torch.from_numpy(solution)
    residuals, jacobian = (
        _residuals(best[None], windows, scale, lag_first)[0],
        _jacobian(best, windows, scale, lag_first),
    )
    inner = torch.linalg.pinv(jacobian.flatten(0, 1).T @ jacobian.flatten(0, 1), rtol=1e-9)
    scores = (jacobian * residuals[..., None]).sum(1)
    error = 1.96 * (inner @ (scores.T @ scores) @ inner).diagonal().sqrt()
    told = _told(best, windows, scale, lag_first) & (error < torch.where(_LOGARITHMIC, 0.1, 0.05))
    bounds = [_numbers(best + sign * error) for sign in (-1, 1)]
    return Dynamics(_numbers(best), bounds[0].clamp(min=0), bounds[1], told, lag_first)


def _noise(windows: Windows) -> Tensor:
    """Standard deviation of odometry about its neighbors, and one hundredth of its size at least, ``[2]``."""
    bend = (windows.measured[:, 2:] - 2 * windows.measured[:, 1:-1] + windows.measured[:, :-2]).flatten(0, 1)
    return 1.48 / 6**0.5 * bend.abs().median(0).values + 0.01 * windows.measured.flatten(0, 1).std(0) + 1e-3


def _numbers(x: Tensor) -> Tensor:
    return torch.where(_LOGARITHMIC, x.exp(), x)


def _residuals(x: Tensor, windows: Windows, scale: Tensor, lag_first: bool) -> Tensor:
    """Returns residuals of candidates ``[C, 11]``, ``[C, W, 2 S]``, whose squares are Huber's loss."""
    error = (predict(_numbers(x), windows, lag_first) - windows.measured) / scale * windows.weight[..., None]
    size = error.abs().clamp(min=1e-12)
    flat = torch.where(size > _OUTLIER, error.sign() * (2 * _OUTLIER * size - _OUTLIER**2).abs().sqrt(), error)
    return flat.flatten(2)


def _jacobian(x: Tensor, windows: Windows, scale: Tensor, lag_first: bool) -> Tensor:
    """Derivatives of the residuals by central differences, all in one batch, ``[W, 2 S, 11]``."""
    width = torch.where(_LOGARITHMIC, 0.01, 0.005).double()
    width[0] = 2 * STEP
    high, low = x + width.diag(), x - width.diag()
    both = _residuals(torch.cat((high, low)), windows, scale, lag_first)
    return ((both[: len(x)] - both[len(x) :]) / (2 * width)[:, None, None]).permute(1, 2, 0)


def _fit(start: Tensor, windows: Windows, scale: Tensor, lag_first: bool) -> tuple[np.ndarray, float]:
    """Returns the parameters that a search from ``start`` ends at, and their loss."""

    def of(x: np.ndarray) -> np.ndarray:
        return _residuals(torch.from_numpy(x)[None], windows, scale, lag_first).flatten().numpy()

    def slope(x: np.ndarray) -> np.ndarray:
        return _jacobian(torch.from_numpy(x), windows, scale, lag_first).flatten(0, 1).numpy()

    bounds = [torch.where(_LOGARITHMIC, bound.log(), bound).numpy() for bound in (LOWEST, HIGHEST)]
    found = least_squares(of, start.numpy(), slope, bounds, x_scale="jac", ftol=1e-4, xtol=1e-4, max_nfev=30)
    return found.x, found.cost


def _starts(windows: Windows, scale: Tensor, lag_first: bool) -> list[Tensor]:
    """Returns the best of a grid of candidates, and the best of those that accelerate most.

    Each channel has its own candidate, with the delay that suits both.
    """
    most = windows.measured.abs().flatten(0, 1).max(0).values
    asked = (windows.area.diff(dim=0) / windows.time.diff()[:, None]).abs().max(0).values
    grid = torch.cartesian_prod(DELAYS, LAGS, ACCELERATIONS)
    top = torch.minimum(1.02 * most, asked).clamp(min=0.05).log().expand(len(grid), 2)
    delay, lag, limit = grid[:, 0], grid[:, 1], grid[:, 2].log()
    gain = torch.zeros_like(delay)
    x = torch.stack((delay, gain, lag, limit, limit, top[:, 0], gain, lag, limit, limit, top[:, 1]), 1)
    parts = [_residuals(part, windows, scale, lag_first).unflatten(2, (-1, 2)) for part in x.split(len(LAGS) * 5)]
    losses = torch.cat([part.square().sum((1, 2)) for part in parts]).unflatten(0, (len(DELAYS), -1))
    fastest = torch.where((limit == limit.max()).unflatten(0, (len(DELAYS), -1))[..., None], losses, torch.inf)
    starts = []
    for loss in (losses, fastest):
        number = int(loss.amin(1).sum(-1).argmin())
        speed, turn = loss[number].argmin(0).tolist()
        rows = x.unflatten(0, (len(DELAYS), -1))[number]
        starts.append(torch.cat((rows[speed, :6], rows[turn, 6:])))
    return starts


def _told(x: Tensor, windows: Windows, scale: Tensor, lag_first: bool) -> Tensor:
    """Whether each parameter is needed: without it, windows are predicted worse than by chance."""
    without = x.repeat(len(x), 1)
    for index, name in enumerate(NAMES):
        if name.split()[-1] in ("acceleration", "deceleration", "top"):
            without[index, index] = float(np.log(FREE))
        elif name.endswith("gain"):
            without[index, index] += 0.1
        else:
            without[index, index] += 0.1
    loss = _residuals(torch.cat((x[None], without)), windows, scale, lag_first).square().sum(-1)
    worse = loss[1:] - loss[0]
    return worse.sum(1) > _TOLD * worse.square().sum(1).sqrt()
