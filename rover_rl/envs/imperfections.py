"""Imperfections of real rovers by name: for training, for judging policies, and for a simulated robot on ROS 2.

``typical`` and ``harsh`` are ranges to train with. The others are single imperfections to judge with, the same in each
episode but for the noise, and ``all`` is all of them at half. Does not import PyTorch.

Example:
    >>> imperfect(EnvConfig(world="maze"), "late").randomization.scan_latency
    (3, 3)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from math import radians
from typing import Any

from rover_rl.envs.config import EnvConfig, LimitsConfig, PoseConfig, Randomization
from rover_rl.registry import perhaps

Changes = dict[str, Any]


def _typical(dt: float) -> Changes:
    pose = PoseConfig("either", drift=0.03, drift_heading=0.01, jump=0.05, jump_rate=0.2, jump_heading=0.02)
    return {"randomization": Randomization.typical(dt), "pose": pose, "limits": LimitsConfig(apply=True)}


def _harsh(dt: float) -> Changes:
    late, bias = (0, round(0.2 / dt)), radians(0.3)
    noise = Randomization(range_noise=0.04, dropout=0.08, odometry_noise=0.05, imu_noise=0.02, lost_scans=0.1)
    noise = replace(noise, odometry_scale=(0.95, 1.05), yaw_bias=(-bias, bias), severity=(0.0, 1.0))
    noise = replace(noise, latency=(0, round(0.15 / dt)), scan_latency=late, state_latency=late, limits=(0.5, 1.0))
    noise = replace(noise, friction=(0.5, 1.5), chassis_mass=(0.8, 1.6), motor_torque=(0.5, 1.0))
    pose = PoseConfig("either", drift=0.08, drift_heading=0.03, jump=0.12, jump_rate=1.0, jump_heading=radians(4))
    return {"randomization": noise, "pose": pose, "limits": LimitsConfig(apply=True)}


def _all(dt: float) -> Changes:
    # With steps of 50 ms, half of the episodes have 50 ms, and half 100 ms.
    late = math.floor(0.075 / dt + 1e-6), math.ceil(0.075 / dt - 1e-6)
    scale, bias = (1.015, 1.015), (radians(0.05),) * 2
    sensors = Randomization(range_noise=0.015, dropout=0.025, scan_latency=late, state_latency=late)
    pose = PoseConfig("either", 0, 0, jump=0.05, jump_rate=1.0, jump_heading=radians(1.5))
    return {"randomization": replace(sensors, odometry_scale=scale, yaw_bias=bias), "pose": pose}


def _late(dt: float) -> Changes:
    late = (round(0.15 / dt),) * 2
    return {"randomization": Randomization(scan_latency=late, state_latency=late)}


_JUMPS = {"pose": PoseConfig("localized", 0, 0, jump=0.1, jump_rate=1.0, jump_heading=radians(3))}
_SCALED = Randomization(odometry_scale=(1.03, 1.03), yaw_bias=(radians(0.1),) * 2)
_ODOMETRY = {"randomization": _SCALED, "pose": PoseConfig("odometry")}
_NOISE = {"randomization": Randomization(range_noise=0.03, dropout=0.05)}

IMPERFECTIONS: dict[str, Callable[[float], Changes]] = {
    "late": _late,
    "jumps": lambda dt: _JUMPS,
    "odometry": lambda dt: _ODOMETRY,
    "noise": lambda dt: _NOISE,
    "all": _all,
    "typical": _typical,
    "harsh": _harsh,
}
"""Imperfections by name: functions of the duration of a control step (s) that return parts of an environment.

``late``: scans, pose and all other sensors 150 ms late. ``jumps``: a pose whose error of 10 cm along x and y each and 3
degrees is drawn anew once a second. ``odometry``: dead reckoning with wheels that measure 3 % too much and a heading
that drifts by 0.1 degrees a second. ``noise``: ranges with 3 cm of noise and 5 % of the beams lost. ``all``: all of
them, each half as bad."""


def imperfect(config: EnvConfig, name: str) -> EnvConfig:
    """Returns an environment with an imperfection of :data:`IMPERFECTIONS`, or raises ``ValueError``."""
    check_imperfections([name])
    exact: Changes = {"randomization": Randomization(), "pose": PoseConfig()}
    return replace(config, **exact | IMPERFECTIONS[name](config.control_dt))


def check_imperfections(names: Iterable[str]) -> None:
    """Raises ``ValueError`` if an imperfection is unknown."""
    for name in names:
        if name not in IMPERFECTIONS:
            known = ", ".join(IMPERFECTIONS)
            raise ValueError(f"unknown imperfection {name!r}{perhaps(name, IMPERFECTIONS)}; it is one of {known}")
