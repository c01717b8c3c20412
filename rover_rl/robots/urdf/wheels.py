"""Finds the wheels of a URDF, and decides by them which drive a robot has.

Wheels are told by the type and axis of their joints and by their shapes, and by names where these are not enough.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rover_rl.robots.options import DriveKind
from rover_rl.robots.urdf.description import Description, Joint, Piece

ALONG = 0.9
"""Least component of the axis of a joint along the direction that it is taken for."""
ROUND = 0.12
"""Largest difference of the extents of a wheel across its axle, by its size."""
OFFSET = 0.3
"""Largest distance of the center of a wheel's shape from its axle, by its radius."""
NEAR_GROUND = 0.25
"""Largest height of the lowest point of a wheel above that of the lowest wheel, by its radius; and of a caster."""
TRAIL = 0.15
"""Distance of the hub from a swivel axis above which the wheel is a caster, by its radius."""
MIDDLE = 0.1
"""Largest distance of a wheel from the middle that is on neither side, by half of the width over the hubs."""
CASTER_NAMES = ("caster", "castor", "free", "ball", "swivel")
CASTER_SIZE = 0.5
"""Largest size of a shape that is taken for a caster, by the distance of the left and right wheels."""
LEVEL = 1e-3
"""Height above the lowest point of a caster up to which points of it are on the ground, m."""
ALIKE = 0.05
"""Largest difference of the radii of wheels that are taken for alike, by their mean."""
NO_DRIVE = "no drive of this package has such wheels"


class RoundLink(NamedTuple):
    """A wheel: what turns about a ``joint``, its axle."""

    joint: Joint
    hub: np.ndarray
    """Center, ``[3]``, m."""
    radius: float
    width: float
    """0 for a sphere."""
    links: tuple[str, ...]
    """The link of the wheel and all that hangs on it."""
    swivel: Joint | None
    """Joint about z that carries the wheel."""
    trail: float
    """Distance of the hub from the axis of the swivel along x, m."""

    @property
    def bottom(self) -> float:
        """Height of the lowest point, m."""
        return float(self.hub[2]) - self.radius


Pair = tuple[RoundLink, RoundLink]
"""A left and a right wheel."""


class FoundWheels(NamedTuple):
    """Wheels on the ground: fixed and steered ones in pairs, from front to back, and casters."""

    fixed: list[Pair]
    steered: list[Pair]
    casters: list[RoundLink]


class Layout(NamedTuple):
    """Drive of a robot and its wheels."""

    kind: DriveKind
    wheels: list[Pair]
    """From front to back. The first pair of an Ackermann drive steers."""
    casters: list[tuple[float, float]]
    """x and y of what holds a differential robot up besides its wheels, m."""
    others: frozenset[str]
    """Links that only hold the robot up, and are no part of the body's shape."""


def forward_turn(urdf: Description) -> float:
    """Returns the angle about z that turns the rolling direction to x: 0, or -pi/2 if the axles are along x."""
    axes = [np.abs(urdf.axis(joint)) for joint in _rolling_joints(urdf)]
    along_x, along_y = (sum(axis[k] > ALONG for axis in axes) for k in (0, 1))
    return -math.pi / 2 if along_x >= 2 and not along_y else 0.0


def find_wheels(urdf: Description) -> FoundWheels:
    """Finds the wheels that stand on the ground.

    Raises:
        ValueError: if there are none, they are not in pairs, or the shape of one cannot be read.
    """
    rolling = _rolling_joints(urdf)
    problems: list[str] = []
    wheels: list[RoundLink] = []
    for joint in rolling:
        inside = any(joint.child in wheel.links for wheel in wheels)
        if inside or abs(urdf.axis(joint)[1]) < ALONG:
            continue
        if (wheel := round_link(urdf, joint, problems)) is not None:
            wheels.append(wheel)
    if not wheels:
        raise ValueError(problems[0] if problems else _no_wheels(urdf, rolling))
    ground = min(wheel.bottom for wheel in wheels)
    above = [wheel for wheel in wheels if wheel.bottom - ground > NEAR_GROUND * wheel.radius]
    try:
        return _sorted_wheels([wheel for wheel in wheels if wheel not in above])
    except ValueError as error:
        if problems:
            raise ValueError(problems[0]) from error
        if not above:
            raise
        height = above[0].bottom - ground
        raise ValueError(f"{error} ({above[0].joint.name} is round, too, {height:.2g} m above the ground)") from error


def _rolling_joints(urdf: Description) -> list[Joint]:
    """Joints that turn without end about a level axis."""
    joints = (urdf.mounts[name] for name in urdf.below(urdf.base) if name in urdf.mounts)
    return [joint for joint in joints if _turns_freely(joint) and abs(urdf.axis(joint)[2]) < 1 - ALONG**2]


def _turns_freely(joint: Joint) -> bool:
    """Whether a joint is continuous, or has limits of more than a turn to both sides."""
    if joint.kind == "revolute" and joint.limits is not None:
        return joint.limits[0] < -2 * math.pi and joint.limits[1] > 2 * math.pi
    return joint.kind == "continuous"


def _no_wheels(urdf: Description, rolling: list[Joint]) -> str:
    joints = urdf.joints.values()
    free = [joint.name for joint in joints if _turns_freely(joint)]
    if not free:
        kinds = sorted({joint.kind for joint in joints})
        return f"it has no wheels: none of its joints turns without end, they are {', '.join(kinds) or 'none'}"
    axes = (urdf.axis(joint) for joint in rolling)
    angles = [round(math.degrees(math.atan2(axis[1], axis[0])) % 180) for axis in axes]
    if len(set(angles)) >= 3:
        named = ", ".join(map(str, angles))
        return f"its {len(rolling)} wheels have axles at {named} degrees to its direction ahead; {NO_DRIVE}"
    stated = Description(urdf.path)
    turning = [(joint.name, stated.axis(joint)) for joint in joints if joint.name in free[:3]]
    # Adding 0 turns -0.0 into 0.0.
    about = [(name, " ".join(f"{round(float(each), 2) + 0.0:g}" for each in axis)) for name, axis in turning]
    named = ", ".join(f"{name} (about {axis})" for name, axis in about) + (", ..." if free[3:] else "")
    return f"it has no wheels: nothing that turns on {named} is round about a level axle"


def round_link(urdf: Description, joint: Joint, problems: list[str]) -> RoundLink | None:
    """Returns what a joint turns as a wheel, or ``None`` if that is not round."""
    links, axis, start = tuple(urdf.below(joint.child)), urdf.axis(joint), urdf.frames[joint.child].position
    failed: list[str] = []
    for visual in (False, True):
        pieces = urdf.pieces(links, visual, failed)
        size = _wheel_size(pieces, start, axis) if pieces else None
        if size is not None:
            radius, width, middle = size
            hub = start + middle * axis
            turning = [each for each in urdf.chain(joint.child)[:-1] if _is_swivel(urdf, each)]
            swivel = turning[-1] if turning else None
            trail = abs(hub[0] - urdf.frames[swivel.child].position[0]) if swivel else 0.0
            return RoundLink(joint, hub, radius, width, links, swivel, trail)
    problems += failed
    return None


def _wheel_size(pieces: list[Piece], hub: np.ndarray, axis: np.ndarray) -> tuple[float, float, float] | None:
    """Radius, width and the middle along the axis from the joint, or ``None`` if the shapes are not round."""
    if len(pieces) == 1 and pieces[0].shape.kind in ("sphere", "cylinder"):
        _, frame, sizes, *_ = pieces[0].shape
        offset = frame.position - hub
        middle = float(offset @ axis)
        if len(sizes) == 1:
            return sizes[0], 0.0, middle
        aside = np.linalg.norm(np.cross(frame.rotation[:, 2], axis)), np.linalg.norm(offset - middle * axis)
        if max(aside) < 1e-6:
            return sizes[0], sizes[1], middle
    arms = np.concatenate([piece.points for piece in pieces]) - hub
    along = arms @ axis
    ahead = np.cross(axis, (0.0, 0.0, 1.0))
    ahead /= np.linalg.norm(ahead)
    across = np.column_stack((arms @ ahead, arms @ np.cross(axis, ahead)))
    low, high = across.min(0), across.max(0)
    middle = (low + high) / 2
    radius = float(np.linalg.norm(across - middle, axis=1).max())
    # A box has a diagonal that is longer than its sides; a tread is nearly as wide in all directions.
    is_round = ((high - low) > 2 * radius * (1 - ROUND)).all() and np.linalg.norm(middle) < OFFSET * radius
    if not is_round or radius <= 0:
        return None
    return radius, float(np.ptp(along)), float(along.max() + along.min()) / 2


def _is_swivel(urdf: Description, joint: Joint) -> bool:
    """Whether a joint turns what it carries about z. One that turns it about the axle is told by its name."""
    if joint.kind not in ("continuous", "revolute"):
        return False
    axis = np.abs(urdf.axis(joint))
    return bool(axis[2] >= ALONG or (axis[1] >= ALONG and "steer" in joint.name.lower()))


def _sorted_wheels(wheels: list[RoundLink]) -> FoundWheels:
    """Sorts wheels into pairs and casters."""
    casters = [wheel for wheel in wheels if _is_caster(wheel)]
    others = [wheel for wheel in wheels if not _is_caster(wheel)]
    if len(others) < 2:
        # Names are no more than a hint.
        casters, others = [], wheels
    sides = [wheel.hub[1] for wheel in others]
    middle, half = (max(sides) + min(sides)) / 2, max((max(sides) - min(sides)) / 2, 1e-6)
    left = [wheel for wheel in others if wheel.hub[1] - middle > MIDDLE * half]
    right = [wheel for wheel in others if middle - wheel.hub[1] > MIDDLE * half]
    between = [wheel for wheel in others if abs(wheel.hub[1] - middle) <= MIDDLE * half]
    if between and len(left) == len(right) == 1 and all(wheel.width == 0 for wheel in between):
        casters, between = [*casters, *between], []
    _check_sides(left, right, between)
    pairs = _pairs(left, right)
    fixed = [pair for pair in pairs if pair[0].swivel is None and pair[1].swivel is None]
    steered = [pair for pair in pairs if pair[0].swivel is not None and pair[1].swivel is not None]
    if len(fixed) + len(steered) < len(pairs):
        raise ValueError("a wheel steers and the one on its other side does not; no drive has such wheels")
    return FoundWheels(fixed, steered, casters)


def _is_caster(wheel: RoundLink) -> bool:
    """Whether a wheel follows where the robot goes: it trails behind a free swivel, or has such a name."""
    names = f"{wheel.joint.name} {wheel.joint.child} {wheel.swivel.name if wheel.swivel else ''}".lower()
    if any(name in names for name in CASTER_NAMES):
        return True
    return wheel.swivel is not None and _turns_freely(wheel.swivel) and wheel.trail > TRAIL * wheel.radius


def _check_sides(left: list[RoundLink], right: list[RoundLink], between: list[RoundLink]) -> None:
    names = [wheel.joint.name for wheel in between]
    if between and len(left) == len(right) == 1 and between[0].swivel is not None:
        raise ValueError(f"it has three wheels, of which {names[0]!r} steers; {NO_DRIVE}")
    if between:
        count = len(left) + len(right) + len(between)
        raise ValueError(
            f"it has {count} wheel{'s' if count > 1 else ''} on the ground, {len(left)} on the left, {len(right)} on "
            f"the right and {names} between them; {NO_DRIVE}, unless that is a caster: a swivel, a ball, or a joint so "
            "named"
        )
    if len(left) != len(right) or not left:
        raise ValueError(
            f"it has {len(left)} wheels on the left and {len(right)} on the right; drives of this package have as many "
            "on each side"
        )


def _pairs(left: list[RoundLink], right: list[RoundLink]) -> list[Pair]:
    """Pairs of a left and a right wheel, from front to back."""
    ahead = [sorted(side, key=lambda wheel: -wheel.hub[0]) for side in (left, right)]
    pairs = [*zip(*ahead, strict=True)]
    for one, other in pairs:
        if abs(one.hub[0] - other.hub[0]) > 0.5 * one.radius:
            raise ValueError(
                f"wheel {one.joint.name!r} is at x = {one.hub[0]:.3g} m and the one across, {other.joint.name!r}, at "
                f"x = {other.hub[0]:.3g} m; wheels must be in pairs"
            )
    return pairs


def decide(urdf: Description, found: FoundWheels, body: list[Piece], wanted: DriveKind | None) -> Layout:
    """Decides which drive a robot has, by its wheels and the shapes of all other links.

    Raises:
        ValueError: if no drive of this package has such wheels, or the one that is ``wanted`` has not.
    """
    pairs = sorted([*found.fixed, *found.steered], key=lambda pair: -pair[0].hub[0])
    radii = [wheel.radius for pair in pairs for wheel in pair]
    if max(radii) - min(radii) > ALIKE * float(np.mean(radii)):
        span = f"{min(radii):.3g} to {max(radii):.3g} m"
        raise ValueError(f"its wheels have radii from {span}; the simulators need wheels that are alike")
    kind = wanted or _kind(urdf, found)
    if kind == "ackermann":
        _check_car(found)
    if kind == "mecanum" and len(pairs) != 2:
        raise ValueError(f"a mecanum drive has four wheels, it has {2 * len(pairs)}")
    tops = (wheel.swivel or wheel.joint for wheel in found.casters)
    others = frozenset(link for top in tops for link in urdf.below(top.child))
    casters: list[tuple[float, float]] = []
    if kind in ("skid_steer", "differential"):
        kind = "skid_steer" if len(pairs) > 1 else "differential"
    if kind == "differential":
        touching = _touching(pairs[0], [piece for piece in body if piece.link not in others])
        others |= {piece.link for piece in touching}
        casters = [(float(wheel.hub[0]), float(wheel.hub[1])) for wheel in found.casters]
        casters = [*casters, *map(_lowest, touching)] or _low_ends(pairs[0], body)
        if not casters:
            raise ValueError(
                "it has two wheels and nothing else touches the ground, so that it cannot stand: a caster is a wheel "
                "on a swivel or a ball at the height of the ground"
            )
    return Layout(kind, pairs, casters, others)


def _kind(urdf: Description, found: FoundWheels) -> DriveKind:
    fixed, steered = len(found.fixed), len(found.steered)
    if steered and not fixed:
        held = "unless they are held: --robot.drive skid_steer"
        raise ValueError(f"all of its {2 * steered} wheels steer; {NO_DRIVE}, {held}")
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
    """Whether wheels are mecanum wheels: by rollers on joints of their own, or by that word."""
    if "mecanum" in urdf.path.read_text(errors="replace").lower():
        return True
    wheels = (wheel for pair in found.fixed for wheel in pair)
    mounts = (urdf.mounts[link] for wheel in wheels for link in wheel.links if link != wheel.joint.child)
    return any(joint.kind == "continuous" for joint in mounts)


def _check_car(found: FoundWheels) -> None:
    counts = len(found.steered), len(found.fixed)
    if counts != (1, 1):
        raise ValueError(
            f"an Ackermann drive has two wheels on steering joints and two others, it has {2 * counts[0]} and "
            f"{2 * counts[1]}; a steering joint turns about z between the body and the wheel"
        )
    if not found.steered[0][0].hub[0] > found.fixed[0][0].hub[0]:
        raise ValueError("its rear wheels steer; the Ackermann drive of this package steers with the front wheels")


def _touching(pair: Pair, body: list[Piece]) -> list[Piece]:
    """Small shapes of the body that reach the ground: balls and blocks that stand for casters."""
    wheel, track = pair[0], pair[0].hub[1] - pair[1].hub[1]
    found = []
    for piece in body:
        low, high = piece.points.min(0), piece.points.max(0)
        if abs(low[2] - wheel.bottom) <= NEAR_GROUND * wheel.radius and (high - low)[:2].max() <= CASTER_SIZE * track:
            found.append(piece)
    return found


def _lowest(piece: Piece) -> tuple[float, float]:
    """X and y of the middle of the lowest points of a shape, m."""
    lowest = piece.points[piece.points[:, 2] <= piece.points[:, 2].min() + LEVEL]
    x, y = ((lowest[:, :2].min(0) + lowest[:, :2].max(0)) / 2).tolist()
    return x, y


def _low_ends(pair: Pair, body: list[Piece]) -> list[tuple[float, float]]:
    """Front and back of a body that reaches the ground, as shapes do that hold their casters, too."""
    wheel = pair[0]
    points = np.concatenate([np.zeros((0, 3)), *(piece.points for piece in body)])
    points = points[points[:, 2] <= wheel.bottom + NEAR_GROUND * wheel.radius]
    if not len(points):
        return []
    middle = float(points[:, 1].min() + points[:, 1].max()) / 2
    ends = [float(points[:, 0].min()), float(points[:, 0].max())]
    return [(x, middle) for x in ends if abs(x - wheel.hub[0]) > wheel.radius]
