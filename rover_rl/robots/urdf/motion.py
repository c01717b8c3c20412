"""Drive of a robot with limits: those that are given, or what its wheels and its center of mass allow."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rover_rl.robots.drives import Ackermann, Drive, Mecanum, SkidSteer, effective_track
from rover_rl.robots.options import RobotOptions
from rover_rl.robots.shapes import Mass
from rover_rl.robots.urdf.wheels import Layout

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
        hubs: centers of the wheels in the base frame, left and right in turn from front to back, then those of the
            casters, ``[W, 3]``.
        size: radius and width of the wheels, m.
        mass: mass of the robot, in the base frame.
        options: limits that are given.
        notes: gets a sentence on what is assumed.
    """
    radius, tread = size
    names = [(left.joint.name, right.joint.name) for left, right in layout.wheels]
    count, speed = 2 * len(names), options.max_speed or SkidSteer.max_speed
    driven = 2 if layout.kind == "ackermann" else count
    limits: dict[str, Any] = {
        "torque": options.torque or _rounded(TRACTION * mass.mass * GRAVITY * radius / driven),
        "max_speed": speed,
        "max_linear_acceleration": options.max_acceleration or _acceleration(hubs, mass, notes),
    }
    if options.torque is None:
        assumed = f"{limits['torque']:g} N m at a wheel are assumed, so that the ground is the limit"
        notes.append(f"its torque is not known: {assumed}")
    if layout.kind == "ackermann":
        (front, rear), swivels = names, [wheel.swivel for wheel in layout.wheels[0] if wheel.swivel is not None]
        left, right = (swivel.name for swivel in swivels)
        steering = options.max_steering or _steering(layout, hubs, notes)
        rate = options.max_yaw_rate or _rounded(speed * (math.tan(steering) / abs(hubs[0, 0] - hubs[2, 0])))
        wheels: dict[str, Any] = {"knuckles": (left, right), "front": front, "rear": rear}
        return Ackermann(**wheels, max_steering=steering, max_yaw_rate=rate, **limits)
    if layout.kind == "mecanum":
        (front, rear), arms = names, np.abs(hubs[:4, :2]).mean(0).sum()
        return Mecanum(front=front, rear=rear, max_yaw_rate=options.max_yaw_rate or _rounded(speed / arms), **limits)
    track = options.separation or _separation(hubs[:count], tread, mass, notes)
    sides: dict[str, Any] = {side: tuple(pair[k] for pair in names) for k, side in enumerate(("left", "right"))}
    casters = tuple(CASTER.format(number + 1) for number in range(len(hubs) - count))
    rate = options.max_yaw_rate or _rounded(2 * speed / track)
    return SkidSteer(**sides, casters=casters, separation=track, max_yaw_rate=rate, **limits)


def _separation(hubs: np.ndarray, tread: float, mass: Mass, notes: list[str]) -> float:
    """Effective distance of the sides by Coulomb's law. Wheels of some width slip in any turn."""
    width = float(hubs[0::2, 1].mean() - hubs[1::2, 1].mean())
    track = effective_track(hubs[:, :2], [1, -1] * (len(hubs) // 2), mass.center, tread)
    by_law = f"separation is {track:.3g} m by Coulomb's law, {track / width:.2f} times that of its wheels"
    notes.append(f"its wheels slip in turns: {by_law}")
    return round(track, 4)


def _acceleration(hubs: np.ndarray, mass: Mass, notes: list[str]) -> float:
    """Largest acceleration, at which the robot does not tip over."""
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
    """Largest steering angle of the middle of the front axle, rad."""
    base, half = hubs[0, 0] - hubs[2, 0], (hubs[0, 1] - hubs[1, 1]) / 2
    largest = math.atan(base / (INSIDE * np.abs(hubs[:, 1]).max()))
    joints = [wheel.swivel for wheel in layout.wheels[0] if wheel.swivel and wheel.swivel.kind == "revolute"]
    stated = [abs(end) for joint in joints for end in joint.limits or ()]
    if not stated or max(stated) > WIDEST_STEERING or min(stated) <= 0:
        angle = min(UNKNOWN_STEERING, largest)
        notes.append(f"its steering joints state no limits: {angle:.3g} rad are assumed")
        return round(angle, 4)
    # The inner wheel of a turn steers most.
    angle = math.atan(base / (base / math.tan(min(stated)) + half))
    return round(min(angle, largest), 4)


def _rounded(value: float) -> float:
    """Three digits."""
    return float(f"{value:.3g}")
