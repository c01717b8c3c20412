"""``Door``: swings about a hinge."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rover_rl.checks import check_at_least, check_positive
from rover_rl.worlds.movers.motions.base import Courses, Scene
from rover_rl.worlds.movers.motions.cycles import Cycle, check_cycle, checked_point, cycle_tensors, share_of_way

MAX_WIDTH = 100.0
"""Widest door, m."""


@dataclass(frozen=True)
class Door(Cycle):
    """Swings open about a hinge and shut again, gently.

    The mover is the leaf: its center goes around the hinge at half the width, and its heading points from the hinge to
    the other edge. The shape is a box as long as the door is wide: ``Box(width, 0.05, 2.0)``.

    Args:
        hinge: point of the hinge, m.
        width: width of the leaf, m.
        closed: heading of the leaf when shut, rad.
        opening: angle by which it opens, counter-clockwise if positive, rad.
        period: time of opening and shutting with both pauses, s.
        pause: rest when open, and when shut, s.
        phase: share of the period at which an episode starts, in [0, 1): 0 is shut. ``None`` is a random one.

    Raises:
        ValueError: if a number is out of range, or the pauses take the whole period.

    Example:
        >>> from rover_rl.worlds.movers import Box, Door, Mover
        >>> door = Mover(Door(hinge=(2.0, 0.0), width=0.9, pause=2.0), Box(0.9, 0.05, 2.0))
    """

    hinge: tuple[float, float]
    width: float = 0.9
    closed: float = 0.0
    opening: float = math.pi / 2
    period: float = 8.0
    pause: float = 0.0
    phase: float | None = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "hinge", checked_point("hinge", self.hinge))
        check_positive(MAX_WIDTH, width=self.width)
        check_at_least(-2 * math.pi, 2 * math.pi, closed=self.closed, opening=self.opening)
        check_cycle(self.phase, self.pause, self.period)
        if self.opening == 0:
            raise ValueError("opening must not be 0")

    def first_point(self) -> tuple[float, float] | None:
        """Returns the center of the shut leaf, unless the phase is random or another one."""
        if self.phase != 0:
            return None
        x, y = self.hinge
        return x + self.width / 2 * math.cos(self.closed), y + self.width / 2 * math.sin(self.closed)

    def tensors(self) -> dict[str, Tensor]:
        """Returns the hinge ``[2]``, the angles, half the width and the cycle."""
        numbers = {"closed": self.closed, "opening": self.opening, "arm": self.width / 2}
        return {
            "hinge": torch.tensor(self.hinge, dtype=torch.float64),
            **{name: torch.tensor(number, dtype=torch.float64) for name, number in numbers.items()},
            **cycle_tensors(self.period / 2 - self.pause, self.pause, True, self.phase),
        }

    @classmethod
    def at_phase(cls, scene: Scene, phase: Tensor) -> Courses:
        """Returns the courses: see :meth:`Cycle.at_phase`."""
        settings, course = scene.settings, scene.course
        share, rate = share_of_way(settings, scene.time, phase)
        yaw, turn = settings["closed"] + share * settings["opening"], rate * settings["opening"]
        arm = settings["arm"][..., None] * torch.stack((yaw.cos(), yaw.sin()), -1)
        across = torch.stack((-arm[..., 1], arm[..., 0]), -1)
        return replace(
            course,
            position=(settings["hinge"] + arm).to(course.position.dtype),
            yaw=yaw.to(course.yaw.dtype),
            velocity=(turn[..., None] * across).to(course.velocity.dtype),
            clock=phase,
        )
