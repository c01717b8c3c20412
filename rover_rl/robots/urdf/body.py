"""Mass and shape of the body of a robot: one rigid body of boxes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rover_rl.robots.shapes import Mass, box_mass
from rover_rl.robots.urdf.description import Description, Piece
from rover_rl.robots.urdf.wheels import RoundLink

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
        around = {(i, j): _around(boxes[i], boxes[j]) for i, j in pairs}
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


def _around(one: Corners, other: Corners) -> Corners:
    return np.minimum(one[0], other[0]), np.maximum(one[1], other[1])


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
