"""Motions that walk: their settings, and how their kernels are launched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, TypeAlias

import torch
from torch import Tensor

from rover_rl.checks import check_at_least, check_positive
from rover_rl.worlds.movers.motion import Motion, MotionInput, MoverState
from rover_rl.worlds.movers.waypoints import MAX_SPEED, MAX_TIME, Point
from rover_rl.worlds.region import Area

Place: TypeAlias = Area | Point


def _checked_place(name: str, place: Any) -> Place | None:
    """Returns a place in floats: a point ``(x, y)``, or an area ``((x_low, x_high), (y_low, y_high))``, m."""
    if place is None:
        return None
    try:
        numbers = torch.tensor(place, dtype=torch.float64)
    except (TypeError, ValueError):
        numbers = torch.empty(0)
    is_place = numbers.shape in ((2,), (2, 2)) and bool(numbers.isfinite().all())
    if not is_place or (numbers.ndim == 2 and not (numbers[:, 0] < numbers[:, 1]).all()):
        raise ValueError(f"{name} must be a point (x, y) or an area ((x_low, x_high), (y_low, y_high)), got {place}")
    x, y = numbers.tolist()
    return (tuple(x), tuple(y)) if numbers.ndim == 2 else (x, y)


def _is_area(place: Place | None) -> bool:
    return place is not None and isinstance(place[0], Sequence)


def _numbers(place: Place | None) -> tuple[float, ...]:
    """Returns 1, and the limits of x and y; zeros for no place."""
    if place is None:
        return (0.0,) * 5
    (x_low, x_high), (y_low, y_high) = ((low, low) if isinstance(low, float) else low for low in place)
    return (1.0, x_low, x_high, y_low, y_high)


class _InKernels(Motion):
    """Base of the motions whose law is in :mod:`~rover_rl.worlds.movers.crowd_kernels`."""

    has_walls: ClassVar[bool] = True
    keeps_others: ClassVar[bool] = True
    law: ClassVar[str]
    """Name of the motion in the kernels."""

    @classmethod
    def begin(cls, inputs: MotionInput) -> MoverState:
        """Draws where the movers start and where they go, with a thread for each row."""
        return cls._launch(inputs, begins=True)

    @classmethod
    def advance(cls, inputs: MotionInput) -> MoverState:
        """Moves the movers by a step, with a thread for each of them."""
        return cls._launch(inputs)

    @classmethod
    def _launch(cls, inputs: MotionInput, begins: bool = False) -> MoverState:
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.native.warp import launch_rows
        from rover_rl.worlds.movers import crowd_kernels, walking_kernels

        state = inputs.state
        after = MoverState(*(getattr(state, item.name).clone() for item in fields(MoverState)))
        device = after.position.device
        states = [walking_kernels.arrays_of(each) for each in ([after] if begins else [state, after])]
        kernel = crowd_kernels.begin if begins else crowd_kernels.step
        shape = inputs.mine.shape[: 1 if begins else 2]
        law = walking_kernels.LAWS.index(cls.law)
        launch_rows(kernel, shape, [walking_kernels.crowd_of(inputs), law, *states], device)
        return after


@dataclass(frozen=True)
class Walk(_InKernels):
    """Base of the motions that walk from goal to goal."""

    speed: float = 1.3
    start: Place | None = None
    goal: Place | None = None
    pause: float = 0.0
    patience: float = 4.0

    def __post_init__(self) -> None:
        check_positive(MAX_SPEED, speed=self.speed)
        check_at_least(0.0, MAX_TIME, pause=self.pause)
        check_positive(MAX_TIME, patience=self.patience)
        for name in ("start", "goal"):
            object.__setattr__(self, name, _checked_place(name, getattr(self, name)))

    def first_point(self) -> Point | None:
        return None if _is_area(self.start) else self.start  # type: ignore[return-value]

    def tensors(self) -> dict[str, Tensor]:
        """Returns the settings in the order in which kernels read them."""
        own = (float(getattr(self, item.name)) for item in fields(self)[len(fields(Walk)) :])
        numbers = [self.speed, *_numbers(self.start), *_numbers(self.goal), self.pause, self.patience, *own]
        return {"walk": torch.tensor(numbers, dtype=torch.float32)}


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

    law: ClassVar[str] = "cross"


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
        start, goal, patience: as for :class:`Cross`.
        pause: how long it rests at a goal, s. Resting movers are pushed by nothing.
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

    law: ClassVar[str] = "social_force"

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
        names = ("strength", "wall_strength", "foresight", "fluctuation")
        check_at_least(0.0, 100.0, **{name: getattr(self, name) for name in names})


@dataclass(frozen=True)
class Orca(Walk):
    """Walks from goal to goal as :class:`Cross` does, and collides with no mover of its kind.

    It takes the velocity next to the desired one with which it collides with nobody within ``horizon`` (J. van den
    Berg, S. J. Guy, M. Lin and D. Manocha, "Reciprocal n-body collision avoidance", ISRR 2009, Springer Tracts in
    Advanced Robotics 70, 2011). Two of its kind share the evasion. It evades movers of other motions and the rover
    alone. It considers the 10 nearest movers, and walks toward a wall no faster than it can stop.

    Args:
        speed: desired and largest speed, m/s.
        start, goal, patience: as for :class:`Cross`.
        pause: how long it rests at a goal, s. Resting movers do not evade.
        horizon: time tau within which it avoids collisions, s.
        sees_rover: whether it avoids the rover of its row.
        margin: distance that it keeps from others, m.

    Raises:
        ValueError: if a number is out of range, or the ends of an area are not in order.
    """

    law: ClassVar[str] = "orca"

    horizon: float = 3.0
    sees_rover: bool = True
    margin: float = 0.05

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(MAX_TIME, horizon=self.horizon)


@dataclass(frozen=True)
class Wander(_InKernels):
    """Walks straight ahead at constant speed, and takes another direction now and then, or where it meets a wall.

    It starts at a random free point of its area, at least 1.5 m from the rover, in a random direction. The times
    between changes of direction are exponentially distributed, and the new direction is uniform. Walls, the bounds of
    the world and the edges of ``area`` reflect it. It takes no notice of rovers and of other movers.

    Args:
        speed: speed, m/s.
        turn_time: mean time between changes of direction, s.
        area: area ``((x_low, x_high), (y_low, y_high))`` in which its center stays, m. ``None`` is the whole world:
            it starts in the rectangle around the areas in which the world's episodes start and end.

    Raises:
        ValueError: if a number is not positive, or the ends of the area are not in order.
    """

    law: ClassVar[str] = "wander"

    speed: float = 1.0
    turn_time: float = 4.0
    area: Area | None = None

    def __post_init__(self) -> None:
        check_positive(MAX_SPEED, speed=self.speed)
        check_positive(MAX_TIME, turn_time=self.turn_time)
        area = _checked_place("area", self.area)
        if area is not None and not _is_area(area):
            raise ValueError(f"area must be ((x_low, x_high), (y_low, y_high)), got {self.area}")
        object.__setattr__(self, "area", area)

    def tensors(self) -> dict[str, Tensor]:
        numbers = [self.speed, *_numbers(self.area), *_numbers(None), 0.0, 1.0, self.turn_time]
        return {"walk": torch.tensor(numbers, dtype=torch.float32)}
