"""``any:17``: a robot with random size, mass, wheels, limits and drive, of a family from small to large ones.

Each seed is another robot. Lengths and masses cover those of the robots of the package. Seeds from 10,000 up are for
evaluation, by the same convention as those of worlds.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rover_rl.robots.drives import Ackermann, Drive, SkidSteer, Wheels
from rover_rl.robots.robot import Robot
from rover_rl.robots.shapes import Box, Frame, Mass, Shape, box_mass, nine_digits

SIDES: dict[str, Any] = {
    "left": ("front_left_wheel", "rear_left_wheel"),
    "right": ("front_right_wheel", "rear_right_wheel"),
}
CAR: dict[str, Any] = {
    "knuckles": ("front_left_knuckle", "front_right_knuckle"),
    "front": ("front_left_wheel", "front_right_wheel"),
    "rear": ("rear_left_wheel", "rear_right_wheel"),
}
"""Names of the joints of the robots of the package: skid-steer robots and cars."""
FRICTION, GRAVITY = 0.5, 9.81
"""Friction of the ground, whose limit the motors exceed, and gravity, m/s^2."""

NIMBLE = 0.8
"""Smallest radius of a turn up to which the lidar of a car may not see what is behind, m."""
BODY, TIRE = (0.35, 0.55, 0.75), (0.12, 0.12, 0.13)
"""Colors."""


@lru_cache(maxsize=2048)
def any_robot(seed: int = 0) -> Robot:
    """Returns the robot of a seed: half of them are skid-steer, half are cars.

    The wheelbase is 0.22 to 0.62 m, the mass 20 to 90 kg per square meter of its outline. Skid-steer robots drive up to
    0.3 to 2 m/s, cars up to 0.6 to 3 m/s. Half of the lidars see a full turn, half 240 to 315 degrees; those of cars
    with a wide turning circle see a full turn.

    Example:
        >>> robot = any_robot(0)
        >>> robot.name, type(robot.drive).__name__
        ('any:0', 'Ackermann')
    """
    draw = np.random.default_rng((0xA27, seed))
    is_car = draw.random() < 0.5
    base = _log_uniform(draw, 0.22, 0.62)
    track = float(np.clip(base * draw.uniform(0.7, 1.5), 0.22, 0.6))
    radius = float(np.clip(base * draw.uniform(0.16, 0.46), 0.05, 0.17))
    width = draw.uniform(0.25, 0.6) * radius + 0.02
    gap = 2 * width if is_car else 0.015
    length = base * draw.uniform(0.9, 1.5) + 0.05
    size = np.array((length, max(track - width - 2 * gap, 0.1), draw.uniform(0.5, 1.0) * radius + 0.06))
    bottom = radius * draw.uniform(0.5, 1.0)
    boxes = [_box(0.0, bottom, size)]
    top = bottom + size[2]
    if draw.random() < 0.5:
        deck = max(top, 2 * radius + 0.02)
        boxes.append(_box(0.0, deck, np.array((length, track + width, 0.03))))
        top = deck + 0.03
    lidar = (0.45 * length * draw.uniform(-0.4, 0.95), 0.0, float(top) + _log_uniform(draw, 0.04, 0.25))
    # Encloses the lidar, so that its origin never enters an obstacle.
    boxes.append(_box(lidar[0], top, np.array((0.06, 0.06, lidar[2] + 0.03 - top))))
    mass = _log_uniform(draw, 20.0, 90.0) * max(length, base + 2 * radius) * (track + width)
    center = np.array((base * draw.uniform(-0.08, 0.08), 0.0, bottom + 0.4 * size[2]))
    wheel = mass * draw.uniform(0.02, 0.06)
    drive = (_car if is_car else _skid_steer)(draw, base, track, mass, radius)
    hubs = [(x, y, radius) for x in (base / 2, -base / 2) for y in (track / 2, -track / 2)]
    # In the order of the drive: the rear wheels of a car come first, and the left wheels of a skid-steer.
    order, steering = ((2, 3, 0, 1), (-1, -1, 0, 1)) if is_car else ((0, 2, 1, 3), ())
    across, along = wheel * (3 * radius**2 + width**2) / 12, wheel * radius**2 / 2
    ranges: dict[str, Any] = {"lidar_range": round(_log_uniform(draw, 8.0, 30.0), 2)}
    # A car with a wide turning circle drives backward often.
    wide = isinstance(drive, Ackermann) and base / math.tan(drive.max_steering) > NIMBLE
    if draw.random() < 0.5 and not wide:
        ranges["lidar_view"] = round(draw.uniform(4.2, 5.5), 2)
    numbers: dict[str, Any] = {
        "body": box_mass(mass - 4 * wheel, center, size),
        "boxes": tuple(boxes),
        "wheel": Mass.of(wheel, np.zeros(3), np.diag((across, along, across))),
        "lidar_position": lidar,
        "imu_position": (0.0, 0.0, float(boxes[0].center[2])),
    }
    numbers = {name: nine_digits(values) for name, values in numbers.items()}
    hub_places, radius, width = nine_digits((tuple(hubs[corner] for corner in order), radius, width))
    wheels = Wheels(hub_places, radius, width, steering)
    visuals = [Shape("box", Frame(np.array(box.center), np.eye(3)), box.size, "", BODY) for box in boxes]
    axle = Rotation.from_rotvec((math.pi / 2, 0, 0)).as_matrix()
    visuals += [Shape("cylinder", Frame(np.array(hub), axle), (radius, width), "", TIRE) for hub in hubs]
    looks: dict[str, Any] = {"visuals": tuple(visuals), "order": CAR["front"] + CAR["rear"]}
    return Robot(name=f"any:{seed}", drive=drive, wheels=wheels, **numbers, **ranges, **looks)


def _box(x: float, bottom: float, size: np.ndarray) -> Box:
    middle = np.array((x, 0.0, bottom + size[2] / 2))
    return Box.between(middle - size / 2, middle + size / 2)


def _log_uniform(draw: np.random.Generator, low: float, high: float) -> float:
    return math.exp(draw.uniform(math.log(low), math.log(high)))


def _skid_steer(draw: np.random.Generator, base: float, track: float, mass: float, radius: float) -> Drive:
    """Draws a skid-steer drive, whose controller knows the slip of its wheels up to a tenth."""
    # Effective distance of wheels at the corners of a rectangle that slip by Coulomb's law.
    separation = track * (1 + (base / track) ** 2) * draw.uniform(0.9, 1.1)
    return SkidSteer(
        **SIDES,
        separation=separation,
        torque=draw.uniform(1.2, 2.5) * FRICTION * mass * GRAVITY / 4 * radius,
        max_linear_acceleration=draw.uniform(2.0, 5.0),
        max_angular_acceleration=draw.uniform(3.0, 6.0),
        max_speed=_log_uniform(draw, 0.3, 2.0),
        max_yaw_rate=_log_uniform(draw, 1.0, 5.0),
    )


def _car(draw: np.random.Generator, base: float, track: float, mass: float, radius: float) -> Drive:
    """Draws an Ackermann drive, which turns about a point beside the car."""
    sharpest = math.atan(base / (0.75 * track + 0.05))
    return Ackermann(
        **CAR,
        max_steering=min(draw.uniform(0.4, 0.6), sharpest),
        max_steering_rate=_log_uniform(draw, 0.7, 4.0),
        torque=draw.uniform(1.2, 2.5) * FRICTION * mass * GRAVITY / 4 * radius,
        max_linear_acceleration=draw.uniform(1.5, 2.0),
        max_speed=_log_uniform(draw, 0.6, 3.0),
        max_yaw_rate=_log_uniform(draw, 2.0, 6.0),
    )
