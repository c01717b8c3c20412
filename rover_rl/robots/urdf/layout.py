"""Decides by the wheels of a URDF which drive a robot has."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rover_rl.robots.options import DriveKind
from rover_rl.robots.urdf.description import Description, Piece
from rover_rl.robots.urdf.wheels import FoundWheels, RoundLink

ALIKE = 0.05
"""Largest difference of the radii of wheels that are taken for alike, by their mean."""
TOUCHING = 0.25
"""Largest distance of a caster's lowest point from the ground, by the radius of the driven wheels."""
LEVEL = 1e-3
"""Height above the lowest point of a caster up to which points of it are on the ground, m."""
CASTER_SIZE = 0.5
"""Largest size of a shape that is taken for a caster, by the distance of the left and right wheels."""


class Layout(NamedTuple):
    """Drive of a robot and its wheels.

    Attributes:
        kind: kind of the drive.
        wheels: pairs of left and right wheels, from front to back. The first one of an Ackermann drive steers.
        casters: x and y of what holds a differential robot up besides its wheels, m.
        others: links that only hold the robot up, and are no part of the body's shape.
    """

    kind: DriveKind
    wheels: list[tuple[RoundLink, RoundLink]]
    casters: list[tuple[float, float]]
    others: frozenset[str]


def decide(urdf: Description, found: FoundWheels, body: list[Piece], wanted: DriveKind | None) -> Layout:
    """Decides which drive a robot has.

    Args:
        urdf: the URDF.
        found: its wheels.
        body: shapes of all other links.
        wanted: kind of the drive; ``None`` decides by the wheels.

    Raises:
        ValueError: if no drive of this package has such wheels, or the one that is wanted has not.
    """
    pairs = sorted([*found.fixed, *found.steered], key=lambda pair: -pair[0].hub[0])
    _check_alike(pairs)
    kind = wanted or _kind(urdf, found)
    if kind == "ackermann":
        _check_car(found)
    if kind == "mecanum" and len(pairs) != 2:
        raise ValueError(f"a mecanum drive has four wheels, it has {2 * len(pairs)}")
    others = frozenset(link for wheel in found.casters for link in _caster_links(urdf, wheel))
    casters: list[tuple[float, float]] = []
    if kind == "differential" and len(pairs) > 1:
        kind = "skid_steer"
    if kind in ("skid_steer", "differential") and len(pairs) == 1:
        kind = "differential"
        touching = _touching(pairs[0], [piece for piece in body if piece.link not in others])
        others |= {piece.link for piece in touching}
        casters = [(float(wheel.hub[0]), float(wheel.hub[1])) for wheel in found.casters]
        casters += [(float(x), float(y)) for x, y in (_lowest(piece) for piece in touching)]
        casters = casters or _low_ends(pairs[0], body)
        if not casters:
            raise ValueError(
                "it has two wheels and nothing else touches the ground, so that it cannot stand: a caster is a wheel "
                "on a swivel or a ball at the height of the ground"
            )
    return Layout(kind, pairs, casters, others)


def _kind(urdf: Description, found: FoundWheels) -> DriveKind:
    fixed, steered = len(found.fixed), len(found.steered)
    if steered and not fixed:
        raise ValueError(
            f"all of its {2 * steered} wheels steer; no drive of this package has such wheels, unless they are held: "
            "--robot.drive skid_steer"
        )
    if steered > 1 or (steered and fixed > 1):
        raise ValueError(
            f"it has {2 * (fixed + steered)} wheels, of which {2 * steered} steer; the Ackermann drive has two that "
            "steer and two that do not (--robot.drive skid_steer holds them straight)"
        )
    if steered:
        return "ackermann"
    if fixed == 2 and _has_rollers(urdf, found):
        return "mecanum"
    return "differential" if fixed == 1 else "skid_steer"


def _has_rollers(urdf: Description, found: FoundWheels) -> bool:
    """Returns whether wheels are mecanum wheels: by rollers on joints of their own, or by that word."""
    if "mecanum" in urdf.path.read_text(errors="replace").lower():
        return True
    for wheel in (each for pair in found.fixed for each in pair):
        mounts = [urdf.mounts[link] for link in wheel.links if link != wheel.joint.child]
        if any(joint.kind == "continuous" for joint in mounts):
            return True
    return False


def _check_car(found: FoundWheels) -> None:
    counts = len(found.steered), len(found.fixed)
    if counts != (1, 1):
        raise ValueError(
            f"an Ackermann drive has two wheels on steering joints and two others, it has {2 * counts[0]} and "
            f"{2 * counts[1]}; a steering joint turns about z between the body and the wheel"
        )
    if not found.steered[0][0].hub[0] > found.fixed[0][0].hub[0]:
        raise ValueError("its rear wheels steer; the Ackermann drive of this package steers with the front wheels")


def _check_alike(pairs: list[tuple[RoundLink, RoundLink]]) -> None:
    radii = [wheel.radius for pair in pairs for wheel in pair]
    if max(radii) - min(radii) > ALIKE * float(np.mean(radii)):
        raise ValueError(
            f"its wheels have radii from {min(radii):.3g} to {max(radii):.3g} m; the simulators need wheels that are "
            "alike"
        )


def _caster_links(urdf: Description, wheel: RoundLink) -> list[str]:
    """Names the links of a caster: from its swivel on."""
    top = wheel.swivel.child if wheel.swivel is not None else wheel.joint.child
    return [*urdf.below(top)]


def _touching(pair: tuple[RoundLink, RoundLink], body: list[Piece]) -> list[Piece]:
    """Returns small shapes of the body that reach the ground: balls and blocks that stand for casters."""
    wheel, track = pair[0], pair[0].hub[1] - pair[1].hub[1]
    found = []
    for piece in body:
        low, high = piece.points.min(0), piece.points.max(0)
        if abs(low[2] - wheel.bottom) <= TOUCHING * wheel.radius and (high - low)[:2].max() <= CASTER_SIZE * track:
            found.append(piece)
    return found


def _low_ends(pair: tuple[RoundLink, RoundLink], body: list[Piece]) -> list[tuple[float, float]]:
    """Returns the front and the back of a body that reaches the ground, as shapes do that hold their casters, too."""
    wheel = pair[0]
    height = wheel.bottom + TOUCHING * wheel.radius
    points = np.concatenate([piece.points for piece in body]) if body else np.zeros((0, 3))
    points = points[points[:, 2] <= height]
    if not len(points):
        return []
    middle = float(points[:, 1].min() + points[:, 1].max()) / 2
    ends = [float(points[:, 0].min()), float(points[:, 0].max())]
    return [(x, middle) for x in ends if abs(x - wheel.hub[0]) > wheel.radius]


def _lowest(piece: Piece) -> np.ndarray:
    """Returns x and y of the middle of the lowest points of a shape, ``[2]``."""
    points = piece.points
    lowest = points[points[:, 2] <= points[:, 2].min() + LEVEL]
    return (lowest[:, :2].min(0) + lowest[:, :2].max(0)) / 2
