"""``SocialForce``: people who keep away from one another and from walls, by forces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rover_rl.checks import check_at_least, check_positive
from rover_rl.worlds.movers.motions.walks import MAX_TIME, Walk


@dataclass(frozen=True)
class SocialForce(Walk):
    """Walks from goal to goal as :class:`Cross` does, and keeps away from walls, other movers and the rover by forces.

    The model and its constants, but for ``foresight``, are those of D. Helbing and P. Molnar, "Social force model for
    pedestrian dynamics", Physical Review E 51 (1995) 4282. Pedestrians are points there, which stand for people with a
    radius of 0.2 m: larger movers keep farther away by what they are larger. Movers that touch are pushed apart, each
    by half of the overlap (D. Helbing, I. Farkas and T. Vicsek, "Simulating dynamical features of escape panic",
    Nature 407 (2000) 487, have a spring instead, which is too stiff for steps of 50 ms).

    Args:
        speed: desired speed v0, m/s. The largest one is 1.3 times as high.
        start: where it starts, as in :class:`Cross`.
        goal: where it goes, as in :class:`Cross`.
        pause: how long it rests at a goal, s. Resting movers are pushed by nothing.
        patience: how long it keeps a goal without coming closer, s.
        sees_rover: whether it keeps away from the rover of its row.
        relaxation: time tau in which it takes up its desired velocity, s.
        strength: potential V0 of another mover, m^2/s^2.
        reach: range sigma of this potential, m.
        wall_strength: potential U0 of a wall, m^2/s^2.
        wall_reach: range R of this potential, m.
        behind: weight c of what is not within 100 degrees of the desired direction.
        foresight: time Delta t of the steps of others that it expects, s. It is the one of A. Johansson, D. Helbing and
            P. Shukla, "Specification of the social force pedestrian model by evolutionary adjustment to video tracking
            data", Advances in Complex Systems 10 (2007) 271. With the 2 s of the first paper, no lanes form: those
            behind push those ahead of them aside.
        fluctuation: standard deviation of a random acceleration in each step, m/s^2. The paper gives no number.

    Raises:
        ValueError: if a number is out of range, or the ends of an area are not in order.
    """

    module: ClassVar[str] = "social_force_kernels"
    kernel: ClassVar[str] = "follow_forces"

    sees_rover: bool = True
    relaxation: float = 0.5
    strength: float = 2.1
    reach: float = 0.3
    wall_strength: float = 10.0
    wall_reach: float = 0.2
    behind: float = 0.5
    foresight: float = 0.5
    fluctuation: float = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(MAX_TIME, relaxation=self.relaxation, reach=self.reach, wall_reach=self.wall_reach)
        check_at_least(0.0, 1.0, behind=self.behind)
        check_at_least(
            0.0,
            100.0,
            strength=self.strength,
            wall_strength=self.wall_strength,
            foresight=self.foresight,
            fluctuation=self.fluctuation,
        )
