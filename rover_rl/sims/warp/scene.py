"""A world and a robot as kernels take them."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import torch

from rover_rl.sims.robots import Robot
from rover_rl.sims.warp.inertial_model import InertialModel
from rover_rl.sims.warp.kernels.types import MAX_WHEELS, Rover, Scene
from rover_rl.sims.warp.library import wp
from rover_rl.sims.worlds import Obstacle, World

BLOCK = 1.5
"""Side of a block of ground, m, about."""
MOST_CELLS = 30
"""Cells along a side of a block: of their corners, kernels keep a bit each in a whole number."""
ROUNDING = 1e-4
"""Metres by which single precision may be off."""
NEAR_CELL = 1.0
"""Side of a cell of the grid that obstacles are found by, m."""


def make_scene(world: World, reach: float, device: wp.Device) -> Scene:
    """A world on a device, for rovers no part of which is farther than ``reach`` (m) from its centre of mass."""
    scene = Scene()
    terrain = world.terrain
    heights = terrain.heights.numpy()
    scene.heights = wp.array(heights, dtype=float, device=device)
    scene.corner = wp.vec2(*terrain.origin)
    scene.cell = terrain.cell
    scene.block = min(max(1, round(BLOCK / terrain.cell)), MOST_CELLS)
    scene.blocks = wp.array(_blocks(heights, scene.block, terrain.cell), dtype=wp.vec4, device=device)
    _add_obstacles(scene, world.obstacles, device)
    _add_near(scene, world, reach, device)
    return scene


def make_rover(robot: Robot, model: InertialModel, device: wp.Device) -> Rover:
    """A robot's model on a device.

    Raises:
        ValueError: if it has more wheels than kernels have room for.
    """
    if len(model.hubs) > MAX_WHEELS:
        raise ValueError(f"the warp backend drives at most {MAX_WHEELS} wheels, {robot.name!r} has {len(model.hubs)}")
    rover = Rover()
    rover.wheels = len(model.hubs)
    rover.left_wheels = len(robot.left_wheels)
    rover.wheel_radius = robot.wheel_radius
    rover.wheel_half_width = robot.wheel_width / 2
    rover.wheel_inertia = model.wheel_spin_inertia
    rover.hubs = wp.array(model.hubs, dtype=wp.vec3, device=device)
    rover.box_centers = wp.array(model.box_centers, dtype=wp.vec3, device=device)
    rover.box_halves = wp.array(model.box_halves, dtype=wp.vec3, device=device)
    rover.points = wp.array(model.points(), dtype=wp.vec3, device=device)
    rover.reach = reach_of(robot, model)
    rover.lidar = wp.vec3(*robot.lidar_position)
    rover.lidar_range = robot.lidar_range
    return rover


def reach_of(robot: Robot, model: InertialModel) -> float:
    """Distance (m) from the centre of mass beyond which there is nothing of the rover."""
    center = model.total(torch.tensor([model.chassis_mass], dtype=torch.float64))[1][0].numpy()
    wheel = math.hypot(robot.wheel_radius, robot.wheel_width / 2)
    hubs = np.linalg.norm(model.hubs - center, axis=1) + wheel
    boxes = np.linalg.norm(np.abs(model.box_centers - center) + model.box_halves, axis=1)
    # A chassis of another mass moves the centre by millimetres.
    return float(np.concatenate((hubs, boxes)).max()) + 0.01


def _blocks(heights: np.ndarray, block: int, cell: float) -> np.ndarray:
    """Planes that follow the ground of each block of cells, their border included: ``[rows, columns, 4]``.

    Of each: slopes along x and y, and the least and the greatest height that it must have at the middle of the block
    for the ground to lie above or below it.
    """
    rows, columns = (range(0, count - 1, block) for count in heights.shape)
    planes = np.empty((len(rows), len(columns), 4))
    for j, i in np.ndindex(len(rows), len(columns)):
        ground = heights[rows[j] : rows[j] + block + 1, columns[i] : columns[i] + block + 1].astype(float)
        y, x = ((np.arange(count) - block / 2) * cell for count in ground.shape)
        # Least squares on a grid: the slopes are regressions of their own.
        arm_x, arm_y = x - x.mean(), y - y.mean()
        slope_x = (ground * arm_x).mean() / (arm_x**2).mean()
        slope_y = (ground * arm_y[:, None]).mean() / (arm_y**2).mean()
        level = ground - slope_x * x - slope_y * y[:, None]
        planes[j, i] = slope_x, slope_y, level.min() - ROUNDING, level.max() + ROUNDING
    return planes.astype(np.float32)


def _add_obstacles(scene: Scene, obstacles: Iterable[Obstacle], device: wp.Device) -> None:
    planes: list[np.ndarray] = []
    vertices: list[np.ndarray] = []
    polygons: list[np.ndarray] = []
    plane_starts, vertex_starts, polygon_starts = [0], [0], [0]
    spheres, polygon_spheres = [], []
    for obstacle in obstacles:
        corners, faces = obstacle.vertices.numpy(), obstacle.planes.numpy()
        spheres.append(_sphere(corners))
        planes.extend(faces)
        vertices.extend(corners)
        plane_starts.append(len(planes))
        vertex_starts.append(len(vertices))
        for plane in faces:
            polygon = _polygon(corners, plane)
            polygon_spheres.append(_sphere(polygon))
            polygons.extend(polygon)
            polygon_starts.append(len(polygons))
    scene.planes = _vectors(planes, wp.vec4, device)
    scene.vertices = _vectors(vertices, wp.vec3, device)
    scene.polygons = _vectors(polygons, wp.vec3, device)
    scene.spheres = _vectors(spheres, wp.vec4, device)
    scene.polygon_spheres = _vectors(polygon_spheres, wp.vec4, device)
    scene.plane_starts = wp.array(plane_starts, dtype=int, device=device)
    scene.vertex_starts = wp.array(vertex_starts, dtype=int, device=device)
    scene.polygon_starts = wp.array(polygon_starts, dtype=int, device=device)


def _sphere(points: np.ndarray) -> tuple[float, ...]:
    """Middle and radius of a sphere around points, a little too large."""
    center = points.mean(0)
    return (*center, np.linalg.norm(points - center, axis=1).max() + 1e-4)


def _polygon(corners: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """The corners on a plane, in order around it."""
    on = corners[np.abs(corners @ plane[:3] + plane[3]) < 1e-6]
    first = on[0] - on.mean(0)
    second = np.cross(plane[:3], first)
    offsets = on - on.mean(0)
    return on[np.argsort(np.arctan2(offsets @ second, offsets @ first))]


def _add_near(scene: Scene, world: World, reach: float, device: wp.Device) -> None:
    """Lists the obstacles within reach of each cell of a grid over all of them."""
    if not world.obstacles:
        scene.near_columns = scene.near_rows = 0
        scene.near_cell = NEAR_CELL
        scene.near_starts = scene.near = wp.zeros(1, dtype=int, device=device)
        return
    lows = np.array([obstacle.vertices.min(0).values.numpy()[:2] for obstacle in world.obstacles]) - reach
    highs = np.array([obstacle.vertices.max(0).values.numpy()[:2] for obstacle in world.obstacles]) + reach
    # A cell more around all: whoever is outside the grid is taken to be in its outermost cells.
    corner = lows.min(0) - NEAR_CELL
    columns, rows = (int(n) for n in np.ceil((highs.max(0) - corner) / NEAR_CELL) + 1)
    cells: list[list[int]] = [[] for _ in range(rows * columns)]
    firsts, lasts = ((ends - corner) // NEAR_CELL for ends in (lows, highs))
    for index, (first, last) in enumerate(zip(firsts.astype(int), lasts.astype(int), strict=True)):
        for row in range(first[1], last[1] + 1):
            for column in range(first[0], last[0] + 1):
                cells[row * columns + column].append(index)
    scene.near_corner = wp.vec2(*corner)
    scene.near_cell = NEAR_CELL
    scene.near_columns, scene.near_rows = columns, rows
    scene.near_starts = wp.array(np.cumsum([0, *map(len, cells)]), dtype=int, device=device)
    scene.near = wp.array([index for cell in cells for index in cell] or [0], dtype=int, device=device)


def _vectors(rows: list, dtype: type, device: wp.Device) -> wp.array:
    width = wp.types.type_size(dtype)
    return wp.array(np.array(rows, dtype=np.float32).reshape(-1, width), dtype=dtype, device=device)
