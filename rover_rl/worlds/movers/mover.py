"""Mover: an obstacle or a person that moves."""

from __future__ import annotations

from dataclasses import dataclass, field

from rover_rl.worlds.movers.motions.base import Motion
from rover_rl.worlds.movers.shapes import Cylinder, Shape

MAX_MOVERS = 512
"""Maximum number of movers in a world."""


@dataclass(frozen=True)
class Mover:
    """An obstacle or a person that moves on the ground of a world.

    Args:
        motion: how it moves.
        shape: its shape.
        name: name for messages.

    Raises:
        ValueError: if the motion is none, or the shape has no parts.

    Example:
        >>> from rover_rl.worlds.movers import Mover, Person, Waypoints
        >>> walker = Mover(
        ...     Waypoints([(0.0, 2.0, -3.0, 1.57), (6.0, 2.0, 3.0, 1.57)], repeat="back_and_forth"), Person()
        ... )
        >>> world = World("crossing", Terrain.flat((20.0, 20.0)), movers=[walker])
    """

    motion: Motion
    shape: Shape = field(default_factory=Cylinder)
    name: str = "mover"

    def __post_init__(self) -> None:
        if not isinstance(self.motion, Motion):
            raise ValueError(
                f"the motion of {self.name!r} must be a Motion, such as Waypoints(...), got {self.motion!r}"
            )
        if not hasattr(self.shape, "parts") or not self.shape.parts():
            raise ValueError(f"the shape of {self.name!r} must have parts, as Cylinder(0.3) has, got {self.shape!r}")
