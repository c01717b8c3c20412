"""World: everything about a place that a task needs to know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor

from rover_rl.sims.worlds.obstacles import Obstacle
from rover_rl.sims.worlds.terrain import Terrain

Range: TypeAlias = tuple[float, float]
Area: TypeAlias = tuple[Range, Range]


@dataclass(frozen=True, eq=False)
class World:
    """A place: its ground, what stands on it, and where the task happens in it.

    Every area is ``((x_low, x_high), (y_low, y_high))`` in meters.

    Args:
        name: its name, in messages and on a live robot in the pose service ``/world/<name>/set_pose``.
        terrain: the ground.
        obstacles: the convex solids on it.
        spawn_range: where episodes start; ``None``: the terrain less 1 m on every side.
        goal_range: where goals lie; ``None``: as ``spawn_range``.
        bounds: leaving these ends the episode (``out_of_bounds``); ``None``: the terrain's extent.
        spawn_height: height in meters at which a live simulator drops the rover (the original's way of
            placing it).
        spawn_height_areas: ``(area, height)`` pairs with another drop height; the first that holds a point
            decides.

    Raises:
        ValueError: for a range whose ends are not in order, or spawn and goal areas that lie outside of
            ``bounds``.

    Example:
        >>> import numpy as np
        >>> from rover_rl.sims.worlds import Terrain, World, box
        >>> hills = Terrain(0.1 * np.random.default_rng(0).standard_normal((41, 41)), cell=0.5)
        >>> world = World("hills", hills, [box((3, 0, 0.5), (1, 1, 1)), box((-3, 2, 0.5), (1, 2, 1))])
        >>> world.spawn_range
        ((-9.0, 9.0), (-9.0, 9.0))
    """

    name: str
    terrain: Terrain
    obstacles: Sequence[Obstacle] = ()
    # Never None once the world is made.
    spawn_range: Area = None  # type: ignore[assignment]
    goal_range: Area = None  # type: ignore[assignment]
    bounds: Area = None  # type: ignore[assignment]
    spawn_height: float = 0.75
    spawn_height_areas: tuple[tuple[Area, float], ...] = ()

    def __post_init__(self) -> None:
        (x_low, x_high), (y_low, y_high) = self.terrain.extent
        spawn = self.spawn_range or ((x_low + 1, x_high - 1), (y_low + 1, y_high - 1))
        object.__setattr__(self, "obstacles", tuple(self.obstacles))
        object.__setattr__(self, "spawn_range", spawn)
        object.__setattr__(self, "goal_range", self.goal_range or spawn)
        object.__setattr__(self, "bounds", self.bounds or self.terrain.extent)
        for field in ("bounds", "spawn_range", "goal_range"):
            area = getattr(self, field)
            message = f"{field} of world {self.name!r} must"
            if any(not low < high for low, high in area):
                raise ValueError(f"{message} be ((x_low, x_high), (y_low, y_high)), got {area}")
            if any(a[0] < b[0] or a[1] > b[1] for a, b in zip(area, self.bounds, strict=True)):
                raise ValueError(f"{message} lie in its bounds {self.bounds}, got {area}")

    def height_at(self, xy: Tensor) -> Tensor:
        """Height of the ground in meters at points ``xy [..., 2]``: ``[...]``. Obstacles do not count."""
        return self.terrain.height_at(xy)

    def normal_at(self, xy: Tensor) -> Tensor:
        """Unit normal of the ground at points ``xy [..., 2]``: ``[..., 3]``."""
        return self.terrain.normal_at(xy)

    def inside(self, points: Tensor) -> Tensor:
        """Which of ``points [..., 3]`` (m) lie below the ground or inside an obstacle: bool ``[...]``."""
        inside = points[..., 2] < self.height_at(points[..., :2])
        for obstacle in self.obstacles:
            inside = inside | obstacle.contains(points)
        return inside

    def drop_height(self, xy: Tensor) -> Tensor:
        """Height in meters at which a live simulator drops the rover at ``xy [..., 2]``: ``[...]``."""
        height = torch.full_like(xy[..., 0], self.spawn_height)
        for ((x_low, x_high), (y_low, y_high)), special in reversed(self.spawn_height_areas):
            x, y = xy[..., 0], xy[..., 1]
            within = (x > x_low) & (x < x_high) & (y > y_low) & (y < y_high)
            height = torch.where(within, torch.full_like(height, special), height)
        return height
