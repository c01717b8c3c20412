"""World: terrain, obstacles, and areas of the task."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from rover_rl.worlds.cache import content_key
from rover_rl.worlds.movers.mover import MAX_MOVERS, Mover
from rover_rl.worlds.movers.waypoints import Waypoints
from rover_rl.worlds.region import Area, Range, Region, expanded, overlap
from rover_rl.worlds.solids import Solids
from rover_rl.worlds.terrain import Terrain

__all__ = ["Area", "Range", "World", "Worlds"]


class Worlds(Protocol):
    """Worlds by index: a list of them, or a :class:`~rover_rl.worlds.pool.WorldPool`."""

    def __getitem__(self, index: int, /) -> World: ...


@dataclass(frozen=True, eq=False)
class World:
    """Terrain, obstacles, and areas of the task.

    Areas have the form ``((x_low, x_high), (y_low, y_high))``, in meters.

    Args:
        name: name of the world, used in messages and in the pose service ``/world/<name>/set_pose`` of a live
            simulator.
        terrain: ground of the world.
        obstacles: static convex solids on the ground, or tables of them. They become one table.
        spawn_range: area in which episodes start. ``None`` is that of ``spawn_region``, or without one the terrain
            less 1 m on every side.
        goal_range: area of the goals. ``None`` is that of ``goal_region``, or without one ``spawn_range``.
        bounds: area whose exit ends the episode (``out_of_bounds``). ``None`` is the extent of the terrain.
        spawn_height: height at which a live simulator drops the rover, as the original environment does, m.
        spawn_height_areas: ``(area, height)`` pairs with other drop heights. The first area that contains a point
            applies.
        notes: what an importer has to say about the world, such as the error of the ground.
        spawn_region: part of ``spawn_range`` in which episodes start, such as the rooms of a building. ``None``
            is all of it.
        goal_region: part of ``goal_range`` that may contain goals. ``None`` is ``spawn_region`` if there is no
            ``goal_range`` either, and otherwise all of ``goal_range``.
        movers: obstacles and people that move.

    Raises:
        ValueError: if the ends of an area are not in order, the spawn or goal area exceeds ``bounds``, there are too
            many movers, or one starts inside an obstacle.

    Example:
        >>> import numpy as np
        >>> from rover_rl.worlds import Terrain, World, box
        >>> hills = Terrain(0.1 * np.random.default_rng(0).standard_normal((41, 41)), cell=0.5)
        >>> world = World("hills", hills, [box((3, 0, 0.5), (1, 1, 1)), box((-3, 2, 0.5), (1, 2, 1))])
        >>> world.spawn_range
        ((-9.0, 9.0), (-9.0, 9.0))
    """

    name: str
    terrain: Terrain
    obstacles: Sequence[Solids] = ()
    # Never None after __post_init__.
    spawn_range: Area = None  # type: ignore[assignment]
    goal_range: Area = None  # type: ignore[assignment]
    bounds: Area = None  # type: ignore[assignment]
    spawn_height: float = 0.75
    spawn_height_areas: tuple[tuple[Area, float], ...] = ()
    notes: tuple[str, ...] = ()
    spawn_region: Region | None = None
    goal_region: Region | None = None
    movers: Sequence[Mover] = ()

    def __post_init__(self) -> None:
        self._complete()
        for field in ("bounds", "spawn_range", "goal_range"):
            area = getattr(self, field)
            message = f"{field} of world {self.name!r} must"
            if any(not low < high for low, high in area):
                raise ValueError(f"{message} be ((x_low, x_high), (y_low, y_high)), got {area}")
            if any(a[0] < b[0] or a[1] > b[1] for a, b in zip(area, self.bounds, strict=True)):
                raise ValueError(f"{message} lie in its bounds {self.bounds}, got {area}")
        self._check_movers()

    def _complete(self) -> None:
        extent, spawn, goal = self.terrain.extent, self.spawn_region, self.goal_region
        if goal is None and self.goal_range is None:
            goal = spawn
        bounds = self.bounds or extent
        spawn_range = self.spawn_range or (spawn and overlap(spawn.bounds, bounds)) or expanded(extent, -1)
        goal_range = self.goal_range or (goal and overlap(goal.bounds, bounds)) or spawn_range
        areas = {"bounds": bounds, "spawn_range": spawn_range, "goal_range": goal_range, "goal_region": goal}
        vars(self).update(areas, obstacles=Solids.of(self.obstacles), movers=tuple(self.movers))

    def _check_movers(self) -> None:
        if len(self.movers) > MAX_MOVERS:
            raise ValueError(f"world {self.name!r} may have at most {MAX_MOVERS} movers, got {len(self.movers)}")
        inside = []
        for mover in self.movers:
            if (start := mover.motion.first_point()) is not None:
                point = torch.tensor(start, dtype=torch.float64)
                if Solids.of(self.obstacles).contains(torch.cat((point, self.height_at(point)[None] + 0.1))):
                    inside.append(mover.name)
                    if not isinstance(mover.motion, Waypoints):
                        raise ValueError(f"{mover.name!r} of world {self.name!r} starts at {start}, inside an obstacle")
        if inside:
            # The worlds of others have such paths, and movers of any path pass through obstacles.
            names = ", ".join(inside)
            warnings.warn(f"{self.name}: movers start inside an obstacle, and pass through it: {names}", stacklevel=4)

    @classmethod
    def from_file(cls, path: str | Path, **options: Any) -> World:
        """Imports a world from a file. Coordinates stay those of the file.

        Args:
            path: SDF world or model (``.sdf``, ``.world``), mesh (``.obj``, ``.stl``, ``.dae``, ``.glb``, ``.gltf``,
                ``.ply``), elevation model (``.tif``, ``.png``, ``.npy``), ROS map (``.yaml``), or a file of
                :meth:`save`.
            **options: fields of :class:`rover_rl.worlds.files.options.ImportOptions`, such as ``spawn_range`` and
                ``missing="skip"``.

        Raises:
            FileNotFoundError: if there is no such file.
            ImportError: if a package of the extra ``worlds`` is missing.
            ValueError: if the file or an option is wrong. The message is one sentence.
        """
        from rover_rl.worlds.files.read import read_world

        return cls(**read_world(Path(path), **options))

    def save(self, path: str | Path) -> None:
        """Writes the world to a file, ``*.world.npz``, that :meth:`from_file` reads without any extra.

        Raises:
            OSError: if the file cannot be written.
            ValueError: if the name has another ending.
        """
        from rover_rl.worlds.files.archive import write_archive

        write_archive(self, Path(path))

    def height_at(self, xy: Tensor) -> Tensor:
        """Returns the height of the ground (m) at points ``xy [..., 2]``, without obstacles: ``[...]``."""
        return self.terrain.height_at(xy)

    def inside(self, points: Tensor) -> Tensor:
        """Returns which of ``points [..., 3]`` (m) are below the ground or inside an obstacle: bool ``[...]``."""
        return (points[..., 2] < self.height_at(points[..., :2])) | Solids.of(self.obstacles).contains(points)

    def drop_height(self, xy: Tensor) -> Tensor:
        """Returns the height (m) at which a live simulator drops the rover at ``xy [..., 2]``: ``[...]``."""
        (x, y), height = xy.unbind(-1), torch.full_like(xy[..., 0], self.spawn_height)
        for ((x_low, x_high), (y_low, y_high)), other in reversed(self.spawn_height_areas):
            within = (x > x_low) & (x < x_high) & (y > y_low) & (y < y_high)
            height = height.masked_fill(within, other)
        return height

    @cached_property
    def key(self) -> str:
        """Hash of the ground, the obstacles and the areas."""
        solids = Solids.of(self.obstacles)
        tensors = [self.terrain.heights, solids.vertices, solids.planes, solids.faces]
        about: list[object] = [self.terrain.cell, self.terrain.origin, self.bounds, self.spawn_range, self.goal_range]
        about += [tuple(self.terrain.heights.shape), solids.starts, solids.plane_starts]
        for region in (self.spawn_region, self.goal_region):
            about.append(region and (region.cell, region.origin, tuple(region.mask.shape)))
            tensors += [] if region is None else [region.mask]
        return content_key(repr(about), *(tensor.numpy().tobytes() for tensor in tensors))

    def scaled(self, scale: float) -> World:
        """Returns a world without movers whose layout is ``scale`` times as large, about the middle of its start area.

        Lengths along x and y grow. On level ground, heights stay; else, they grow as well, so that slopes stay.

        Raises:
            ValueError: if something moves in the world, which knows its ways.
        """
        if self.movers:
            raise ValueError(f"world {self.name!r} has movers: only its function can scale it, with a setting 'scale'")
        upward = 1.0 if self.terrain.is_flat else scale
        x, y = ((low + high) / 2 for low, high in self.spawn_range)

        def moved(point: Range) -> Range:
            return x + (point[0] - x) * scale, y + (point[1] - y) * scale

        def grown(area: Area) -> Area:
            (left, bottom), (right, top) = map(moved, zip(*area, strict=True))
            return (left, right), (bottom, top)

        solids, middle = Solids.of(self.obstacles), torch.tensor((x, y, 0.0), dtype=torch.float64)
        factors = torch.tensor((scale, scale, upward), dtype=torch.float64)
        normals = solids.planes[:, :3] / factors
        offsets = solids.planes[:, 3:] + (solids.planes[:, :3] - normals) @ middle[:, None]
        planes = torch.cat((normals, offsets), -1) / normals.norm(dim=-1, keepdim=True)
        changed: dict[str, Any] = {name: grown(getattr(self, name)) for name in ("spawn_range", "goal_range", "bounds")}
        for name in ("spawn_region", "goal_region"):
            region = getattr(self, name)
            changed[name] = region and Region(region.mask, region.cell * scale, moved(region.origin))
        return replace(
            self,
            terrain=Terrain(self.terrain.heights * upward, self.terrain.cell * scale, moved(self.terrain.origin)),
            obstacles=Solids(middle + (solids.vertices - middle) * factors, planes, solids.shapes),
            **changed,
            spawn_height=self.spawn_height * upward,
            spawn_height_areas=tuple((grown(area), height * upward) for area, height in self.spawn_height_areas),
        )
