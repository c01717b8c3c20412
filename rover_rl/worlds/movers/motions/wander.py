"""``Wander``: walks straight, and changes its mind now and then."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from rover_rl.checks import check_positive
from rover_rl.worlds.movers.motions.base import Courses, Motion, Scene
from rover_rl.worlds.movers.motions.walks import MAX_TIME, check_walk, checked_place, launch, point_of, settings_of
from rover_rl.worlds.region import Area


@dataclass(frozen=True)
class Wander(Motion):
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

    has_walls: ClassVar[bool] = True

    speed: float = 1.0
    turn_time: float = 4.0
    area: Area | None = None

    def __post_init__(self) -> None:
        check_walk(self.speed)
        check_positive(MAX_TIME, turn_time=self.turn_time)
        area = checked_place("area", self.area)
        if point_of(area):
            raise ValueError(f"area must be ((x_low, x_high), (y_low, y_high)), got {self.area}")
        object.__setattr__(self, "area", area)

    def tensors(self) -> dict[str, Tensor]:
        """Returns the settings in the order in which the kernel reads them."""
        return settings_of(self.speed, self.area, own=(self.turn_time,))

    @classmethod
    def begin(cls, scene: Scene) -> Courses:
        """Starts at a random free point, in a random direction."""
        return launch("begin_wanders", scene)

    @classmethod
    def advance(cls, scene: Scene) -> Courses:
        """Walks on."""
        return launch("wander", scene)
