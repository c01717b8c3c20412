"""Finds the wheels of a URDF: by the type and axis of their joints and by their shapes, by names as a tie-break."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rover_rl.robots.urdf.description import Description, Joint, Piece

ALONG = 0.9
"""Least component of the axis of a joint along the direction that it is taken for."""
ROUND = 0.12
"""Largest difference of the extents of a wheel across its axle, by its size."""
OFFSET = 0.3
"""Largest distance of the center of a wheel's shape from its axle, by its radius."""
NEAR_GROUND = 0.25
"""Largest height of the lowest point of a wheel above that of the lowest wheel, by its radius."""
TRAIL = 0.15
"""Distance of the hub from a swivel axis above which the wheel is a caster, by its radius."""
MIDDLE = 0.1
"""Largest distance of a wheel from the middle that is on neither side, by half of the width over the hubs."""
CASTER_NAMES = ("caster", "castor", "free", "ball", "swivel")


class RoundLink(NamedTuple):
    """A wheel.

    Attributes:
        joint: joint about its axle.
        hub: center, ``[3]``, m.
        radius: radius, m.
        width: width, m; 0 for a sphere.
        links: the link of the wheel and all that hangs on it.
        swivel: joint about z that carries the wheel.
        trail: distance of the hub from the axis of the swivel along x, m.
        sign: 1 if the joint turns about +y, -1 about -y.
    """

    joint: Joint
    hub: np.ndarray
    radius: float
    width: float
    links: tuple[str, ...]
    swivel: Joint | None
    trail: float
    sign: float

    @property
    def bottom(self) -> float:
        """Height of the lowest point, m."""
        return float(self.hub[2]) - self.radius


class FoundWheels(NamedTuple):
    """Wheels on the ground: fixed and steered ones in pairs of left and right, from front to back, and casters."""

    fixed: list[tuple[RoundLink, RoundLink]]
    steered: list[tuple[RoundLink, RoundLink]]
    casters: list[RoundLink]


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
    """Returns the joints that turn without end about a level axis."""
    joints = (urdf.mounts[name] for name in urdf.below(urdf.base) if name in urdf.mounts)
    return [joint for joint in joints if _turns_freely(joint) and abs(urdf.axis(joint)[2]) < 1 - ALONG**2]


def _turns_freely(joint: Joint) -> bool:
    """Returns whether a joint is continuous, or has limits of more than a turn to both sides."""
    if joint.kind == "revolute" and joint.limits is not None:
        return joint.limits[0] < -2 * math.pi and joint.limits[1] > 2 * math.pi
    return joint.kind == "continuous"


def _no_wheels(urdf: Description, rolling: list[Joint]) -> str:
    joints = urdf.joints.values()
    free = [joint.name for joint in joints if _turns_freely(joint)]
    if not free:
        kinds = sorted({joint.kind for joint in joints})
        return f"it has no wheels: none of its joints turns without end, they are {', '.join(kinds) or 'none'}"
    if len({round(each) for each in _angles(urdf, rolling)}) >= 3:
        angles = ", ".join(f"{round(each)}" for each in _angles(urdf, rolling))
        return (
            f"its {len(rolling)} wheels have axles at {angles} degrees to its direction ahead; no drive of this "
            "package has such wheels"
        )
    stated = Description(urdf.path)
    turning = [(joint.name, stated.axis(joint)) for joint in joints if joint.name in free[:3]]
    named = ", ".join(f"{name} (about {_direction(axis)})" for name, axis in turning) + (", ..." if free[3:] else "")
    return f"it has no wheels: nothing that turns on {named} is round about a level axle"


def _angles(urdf: Description, rolling: list[Joint]) -> list[float]:
    """Returns the directions of axles, from 0 to 180 degrees from +x."""
    axes = (urdf.axis(joint) for joint in rolling)
    return [math.degrees(math.atan2(axis[1], axis[0])) % 180 for axis in axes]


def _direction(axis: np.ndarray) -> str:
    """Returns the components of a direction as text."""
    # Adding 0 turns -0.0 into 0.0.
    return " ".join(f"{round(float(each), 2) + 0.0:g}" for each in axis)


def round_link(urdf: Description, joint: Joint, problems: list[str]) -> RoundLink | None:
    """Returns what a joint turns as a wheel, or ``None`` if that is not round."""
    links = tuple(urdf.below(joint.child))
    axis = urdf.axis(joint)
    failed: list[str] = []
    for visual in (False, True):
        pieces = urdf.pieces(links, visual, failed)
        size = _wheel_size(pieces, urdf.frames[joint.child].position, axis) if pieces else None
        if size is not None:
            radius, width, middle = size
            hub = urdf.frames[joint.child].position + middle * axis
            turning = [each for each in urdf.chain(joint.child)[:-1] if _is_swivel(urdf, each)]
            swivel = turning[-1] if turning else None
            trail = abs(hub[0] - urdf.frames[swivel.child].position[0]) if swivel else 0.0
            return RoundLink(joint, hub, radius, width, links, swivel, trail, float(np.sign(axis[1])))
    problems += failed
    return None


def _wheel_size(pieces: list[Piece], hub: np.ndarray, axis: np.ndarray) -> tuple[float, float, float] | None:
    """Returns radius, width and the middle along the axis from the joint, or ``None`` if the shapes are not round."""
    if len(pieces) == 1 and pieces[0].shape.kind in ("sphere", "cylinder"):
        _, frame, sizes, *_ = pieces[0].shape
        offset = frame.position - hub
        middle = float(offset @ axis)
        if len(sizes) == 1:
            return sizes[0], 0.0, middle
        if (
            np.linalg.norm(np.cross(frame.rotation[:, 2], axis)) < 1e-6
            and np.linalg.norm(offset - middle * axis) < 1e-6
        ):
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
    """Returns whether a joint turns what it carries about z. One that turns it about the axle is told by its name."""
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
    """Returns whether a wheel follows where the robot goes: it trails behind a free swivel, or has such a name."""
    names = f"{wheel.joint.name} {wheel.joint.child} {wheel.swivel.name if wheel.swivel else ''}".lower()
    if any(name in names for name in CASTER_NAMES):
        return True
    return wheel.swivel is not None and _turns_freely(wheel.swivel) and wheel.trail > TRAIL * wheel.radius


def _check_sides(left: list[RoundLink], right: list[RoundLink], between: list[RoundLink]) -> None:
    if len(left) == len(right) and left and not between:
        return
    names = [wheel.joint.name for wheel in between]
    if between and len(left) == len(right) == 1 and between[0].swivel is not None:
        raise ValueError(f"it has three wheels, of which {names[0]!r} steers; no drive of this package has such wheels")
    if between:
        count = len(left) + len(right) + len(between)
        raise ValueError(
            f"it has {count} wheel{'s' if count > 1 else ''} on the ground, {len(left)} on the left, {len(right)} on "
            f"the right and {names} between them; no drive of this package has such wheels, unless that is a caster: a "
            "swivel, a ball, or a joint so named"
        )
    raise ValueError(
        f"it has {len(left)} wheels on the left and {len(right)} on the right; drives of this package have "
        "as many on each side"
    )


def _pairs(left: list[RoundLink], right: list[RoundLink]) -> list[tuple[RoundLink, RoundLink]]:
    """Returns pairs of a left and a right wheel, from front to back."""
    ahead = [sorted(side, key=lambda wheel: -wheel.hub[0]) for side in (left, right)]
    pairs = [*zip(*ahead, strict=True)]
    for one, other in pairs:
        if abs(one.hub[0] - other.hub[0]) > 0.5 * one.radius:
            raise ValueError(
                f"wheel {one.joint.name!r} is at x = {one.hub[0]:.3g} m and the one across, {other.joint.name!r}, at "
                f"x = {other.hub[0]:.3g} m; wheels must be in pairs"
            )
    return pairs
