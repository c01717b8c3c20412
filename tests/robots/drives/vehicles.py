"""Robots with each kind of drive, from URDF files that the tests write."""

from __future__ import annotations

from pathlib import Path

from rover_rl.robots import Robot
from rover_rl.robots.drives import Ackermann, Drive, Mecanum, SkidSteer
from tests.robots.public_urdfs import Machine, car, joint, link

WHEELBASE, TRACK = 0.5, 0.4


def _read(folder: Path, name: str, machine: Machine, drive: Drive) -> Robot:
    for sensor, place in (("lidar", "0.2 0 0.3"), ("imu", "0 0 0.2")):
        machine.add(link(f"{sensor}_link"), joint(sensor, "fixed", "base_footprint", f"{sensor}_link", place))
    return Robot.from_urdf(machine.write(folder, name), drive=drive)


def make_car(folder: Path, **limits: float) -> Robot:
    """Returns a robot that steers with its front wheels, whose base frame lies in the middle of the wheels."""
    joints = {"knuckles": ("left_steering", "right_steering"), "front": ("left_wheel", "right_wheel")}
    drive = Ackermann(**joints, rear=("rear_left", "rear_right"), torque=3.0, **{"max_steering": 0.5, **limits})
    return _read(folder, "car", car(steering=1), drive)


def make_omni(folder: Path) -> Robot:
    """Returns a robot with four mecanum wheels."""
    machine = Machine().body().wheels((WHEELBASE / 2, -WHEELBASE / 2), TRACK / 2)
    return _read(folder, "omni", machine, Mecanum(front=("left_0", "right_0"), rear=("left_1", "right_1"), torque=3.0))


def make_pair(folder: Path) -> Robot:
    """Returns a robot with two driven wheels, and casters ahead of and behind them."""
    machine = Machine(width=0.01).body().wheels((0.0,), TRACK / 2).wheel("ahead", 0.2, 0.0).wheel("behind", -0.2, 0.0)
    drive = SkidSteer(left=("left_0",), right=("right_0",), casters=("ahead", "behind"), torque=3.0)
    return _read(folder, "pair", machine, drive)
