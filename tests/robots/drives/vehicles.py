"""Robots with each kind of drive, from URDF files that the tests write."""

from __future__ import annotations

from pathlib import Path

from rover_rl.robots import Robot
from rover_rl.robots.drives import Ackermann, Mecanum, SkidSteer

WHEELBASE, TRACK, RADIUS = 0.5, 0.4, 0.1
CORNERS = {
    "front_left": (WHEELBASE / 2, TRACK / 2),
    "front_right": (WHEELBASE / 2, -TRACK / 2),
    "rear_left": (-WHEELBASE / 2, TRACK / 2),
    "rear_right": (-WHEELBASE / 2, -TRACK / 2),
}
_INERTIAL = (
    '<inertial><mass value="0.6"/><inertia ixx="0.0018" ixy="0" ixz="0" iyy="0.003" iyz="0" izz="0.0018"/></inertial>'
)
_WHEEL = f'<origin rpy="1.5707963267948966 0 0"/><geometry><cylinder radius="{RADIUS}" length="0.05"/></geometry>'
_BASE = """
<link name="base_link">
  <inertial><origin xyz="0 0 0.15"/><mass value="10"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.25" iyz="0" izz="0.3"/></inertial>
  <collision><origin xyz="0 0 0.2"/><geometry><box size="0.6 0.3 0.1"/></geometry></collision>
</link>
<link name="lidar_link"/>
<joint name="lidar" type="fixed">
  <parent link="base_link"/><child link="lidar_link"/><origin xyz="0.2 0 0.3"/>
</joint>
<link name="imu_link"/>
<joint name="imu" type="fixed"><parent link="base_link"/><child link="imu_link"/><origin xyz="0 0 0.2"/></joint>"""


def _wheel(name: str, parent: str, origin: str) -> str:
    return f"""
<link name="{name}_wheel_link">{_INERTIAL}<collision>{_WHEEL}</collision></link>
<joint name="{name}_wheel" type="continuous">
  <parent link="{parent}"/><child link="{name}_wheel_link"/><origin xyz="{origin}"/><axis xyz="0 1 0"/>
</joint>"""


def _knuckle(name: str, origin: str) -> str:
    return f"""
<link name="{name}_knuckle_link">
  <inertial><mass value="0.1"/><inertia ixx="0.0001" ixy="0" ixz="0" iyy="0.0001" iyz="0" izz="0.0001"/></inertial>
</link>
<joint name="{name}_knuckle" type="revolute">
  <parent link="base_link"/><child link="{name}_knuckle_link"/><origin xyz="{origin}"/><axis xyz="0 0 1"/>
  <limit lower="-0.7" upper="0.7" effort="10" velocity="5"/>
</joint>"""


def make_car(folder: Path, **limits: float) -> Robot:
    """Returns a robot that steers with its front wheels, whose base frame lies in the middle of the wheels."""
    parts = [_BASE]
    for name, (x, y) in CORNERS.items():
        if name.startswith("front"):
            parts += [_knuckle(name, f"{x} {y} {RADIUS}"), _wheel(name, f"{name}_knuckle_link", "0 0 0")]
        else:
            parts.append(_wheel(name, "base_link", f"{x} {y} {RADIUS}"))
    drive = Ackermann(
        knuckles=("front_left_knuckle", "front_right_knuckle"),
        front=("front_left_wheel", "front_right_wheel"),
        rear=("rear_left_wheel", "rear_right_wheel"),
        torque=3.0,
        **{"max_steering": 0.5, **limits},
    )
    return Robot.from_urdf(_write(folder, "car", parts), drive=drive)


def make_omni(folder: Path) -> Robot:
    """Returns a robot with four mecanum wheels."""
    parts = [_BASE, *(_wheel(name, "base_link", f"{x} {y} {RADIUS}") for name, (x, y) in CORNERS.items())]
    drive = Mecanum(
        front=("front_left_wheel", "front_right_wheel"), rear=("rear_left_wheel", "rear_right_wheel"), torque=3.0
    )
    return Robot.from_urdf(_write(folder, "omni", parts), drive=drive)


def make_pair(folder: Path) -> Robot:
    """Returns a robot with two driven wheels, and casters ahead of and behind them."""
    places = {"left": (0.0, TRACK / 2), "right": (0.0, -TRACK / 2), "ahead": (0.2, 0.0), "behind": (-0.2, 0.0)}
    parts = [_BASE, *(_wheel(name, "base_link", f"{x} {y} {RADIUS}") for name, (x, y) in places.items())]
    parts = [part.replace('length="0.05"', 'length="0.01"') for part in parts]
    drive = SkidSteer(left=("left_wheel",), right=("right_wheel",), casters=("ahead_wheel", "behind_wheel"), torque=3.0)
    return Robot.from_urdf(_write(folder, "pair", parts), drive=drive)


def _write(folder: Path, name: str, parts: list[str]) -> Path:
    path = folder / f"{name}.urdf"
    path.write_text(f'<robot name="{name}">{"".join(parts)}</robot>')
    return path
