"""Control rate. Does not import PyTorch."""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass, replace
from typing import Any

CONTROL_DT = 0.05
"""Default duration of a control step, s: the control rate of the contract, 20 Hz.

``Simulator.control_dt`` is the value that a simulator uses.
"""


def at_rate(settings: Any, rate: float) -> Any:
    """Returns the settings of a backend at another control rate, Hz.

    A control step has so many physics steps that none lasts longer than before. ``substep_multiple`` of a class of
    settings is a number that divides theirs.

    Raises:
        ValueError: if the settings have no field ``control_dt``.
    """
    names = [field.name for field in fields(settings)] if is_dataclass(settings) else []
    if "control_dt" not in names:
        raise ValueError(f"control_rate needs a backend whose settings have a control_dt, and {settings!r} has none")
    changes: dict[str, Any] = {"control_dt": 1 / rate}
    if "substeps" in names:
        multiple = getattr(settings, "substep_multiple", 1)
        steps = vars(settings)["substeps"] / rate / vars(settings)["control_dt"]
        changes["substeps"] = max(1, math.ceil(steps / multiple - 1e-9)) * multiple
    return replace(settings, **changes)


MIN_REVERSAL = 0.5
"""Smallest desired yaw rate that changes the turning direction of a live rover, rad/s. The heading PID outputs it at a
heading error of 14 degrees."""
