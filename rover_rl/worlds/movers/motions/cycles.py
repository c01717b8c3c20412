"""``Cycle``: the base of motions that go there and back, again and again."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from rover_rl.checks import check_at_least, check_positive
from rover_rl.rng import to_unit
from rover_rl.worlds.movers.motions.base import Courses, Motion, Scene
from rover_rl.worlds.movers.motions.walks import MAX_TIME


@dataclass(frozen=True)
class Cycle(Motion):
    """A motion that goes a way, pauses, goes back and pauses, for the whole episode. The clock keeps its phase."""

    is_foreseen: ClassVar[bool] = True

    @classmethod
    def begin(cls, scene: Scene) -> Courses:
        """Starts at the phase."""
        return cls.at_phase(scene, drawn_phase(scene))

    @classmethod
    def advance(cls, scene: Scene) -> Courses:
        """Moves on."""
        return cls.at_phase(scene, scene.course.clock)

    @classmethod
    @abstractmethod
    def at_phase(cls, scene: Scene, phase: Tensor) -> Courses:
        """Returns the courses at the time of the scene, of movers that began at a phase ``[N, M]`` of their cycle."""


def check_cycle(phase: float | None, pause: float, period: float | None) -> None:
    """Raises ``ValueError`` if the phase is not in [0, 1), a time is out of range, or pauses take the whole period."""
    check_at_least(0.0, MAX_TIME, pause=pause)
    if phase is not None and not 0 <= phase < 1:
        raise ValueError(f"phase must be at least 0 and less than 1, or None for a random one, got {phase}")
    if period is not None:
        check_positive(MAX_TIME, period=period)
        if period <= 2 * pause:
            raise ValueError(f"period must be longer than two pauses of {pause:g} s, got {period}")


def checked_point(name: str, point: Any) -> tuple[float, float]:
    """Returns a point in floats.

    Raises:
        ValueError: if it is none.
    """
    try:
        x, y = map(float, point)
    except (TypeError, ValueError):
        x = y = math.nan
    if not (math.isfinite(x) and math.isfinite(y)):
        raise ValueError(f"{name} must be a point (x, y) of finite numbers, got {point}")
    return x, y


def cycle_tensors(way_time: float, pause: float, smooth: bool, phase: float | None) -> dict[str, Tensor]:
    """Returns the settings that :func:`share_of_way` reads."""
    numbers = {
        "way_time": way_time,
        "pause": pause,
        "smooth": float(smooth),
        "phase": 0.0 if phase is None else phase,
        "random_phase": float(phase is None),
    }
    return {name: torch.tensor(number, dtype=torch.float64) for name, number in numbers.items()}


def drawn_phase(scene: Scene) -> Tensor:
    """Returns the share of the cycle at which each mover starts, ``[N, M]``."""
    settings = scene.settings
    drawn = to_unit(scene.bits(1)[..., 0])
    return torch.where(settings["random_phase"] > 0, drawn, settings["phase"]).to(scene.course.clock.dtype)


def share_of_way(settings: dict[str, Tensor], time: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
    """Returns how far movers are on a way there, and back after it.

    A cycle is the way there, a pause, the way back, and another pause. Phase 0 is the beginning of the way there.

    Args:
        settings: settings of :func:`cycle_tensors`, ``[N, M]``.
        time: time since the episode began, ``[N, 1]``, s.
        phase: share of the cycle at which it began, ``[N, M]``.

    Returns:
        Share of the way, in [0, 1], and its rate, 1/s, float64 ``[N, M]``.
    """
    way_time = settings["way_time"].clamp(min=1e-6)
    half = way_time + settings["pause"]
    within = torch.remainder(time + phase * 2 * half, 2 * half)
    returns = within >= half
    passed = ((within - returns * half) / way_time).clamp(max=1)
    moves = (passed < 1).double() / way_time
    smooth = settings["smooth"] > 0
    # The cubic with a slope of 0 at both ends.
    share = torch.where(smooth, passed * passed * (3 - 2 * passed), passed)
    rate = torch.where(smooth, 6 * passed * (1 - passed), 1.0) * moves
    return torch.where(returns, 1 - share, share), torch.where(returns, -rate, rate)
