"""Imperfections of real rovers by name: for training, for judging policies, and for a simulated robot on ROS 2.

``typical`` and ``harsh`` are ranges to train with. The others are single imperfections to judge with, the same in each
episode but for the noise, and ``all`` is all of them at half. Does not import PyTorch.

Example:
    >>> imperfect(EnvConfig(world="maze"), "late").randomization.scan_latency
    (3, 3)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from rover_rl.envs.config import EnvConfig, LimitsConfig, PoseConfig, Randomization
from rover_rl.registry import perhaps


@dataclass(frozen=True)
class Imperfection:
    """What is not exact: parts of :class:`~rover_rl.envs.config.EnvConfig`.

    ``limits`` are ``None`` where the limits of the commands stay as they are.
    """

    randomization: Randomization
    pose: PoseConfig = field(default_factory=PoseConfig)
    limits: LimitsConfig | None = None


def _steps(low: float, high: float, dt: float) -> tuple[int, int]:
    """Returns a range of delays (s) in control steps."""
    return round(low / dt), round(high / dt)


def _typical(dt: float) -> Imperfection:
    noise = replace(
        Randomization.typical(),
        latency=_steps(0.0, 0.1, dt),
        scan_latency=_steps(0.0, 0.1, dt),
        state_latency=_steps(0.0, 0.05, dt),
    )
    pose = PoseConfig("either", drift=0.03, drift_heading=0.01, jump=0.05, jump_rate=0.2, jump_heading=0.02)
    return Imperfection(noise, pose, LimitsConfig(apply=True))


def _harsh(dt: float) -> Imperfection:
    noise = Randomization(
        friction=(0.5, 1.5),
        chassis_mass=(0.8, 1.6),
        motor_torque=(0.5, 1.0),
        latency=_steps(0.0, 0.15, dt),
        range_noise=0.04,
        dropout=0.08,
        odometry_noise=0.05,
        imu_noise=0.02,
        scan_latency=_steps(0.0, 0.2, dt),
        state_latency=_steps(0.0, 0.2, dt),
        lost_scans=0.1,
        odometry_scale=(0.95, 1.05),
        yaw_bias=(-math.radians(0.3), math.radians(0.3)),
        limits=(0.5, 1.0),
        severity=(0.0, 1.0),
    )
    pose = PoseConfig("either", drift=0.08, drift_heading=0.03, jump=0.12, jump_rate=1.0, jump_heading=math.radians(4))
    return Imperfection(noise, pose, LimitsConfig(apply=True))


def _late(dt: float) -> Imperfection:
    late = _steps(0.15, 0.15, dt)
    return Imperfection(Randomization(scan_latency=late, state_latency=late))


def _jumps(dt: float) -> Imperfection:
    pose = PoseConfig("localized", drift=0, drift_heading=0, jump=0.1, jump_rate=1.0, jump_heading=math.radians(3))
    return Imperfection(Randomization(), pose)


def _odometry(dt: float) -> Imperfection:
    drift = Randomization(odometry_scale=(1.03, 1.03), yaw_bias=(math.radians(0.1),) * 2)
    return Imperfection(drift, PoseConfig("odometry"))


def _noise(dt: float) -> Imperfection:
    return Imperfection(Randomization(range_noise=0.03, dropout=0.05))


def _all(dt: float) -> Imperfection:
    # With steps of 50 ms, half of the episodes have 50 ms, and half 100 ms.
    late = math.floor(0.075 / dt + 1e-6), math.ceil(0.075 / dt - 1e-6)
    noise = Randomization(
        range_noise=0.015,
        dropout=0.025,
        scan_latency=late,
        state_latency=late,
        odometry_scale=(1.015, 1.015),
        yaw_bias=(math.radians(0.05),) * 2,
    )
    return Imperfection(noise, PoseConfig("either", 0, 0, jump=0.05, jump_rate=1.0, jump_heading=math.radians(1.5)))


IMPERFECTIONS: dict[str, Callable[[float], Imperfection]] = {
    "late": _late,
    "jumps": _jumps,
    "odometry": _odometry,
    "noise": _noise,
    "all": _all,
    "typical": _typical,
    "harsh": _harsh,
}
"""Imperfections by name, as functions of the duration of a control step, s.

``late``: scans, pose and all other sensors 150 ms late. ``jumps``: a pose whose error of 10 cm along x and y each and 3
degrees is drawn anew once a second. ``odometry``: dead reckoning with wheels that measure 3 % too much and a heading
that drifts by 0.1 degrees a second. ``noise``: ranges with 3 cm of noise and 5 % of the beams lost. ``all``: all of
them, each half as bad."""


def imperfect(config: EnvConfig, name: str) -> EnvConfig:
    """Returns an environment with an imperfection: see :data:`IMPERFECTIONS`.

    Raises:
        ValueError: if the imperfection is unknown.
    """
    check_imperfections([name])
    found = IMPERFECTIONS[name](config.control_dt)
    limits = config.limits if found.limits is None else found.limits
    return replace(config, randomization=found.randomization, pose=found.pose, limits=limits)


def check_imperfections(names: list[str] | tuple[str, ...]) -> None:
    """Raises ``ValueError`` if an imperfection is unknown."""
    for name in names:
        if name not in IMPERFECTIONS:
            known = ", ".join(IMPERFECTIONS)
            raise ValueError(f"unknown imperfection {name!r}{perhaps(name, IMPERFECTIONS)}; it is one of {known}")
