"""Scenes of the worlds of a batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias
from weakref import WeakKeyDictionary

import numpy as np

from rover_rl.native.warp import wp
from rover_rl.sims.scenes.scene import Scene
from rover_rl.worlds import World
from rover_rl.worlds.solids import Solids, bounding_balls, face_polygons

BLOCK_SIDE = 1.5
"""Approximate side length of a block of ground, m."""
MAX_BLOCK_CELLS = 30
"""Maximum number of cells along a side of a block: kernels store a bit for each grid point in a 32-bit integer."""
ROUNDING = 1e-4
"""Safety margin of bounds for the rounding errors of single precision, m."""
GRID_CELL = 1.0
"""Side length of a cell of the broad-phase grid, m."""
ALIGNMENT = 64
"""Alignment of the arrays of a scene in memory, bytes: the length of a cache line."""
Contents: TypeAlias = tuple[dict[str, Any], dict[str, np.ndarray]]
"""Numbers and arrays of a struct that stands for a world, by the names of its fields."""


class SceneTable:
    """Worlds of a :class:`~rover_rl.worlds.table.WorldTable` as kernels read them: ``scenes``, an array of structs.

    It has the ``struct`` of each of at most ``capacity`` slots, whose ``contents`` a function returns for a world.
    """

    def __init__(self, capacity: int, device: wp.Device, struct: Any, contents: Callable[[World], Contents]) -> None:
        self._device, self._struct, self._contents = device, struct, contents
        self.scenes = wp.zeros(capacity, dtype=struct, device=device)
        self._size = wp.types.type_size_in_bytes(struct)
        self._bytes = wp.array(ptr=self.scenes.ptr, dtype=wp.uint8, shape=capacity * self._size, device=device)
        # A struct in an array refers to other arrays without owning them.
        self._owners: list[wp.array | None] = [None] * capacity
        # Rovers may come back to a world that another one has replaced.
        self._packed: WeakKeyDictionary[World, PackedScene] = WeakKeyDictionary()

    @classmethod
    def of_solids(cls, capacity: int, reach: float, device: wp.Device) -> SceneTable:
        """Creates a table of :class:`Scene`, whose worlds have any ground.

        ``reach`` is the radius of a sphere around the center of mass that contains the rover, m; 0 for rays.
        """
        return cls(capacity, device, Scene, partial(scene_contents, reach=reach))

    def prepare(self, world: World) -> PackedScene:
        """Packs a world that may be set soon. It is safe to call from another thread."""
        packed = self._packed.get(world)
        if packed is None:
            packed = self._packed[world] = PackedScene.of(self._struct, *self._contents(world))
        return packed

    def __setitem__(self, slot: int, world: World) -> None:
        """Copies a world to a slot."""
        packed = self.prepare(world)
        self._owners[slot] = memory = wp.array(packed.block, dtype=wp.uint8, device=self._device)
        record = wp.array(packed.record_at(memory.ptr), dtype=wp.uint8, device=self._device)
        wp.copy(self._bytes, record, dest_offset=slot * self._size, count=self._size)


@dataclass(frozen=True)
class PackedScene:
    """A world as the kernels read it, in one block of memory, so that a thread reads one region.

    ``block`` has the arrays of the struct one after the other, each aligned to a cache line, and ``record`` is the
    struct, both uint8. The addresses of the arrays, the words of 8 bytes at ``addresses``, are relative to the block.
    """

    block: np.ndarray
    record: np.ndarray
    addresses: list[int]

    @classmethod
    def of(cls, struct: Any, numbers: dict[str, Any], arrays: dict[str, np.ndarray]) -> PackedScene:
        """Packs the contents of a struct."""
        sizes = [_aligned(array.nbytes) for array in arrays.values()]
        memory = np.zeros(sum(sizes) + ALIGNMENT, dtype=np.uint8)
        scene, types = struct(), _array_types(struct)
        for name, value in numbers.items():
            setattr(scene, name, value)
        for (name, array), end in zip(arrays.items(), np.cumsum(sizes).tolist(), strict=True):
            start = end - _aligned(array.nbytes)
            memory[start : start + array.nbytes] = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
            # The last dimension of an array of vectors is in its type.
            shape = array.shape[:-1] if wp.types.type_is_vector(types[name]) else array.shape
            setattr(scene, name, wp.array(ptr=memory.ctypes.data + start, dtype=types[name], shape=shape, device="cpu"))
        content = scene.__ctype__()
        record = np.frombuffer(content, dtype=np.uint8).copy()
        addresses = [getattr(type(content), name).offset // 8 for name in types]
        record.view(np.uint64)[addresses] -= np.uint64(memory.ctypes.data)
        return cls(memory, record, addresses)

    def record_at(self, address: int) -> np.ndarray:
        """The struct of the scene for a copy of the block at an address, uint8."""
        record = self.record.copy()
        record.view(np.uint64)[self.addresses] += np.uint64(address)
        return record


def _array_types(struct: Any) -> dict[str, Any]:
    """Type of the elements of each array in a struct."""
    return {name: var.type.dtype for name, var in struct.vars.items() if hasattr(var.type, "dtype")}


def _aligned(size: int) -> int:
    """Size (bytes) up to the next array in a block."""
    return -(-size // ALIGNMENT) * ALIGNMENT


def scene_contents(world: World, reach: float) -> Contents:
    """Returns the contents of a :class:`Scene` for a ``reach``, as in :meth:`SceneTable.of_solids`."""
    terrain = world.terrain
    heights = terrain.heights.numpy()
    block = min(max(1, round(BLOCK_SIDE / terrain.cell)), MAX_BLOCK_CELLS)
    solids = Solids.of(world.obstacles)
    grid_numbers, grid = _grid(solids, reach)
    arrays = {"heights": heights, "blocks": _blocks(heights, block, terrain.cell)}
    numbers = {"origin": wp.vec2(*terrain.origin), "cell": terrain.cell, "block": block, **grid_numbers}
    return numbers, arrays | _solids(solids) | _faces(solids) | grid


def _blocks(heights: np.ndarray, block: int, cell: float) -> np.ndarray:
    """Bounding planes of each block of cells, ``[rows, columns, 4]``, as ``Scene.blocks``. Borders are included."""
    starts = [np.arange(0, count - 1, block) for count in heights.shape]
    # Grid points of each block along an axis. The last block may have fewer: then its last one counts several times.
    points = [
        np.minimum(first[:, None] + np.arange(block + 1), count - 1)
        for first, count in zip(starts, heights.shape, strict=True)
    ]
    ground = heights[points[0][:, None, :, None], points[1][:, None]].astype(float)
    y, x = ((p - first[:, None] - block / 2) * cell for p, first in zip(points, starts, strict=True))
    arm_x, arm_y = x - x.mean(1, keepdims=True), y - y.mean(1, keepdims=True)
    # Least-squares fit; on a regular grid the two slopes are independent linear regressions.
    slope_x = np.einsum("jirc,ic->ji", ground, arm_x) / (block + 1) / (arm_x**2).sum(1)
    slope_y = np.einsum("jirc,jr->ji", ground, arm_y) / (block + 1) / (arm_y**2).sum(1)[:, None]
    level = ground - slope_x[..., None, None] * x[:, None] - slope_y[..., None, None] * y[:, None, :, None]
    planes = (slope_x, slope_y, level.min((2, 3)) - ROUNDING, level.max((2, 3)) + ROUNDING)
    return np.stack(planes, -1).astype(np.float32)


def _solids(solids: Solids) -> dict[str, np.ndarray]:
    """Planes, vertices and bounding spheres of the obstacles, as flat lists."""
    vertices = solids.vertices.numpy()
    middles, radii = bounding_balls(vertices, solids.starts) if solids else (vertices, np.zeros(0))
    return {
        "spheres": np.column_stack((middles, radii + ROUNDING)).astype(np.float32),
        "planes": solids.planes.numpy().astype(np.float32),
        "plane_starts": np.array(solids.plane_starts, dtype=np.int32),
        "vertices": vertices.astype(np.float32),
        "vertex_starts": np.array(solids.starts, dtype=np.int32),
    }


def _faces(solids: Solids) -> dict[str, np.ndarray]:
    """Faces of the obstacles, as flat lists. Obstacles of the same shape share them."""
    firsts, polygons = {}, list[np.ndarray]()
    for index, shape in enumerate(solids.shapes):
        if shape not in firsts:
            firsts[shape] = len(polygons)
            polygons += face_polygons(solids[index])
    return {
        "first_faces": np.array([firsts[shape] for shape in solids.shapes], dtype=np.int32),
        "face_starts": np.cumsum([0, *map(len, polygons)], dtype=np.int32),
        "corners": np.concatenate([np.zeros(0), *polygons]).astype(np.int32),
    }


def _grid(solids: Solids, reach: float) -> Contents:
    """Size and lists of the broad-phase grid: for each cell the obstacles within reach of a rover centered in it."""
    if not solids:
        lists = {"grid_starts": np.zeros(1, dtype=np.int32), "grid_obstacles": np.zeros(0, dtype=np.int32)}
        return {"grid_cell": GRID_CELL, "grid_columns": 0, "grid_rows": 0}, lists
    lows, highs = (corner[:, :2] + sign * reach for corner, sign in zip(solids.bounding_boxes, (-1, 1), strict=True))
    # A margin of one cell on all sides: kernels clamp rovers outside the grid to its outermost cells.
    corner = lows.min(0) - GRID_CELL
    columns, rows = (int(n) for n in np.ceil((highs.max(0) - corner) / GRID_CELL) + 1)
    firsts, lasts = (((ends - corner) // GRID_CELL).astype(int) for ends in (lows, highs))
    # Every obstacle is listed in the cells of a rectangle, row by row.
    sizes = lasts - firsts + 1
    obstacles = np.repeat(np.arange(len(sizes)), sizes.prod(1))
    number = np.arange(len(obstacles)) - np.repeat(sizes.prod(1).cumsum() - sizes.prod(1), sizes.prod(1))
    along = np.stack((number % sizes[obstacles, 0], number // sizes[obstacles, 0]), -1) + firsts[obstacles]
    cells = along[:, 1] * columns + along[:, 0]
    counts = np.bincount(cells, minlength=rows * columns)
    size = {"grid_origin": wp.vec2(*corner), "grid_cell": GRID_CELL, "grid_columns": columns, "grid_rows": rows}
    return size, {
        "grid_starts": np.cumsum([0, *counts], dtype=np.int32),
        "grid_obstacles": obstacles[np.argsort(cells, kind="stable")].astype(np.int32),
    }
