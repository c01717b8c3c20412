"""Conversion of worlds and robots to the structs that the kernels take."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import torch

from rover_rl.sims.native.warp import wp
from rover_rl.sims.robots import Robot
from rover_rl.sims.robots.inertial_model import InertialModel
from rover_rl.sims.warp.kernels.types import MAX_WHEELS, RobotModel, Scene
from rover_rl.sims.worlds import Obstacle, World

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


def _add_obstacles(scene: Scene, obstacles: Iterable[Obstacle], device: wp.Device) -> None:
    """Adds planes, vertices, face polygons and bounding spheres of the obstacles, as flat lists."""
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
    """Center and radius of a bounding sphere of points, with a margin for rounding."""
    center = points.mean(0)
    return (*center, np.linalg.norm(points - center, axis=1).max() + 1e-4)


def _polygon(corners: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """The vertices that lie on a plane, counter-clockwise around its normal."""
    on = corners[np.abs(corners @ plane[:3] + plane[3]) < 1e-6]
    first = on[0] - on.mean(0)
    second = np.cross(plane[:3], first)
    offsets = on - on.mean(0)
    return on[np.argsort(np.arctan2(offsets @ second, offsets @ first))]


def _add_grid(scene: Scene, world: World, reach: float, device: wp.Device) -> None:
    """Adds the broad-phase grid: for each cell, the obstacles within reach of a rover centered in it."""
    if not world.obstacles:
        scene.grid_columns = scene.grid_rows = 0
        scene.grid_cell = GRID_CELL
        scene.grid_starts = scene.grid_obstacles = wp.zeros(1, dtype=int, device=device)
        return
    lows = np.array([obstacle.vertices.min(0).values.numpy()[:2] for obstacle in world.obstacles]) - reach
    highs = np.array([obstacle.vertices.max(0).values.numpy()[:2] for obstacle in world.obstacles]) + reach
    # A margin of one cell on all sides: kernels clamp rovers outside the grid to its outermost cells.
    corner = lows.min(0) - GRID_CELL
    columns, rows = (int(n) for n in np.ceil((highs.max(0) - corner) / GRID_CELL) + 1)
    cells: list[list[int]] = [[] for _ in range(rows * columns)]
    firsts, lasts = ((ends - corner) // GRID_CELL for ends in (lows, highs))
    for index, (first, last) in enumerate(zip(firsts.astype(int), lasts.astype(int), strict=True)):
        for row in range(first[1], last[1] + 1):
            for column in range(first[0], last[0] + 1):
                cells[row * columns + column].append(index)
    scene.grid_origin = wp.vec2(*corner)
    scene.grid_cell = GRID_CELL
    scene.grid_columns, scene.grid_rows = columns, rows
    scene.grid_starts = wp.array(np.cumsum([0, *map(len, cells)]), dtype=int, device=device)
    scene.grid_obstacles = wp.array([index for cell in cells for index in cell] or [0], dtype=int, device=device)


def _vectors(rows: list, dtype: type, device: wp.Device) -> wp.array:
    width = wp.types.type_size(dtype)
    return wp.array(np.array(rows, dtype=np.float32).reshape(-1, width), dtype=dtype, device=device)
