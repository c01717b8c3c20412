"""What motions of walking movers have in common: their settings, and how their kernels are launched."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from importlib import import_module
from typing import Any, ClassVar, TypeAlias

import torch
from torch import Tensor

from rover_rl.checks import check_at_least, check_positive
from rover_rl.worlds.movers.motions.base import Courses, Motion, Scene
from rover_rl.worlds.region import Area

Point: TypeAlias = tuple[float, float]
Place: TypeAlias = Area | Point

MAX_SPEED = 10.0
"""Largest speed of a mover that walks, m/s."""
MAX_TIME = 1e6
"""Largest duration among the settings, s."""
ANYWHERE = (0.0, 0.0, 0.0, 0.0, 0.0)
"""Settings of a place that is not given."""


def checked_place(name: str, place: Any) -> Place | None:
    """Returns a place in floats: a point ``(x, y)``, or an area ``((x_low, x_high), (y_low, y_high))``, m.

    Raises:
        ValueError: if it is neither.
    """
    if place is None:
        return None
    message = f"{name} must be a point (x, y) or an area ((x_low, x_high), (y_low, y_high)), got {place}"
    try:
        numbers = torch.tensor(place, dtype=torch.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(message) from error
    if numbers.shape not in ((2,), (2, 2)) or not numbers.isfinite().all():
        raise ValueError(message)
    if numbers.ndim == 2 and not (numbers[:, 0] < numbers[:, 1]).all():
        raise ValueError(message)
    if numbers.ndim == 1:
        x, y = numbers.tolist()
        return x, y
    (x_low, x_high), (y_low, y_high) = numbers.tolist()
    return (x_low, x_high), (y_low, y_high)


def point_of(place: Place | None) -> Point | None:
    """Returns a place that is a point, and ``None`` for others."""
    return None if place is None or isinstance(place[0], Sequence) else place


def check_walk(speed: float, pause: float = 0.0, patience: float = 1.0) -> None:
    """Raises ``ValueError`` for the first number that is out of range."""
    check_positive(MAX_SPEED, speed=speed)
    check_at_least(0.0, MAX_TIME, pause=pause)
    check_positive(MAX_TIME, patience=patience)


def settings_of(
    speed: float,
    start: Place | None,
    goal: Place | None = None,
    pause: float = 0.0,
    patience: float = 1.0,
    own: Sequence[float] = (),
) -> dict[str, Tensor]:
    """Returns the settings of a mover in the order in which kernels read them."""
    numbers = [speed, *_numbers(start), *_numbers(goal), pause, patience, *own]
    return {"walk": torch.tensor(numbers, dtype=torch.float32)}


def _numbers(place: Place | None) -> tuple[float, ...]:
    """Returns 1, and the limits of x and y; zeros for no place."""
    if place is None:
        return ANYWHERE
    (x_low, x_high), (y_low, y_high) = ((low, low) if isinstance(low, float) else low for low in place)
    return (1.0, x_low, x_high, y_low, y_high)


@dataclass(frozen=True)
class Walk(Motion):
    """Base of the motions that walk from goal to goal.

    Attributes:
        module: module of this folder with the kernel :attr:`kernel`, which moves the movers by one step.
        kernel: name of the kernel.
    """

    has_walls: ClassVar[bool] = True
    module: ClassVar[str] = "walking_kernels"
    kernel: ClassVar[str]

    speed: float = 1.3
    start: Place | None = None
    goal: Place | None = None
    pause: float = 0.0
    patience: float = 4.0

    def __post_init__(self) -> None:
        check_walk(self.speed, self.pause, self.patience)
        for name in ("start", "goal"):
            object.__setattr__(self, name, checked_place(name, getattr(self, name)))

    def first_point(self) -> Point | None:
        """Returns the start if it is a point."""
        return point_of(self.start)

    def tensors(self) -> dict[str, Tensor]:
        """Returns the settings in the order in which kernels read them."""
        own = [float(getattr(self, item.name)) for item in fields(self)[len(fields(Walk)) :]]
        return settings_of(self.speed, self.start, self.goal, self.pause, self.patience, own)

    @classmethod
    def begin(cls, scene: Scene) -> Courses:
        """Draws where the movers start and where they go."""
        return launch("begin_walks", scene)

    @classmethod
    def advance(cls, scene: Scene) -> Courses:
        """Walks on, to the next goal if one is reached."""
        return launch(cls.kernel, scene, cls.module)


def launch(kernel: str, scene: Scene, module: str = "walking_kernels") -> Courses:
    """Runs a kernel of this folder, with a thread for each row if it begins episodes, else for each mover.

    Args:
        kernel: name of the kernel.
        scene: what it depends on.
        module: module with the kernel.
    """
    # Importing NVIDIA Warp takes half a second.
    from rover_rl.native.warp import wp

    begins = kernel.startswith("begin")
    device = scene.course.position.device
    after = Courses(**{item.name: getattr(scene.course, item.name).clone() for item in fields(Courses)})
    function = getattr(import_module(f"{__package__}.{module}"), kernel)
    with wp.ScopedStream(wp.stream_from_torch(device) if device.type == "cuda" else None):
        inputs = [_crowd(scene), _walls(scene)]
        inputs += [_courses(after)] if begins else [_courses(scene.course), _courses(after)]
        size: Any = len(scene.mine) if begins else tuple(scene.mine.shape)
        wp.launch(function, size, inputs, device=wp.device_from_torch(device))
    return after


def _crowd(scene: Scene) -> Any:
    """Returns what a kernel reads of a scene, in the same memory where possible."""
    from rover_rl.native.warp import wp
    from rover_rl.worlds.movers.motions.walking_kernels import Crowd

    crowd = Crowd()
    crowd.mine, crowd.present = (wp.from_torch(mask.contiguous()) for mask in (scene.mine, scene.present))
    crowd.radius, crowd.arena = (wp.from_torch(part.float().contiguous()) for part in (scene.radius, scene.arena))
    crowd.settings = wp.from_torch(scene.settings["walk"].contiguous())
    crowd.keys = wp.from_torch(scene.keys.contiguous(), dtype=wp.uint64)
    crowd.rovers, crowd.rover_velocities = (
        wp.from_torch(part.float().contiguous(), dtype=wp.vec2)
        for part in (scene.rovers.position, scene.rovers.velocity)
    )
    crowd.rover_radius, crowd.dt = scene.rovers.radius, scene.dt
    crowd.time = wp.from_torch(scene.time)
    return crowd


def _walls(scene: Scene) -> Any:
    """Returns the grids of distances to walls."""
    from rover_rl.native.warp import wp
    from rover_rl.worlds.movers.motions.walking_kernels import Walls

    walls, grids = Walls(), scene.walls.grids()
    walls.distances, walls.grids = wp.from_torch(grids.distances), wp.from_torch(grids.grids.contiguous())
    walls.slots = wp.from_torch(grids.slots.contiguous())
    return walls


def _courses(course: Courses) -> Any:
    """Returns courses as a kernel reads and writes them, in the same memory."""
    from rover_rl.native.warp import wp
    from rover_rl.worlds.movers.motions.walking_kernels import CourseArrays

    courses = CourseArrays()
    for item in fields(Courses):
        value = getattr(course, item.name)
        setattr(courses, item.name, wp.from_torch(value, dtype=wp.vec2) if value.ndim == 3 else wp.from_torch(value))
    return courses
