"""Robots as the planar kernels read them: wheels, loads and outline, seen from above."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rover_rl.native.warp import wp
from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet
from rover_rl.sims.warp.kernels.types import MAX_WHEELS

STANCE = 0.01
"""Largest difference of the heights of the wheels' lowest points on level ground, m."""
FRICTION_POINT = 0.57735027
"""Point at which friction acts, between the middle and the edge of a tread, as in the full engine."""


@wp.struct
class PlanarRobot:
    """A robot seen from above. Positions in the base frame, m."""

    wheels: int
    motors: int
    motor_of_wheel: wp.array[int]
    steering_of_wheel: wp.array[int]
    hubs: wp.array[wp.vec2]
    radius: float
    # Moment of inertia of one wheel about its axle, kg m^2.
    wheel_inertia: float
    # Number of points of each wheel at which friction acts, 1 or 2, and their distance from its hub along the axle.
    patches: int
    treads: wp.array[float]
    # Direction of the roller of each wheel on the ground, zero for a tire; empty if all are tires.
    rollers: wp.array[wp.vec2]
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
    lidar_position: wp.vec3
    lidar_range: float


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
        stand = [model.height for model in self._owners]
        self.highest_axle = max(
            h + max(hub[2] for hub in r.wheels.hubs) for h, r in zip(stand, fleet.robots, strict=True)
        )
        self.tops = np.array([h + _spans(r)[:, 1].max() for h, r in zip(stand, fleet.robots, strict=True)])
        self.lidars = np.array([h + r.lidar_position[2] for h, r in zip(stand, fleet.robots, strict=True)])
        self.sight = max(r.lidar_range + math.hypot(*r.lidar_position[:2]) for r in fleet.robots)


def _planar(robot: Robot, device: wp.Device) -> PlanarRobot:
    wheels, drive = robot.wheels, robot.drive
    hubs = np.array(wheels.hubs)
    if len(hubs) > MAX_WHEELS:
        raise ValueError(f"the planar tier supports at most {MAX_WHEELS} wheels, {robot.name!r} has {len(hubs)}")
    lowest = hubs[:, 2] - wheels.radius
    loads = _loads(hubs[:, :2])
    center = np.array(robot.center_of_mass)
    if np.ptp(lowest) > STANCE or (loads @ [1.0, *center[:2]]).min() < 0:
        raise ValueError(f"physics='planar' needs a robot that stands level on all wheels, and {robot.name!r} does not")
    boxes, spans, owners = _rectangles(robot), _spans(robot), _owners(robot)
    kept = _visible(boxes, spans)
    corners, corner_owners = _corners(boxes[kept], spans[kept] - lowest.mean(), owners[kept])
    model = PlanarRobot()
    model.wheels, model.motors, model.radius = len(hubs), len(drive.motors), wheels.radius
    model.wheel_inertia, model.height = robot.wheel.inertia[1][1], float(-lowest.mean())
    # A roller touches the ground below the hub.
    rollers = drive.rollers or (None,) * len(hubs)
    treads = [FRICTION_POINT * wheels.width / 2 if roller is None else 0.0 for roller in rollers]
    model.patches = 2 if max(treads) > 0 else 1
    reach = np.linalg.norm(np.abs(boxes[:, :2] - center[:2]) + boxes[:, 2:], axis=1).max()
    # The margin covers the shift of the center of mass, some millimeters, when the mass of the chassis is randomized.
    model.reach = float(reach) + 0.01
    model.lidar_position, model.lidar_range = wp.vec3(*robot.lidar_position), robot.lidar_range
    arms = [(0.0, 0.0) if angle is None else (math.cos(angle), math.sin(angle)) for angle in drive.rollers]
    indices = {
        "motor_of_wheel": drive.motor_of_wheel,
        "steering_of_wheel": wheels.steering or (-1,) * len(hubs),
        "wheel_of_corner": corner_owners,
        "wheel_of_box": owners[kept],
    }
    vectors: dict[str, tuple[Any, Any]] = {
        "hubs": (hubs[:, :2], wp.vec2),
        "rollers": (np.reshape(arms, (-1, 2)), wp.vec2),
        "loads": (loads, wp.vec3),
        "corners": (corners, wp.vec4),
        "boxes": (boxes[kept], wp.vec4),
        "box_spans": (spans[kept] + model.height, wp.vec2),
    }
    model.treads = wp.array(treads, dtype=float, device=device)
    for name, values in indices.items():
        setattr(model, name, wp.array(np.asarray(values), dtype=int, device=device))
    for name, (values, dtype) in vectors.items():
        setattr(model, name, wp.array(values, dtype=dtype, device=device))
    return model


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


def _rectangles(robot: Robot) -> np.ndarray:
    """Boxes and wheels seen from above: centers and half sides, ``[B + W, 4]``, m."""
    boxes = [(*box.center[:2], box.size[0] / 2, box.size[1] / 2) for box in robot.boxes]
    half = robot.wheels.radius, robot.wheels.width / 2 or robot.wheels.radius
    return np.array(boxes + [(*hub[:2], *half) for hub in robot.wheels.hubs])


def _spans(robot: Robot) -> np.ndarray:
    """Lowest and highest points of boxes and wheels, ``[B + W, 2]``, m."""
    boxes = [(box.center[2] - box.size[2] / 2, box.center[2] + box.size[2] / 2) for box in robot.boxes]
    radius = robot.wheels.radius
    return np.array(boxes + [(hub[2] - radius, hub[2] + radius) for hub in robot.wheels.hubs])


def _owners(robot: Robot) -> np.ndarray:
    """Steered wheel that each box and wheel turns with, or -1, ``[B + W]``."""
    steering = robot.wheels.steering or (-1,) * len(robot.wheels.hubs)
    return np.array([-1] * len(robot.boxes) + [wheel if joint >= 0 else -1 for wheel, joint in enumerate(steering)])


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
