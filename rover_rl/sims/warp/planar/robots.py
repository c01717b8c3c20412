"""Robots as the planar kernels read them: wheels, loads and outline, seen from above."""

from __future__ import annotations

import math

import numpy as np

from rover_rl.native.warp import wp
from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet
from rover_rl.sims.warp.kernels.contacts import FRICTION_POINT
from rover_rl.sims.warp.kernels.types import RobotModel
from rover_rl.sims.warp.models import make_robot_model

STANCE = 0.01
"""Largest difference of the heights of the wheels' lowest points on level ground, m."""


@wp.struct
class PlanarRobot:
    """A robot seen from above. Positions in the base frame, m."""

    # Wheels, motors and lidar, as the full engine reads them.
    model: RobotModel
    hubs: wp.array[wp.vec2]
    # Number of points of each wheel at which friction acts, 1 or 2, and their distance from its hub along the axle.
    patches: int
    treads: wp.array[float]
    # Share of the weight on each wheel for a center of mass at the origin, and what it gains for each meter of x and y.
    loads: wp.array[wp.vec3]
    # Height of the base frame above the ground.
    height: float
    # Corners (x, y, lowest, highest point) of the outline, and wheel that each turns with, or -1.
    corners: wp.array[wp.vec4]
    wheel_of_corner: wp.array[int]
    # Rectangles (center, half sides) that the outline is around, their lowest and highest points, and their wheels.
    boxes: wp.array[wp.vec4]
    box_spans: wp.array[wp.vec2]
    wheel_of_box: wp.array[int]
    # Radius of a disc around the center of mass that contains the outline.
    reach: float


class PlanarRobots:
    """Robots of a fleet, by index, in one array: see :class:`~rover_rl.sims.warp.models.ModelTable`.

    ``highest_axle`` (m), ``tops`` and ``lidars`` (``[K]``, m) are heights above the ground. Raises ``ValueError`` for a
    robot that does not stand level.
    """

    def __init__(self, fleet: Fleet, device: wp.Device) -> None:
        self._owners = [_planar(robot, device) for robot in fleet.robots]
        self.models = wp.array(self._owners, dtype=PlanarRobot, device=device)
        self.reach = max(model.reach for model in self._owners)
        self.ranges = fleet.table(lambda robot: robot.lidar_range)
        pairs = [(model.height, robot) for model, robot in zip(self._owners, fleet.robots, strict=True)]
        self.highest_axle = max(stands + hub[2] for stands, robot in pairs for hub in robot.wheels.hubs)
        self.tops = np.array([stands + _parts(robot)[1][:, 1].max() for stands, robot in pairs])
        self.lidars = np.array([stands + robot.lidar_position[2] for stands, robot in pairs])
        self.sight = max(r.lidar_range + math.hypot(*r.lidar_position[:2]) for r in fleet.robots)


def _planar(robot: Robot, device: wp.Device) -> PlanarRobot:
    hubs = np.array(robot.wheels.hubs)
    lowest = hubs[:, 2] - robot.wheels.radius
    loads = _loads(hubs[:, :2])
    center = np.array(robot.center_of_mass)
    if np.ptp(lowest) > STANCE or (loads @ [1.0, *center[:2]]).min() < 0:
        raise ValueError(f"physics='planar' needs a robot that stands level on all wheels, and {robot.name!r} does not")
    boxes, spans, owners = _parts(robot)
    kept = _visible(boxes, spans)
    corners, corner_owners = _corners(boxes[kept], spans[kept] - lowest.mean(), owners[kept])
    planar = PlanarRobot()
    planar.model = make_robot_model(robot, device)
    planar.height = float(-lowest.mean())
    # A roller touches the ground below the hub.
    rollers = robot.drive.rollers or (None,) * len(hubs)
    treads = [FRICTION_POINT * robot.wheels.width / 2 if roller is None else 0.0 for roller in rollers]
    planar.patches = 2 if max(treads) > 0 else 1
    reach = np.linalg.norm(np.abs(boxes[:, :2] - center[:2]) + boxes[:, 2:], axis=1).max()
    # The margin covers the shift of the center of mass, some millimeters, when the mass of the chassis is randomized.
    planar.reach = float(reach) + 0.01
    planar.treads = wp.array(treads, dtype=float, device=device)
    planar.wheel_of_corner = wp.array(corner_owners, dtype=int, device=device)
    planar.wheel_of_box = wp.array(owners[kept], dtype=int, device=device)
    planar.hubs = wp.array(hubs[:, :2], dtype=wp.vec2, device=device)
    planar.loads = wp.array(loads, dtype=wp.vec3, device=device)
    planar.corners = wp.array(corners, dtype=wp.vec4, device=device)
    planar.boxes = wp.array(boxes[kept], dtype=wp.vec4, device=device)
    planar.box_spans = wp.array(spans[kept] + planar.height, dtype=wp.vec2, device=device)
    return planar


def _loads(hubs: np.ndarray) -> np.ndarray:
    """Share of the weight on wheels at ``hubs [W, 2]``, linear in the center of mass: ``[W, 3]`` times (1, x, y).

    Wheels are alike and a little compliant, so that the load is linear in the position, ``N_i = a + b . (h_i - m)``
    with the mean m of the hubs. Balance of forces and moments with the weight at c gives ``a = 1 / W`` and ``b = S^-1
    (c - m)`` with ``S = sum (h_i - m)(h_i - m)^T``.
    """
    middle = hubs.mean(0)
    arms = hubs - middle
    slopes = arms @ np.linalg.pinv(arms.T @ arms)
    return np.column_stack((1 / len(hubs) - slopes @ middle, slopes))


def _parts(robot: Robot) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes and wheels as rectangles (center, half sides) ``[B + W, 4]``, their lowest and highest points, and wheels.

    The wheel is that which a rectangle turns with, or -1, ``[B + W]``. Lengths in m.
    """
    radius, half_width = robot.wheels.radius, robot.wheels.width / 2 or robot.wheels.radius
    centers = np.array([*(box.center for box in robot.boxes), *robot.wheels.hubs])
    wheel = (radius, half_width, radius)
    halves = np.array([*(np.array(box.size) / 2 for box in robot.boxes), *[wheel] * len(robot.wheels.hubs)])
    steering = [wheel if joint >= 0 else -1 for wheel, joint in enumerate(robot.wheels.steering)]
    owners = np.array([-1] * len(robot.boxes) + (steering or [-1] * len(robot.wheels.hubs)))
    spans = np.stack((centers[:, 2] - halves[:, 2], centers[:, 2] + halves[:, 2]), 1)
    return np.column_stack((centers[:, :2], halves[:, :2])), spans, owners


def _visible(boxes: np.ndarray, spans: np.ndarray) -> np.ndarray:
    """Which rectangles are not within a larger one, which what is beside them meets first. Bool ``[B]``."""
    inner = (np.abs(boxes[:, None, :2] - boxes[:, :2]) + boxes[:, None, 2:] <= boxes[:, 2:] + 1e-9).all(-1)
    covered = inner & (spans[:, 0] <= spans[:, None, 0] + 1e-9) & (spans[:, 1] >= spans[:, None, 1] - 1e-9)
    np.fill_diagonal(covered, False)
    return ~covered.any(1)


def _corners(boxes: np.ndarray, spans: np.ndarray, owners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (x, y, lowest, highest) of rectangles that no other one covers, ``[C, 4]``, and their wheels."""
    signs = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
    points = boxes[:, None, :2] + signs * boxes[:, None, 2:]
    number = np.arange(len(boxes)).repeat(4)
    flat = points.reshape(-1, 2)
    within = (np.abs(flat[:, None] - boxes[:, :2]) < boxes[:, 2:] - 1e-9).all(-1)
    reaches = (spans[:, 0] <= spans[number][:, :1]) & (spans[:, 1] >= spans[number][:, 1:])
    kept = ~(within & reaches & (owners < 0)).any(1) | (owners[number] >= 0)
    return np.column_stack((flat, spans[number]))[kept], owners[number][kept]
