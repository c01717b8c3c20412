"""Conversion of worlds and robots to the structs that the kernels take."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from rover_rl.sims.native.warp import wp
from rover_rl.sims.robots import Robot
from rover_rl.sims.robots.inertial_model import InertialModel
from rover_rl.sims.warp.kernels.types import MAX_WHEELS, RobotModel, Scene
from rover_rl.sims.worlds import Obstacle, World
from rover_rl.sims.worlds.obstacles import groups_of

BLOCK_SIDE = 1.5
"""Approximate side length of a block of ground, m."""
MAX_BLOCK_CELLS = 30
"""Maximum number of cells along a side of a block: kernels store a bit for each grid point in a 32-bit integer."""
ROUNDING = 1e-4
"""Safety margin of bounds for the rounding errors of single precision, m."""
GRID_CELL = 1.0
"""Side length of a cell of the broad-phase grid, m."""


class SceneTable:
    """Scenes of the worlds in :class:`~rover_rl.sims.worlds.slots.Slots`, in one array.

    Args:
        capacity: maximum number of slots.
        reach: radius of a sphere around the center of mass that contains the rover, m.
        device: device of the arrays.

    Attributes:
        scenes: scene of each slot.
    """

    def __init__(self, capacity: int, reach: float, device: wp.Device) -> None:
        self._reach, self._device = reach, device
        self.scenes = wp.zeros(capacity, dtype=Scene, device=device)
        # A struct in an array refers to other arrays without owning them.
        self._owners: list[Scene | None] = [None] * capacity

    def __setitem__(self, slot: int, world: World) -> None:
        """Copies a world to a slot."""
        scene = make_scene(world, self._reach, self._device)
        wp.copy(self.scenes, wp.array([scene], dtype=Scene, device=self._device), dest_offset=slot, count=1)
        self._owners[slot] = scene


def make_scene(world: World, reach: float, device: wp.Device) -> Scene:
    """Copies a world to a device.

    Args:
        world: world to copy.
        reach: radius of a sphere around the center of mass that contains the rover, m.
        device: device of the arrays.
    """
    scene = Scene()
    terrain = world.terrain
    heights = terrain.heights.numpy()
    scene.heights = wp.array(heights, dtype=float, device=device)
    scene.origin = wp.vec2(*terrain.origin)
    scene.cell = terrain.cell
    scene.block = min(max(1, round(BLOCK_SIDE / terrain.cell)), MAX_BLOCK_CELLS)
    scene.blocks = wp.array(_blocks(heights, scene.block, terrain.cell), dtype=wp.vec4, device=device)
    _add_obstacles(scene, world.obstacles, device)
    _add_grid(scene, world, reach, device)
    return scene


def make_robot_model(robot: Robot, inertial_model: InertialModel, device: wp.Device) -> RobotModel:
    """Copies the geometry of a robot to a device.

    Raises:
        ValueError: if the robot has more than :data:`MAX_WHEELS` wheels.
    """
    wheels = len(inertial_model.hubs)
    if wheels > MAX_WHEELS:
        raise ValueError(f"the warp backend supports at most {MAX_WHEELS} wheels, {robot.name!r} has {wheels}")
    model = RobotModel()
    model.wheels = wheels
    model.left_wheels = len(robot.left_wheels)
    model.wheel_radius = robot.wheel_radius
    model.wheel_half_width = robot.wheel_width / 2
    model.wheel_inertia = inertial_model.wheel_spin_inertia
    model.hubs = wp.array(inertial_model.hubs, dtype=wp.vec3, device=device)
    model.box_centers = wp.array(inertial_model.box_centers, dtype=wp.vec3, device=device)
    model.box_halves = wp.array(inertial_model.box_halves, dtype=wp.vec3, device=device)
    model.chassis_points = wp.array(inertial_model.points(), dtype=wp.vec3, device=device)
    model.bounding_radius = bounding_radius(robot, inertial_model)
    model.lidar_position = wp.vec3(*robot.lidar_position)
    model.lidar_range = robot.lidar_range
    return model


def bounding_radius(robot: Robot, model: InertialModel) -> float:
    """Radius (m) of a sphere around the center of mass that contains the whole rover."""
    center = model.total(torch.tensor([model.chassis_mass], dtype=torch.float64))[1][0].numpy()
    wheel = math.hypot(robot.wheel_radius, robot.wheel_width / 2)
    hubs = np.linalg.norm(model.hubs - center, axis=1) + wheel
    boxes = np.linalg.norm(np.abs(model.box_centers - center) + model.box_halves, axis=1)
    # The margin of 1 cm covers the shift of the center of mass, some millimeters, when the chassis mass is randomized.
    return float(np.concatenate((hubs, boxes)).max()) + 0.01


def _blocks(heights: np.ndarray, block: int, cell: float) -> np.ndarray:
    """Bounding planes of each block of cells, ``[rows, columns, 4]``.

    Each entry holds the slopes dz/dx and dz/dy of a plane fitted to the ground of the block, borders included, and the
    heights at the middle of the block of two such planes that bound the ground from below and from above (m).
    """
    rows, columns = (range(0, count - 1, block) for count in heights.shape)
    planes = np.empty((len(rows), len(columns), 4))
    for j, i in np.ndindex(len(rows), len(columns)):
        ground = heights[rows[j] : rows[j] + block + 1, columns[i] : columns[i] + block + 1].astype(float)
        y, x = ((np.arange(count) - block / 2) * cell for count in ground.shape)
        # Least-squares fit; on a regular grid the two slopes are independent linear regressions.
        arm_x, arm_y = x - x.mean(), y - y.mean()
        slope_x = (ground * arm_x).mean() / (arm_x**2).mean()
        slope_y = (ground * arm_y[:, None]).mean() / (arm_y**2).mean()
        level = ground - slope_x * x - slope_y * y[:, None]
        planes[j, i] = slope_x, slope_y, level.min() - ROUNDING, level.max() + ROUNDING
    return planes.astype(np.float32)


def _add_obstacles(scene: Scene, obstacles: Sequence[Obstacle], device: wp.Device) -> None:
    """Adds planes, vertices, face polygons and bounding spheres of the obstacles, as flat lists."""
    planes, vertices, spheres = [_NONE], [_NONE], [_NONE]
    polygons, polygon_spheres = [_NONE], [_NONE]
    plane_counts, vertex_counts, polygon_counts = [0], [0], [0]
    for solids in groups_of(obstacles):
        count, corners = len(solids), solids.vertices.numpy()
        faces = [corners[:, polygon] for polygon in solids.polygons]
        planes.append(solids.planes.numpy())
        vertices.append(corners)
        spheres.append(_spheres(corners))
        polygons.append(np.concatenate(faces, 1))
        polygon_spheres.append(np.stack([_spheres(face) for face in faces], 1))
        plane_counts += [len(faces)] * count
        vertex_counts += [corners.shape[1]] * count
        polygon_counts += [len(polygon) for polygon in solids.polygons] * count
    scene.planes = _vectors(planes, wp.vec4, device)
    scene.vertices = _vectors(vertices, wp.vec3, device)
    scene.polygons = _vectors(polygons, wp.vec3, device)
    scene.spheres = _vectors(spheres, wp.vec4, device)
    scene.polygon_spheres = _vectors(polygon_spheres, wp.vec4, device)
    scene.plane_starts = wp.array(np.cumsum(plane_counts), dtype=int, device=device)
    scene.vertex_starts = wp.array(np.cumsum(vertex_counts), dtype=int, device=device)
    scene.polygon_starts = wp.array(np.cumsum(polygon_counts), dtype=int, device=device)


_NONE = np.zeros((0, 0))
"""First entry of each list, so that a world without obstacles has empty arrays."""


def _spheres(points: np.ndarray) -> np.ndarray:
    """Centers and radii of bounding spheres of points ``[N, V, 3]``, with a margin for rounding: ``[N, 4]``."""
    centers = points.mean(1)
    radii = np.linalg.norm(points - centers[:, None], axis=-1).max(1) + ROUNDING
    return np.column_stack((centers, radii))


def _add_grid(scene: Scene, world: World, reach: float, device: wp.Device) -> None:
    """Adds the broad-phase grid: for each cell, the obstacles within reach of a rover centered in it."""
    if not world.obstacles:
        scene.grid_columns = scene.grid_rows = 0
        scene.grid_cell = GRID_CELL
        scene.grid_starts = scene.grid_obstacles = wp.zeros(1, dtype=int, device=device)
        return
    outlines = [solids.vertices[..., :2].numpy() for solids in groups_of(world.obstacles)]
    lows = np.concatenate([outline.min(1) for outline in outlines]) - reach
    highs = np.concatenate([outline.max(1) for outline in outlines]) + reach
    # A margin of one cell on all sides: kernels clamp rovers outside the grid to its outermost cells.
    corner = lows.min(0) - GRID_CELL
    columns, rows = (int(n) for n in np.ceil((highs.max(0) - corner) / GRID_CELL) + 1)
    firsts, lasts = (((ends - corner) // GRID_CELL).astype(int) for ends in (lows, highs))
    listed: list[np.ndarray] = []
    for (left, low), (right, high) in zip(firsts, lasts, strict=True):
        listed.append((np.arange(low, high + 1)[:, None] * columns + np.arange(left, right + 1)).reshape(-1))
    obstacles = np.repeat(np.arange(len(listed)), [len(cells) for cells in listed])
    cells = np.concatenate(listed)
    scene.grid_origin = wp.vec2(*corner)
    scene.grid_cell = GRID_CELL
    scene.grid_columns, scene.grid_rows = columns, rows
    counts = np.bincount(cells, minlength=rows * columns)
    scene.grid_starts = wp.array(np.cumsum([0, *counts]), dtype=int, device=device)
    scene.grid_obstacles = wp.array(obstacles[np.argsort(cells, kind="stable")], dtype=int, device=device)


def _vectors(parts: list[np.ndarray], dtype: type, device: wp.Device) -> wp.array:
    """Joins arrays ``[..., width]`` to an array of vectors."""
    flat = np.concatenate([part.reshape(-1) for part in parts]).astype(np.float32)
    return wp.array(flat.reshape(-1, wp.types.type_size(dtype)), dtype=dtype, device=device)
