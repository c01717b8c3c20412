"""``Cross``: walks from goal to goal, and takes no notice of others."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rover_rl.worlds.movers.motions.walks import Walk


@dataclass(frozen=True)
class Cross(Walk):
    """Walks straight to a random goal, along walls that are in its way, and then to the next goal.

    With a place to start and a place to go, it walks back and forth between them. A place is a point, or an area in
    which free points are drawn uniformly. It draws another goal, too, if it makes no way. It takes no notice of rovers
    and of other movers.

    Args:
        speed: speed, m/s.
        start: where it starts: a point ``(x, y)`` or an area ``((x_low, x_high), (y_low, y_high))``, m. ``None`` is any
            free point of the rectangle around the areas in which the world's episodes start and end. Random points are
            at least 1.5 m from the rover.
        goal: where it goes, as ``start``. ``None`` is any free point of this rectangle to which it has a straight way.
        pause: how long it rests at a goal, s.
        patience: how long it keeps a goal without coming closer, s.

    Raises:
        ValueError: if a number is not positive, the pause is negative, or the ends of an area are not in order.
    """

    kernel: ClassVar[str] = "cross"
