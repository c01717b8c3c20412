"""Robots of other sizes than Rover Zero, from URDF files that the tests write: a large skid-steer and two cars."""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

from rover_rl.robots import Robot
from rover_rl.robots.drives import Ackermann, SkidSteer

CORNERS = ("front_left", "front_right", "rear_left", "rear_right")


@cache
def husky() -> Robot:
    """Returns a skid-steer of 0.99 x 0.67 m with wheels like those of a Husky, and a lidar on its top plate."""
    text = _body((0.99, 0.57, 0.15), 0.24, 33.0, (0.22, 0.42))
    text += "".join(_wheel(name, "base_link", _hub(name, 0.512, 0.571, 0.165), 0.165, 0.1, 2.6) for name in CORNERS)
    sides = [(f"front_{side}_wheel", f"rear_{side}_wheel") for side in ("left", "right")]
    drive = SkidSteer(left=sides[0], right=sides[1], torque=20.0, separation=1.0)
    return Robot.from_urdf(_write("husky", text), drive=drive, lidar_range=12.0)


@cache
def racer() -> Robot:
    """Returns a car with a wheelbase of 0.33 m that turns on a radius of 0.74 m."""
    return _car("racer", 0.33, 0.24, 0.05, (0.45, 0.16, 0.06), 0.74, 3.0)


@cache
def hunter() -> Robot:
    """Returns a car with a wheelbase of 0.6 m that turns on a radius of 1.6 m."""
    return _car("hunter", 0.6, 0.5, 0.137, (0.8, 0.4, 0.12), 1.6, 30.0)


def _car(name: str, base: float, track: float, radius: float, body: tuple, turn: float, mass: float) -> Robot:
    text = _body(body, radius + body[2], mass, (base / 2, radius + body[2] + 0.15))
    for corner in CORNERS:
        hub = _hub(corner, base, track, radius)
        parent = "base_link"
        if corner.startswith("front"):
            text += _knuckle(corner, hub, mass / 300)
            parent, hub = f"{corner}_knuckle_link", (0.0, 0.0, 0.0)
        text += _wheel(corner, parent, hub, radius, radius * 0.6, mass / 20)
    drive = Ackermann(
        knuckles=("front_left_knuckle", "front_right_knuckle"),
        front=("front_left_wheel", "front_right_wheel"),
        rear=("rear_left_wheel", "rear_right_wheel"),
        torque=mass * radius * 3,
        max_steering=math.atan(base / turn),
    )
    return Robot.from_urdf(_write(name, text), drive=drive)


def _hub(corner: str, base: float, track: float, radius: float) -> tuple[float, float, float]:
    return (base if "front" in corner else -base) / 2, (track if "left" in corner else -track) / 2, radius


def _box_inertial(mass: float, size: tuple, z: float) -> str:
    x, y, h = (side * side for side in size)
    ixx, iyy, izz = (mass * sides / 12 for sides in (y + h, x + h, x + y))
    return (
        f'<inertial><origin xyz="0 0 {z}"/><mass value="{mass}"/>'
        f'<inertia ixx="{ixx}" ixy="0" ixz="0" iyy="{iyy}" iyz="0" izz="{izz}"/></inertial>'
    )


def _body(size: tuple, z: float, mass: float, lidar: tuple[float, float]) -> str:
    shape = f'<origin xyz="0 0 {z}"/><geometry><box size="{size[0]} {size[1]} {size[2]}"/></geometry>'
    return (
        f'<link name="base_link">{_box_inertial(mass, size, z)}<collision>{shape}</collision></link>'
        + _frame("lidar", f"{lidar[0]} 0 {lidar[1]}")
        + _frame("imu", f"0 0 {z}")
    )


def _frame(name: str, place: str) -> str:
    return (
        f'<link name="{name}_link"/><joint name="{name}" type="fixed"><parent link="base_link"/>'
        f'<child link="{name}_link"/><origin xyz="{place}"/></joint>'
    )


def _wheel(name: str, parent: str, hub: tuple, radius: float, width: float, mass: float) -> str:
    across, along = mass * (3 * radius**2 + width**2) / 12, mass * radius**2 / 2
    return f"""
<link name="{name}_wheel_link">
  <inertial><mass value="{mass}"/>
    <inertia ixx="{across}" ixy="0" ixz="0" iyy="{along}" iyz="0" izz="{across}"/></inertial>
  <collision><origin rpy="1.5707963267948966 0 0"/>
    <geometry><cylinder radius="{radius}" length="{width}"/></geometry></collision>
</link>
<joint name="{name}_wheel" type="continuous">
  <parent link="{parent}"/><child link="{name}_wheel_link"/>
  <origin xyz="{hub[0]} {hub[1]} {hub[2]}"/><axis xyz="0 1 0"/>
</joint>"""


def _knuckle(name: str, hub: tuple, mass: float) -> str:
    moments = 'ixx="0.0001" ixy="0" ixz="0" iyy="0.0001" iyz="0" izz="0.0001"'
    return f"""
<link name="{name}_knuckle_link"><inertial><mass value="{mass}"/><inertia {moments}/></inertial></link>
<joint name="{name}_knuckle" type="revolute">
  <parent link="base_link"/><child link="{name}_knuckle_link"/>
  <origin xyz="{hub[0]} {hub[1]} {hub[2]}"/><axis xyz="0 0 1"/>
  <limit lower="-0.7" upper="0.7" effort="10" velocity="5"/>
</joint>"""


def _write(name: str, parts: str) -> Path:
    path = Path(mkdtemp()) / f"{name}.urdf"
    path.write_text(f'<robot name="{name}">{parts}</robot>')
    return path
