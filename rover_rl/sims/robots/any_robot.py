"""``any:17``: a robot with random size, mass, wheels, limits and drive, of a family from small to large ones.

Each seed is another robot. Lengths and masses cover those of the robots of the package. Seeds from 10,000 up are for
evaluation, by the same convention as those of worlds.
"""

from __future__ import annotations

import hashlib
import math
import tempfile
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

import numpy as np

from rover_rl.files import written_whole
from rover_rl.sims.drives.ackermann import Ackermann
from rover_rl.sims.drives.base import Drive
from rover_rl.sims.drives.skid_steer import SkidSteer
from rover_rl.sims.robots.robot import Robot
from rover_rl.sims.worlds.cache import cache_folder

CORNERS = ("front_left", "front_right", "rear_left", "rear_right")
FRICTION, GRAVITY = 0.5, 9.81
"""Friction of the ground, whose limit the motors exceed, and gravity, m/s^2."""

_Vector: TypeAlias = tuple[float, float, float]


@lru_cache(maxsize=2048)
def any_robot(seed: int = 0) -> Robot:
    """Returns the robot of a seed: half of them are skid-steer, half are cars.

    The wheelbase is 0.22 to 0.62 m, the mass 20 to 90 kg per square meter of its outline. Skid-steer robots drive up to
    0.4 to 2 m/s, cars up to 0.6 to 3 m/s.

    Example:
        >>> robot = any_robot(0)
        >>> robot.name, type(robot.drive).__name__
        ('any:0', 'Ackermann')
    """
    draw = np.random.default_rng((0xA27, seed))
    is_car = draw.random() < 0.5
    base, track, radius = _wheels(draw)
    width = draw.uniform(0.25, 0.6) * radius + 0.02
    gap = 2 * width if is_car else 0.015
    body = (
        base * draw.uniform(0.9, 1.5) + 0.05,
        max(track - width - 2 * gap, 0.1),
        draw.uniform(0.5, 1.0) * radius + 0.06,
    )
    bottom = radius * draw.uniform(0.5, 1.0)
    boxes = [((0.0, 0.0, bottom + body[2] / 2), body)]
    top = bottom + body[2]
    if draw.random() < 0.5:
        deck = max(top, 2 * radius + 0.02)
        boxes.append(((0.0, 0.0, deck + 0.015), (body[0], track + width, 0.03)))
        top = deck + 0.03
    lidar = (0.45 * body[0] * draw.uniform(-0.4, 0.95), 0.0, top + _log_uniform(draw, 0.04, 0.25))
    mast = lidar[2] + 0.03 - top
    boxes.append(((lidar[0], 0.0, top + mast / 2), (0.06, 0.06, mast)))
    mass = _log_uniform(draw, 20.0, 90.0) * max(body[0], base + 2 * radius) * (track + width)
    center = (base * draw.uniform(-0.08, 0.08), 0.0, bottom + 0.4 * body[2])
    wheel = mass * draw.uniform(0.02, 0.06)
    drive = _car(draw, base, track, radius, mass) if is_car else _skid_steer(draw, base, track, radius, mass)
    text = _urdf(f"any_{seed}", boxes, (center, mass - 4 * wheel), (base, track, radius, width, wheel), lidar, is_car)
    lidar_range = _log_uniform(draw, 8.0, 30.0)
    return Robot(f"any:{seed}", _stored(f"any_{seed}", text), drive, lidar_range=round(lidar_range, 2))


def _log_uniform(draw: np.random.Generator, low: float, high: float) -> float:
    return math.exp(draw.uniform(math.log(low), math.log(high)))


def _wheels(draw: np.random.Generator) -> tuple[float, float, float]:
    """Draws the wheelbase, the track and the radius of the wheels, m."""
    base = _log_uniform(draw, 0.22, 0.62)
    track = float(np.clip(base * draw.uniform(0.7, 1.5), 0.22, 0.6))
    return base, track, float(np.clip(base * draw.uniform(0.16, 0.46), 0.05, 0.17))


def _skid_steer(draw: np.random.Generator, base: float, track: float, radius: float, mass: float) -> Drive:
    """Draws a skid-steer drive, whose controller knows the slip of its wheels up to a tenth."""
    # Effective distance of wheels at the corners of a rectangle that slip by Coulomb's law.
    separation = track * (1 + (base / track) ** 2) * draw.uniform(0.9, 1.1)
    return SkidSteer(
        left=("front_left_wheel", "rear_left_wheel"),
        right=("front_right_wheel", "rear_right_wheel"),
        separation=separation,
        torque=draw.uniform(1.2, 2.5) * FRICTION * mass * GRAVITY / 4 * radius,
        max_linear_acceleration=draw.uniform(2.0, 5.0),
        max_angular_acceleration=draw.uniform(3.0, 6.0),
        max_speed=_log_uniform(draw, 0.4, 2.0),
        max_yaw_rate=_log_uniform(draw, 1.0, 5.0),
    )


def _car(draw: np.random.Generator, base: float, track: float, radius: float, mass: float) -> Drive:
    """Draws an Ackermann drive, which turns about a point beside the car."""
    sharpest = math.atan(base / (0.75 * track + 0.05))
    return Ackermann(
        knuckles=("front_left_knuckle", "front_right_knuckle"),
        front=("front_left_wheel", "front_right_wheel"),
        rear=("rear_left_wheel", "rear_right_wheel"),
        max_steering=min(draw.uniform(0.4, 0.6), sharpest),
        max_steering_rate=_log_uniform(draw, 0.7, 4.0),
        torque=draw.uniform(1.2, 2.5) * FRICTION * mass * GRAVITY / 4 * radius,
        max_linear_acceleration=draw.uniform(1.5, 2.0),
        max_speed=_log_uniform(draw, 0.6, 3.0),
        max_yaw_rate=_log_uniform(draw, 2.0, 6.0),
    )


def _urdf(
    name: str,
    boxes: list[tuple[_Vector, _Vector]],
    body: tuple[_Vector, float],
    wheels: tuple[float, float, float, float, float],
    lidar: _Vector,
    is_car: bool,
) -> str:
    """Returns the URDF of a robot.

    Args:
        name: name of the robot.
        boxes: centers and sizes of the boxes of the body, the first of which has its mass, m.
        body: center of mass, m, and mass of the body, kg, with the knuckles of a car.
        wheels: wheelbase, track, radius and width of the wheels, m, and their mass, kg.
        lidar: position of the lidar, m.
        is_car: whether the front wheels steer.
    """
    base, track, radius, width, mass = wheels
    center, body_mass = body
    knuckle = 0.01 * body_mass if is_car else 0.0
    sides = [side**2 for side in boxes[0][1]]
    moments = [(body_mass - 2 * knuckle) / 12 * (sum(sides) - side) for side in sides]
    parts = [_link("base_link", _inertial(body_mass - 2 * knuckle, moments, center))]
    for number, (place, size) in enumerate(boxes):
        shape = f'<geometry><box size="{_text(size)}"/></geometry>'
        color = '<material name="body"><color rgba="0.35 0.55 0.75 1"/></material>'
        parts.append(_link(f"box_{number}", f"<visual>{shape}{color}</visual><collision>{shape}</collision>"))
        parts.append(_joint(f"box_{number}_mount", "fixed", "base_link", f"box_{number}", place))
    for mount, place in (("lidar", lidar), ("imu", (0.0, 0.0, boxes[0][0][2]))):
        parts += [_link(f"{mount}_link"), _joint(mount, "fixed", "base_link", f"{mount}_link", place)]
    shape = '<origin rpy="1.5707963267948966 0 0"/>'
    shape += f'<geometry><cylinder radius="{radius}" length="{width}"/></geometry>'
    color = '<material name="rubber"><color rgba="0.12 0.12 0.13 1"/></material>'
    across, along = mass * (3 * radius**2 + width**2) / 12, mass * radius**2 / 2
    wheel = _inertial(mass, (across, along, across)) + f"<visual>{shape}{color}</visual><collision>{shape}</collision>"
    for corner in CORNERS:
        hub = (base if "front" in corner else -base) / 2, (track if "left" in corner else -track) / 2, radius
        parent = "base_link"
        if is_car and "front" in corner:
            parent, moment = f"{corner}_knuckle_link", 0.01 * knuckle * radius**2 + 1e-6
            parts.append(_link(parent, _inertial(knuckle, (moment, moment, moment))))
            parts.append(_joint(f"{corner}_knuckle", "continuous", "base_link", parent, hub, "0 0 1"))
            hub = (0.0, 0.0, 0.0)
        parts.append(_link(f"{corner}_wheel_link", wheel))
        parts.append(_joint(f"{corner}_wheel", "continuous", parent, f"{corner}_wheel_link", hub, "0 1 0"))
    return f'<robot name="{name}">\n' + "\n".join(parts) + "\n</robot>\n"


def _link(name: str, content: str = "") -> str:
    return f'<link name="{name}">{content}</link>'


def _joint(name: str, kind: str, parent: str, child: str, place: _Vector, axis: str = "1 0 0") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{_text(place)}"/><axis xyz="{axis}"/></joint>'
    )


def _inertial(mass: float, moments: list[float] | _Vector, center: _Vector = (0.0, 0.0, 0.0)) -> str:
    x, y, z = moments
    return (
        f'<inertial><origin xyz="{_text(center)}"/><mass value="{mass}"/>'
        f'<inertia ixx="{x}" ixy="0" ixz="0" iyy="{y}" iyz="0" izz="{z}"/></inertial>'
    )


def _text(numbers: _Vector) -> str:
    return " ".join(map(repr, map(float, numbers)))


def _stored(name: str, text: str) -> Path:
    """Writes a URDF to the cache, or to the folder of temporary files if that cannot be written."""
    key = hashlib.sha256(text.encode()).hexdigest()[:16]
    for folder in (cache_folder(), Path(tempfile.gettempdir()) / "rover_rl"):
        path = folder / "robots" / key / f"{name}.urdf"
        try:
            if not path.is_file():
                with written_whole(path) as temporary:
                    temporary.write_text(text, encoding="utf-8")
            return path
        except OSError as error:
            problem = error
    raise problem
