"""``Slider``: slides back and forth between two points."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rover_rl.checks import check_positive
from rover_rl.worlds.movers.motions.base import Courses, Scene
from rover_rl.worlds.movers.motions.cycles import Cycle, check_cycle, checked_point, cycle_tensors, share_of_way
from rover_rl.worlds.movers.motions.walks import MAX_SPEED


@dataclass(frozen=True)
class Slider(Cycle):
    """Slides back and forth between two points, as a gate or a cart does, and never turns.

    Args:
        to: point at the other end, m.
        start: point at which it starts, m.
        speed: mean speed on the way, m/s.
        period: time there and back with both pauses, s, instead of ``speed``.
        pause: rest at each end, s.
        smooth: whether it accelerates and brakes gently: 1.5 times as fast as ``speed`` halfway. Otherwise, the speed
            is constant.
        phase: share of the cycle at which an episode starts, in [0, 1). ``None`` is a random one.
        yaw: heading, rad. ``None`` is the direction from ``start`` to ``to``.

    Raises:
        ValueError: if the points are the same, a number is out of range, or the pauses take the whole period.
    """

    to: tuple[float, float]
    start: tuple[float, float] = (0.0, 0.0)
    speed: float = 1.0
    period: float | None = None
    pause: float = 0.0
    smooth: bool = False
    phase: float | None = 0.0
    yaw: float | None = None

    def __post_init__(self) -> None:
        for name in ("to", "start"):
            object.__setattr__(self, name, checked_point(name, getattr(self, name)))
        check_positive(MAX_SPEED, speed=self.speed)
        check_cycle(self.phase, self.pause, self.period)
        if self.to == self.start:
            raise ValueError(f"to and start must be different points, got {self.to} twice")
        if self.yaw is not None and not math.isfinite(self.yaw):
            raise ValueError(f"yaw must be finite, got {self.yaw}")

    @property
    def way_time(self) -> float:
        """Time of the way from one end to the other, s."""
        return math.dist(self.to, self.start) / self.speed if self.period is None else self.period / 2 - self.pause

    def first_point(self) -> tuple[float, float] | None:
        """Returns the start, unless the phase is random or another one."""
        return self.start if self.phase == 0 else None

    def tensors(self) -> dict[str, Tensor]:
        """Returns the ends ``[2]``, the heading and the cycle."""
        (x, y), (to_x, to_y) = self.start, self.to
        yaw = math.atan2(to_y - y, to_x - x) if self.yaw is None else self.yaw
        return {
            "start": torch.tensor(self.start, dtype=torch.float64),
            "way": torch.tensor((to_x - x, to_y - y), dtype=torch.float64),
            "yaw": torch.tensor(yaw),
            **cycle_tensors(self.way_time, self.pause, self.smooth, self.phase),
        }

    @classmethod
    def at_phase(cls, scene: Scene, phase: Tensor) -> Courses:
        """Returns the courses: see :meth:`Cycle.at_phase`."""
        settings, course = scene.settings, scene.course
        share, rate = share_of_way(settings, scene.time, phase)
        position = settings["start"] + share[..., None] * settings["way"]
        return replace(
            course,
            position=position.to(course.position.dtype),
            yaw=settings["yaw"].to(course.yaw.dtype),
            velocity=(rate[..., None] * settings["way"]).to(course.velocity.dtype),
            clock=phase,
        )
