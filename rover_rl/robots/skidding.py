"""How a skid-steer robot turns by Coulomb's law: the effective distance of its left and right wheels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

_ROUNDING = 1e-3
"""Slip, relative to that of the wheels, below which the friction of the calculation is rounded off."""


def wheel_loads(points: np.ndarray, center: Sequence[float]) -> np.ndarray:
    """Returns the share of the weight on each wheel of a robot on equal springs: ``[W]``, none below 0.

    Args:
        points: x and y of the contacts, ``[W, 2]``, m.
        center: x and y of the center of mass, m.
    """
    rows = np.column_stack((np.ones(len(points)), points))
    # On equal springs, the loads are linear in x and y.
    shares = rows @ np.linalg.pinv(rows.T @ rows) @ np.array((1.0, *center[:2]))
    shares = np.maximum(shares, 0.0)
    return shares / shares.sum()


def effective_track(points: np.ndarray, sides: Sequence[int], center: Sequence[float], width: float = 0.0) -> float:
    """Returns the distance of left and right wheels that slip in a turn in place, as odometry must take it, m.

    The wheels of a side turn at one speed, and each transfers Coulomb friction against its slip. In steady motion, the
    forces and the moment vanish, which minimizes the power that friction takes, a convex function of the velocity. For
    four thin wheels at the corners of a wheelbase L and a track T, the result is ``T (1 + (L / T)^2)``.

    Args:
        points: x and y of the contacts of the wheels, ``[W, 2]``, m.
        sides: 1 for a left wheel, -1 for a right one.
        center: x and y of the center of mass, m.
        width: width of the wheels, m. Each touches the ground at two points, as in the simulators, ``width / sqrt(3)``
            apart.

    Example:
        >>> corners = np.array([(0.2, 0.25), (-0.2, 0.25), (0.2, -0.25), (-0.2, -0.25)])
        >>> round(effective_track(corners, (1, 1, -1, -1), (0.0, 0.0)), 3)
        0.82
    """
    loads, signs = np.tile(wheel_loads(points, center) / 2, 2), np.tile(np.asarray(sides, dtype=float), 2)
    scale, half = float(np.abs(points[:, 1]).mean()), np.array((0.0, width / math.sqrt(12)))
    x, y = (np.concatenate([points - half, points + half]) / scale).T

    def power(velocity: np.ndarray) -> float:
        ahead, left, turn = velocity
        # The right wheels roll ahead with speed 1, the left ones back.
        slip = ahead - turn * y + signs, left + turn * x
        return float(loads @ np.sqrt(slip[0] ** 2 + slip[1] ** 2 + _ROUNDING**2))

    # Importing it takes 0.2 seconds, and most programs do without.
    from scipy.optimize import minimize

    tolerances = {"xatol": 1e-6, "fatol": 1e-12}
    least = minimize(power, np.array((0.0, 0.0, 0.5)), method="Nelder-Mead", options=tolerances)
    return float(2 * scale / least.x[2])
