"""What simulators measure only if asked: contact forces by side of the rover, and torques of the wheel motors.

Both are means over the physics steps of a control step. The mean of a force is the momentum that it transfers, divided
by the duration of the step: simulators agree on it, and not on the peak of an impact.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from rover_rl.sims.base import Report

SIDES = ("front", "left", "back", "right")
"""Sides of a rover in the base frame, in the order of the columns of ``RoverState.contact_force``."""


def by_side(push: np.ndarray) -> np.ndarray:
    """Returns forces on the rover ``[..., 2]`` along x and y of the base frame (N) by :data:`SIDES`, ``[..., 4]``, N.

    What pushes backward is in front, and what pushes to the right is on the left. A force at an angle counts on two
    sides, by its components.
    """
    return np.concatenate((-push, push), -1).clip(0.0)


def empty_reports(fields: Collection[Report], count: int, wheels: int) -> dict[Report, np.ndarray]:
    """Returns zeros of each of the fields, float32 ``[count, k]``, for robots with so many wheels."""
    sizes: dict[Report, int] = {"contact_force": 2 * len(SIDES), "wheel_torque": wheels}
    return {field: np.zeros((count, size), np.float32) for field, size in sizes.items() if field in fields}


def of_rows(reports: Mapping[Report, np.ndarray], rows: slice) -> dict[Report, np.ndarray]:
    """Returns views of consecutive rows."""
    return {field: values[rows] for field, values in reports.items()}
