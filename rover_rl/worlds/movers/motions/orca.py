"""``Orca``: people who avoid one another by optimal reciprocal collision avoidance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rover_rl.checks import check_at_least, check_positive
from rover_rl.worlds.movers.motions.walks import MAX_TIME, Walk


@dataclass(frozen=True)
class Orca(Walk):
    """Walks from goal to goal as :class:`Cross` does, and collides with no mover of its kind.

    It takes the velocity next to the desired one with which it collides with nobody within ``horizon`` (J. van den
    Berg, S. J. Guy, M. Lin and D. Manocha, "Reciprocal n-body collision avoidance", ISRR 2009, Springer Tracts in
    Advanced Robotics 70, 2011). Two of its kind share the evasion. It evades movers of other motions and the rover
    alone. It considers the 10 nearest movers, and walks toward a wall no faster than it can stop.

    Args:
        speed: desired and largest speed, m/s.
        start: where it starts, as in :class:`Cross`.
        goal: where it goes, as in :class:`Cross`.
        pause: how long it rests at a goal, s. Resting movers do not evade.
        patience: how long it keeps a goal without coming closer, s.
        horizon: time tau within which it avoids collisions, s.
        sees_rover: whether it avoids the rover of its row.
        margin: distance that it keeps from others, m.

    Raises:
        ValueError: if a number is out of range, or the ends of an area are not in order.
    """

    module: ClassVar[str] = "orca_kernels"
    kernel: ClassVar[str] = "avoid"

    horizon: float = 3.0
    sees_rover: bool = True
    margin: float = 0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(MAX_TIME, horizon=self.horizon)
        check_at_least(0.0, 10.0, margin=self.margin)
