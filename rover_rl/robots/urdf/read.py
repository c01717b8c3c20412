"""Reads a robot from the URDF of a wheeled robot."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from rover_rl.robots.drives import Ackermann, Drive, Wheels
from rover_rl.robots.options import RobotOptions
from rover_rl.robots.shapes import WEIGHTLESS, Box, Mass, Shape, Vector, nine_digits
from rover_rl.robots.urdf.body import CASTER, Corners, boxes_of, check_mass, check_size, make_drive, split_mass
from rover_rl.robots.urdf.description import Description, Joint, Piece, readable_mesh
from rover_rl.robots.urdf.wheels import FoundWheels, Layout, RoundLink, decide, find_wheels, forward_turn, round_link

Mount: TypeAlias = str | Vector
"""Place of a sensor: the name of a link of the URDF, or its position in the base frame, m."""
FLOOR = 0.1
"""Height of the lowest boxes of a body that reaches the ground, by the radius of the wheels."""
ABOVE = 0.05
"""Height above the body of a lidar whose place is not stated, m."""
ALIKE = 0.01
"""Largest relative difference between the wheels of a drive that is given."""
STEERING_TOLERANCE = 0.01
"""Largest distance of a steering axis from the hub of its wheel, m."""
_AXIAL = math.cos(0.01)
_LIDARS = re.compile(r"lidar|laser|scan|hokuyo|velodyne|sick|ouster|(^|_)urg|(^|_)lds|livox")
_HOLDERS = re.compile(r"mount|bracket|plate|support|holder|standoff|adapter|riser|optical")


def read_urdf(
    path: Path,
    drive: Drive | None = None,
    options: RobotOptions | None = None,
    name: str | None = None,
    lidar: Mount | None = None,
    imu: Mount | None = None,
) -> dict[str, Any]:
    """Returns the arguments of :class:`~rover_rl.robots.Robot` for the robot of a URDF.

    Raises:
        ValueError: if it is no URDF, has no wheels that the drive fits, or lengths and masses of no robot.
        FileNotFoundError: if the file does not exist.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no robot at {path}: the file does not exist")
    try:
        urdf = Description(path)
        notes: list[str] = []
        if drive is None:
            options = options or RobotOptions()
            robot = _found(urdf, options, options.lidar if lidar is None else lidar, imu, notes)
            own_name = re.sub(r"\W+", "_", name or robot.pop("name") or path.stem)
        else:
            robot = _stated(urdf, drive, lidar, imu, notes)
            own_name = name or urdf.name or path.stem
    except ValueError as error:
        raise ValueError(f"robot {name or path.name!r} cannot be read from {path}: {error}") from error
    return {**robot, "name": own_name, "urdf": path, "notes": tuple(notes)}


def _stated(
    urdf: Description, drive: Drive, lidar: Mount | None, imu: Mount | None, notes: list[str]
) -> dict[str, Any]:
    """Reads a robot with a drive that names its joints."""
    for name in (*drive.wheels, *drive.steering):
        if name not in urdf.joints:
            raise ValueError(f"the drive names joint {name!r}, the URDF has the joints {sorted(urdf.joints)}")
    wheels = [_wheel(urdf, urdf.joints[name]) for name in drive.wheels]
    masses = [_checked_mass(urdf.mass(wheel.links), f"wheel link {wheel.joint.child!r}") for wheel in wheels]
    sizes = {"radius": [each.radius for each in wheels], "mass": [each.mass for each in masses]}
    for what, values in {**sizes, "width": [each.width for each in wheels if each.width]}.items():
        if values and max(values) - min(values) > ALIKE * max(values):
            span = f"{min(values):.4g} to {max(values):.4g}"
            raise ValueError(f"its wheels are not alike: the {what} is from {span}; they may differ by {ALIKE:.0%}")
    carriers, steering = [urdf.joints[name] for name in drive.steering], []
    for wheel in wheels:
        chain = [joint for joint in urdf.chain(wheel.joint.child)[:-1] if joint in carriers]
        steering.append(carriers.index(chain[0]) if chain else -1)
        for joint in chain:
            _check_steering(urdf, joint, wheel)
    rolling = {link for wheel in wheels for link in wheel.links}
    knuckles = [[link for link in urdf.below(joint.child) if link not in rolling] for joint in carriers]
    body = [link for link in urdf.below(urdf.base) if link not in rolling.union(*knuckles)]
    _checked_mass(urdf.mass(body), "the body")
    knuckle = urdf.mass(knuckles[0]) if knuckles else None
    if knuckle is not None:
        place = np.array(knuckle.center) - urdf.frames[carriers[0].child].position
        knuckle = knuckle._replace(center=tuple(place.tolist())) if knuckle.mass > 0 else None
    problems: list[str] = []
    pieces = urdf.pieces(body, visual=False, problems=problems)
    if problems:
        raise ValueError(problems[0])
    # A link with a box has a mass of its own, unless all others have none.
    apart = {piece.link for piece in pieces if piece.link != urdf.base}
    if not urdf.mass(others := [link for link in body if link not in apart]).mass > 0:
        apart, others = set(), body
    boxes: list[Box] = []
    for number, piece in enumerate(pieces):
        is_first = piece.link not in (each.link for each in pieces[:number])
        own = urdf.mass([piece.link]) if piece.link in apart and is_first else WEIGHTLESS
        boxes.append(_box(piece)._replace(mass=None if is_first and piece.link == urdf.base else own))
    notes += urdf.lost
    hubs = tuple(tuple(wheel.hub.tolist()) for wheel in wheels)
    width = next((wheel.width for wheel in wheels if wheel.width), 0.0)
    return {
        "drive": drive,
        "body": urdf.mass(others),
        "boxes": tuple(boxes),
        "wheels": Wheels(hubs, wheels[0].radius, width, tuple(steering) if carriers else ()),
        "wheel": masses[0]._replace(center=(0.0, 0.0, 0.0)),
        "knuckle": knuckle,
        "steering_limits": carriers[0].limits if carriers and carriers[0].kind == "revolute" else None,
        "order": tuple(name for name in urdf.joints if name in drive.wheels),
        "lidar_position": _mount(urdf, "lidar", lidar or "lidar_link", np.zeros(3)),
        "imu_position": _mount(urdf, "imu", imu or "imu_link", np.zeros(3)),
        "visuals": _visuals(urdf, np.zeros(3), notes),
    }


def _wheel(urdf: Description, joint: Joint) -> RoundLink:
    if joint.kind != "continuous":
        raise ValueError(f"wheel joint {joint.name!r} is {joint.kind}, it must be continuous")
    if not abs(urdf.axis(joint)[1]) >= _AXIAL:
        raise ValueError(f"wheel joint {joint.name!r} must turn about y of the base frame")
    problems: list[str] = []
    if (wheel := round_link(urdf, joint, problems)) is None:
        reason = problems[0] if problems else "it is not round about its joint"
        raise ValueError(f"wheel link {joint.child!r} must have the shape of a wheel: {reason}")
    return wheel


def _check_steering(urdf: Description, joint: Joint, wheel: RoundLink) -> None:
    name = f"steering joint {joint.name!r}"
    if joint.kind not in ("revolute", "continuous") or not urdf.axis(joint)[2] >= _AXIAL:
        raise ValueError(f"{name} must be revolute or continuous, and turn about +z of the base frame")
    offset = np.linalg.norm((wheel.hub - urdf.frames[joint.child].position)[:2])
    if not offset <= STEERING_TOLERANCE:
        raise ValueError(
            f"the axis of {name} is {offset:.3g} m from the hub of its wheel; {STEERING_TOLERANCE} m is allowed"
        )


def _checked_mass(mass: Mass, what: str) -> Mass:
    if not mass.mass > 0:
        raise ValueError(f"{what} must have a positive mass, its URDF states {mass.mass or 'none'}")
    if not mass.is_rigid:
        moments = ", ".join(f"{each:.4g}" for each in np.linalg.eigvalsh(mass.inertia))
        raise ValueError(
            f"the inertia of {what} is not that of a rigid body: its principal moments {moments} kg m^2 must be "
            "positive, and none larger than the sum of the other two"
        )
    return mass


def _box(piece: Piece) -> Box:
    """The box itself if it is along the axes, else one around the shape."""
    kind, frame, sizes, *_ = piece.shape
    if kind == "box" and not frame.is_turned:
        return Box(tuple(frame.position.tolist()), (sizes[0], sizes[1], sizes[2]))
    return Box.between(piece.points.min(0), piece.points.max(0))


def _found(
    urdf: Description, options: RobotOptions, lidar: Mount | None, imu: Mount | None, notes: list[str]
) -> dict[str, Any]:
    """Finds the wheels and the drive of a robot. The base frame is below the middle of the wheels."""
    if turn := forward_turn(urdf):
        notes.append("its wheels roll along y of its base link: +y is taken for ahead")
        urdf = Description(urdf.path, turn)
    total = urdf.mass(urdf.links)
    check_mass(total.mass)
    found = find_wheels(urdf)
    body = _body(urdf, found, options.missing, notes)
    layout = decide(urdf, found, body, options.drive)
    wheels = [wheel for pair in layout.wheels for wheel in pair]
    radius, width = (float(np.mean([getattr(wheel, size) for wheel in wheels])) for size in ("radius", "width"))
    hubs = np.array([wheel.hub for wheel in wheels])
    middle = (hubs.min(0) + hubs.max(0)) / 2
    origin = np.array((middle[0], middle[1], hubs[:, 2].mean() - radius))
    hubs = hubs - origin
    hubs[:, 2] = radius
    boxes = _boxes([piece for piece in body if piece.link not in layout.others], hubs, origin, radius, notes)
    total = Mass.of(total.mass, np.array(total.center) - origin, np.array(total.inertia))
    hubs = np.concatenate([hubs, _casters(layout, hubs, origin, total.center[0], notes)])
    rest, rolling = split_mass(urdf, total, wheels, hubs, boxes, notes)
    _note_held(urdf, layout, notes)
    drive = make_drive(layout, hubs, (radius, width), total, options, notes)
    names = [wheel.joint.name for wheel in wheels] + [CASTER.format(n + 1) for n in range(len(hubs) - len(wheels))]
    place = dict(zip(names, map(tuple, hubs.tolist()), strict=True))
    low, high = np.min([box[0] for box in boxes], 0), np.max([box[1] for box in boxes], 0)
    middle = (low + high) / 2
    lidar_position = _lidar(urdf, origin, lidar, (*middle[:2], high[2] + ABOVE), notes)
    imu = imu or next((link for link in urdf.frames if "imu" in link.lower()), tuple(middle.tolist()))
    notes.insert(0, f"read as {_summary(layout)}")
    notes += urdf.lost
    numbers = {
        "body": rest,
        "boxes": tuple(Box.between(*box) for box in boxes),
        "wheel": rolling,
        "lidar_position": lidar_position,
        "imu_position": _mount(urdf, "imu", imu, origin),
    }
    hubs, radius, width = nine_digits((tuple(place[name] for name in drive.wheels), radius, width))
    wheel = Wheels(hubs, radius, width, (-1, -1, 0, 1) if isinstance(drive, Ackermann) else ())
    robot = {key: nine_digits(value) for key, value in numbers.items()}
    looks = {"order": tuple(names), "visuals": _visuals(urdf, origin, notes)}
    return {**robot, **looks, "name": urdf.name, "drive": drive, "wheels": wheel}


def _body(urdf: Description, found: FoundWheels, missing: str, notes: list[str]) -> list[Piece]:
    """Shapes of all links but the wheels: for collisions, or visual ones if there are no others."""
    pairs = [*found.fixed, *found.steered]
    rolling = {link for pair in pairs for wheel in pair for link in wheel.links}
    others = [name for name in urdf.links if name not in rolling]
    for visual in (False, True):
        problems: list[str] = []
        pieces = urdf.pieces(others, visual, problems)
        if problems and missing == "error":
            more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
            raise ValueError(f"{problems[0]}{more}; --robot.missing skip leaves such shapes of the body out")
        if problems and (pieces or visual):
            notes.append(f"shapes of its body are left out, since they cannot be read ({len(problems)}): {problems[0]}")
        if pieces:
            return pieces
    return []


def _boxes(pieces: list[Piece], hubs: np.ndarray, origin: np.ndarray, radius: float, notes: list[str]) -> list[Corners]:
    """Boxes of the body in the base frame."""
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


def _casters(layout: Layout, hubs: np.ndarray, origin: np.ndarray, center: float, notes: list[str]) -> np.ndarray:
    """Centers of the wheels that stand for casters, ``[C, 3]``.

    If the center of mass, at x = ``center``, is not between the wheels and the casters, there is one more.
    """
    places = [(x - origin[0], y - origin[1]) for x, y in layout.casters]
    if not places:
        return np.zeros((0, 3))
    many = "1 caster holds" if len(places) == 1 else f"{len(places)} casters hold"
    notes.append(f"{many} it up without friction, as wheels of the size of its others")
    x = [*hubs[:, 0], *(place[0] for place in places)]
    if not min(x) < center < max(x):
        far = max(places, key=lambda place: abs(place[0]))
        places.append((-far[0], 0.0))
        notes.append(f"its center of mass is not above its wheels: one more caster at x = {-far[0]:.2g} m holds it up")
    return np.array([(x, y, hubs[0, 2]) for x, y in places])


def _note_held(urdf: Description, layout: Layout, notes: list[str]) -> None:
    wheels = [wheel for pair in layout.wheels for wheel in pair]
    moving = {wheel.joint.name for wheel in wheels}
    if layout.kind == "ackermann":
        moving |= {wheel.swivel.name for wheel in layout.wheels[0] if wheel.swivel is not None}
    inside = {link for wheel in wheels for link in wheel.links} | layout.others
    turning = [joint for joint in urdf.joints.values() if joint.kind != "fixed" and joint.child not in inside]
    held = [joint.name for joint in turning if joint.name not in moving]
    if held:
        notes.append(f"joints that are held: {', '.join(held[:6])}{', ...' if len(held) > 6 else ''}")


def _summary(layout: Layout) -> str:
    pairs, casters = len(layout.wheels), len(layout.casters)
    return {
        "skid_steer": f"skid-steer with {2 * pairs} wheels",
        "differential": f"differential with {casters} caster{'s' if casters > 1 else ''}",
        "ackermann": "Ackermann with 2 steered front wheels",
        "mecanum": "mecanum with 4 wheels",
    }[layout.kind]


def _lidar(
    urdf: Description, origin: np.ndarray, given: Mount | None, top: Sequence[float], notes: list[str]
) -> Vector:
    if given is not None:
        return _mount(urdf, "lidar", given, origin)
    named = [name for name in urdf.frames if _LIDARS.search(name.lower())]
    named = [name for name in named if not _HOLDERS.search(name.lower())] or named
    # Of the links of one lidar, the last holds the frame of its readings. Of several lidars, the one farthest ahead.
    ends = [name for name in named if not any(other in named for other in [*urdf.below(name)][1:])]
    name = max(ends, key=lambda name: round(urdf.frames[name].position[0], 3), default=None)
    if name is None:
        place = _rounded(top)
        text = " ".join(f"{each:.3g}" for each in place)
        notes.append(f"it names no lidar: one at {text} m, above its middle, is assumed")
        return place
    notes.append(f"link {name!r} is taken for its lidar")
    return _mount(urdf, "lidar", name, origin)


def _mount(urdf: Description, sensor: str, mount: Mount, origin: np.ndarray) -> Vector:
    """Position of a sensor in the base frame."""
    if isinstance(mount, str) and mount in urdf.frames:
        return _rounded(urdf.frames[mount].position - origin)
    try:
        x, y, z = map(float, mount.split() if isinstance(mount, str) else mount)
    except ValueError:
        allowed = f'"x y z" in meters, or one of its links {sorted(urdf.frames)}'
        raise ValueError(f"{sensor} must be {allowed}, got {mount!r}") from None
    return x, y, z


def _rounded(position: Iterable[float]) -> Vector:
    x, y, z = (round(float(each), 9) for each in position)
    return x, y, z


def _visuals(urdf: Description, origin: np.ndarray, notes: list[str]) -> tuple[Shape, ...]:
    """Visual shapes that can be drawn, in the base frame."""
    shapes = []
    for name, shape in [(each, shape) for each in urdf.frames for shape in urdf.links[each].visuals]:
        if shape.kind == "mesh":
            try:
                shape = shape._replace(file=str(readable_mesh(shape.file, urdf.path)))
            except ValueError as error:
                notes.append(f"{error}; it is not drawn")
                continue
        elif shape.kind not in ("box", "cylinder", "sphere"):
            notes.append(f"a visual shape of link {name!r} is a {shape.kind}; it is not drawn")
            continue
        pose = urdf.frames[name] @ shape.frame
        shapes.append(shape._replace(frame=pose._replace(position=pose.position - origin)))
    return tuple(shapes)
