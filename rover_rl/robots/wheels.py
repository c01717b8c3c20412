"""Wheels of a robot, read from its URDF and checked."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rover_rl.robots.description import Description, Frame, Inertial, Joint, Link
from rover_rl.robots.drives import Drive, Wheels

LENGTH_TOLERANCE = 1e-3
"""Tolerance of positions and widths, m."""
STEERING_TOLERANCE = 0.01
"""Largest distance of a steering axis from the hub of its wheel, m."""
RELATIVE_TOLERANCE = 0.01
"""Relative tolerance of radii, and of masses and moments of inertia between wheels."""
AXIS_TOLERANCE = 0.01
"""Tolerance of the directions of axes, rad."""

_LEFT, _UP = np.array((0.0, 1.0, 0.0)), np.array((0.0, 0.0, 1.0))


class _Wheel(NamedTuple):
    """A wheel: center, radius and width (``None`` for a sphere), m; mass, kg, and inertia ``[3, 3]``, kg m^2."""

    joint: str
    hub: tuple[float, float, float]
    radius: float
    width: float | None
    mass: float
    inertia: np.ndarray
    steering: int


def read_wheels(description: Description, drive: Drive) -> Wheels:
    """Reads the wheels of a drive from a URDF.

    Raises:
        ValueError: if a joint of the drive is missing or of another kind, a wheel is no cylinder or sphere about its
            joint or differs from the others, or a wheel or the base has no mass and inertia of a rigid body.
    """
    for name in (*drive.wheels, *drive.steering):
        if name not in description.joints:
            raise ValueError(f"the drive names joint {name!r}, the URDF has the joints {sorted(description.joints)}")
    _checked_inertial(description.links[description.base], "base link")
    read = [_read_wheel(description, drive, description.joints[name]) for name in drive.wheels]
    _check_alike(read)
    width = next((wheel.width for wheel in read if wheel.width is not None), 0.0)
    steering = tuple(wheel.steering for wheel in read) if drive.steering else ()
    wheels = Wheels(tuple(wheel.hub for wheel in read), read[0].radius, width, steering)
    drive.check(wheels)
    return wheels


def _read_wheel(description: Description, drive: Drive, joint: Joint) -> _Wheel:
    if joint.kind != "continuous":
        raise ValueError(f"wheel joint {joint.name!r} is {joint.kind}, it must be continuous")
    carriers = [description.joints[name].child for name in drive.steering]
    carrier = carriers.index(joint.parent) if joint.parent in carriers else -1
    mount = joint if carrier < 0 else description.joints[drive.steering[carrier]]
    if mount.parent not in description.fixed:
        raise ValueError(
            f"wheel joint {joint.name!r} must be on the base link {description.base!r}, on a link fixed to it or on "
            f"the link of a steering joint of these, it is on {joint.parent!r}"
        )
    frame = description.fixed[mount.parent] @ mount.frame
    if mount is not joint:
        _check_steering(mount, frame, joint)
        frame = frame @ joint.frame
    _check_axis(f"wheel joint {joint.name!r}", "+y, (0, 1, 0)", frame.rotation @ joint.axis, _LEFT)
    link = description.links[joint.child]
    inertial, size, hub = (
        _checked_inertial(link, "wheel link"),
        _wheel_size(link, frame),
        tuple(frame.position.tolist()),
    )
    rotation = (frame @ inertial.frame).rotation
    return _Wheel(joint.name, hub, *size, inertial.mass, rotation @ inertial.inertia @ rotation.T, carrier)


def _check_steering(steering: Joint, frame: Frame, wheel: Joint) -> None:
    """Checks a steering joint, whose pose is ``frame`` while the wheel that it carries points ahead."""
    name = f"steering joint {steering.name!r}"
    if steering.kind not in ("revolute", "continuous"):
        raise ValueError(f"{name} is {steering.kind}, it must be revolute or continuous")
    _check_axis(name, "+z, (0, 0, 1)", frame.rotation @ steering.axis, _UP)
    offset = np.linalg.norm((frame @ wheel.frame).position[:2] - frame.position[:2])
    if not offset <= STEERING_TOLERANCE:
        raise ValueError(
            f"the axis of {name} is {offset:.3g} m from the hub of its wheel; {STEERING_TOLERANCE} m is allowed"
        )


def _check_axis(joint: str, allowed: str, axis: np.ndarray, expected: np.ndarray) -> None:
    if not np.linalg.norm(axis - expected) <= AXIS_TOLERANCE:
        raise ValueError(f"{joint} must turn about {allowed}, of the base frame, it turns about {_rounded(axis)}")


def _wheel_size(link: Link, frame: Frame) -> tuple[float, float | None]:
    """Returns the radius of a wheel whose link has the pose ``frame``, and its width; ``None`` for a sphere."""
    wheel = f"wheel link {link.name!r}"
    kinds = [shape.kind for shape in link.shapes]
    if kinds not in (["cylinder"], ["sphere"]):
        raise ValueError(f"{wheel} must have one collision shape, a cylinder or a sphere, it has {kinds or 'none'}")
    (shape,) = link.shapes
    offset = np.linalg.norm(shape.frame.position)
    if not offset <= LENGTH_TOLERANCE:
        raise ValueError(
            f"the {shape.kind} of {wheel} is {offset:.6g} m from its joint; {LENGTH_TOLERANCE} m is allowed"
        )
    if shape.kind == "sphere":
        return shape.sizes[0], None
    axis = (frame @ shape.frame).rotation[:, 2]
    if not np.linalg.norm(np.cross(axis, _LEFT)) <= AXIS_TOLERANCE:
        raise ValueError(f"the cylinder of {wheel} must lie along y of the base frame, it lies along {_rounded(axis)}")
    return shape.sizes[0], shape.sizes[1]


def _checked_inertial(link: Link, kind: str) -> Inertial:
    """Returns the mass and inertia of a link, if they are those of a rigid body."""
    inertial = link.inertial
    if inertial is None or not inertial.mass > 0:
        mass = "none" if inertial is None else f"{inertial.mass} kg"
        raise ValueError(f"{kind} {link.name!r} must have a positive mass, its URDF states {mass}")
    moments = np.linalg.eigvalsh(inertial.inertia)
    if not moments[0] > 0:
        raise ValueError(
            f"the inertia of {kind} {link.name!r} must be positive definite, its principal moments are "
            f"{_rounded(moments)} kg m^2"
        )
    if not moments[2] <= (1 + RELATIVE_TOLERANCE) * (moments[0] + moments[1]):
        raise ValueError(
            f"the inertia of {kind} {link.name!r} is not that of a rigid body: the largest of its principal moments "
            f"{_rounded(moments)} kg m^2 may be {RELATIVE_TOLERANCE:.0%} above the sum of the other two"
        )
    return inertial


def _check_alike(wheels: list[_Wheel]) -> None:
    units = {"radius": "m", "width": "m", "mass": "kg", "inertia": "kg m^2 (xx, xy, xz, yy, yz, zz)"}
    for name, unit in units.items():
        stated = [(wheel.joint, getattr(wheel, name)) for wheel in wheels if getattr(wheel, name) is not None]
        for joint, value in stated[1:]:
            first, expected = stated[0]
            if not np.abs(value - expected).max() <= RELATIVE_TOLERANCE * np.abs(expected).max():
                upper = np.triu_indices(3)
                one, other = (_rounded(v[upper]) if name == "inertia" else v for v in (expected, value))
                raise ValueError(
                    f"its wheels are not alike: the {name} of {first!r} is {one} {unit}, that of {joint!r} {other} "
                    f"{unit}; they may differ by {RELATIVE_TOLERANCE:.0%}"
                )


def _rounded(values: np.ndarray) -> tuple[float, ...]:
    """Returns values rounded for an error message."""
    # Adding 0 turns -0.0 into 0.0.
    return tuple(round(float(value), 9) + 0.0 for value in values)
