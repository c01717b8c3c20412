"""Body and drive of a robot whose wheels are found: one rigid body of boxes, and limits that are given or assumed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from rover_rl.robots.drives import Ackermann, Drive, Mecanum, SkidSteer, effective_track
from rover_rl.robots.options import RobotOptions
from rover_rl.robots.shapes import Mass, box_mass
from rover_rl.robots.urdf.description import Description, Piece
from rover_rl.robots.urdf.wheels import Layout, RoundLink

Corners = tuple[np.ndarray, np.ndarray]
"""Lowest and highest corner of a box along the axes, ``[3]`` each, m."""
MAX_BOXES = 6
"""Largest number of boxes of a body."""
WHEELS_SHARE = 0.6
"""Largest share of the mass of a robot that its wheels and casters get."""
SPINS = 0.1, 2.2
"""Least and largest moment of inertia of a wheel about its axle, by that of a disc of its mass."""
GYRATION = 0.08, 1.0
"""Least and largest radius of gyration of a body, by the diagonal of its boxes; that of an even box is about 0.3."""
MASSES = 0.02, 20_000.0
"""Smallest and largest mass of a robot, kg."""
SIZES = 0.03, 20.0
"""Smallest and largest length of a robot, m."""
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


def boxes_of(pieces: list[Piece], floor: float) -> list[Corners]:
    """Returns boxes around shapes: few of them, and none below the height ``floor``."""
    boxes = []
    for piece in pieces:
        low, high = piece.points.min(0), piece.points.max(0)
        low[2] = max(low[2], floor)
        if (high - low > 1e-4).all():
            boxes.append((low, high))
    boxes = [box for k, box in enumerate(boxes) if not _is_inside(box, boxes[:k] + boxes[k + 1 :], k)]
    while len(boxes) > MAX_BOXES:
        # The two boxes for which one around both takes the least additional room become that one.
        pairs = [(i, j) for i in range(len(boxes)) for j in range(i)]
        corners = {pair: np.array([boxes[k] for k in pair]) for pair in pairs}
        around = {pair: (ends[:, 0].min(0), ends[:, 1].max(0)) for pair, ends in corners.items()}
        i, j = min(pairs, key=lambda pair: _room(around[pair]) - _room(boxes[pair[0]]) - _room(boxes[pair[1]]))
        boxes = [box for k, box in enumerate(boxes) if k not in (i, j)] + [around[i, j]]
    return boxes


def _is_inside(box: Corners, others: list[Corners], index: int) -> bool:
    """Whether a box lies in another. Of equal ones, the first counts."""
    low, high = box
    for k, (other_low, other_high) in enumerate(others):
        inside = (other_low <= low).all() and (high <= other_high).all()
        equal = (other_low == low).all() and (other_high == high).all()
        if inside and (not equal or k < index):
            return True
    return False


def _room(box: Corners) -> float:
    return float(np.prod(box[1] - box[0]))


def check_mass(mass: float) -> None:
    """Refuses a mass that no ground robot has."""
    low, high = MASSES
    if not mass > 0:
        raise ValueError("its links have no mass")
    if not low <= mass <= high:
        raise ValueError(f"its links have {mass:.3g} kg in all; from {low:g} to {high:g} kg are taken for a robot")


def check_size(points: np.ndarray) -> None:
    """Refuses a size that no ground robot has, by points of it ``[P, 3]``, m."""
    low, high = SIZES
    size = float(np.ptp(points, 0).max())
    if size > high:
        raise ValueError(f"it is {size:.3g} m large; lengths of a URDF are in meters, perhaps these are millimeters")
    if size < low:
        raise ValueError(f"it is {1000 * size:.3g} mm large; lengths of a URDF are in meters")


def split_mass(
    urdf: Description,
    total: Mass,
    wheels: Sequence[RoundLink],
    hubs: np.ndarray,
    boxes: list[Corners],
    notes: list[str],
) -> tuple[Mass, Mass]:
    """Splits the ``total`` mass of a robot into that of its body and that of each of its wheels, which are alike.

    ``wheels`` are without casters, ``hubs [W, 3]`` (m) with them. ``notes`` get a sentence on inertias that no rigid
    body has.

    Raises:
        ValueError: if the wheels, or all other links together, have no mass.
    """
    radius, width = (float(np.mean([getattr(wheel, size) for wheel in wheels])) for size in ("radius", "width"))
    stated = [urdf.mass(wheel.links) for wheel in wheels]
    masses = [each.mass for each in stated]
    if not min(masses) > 0:
        wheel = wheels[int(np.argmin(masses))]
        raise ValueError(f"wheel link {wheel.joint.child!r} must have a positive mass, its URDF states none")
    if not total.mass - sum(masses) > 1e-6 * total.mass:
        raise ValueError("all links besides the wheels must have a positive mass together, its URDF states none")
    # Casters are wheels like the others, so that there may be more wheels than the mass is for.
    mass = min(float(np.mean(masses)), WHEELS_SHARE * total.mass / len(hubs))
    spins = [each.inertia[1][1] * mass / each.mass for each in stated]
    disc, spin = mass * radius**2 / 2, float(np.mean(spins))
    if not all(SPINS[0] * disc <= each <= SPINS[1] * disc for each in spins):
        notes.append("the inertia of its wheels is not that of a wheel: that of even density is taken")
        spin = disc
    # A wheel of no width is a ball.
    turn = spin / 2 + mass * width**2 / 12 if width else spin
    rest, inertia = total, np.diag((turn, spin, turn))
    for hub in hubs:
        rest = rest.without(Mass.of(mass, hub, inertia))
    size = np.max([box[1] for box in boxes], 0) - np.min([box[0] for box in boxes], 0)
    gyration = np.sqrt(max(np.linalg.eigvalsh(rest.inertia)[-1], 0.0) / rest.mass)
    if not (rest.is_rigid and GYRATION[0] < gyration / np.linalg.norm(size) < GYRATION[1]):
        notes.append("the inertia of its body is not that of a rigid body of its size: that of a box is taken")
        rest = box_mass(rest.mass, np.array(rest.center), size)
    return rest, Mass.of(mass, np.zeros(3), inertia)


def make_drive(
    layout: Layout, hubs: np.ndarray, size: tuple[float, float], mass: Mass, options: RobotOptions, notes: list[str]
) -> Drive:
    """Returns the drive of a robot, with the limits of ``options``. ``notes`` get a sentence on what is assumed.

    ``hubs [W, 3]`` are centers of the wheels in the base frame, left and right in turn from front to back, then those
    of the casters. ``size`` is the radius and the width of the wheels, m.
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
