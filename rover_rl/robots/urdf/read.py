"""Reads a robot from any URDF of a wheeled robot."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rover_rl.robots.drives import Ackermann, Drive
from rover_rl.robots.options import RobotOptions
from rover_rl.robots.urdf.body import Box, boxes_of, check_mass, check_size, split_mass, total_mass
from rover_rl.robots.urdf.derived import Derived, Wheel, store
from rover_rl.robots.urdf.layout import Layout, decide
from rover_rl.robots.urdf.motion import CASTER, make_drive
from rover_rl.robots.urdf.mounts import sensor_mounts, visible_shapes
from rover_rl.robots.urdf.placed import Piece, Placed
from rover_rl.robots.urdf.wheels import FoundWheels, find_wheels, forward_turn

FLOOR = 0.1
"""Height of the lowest boxes of a body that reaches the ground, by the radius of the wheels."""


class ReadRobot(NamedTuple):
    """What was understood of a URDF.

    Attributes:
        name: name of the robot.
        urdf: path of the URDF that simulators load, derived from the file.
        drive: its drive.
        mass: mass of all links of the file, kg.
        summary: kind of the robot, in words.
        notes: what was assumed or left out, a sentence each.
    """

    name: str
    urdf: Path
    drive: Drive
    mass: float
    summary: str
    notes: tuple[str, ...]


def read_urdf(path: Path, options: RobotOptions, name: str | None = None) -> ReadRobot:
    """Reads a robot from a URDF, and writes the URDF that simulators load to the cache.

    Wheels are found by their joints and shapes. All other joints are held. The body becomes one rigid body of boxes,
    and the wheels become alike; the mass of all links together stays.

    Args:
        path: path of the URDF.
        options: what the URDF does not tell.
        name: name of the robot. ``None``: that of the URDF.

    Raises:
        ValueError: if it is no URDF, has no wheels that a drive fits, or lengths and masses of no robot.
        FileNotFoundError: if the file does not exist.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no robot at {path}: the file does not exist")
    try:
        return _read(path, options, name)
    except ValueError as error:
        raise ValueError(f"robot {name or path.name!r} cannot be read from {path}: {error}") from error


def _read(path: Path, options: RobotOptions, name: str | None) -> ReadRobot:
    notes: list[str] = []
    placed = _facing_ahead(Placed(path), notes)
    total = total_mass(placed, placed.description.links)
    check_mass(total.mass)
    found = find_wheels(placed)
    body = _body(placed, found, options.missing, notes)
    layout = decide(placed, found, body, options.drive)
    wheels = [wheel for pair in layout.wheels for wheel in pair]
    radius, width = (float(np.mean([getattr(wheel, size) for wheel in wheels])) for size in ("radius", "width"))
    origin = _origin(layout, radius)
    hubs = np.array([wheel.hub - origin for wheel in wheels])
    hubs[:, 2] = radius
    boxes = _boxes([piece for piece in body if piece.link not in layout.others], hubs, origin, radius, notes)
    total = total._replace(center=total.center - origin)
    hubs = np.concatenate([hubs, _casters(layout, hubs, origin, total.center, notes)])
    rest, rolling = split_mass(placed, total, wheels, hubs, boxes, notes)
    _note_held(placed, layout, notes)
    drive = make_drive(layout, hubs, (radius, width), total, options, notes)
    mounts = sensor_mounts(placed, boxes, origin, options.lidar, notes)
    notes += placed.lost
    own_name = re.sub(r"\W+", "_", name or placed.description.name or path.stem)
    derived = Derived(
        own_name,
        rest,
        boxes,
        _wheels(layout, drive, hubs),
        rolling,
        radius,
        width,
        mounts,
        visible_shapes(placed, origin),
    )
    return ReadRobot(own_name, store(derived, path), drive, total.mass, _summary(layout), tuple(notes))


def _facing_ahead(placed: Placed, notes: list[str]) -> Placed:
    """Returns a URDF turned so that its wheels roll along x."""
    turn = forward_turn(placed)
    if not turn:
        return placed
    notes.append("its wheels roll along y of its base link: +y is taken for ahead")
    return Placed(placed.path, turn)


def _body(placed: Placed, found: FoundWheels, missing: str, notes: list[str]) -> list[Piece]:
    """Returns the shapes of all links but the wheels: for collisions, or visual ones if there are no others."""
    pairs = [*found.fixed, *found.steered]
    rolling = {link for pair in pairs for wheel in pair for link in wheel.links}
    others = [name for name in placed.description.links if name not in rolling]
    for visual in (False, True):
        problems: list[str] = []
        pieces = placed.pieces(others, visual, problems)
        if problems and missing == "error":
            more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
            raise ValueError(f"{problems[0]}{more}; --robot.missing skip leaves such shapes of the body out")
        if problems and (pieces or visual):
            notes.append(f"shapes of its body are left out, since they cannot be read ({len(problems)}): {problems[0]}")
        if pieces:
            return pieces
    return []


def _origin(layout: Layout, radius: float) -> np.ndarray:
    """Returns the point on the ground below the middle of the wheels, ``[3]``."""
    hubs = np.array([wheel.hub for pair in layout.wheels for wheel in pair])
    middle = (hubs.min(0) + hubs.max(0)) / 2
    return np.array((middle[0], middle[1], hubs[:, 2].mean() - radius))


def _boxes(pieces: list[Piece], hubs: np.ndarray, origin: np.ndarray, radius: float, notes: list[str]) -> list[Box]:
    """Returns the boxes of the body in the base frame."""
    reach = np.array((radius, 0.0, radius))
    check_size(np.concatenate([hubs - reach, hubs + reach]))
    check_size(np.concatenate([hubs - reach, hubs + reach, *(piece.points - origin for piece in pieces)]))
    floor = origin[2] + FLOOR * radius
    if any(piece.points[:, 2].min() < floor - 1e-3 for piece in pieces):
        notes.append(f"its body reaches the ground: it is taken to begin {FLOOR * radius:.2g} m above")
    boxes = [(low - origin, high - origin) for low, high in boxes_of(pieces, floor)]
    if boxes:
        return boxes
    notes.append("it has no shape of its body: a box between the wheels stands for it")
    low, high = hubs.min(0) - 0.5 * reach, hubs.max(0) + 0.5 * reach
    return [(low, high + np.array((0.0, 0.0, radius)))]


def _casters(layout: Layout, hubs: np.ndarray, origin: np.ndarray, center: np.ndarray, notes: list[str]) -> np.ndarray:
    """Returns the centers of the wheels that stand for casters, ``[C, 3]``.

    If the center of mass is not between the wheels and the casters, there is one more.
    """
    places = [(x - origin[0], y - origin[1]) for x, y in layout.casters]
    if not places:
        return np.zeros((0, 3))
    many = "1 caster holds" if len(places) == 1 else f"{len(places)} casters hold"
    notes.append(f"{many} it up without friction, as wheels of the size of its others")
    x = [*hubs[:, 0], *(place[0] for place in places)]
    if not min(x) < center[0] < max(x):
        far = max(places, key=lambda place: abs(place[0]))
        places.append((-far[0], 0.0))
        notes.append(f"its center of mass is not above its wheels: one more caster at x = {-far[0]:.2g} m holds it up")
    return np.array([(x, y, hubs[0, 2]) for x, y in places])


def _wheels(layout: Layout, drive: Drive, hubs: np.ndarray) -> list[Wheel]:
    names = [wheel.joint.name for pair in layout.wheels for wheel in pair]
    names += [CASTER.format(number + 1) for number in range(len(hubs) - len(names))]
    steering: dict[str, str] = {}
    if isinstance(drive, Ackermann):
        steering = dict(zip(drive.front, drive.knuckles, strict=True))
    return [Wheel(name, tuple(hub), steering.get(name)) for name, hub in zip(names, hubs.tolist(), strict=True)]


def _note_held(placed: Placed, layout: Layout, notes: list[str]) -> None:
    """Notes the joints that are held."""
    moving = {wheel.joint.name for pair in layout.wheels for wheel in pair}
    if layout.kind == "ackermann":
        moving |= {wheel.swivel.name for wheel in layout.wheels[0] if wheel.swivel is not None}
    inside = {link for pair in layout.wheels for wheel in pair for link in wheel.links} | layout.others
    held = [
        joint.name
        for joint in placed.description.joints.values()
        if joint.kind != "fixed" and joint.name not in moving and joint.child not in inside
    ]
    if held:
        named = ", ".join(held[:6]) + (", ..." if len(held) > 6 else "")
        notes.append(f"joints that are held: {named}")


def _summary(layout: Layout) -> str:
    pairs, casters = len(layout.wheels), len(layout.casters)
    return {
        "skid_steer": f"skid-steer with {2 * pairs} wheels",
        "differential": f"differential with {casters} caster{'s' if casters > 1 else ''}",
        "ackermann": "Ackermann with 2 steered front wheels",
        "mecanum": "mecanum with 4 wheels",
    }[layout.kind]
