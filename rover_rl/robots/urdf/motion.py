"""Drive of a robot with limits: those that are given, or what its wheels and its center of mass allow."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rover_rl.robots.drives import Ackermann, Drive, Mecanum, SkidSteer
from rover_rl.robots.options import RobotOptions
from rover_rl.robots.shapes import Mass
from rover_rl.robots.skidding import effective_track
from rover_rl.robots.urdf.layout import Layout
from rover_rl.robots.urdf.wheels import RoundLink

GRAVITY = 9.81
"""Acceleration of gravity, m/s^2."""
TRACTION = 1.4
"""Torque that is not stated, by what spins a wheel under its share of the weight with a friction of 1."""
TIPPING = 0.8
"""Largest acceleration that is not stated, by that at which the robot tips over."""
UNKNOWN_STEERING = 0.5
"""Steering limit of a car whose URDF states none, rad."""
WIDEST_STEERING = 1.2
"""Largest limit of a steering joint that is taken for a statement, rad."""
INSIDE = 1.1
"""Least radius of a turn, by half the width over the hubs: the center of rotation is beside the car."""
CASTER = "caster_{}"
"""Name of the joint of a caster, by its number."""


def make_drive(
    layout: Layout, hubs: np.ndarray, size: tuple[float, float], mass: Mass, options: RobotOptions, notes: list[str]
) -> Drive:
    """Returns the drive of a robot.

    Args:
        layout: kind of the drive, and the wheels.
        hubs: centers of the wheels, left and right in turn from front to back, then those of the casters, ``[W, 3]``.
        size: radius and width of the wheels, m.
        mass: mass of the robot. The base frame is that of the robot.
        options: limits that are given.
        notes: gets a sentence on what is assumed.
    """
    radius, tread = size
    names = [(left.joint.name, right.joint.name) for left, right in layout.wheels]
    left, right = (tuple(pair[side] for pair in names) for side in (0, 1))
    count, speed = 2 * len(names), options.max_speed or SkidSteer.max_speed
    driven = 2 if layout.kind == "ackermann" else count
    limits: dict[str, Any] = {
        "torque": options.torque or _rounded(TRACTION * mass.mass * GRAVITY * radius / driven),
        "max_speed": speed,
        "max_linear_acceleration": options.max_acceleration or _acceleration(hubs, mass, notes),
    }
    if options.torque is None:
        notes.append(
            f"its torque is not known: {limits['torque']:g} N m at a wheel are assumed, so that the ground is the limit"
        )
    if layout.kind == "ackermann":
        return _car(layout, hubs, options, limits, notes)
    if layout.kind == "mecanum":
        (front, rear), arms = names, np.abs(hubs[:4, :2]).mean(0).sum()
        rate = options.max_yaw_rate or _rounded(speed / arms)
        return Mecanum(front=front, rear=rear, max_yaw_rate=rate, **limits)
    track = options.separation or _separation(hubs[:count], tread, mass, notes)
    rate = options.max_yaw_rate or _rounded(2 * speed / track)
    casters = tuple(CASTER.format(number + 1) for number in range(len(hubs) - count))
    return SkidSteer(left=left, right=right, casters=casters, separation=track, max_yaw_rate=rate, **limits)


def _car(
    layout: Layout, hubs: np.ndarray, options: RobotOptions, limits: dict[str, Any], notes: list[str]
) -> Ackermann:
    front, rear = ((left.joint.name, right.joint.name) for left, right in layout.wheels)
    left, right = (wheel.swivel.name for wheel in layout.wheels[0] if wheel.swivel is not None)
    steering = options.max_steering or _steering(layout, hubs, notes)
    sharpest = math.tan(steering) / abs(hubs[0, 0] - hubs[2, 0])
    rate = options.max_yaw_rate or _rounded(limits["max_speed"] * sharpest)
    return Ackermann(knuckles=(left, right), front=front, rear=rear, max_steering=steering, max_yaw_rate=rate, **limits)


def _separation(hubs: np.ndarray, tread: float, mass: Mass, notes: list[str]) -> float:
    """Returns the effective distance of the sides by Coulomb's law. Wheels of some width slip in any turn."""
    width = float(hubs[0::2, 1].mean() - hubs[1::2, 1].mean())
    track = effective_track(hubs[:, :2], [1, -1] * (len(hubs) // 2), mass.center, tread)
    notes.append(
        f"its wheels slip in turns: separation is {track:.3g} m by Coulomb's law, {track / width:.2f} times that of "
        "its wheels"
    )
    return round(track, 4)


def _acceleration(hubs: np.ndarray, mass: Mass, notes: list[str]) -> float:
    """Returns the largest acceleration, at which the robot does not tip over."""
    usual = SkidSteer.max_linear_acceleration
    x, _, height = mass.center
    arm = min(hubs[:, 0].max() - x, x - hubs[:, 0].min())
    tips = GRAVITY * arm / height if height > 0 else math.inf
    if TIPPING * tips >= usual:
        return usual
    limit = max(_rounded(TIPPING * tips), 0.5)
    notes.append(f"it tips over at {max(tips, 0.0):.2g} m/s^2: its acceleration is limited to {limit:g} m/s^2")
    return limit


def _steering(layout: Layout, hubs: np.ndarray, notes: list[str]) -> float:
    """Returns the largest steering angle of the middle of the front axle, rad."""
    base, half = hubs[0, 0] - hubs[2, 0], (hubs[0, 1] - hubs[1, 1]) / 2
    largest = math.atan(base / (INSIDE * np.abs(hubs[:, 1]).max()))
    stated = [abs(end) for wheel in layout.wheels[0] for end in _limits(wheel)]
    if not stated or max(stated) > WIDEST_STEERING or min(stated) <= 0:
        angle = min(UNKNOWN_STEERING, largest)
        notes.append(f"its steering joints state no limits: {angle:.3g} rad are assumed")
        return round(angle, 4)
    # The inner wheel of a turn steers most.
    angle = math.atan(base / (base / math.tan(min(stated)) + half))
    return round(min(angle, largest), 4)


def _limits(wheel: RoundLink) -> tuple[float, ...]:
    joint = wheel.swivel
    return joint.limits if joint is not None and joint.kind == "revolute" and joint.limits is not None else ()


def _rounded(value: float) -> float:
    """Returns a number with three digits."""
    return float(f"{value:.3g}")
