"""Wheels of a robot, read from its URDF and checked."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rover_rl.sims.drives.base import Drive, Wheels
from rover_rl.sims.robots.description import Description, Frame, Inertial, Joint, Link

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
    """A wheel: center (m), radius, width (``None`` for a sphere), mass, and inertia ``[3, 3]`` in the base frame."""

    joint: str
    hub: tuple[float, float, float]
    radius: float
    width: float | None
    mass: float
    inertia: np.ndarray


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
    wheels = Wheels(tuple(wheel.hub for wheel in read), read[0].radius, width, _steering(description, drive))
    drive.check(wheels)
    return wheels


def _steering(description: Description, drive: Drive) -> tuple[int, ...]:
    """Returns the index of the steering joint of each wheel, or -1; nothing if no wheel steers."""
    carriers = [description.joints[name].child for name in drive.steering]
    parents = [description.joints[name].parent for name in drive.wheels]
    return tuple(carriers.index(parent) if parent in carriers else -1 for parent in parents) if carriers else ()


def _read_wheel(description: Description, drive: Drive, joint: Joint) -> _Wheel:
    if joint.kind != "continuous":
        raise ValueError(f"wheel joint {joint.name!r} is {joint.kind}, it must be continuous")
    if joint.parent in description.fixed:
        frame = description.fixed[joint.parent] @ joint.frame
    else:
        frame = _steered_frame(description, drive, joint)
    _check_axis(f"wheel joint {joint.name!r}", "+y, (0, 1, 0)", frame.rotation @ joint.axis, _LEFT)
    link = description.links[joint.child]
    radius, width = _wheel_size(link, frame)
    inertial = _checked_inertial(link, "wheel link")
    rotation = (frame @ inertial.frame).rotation
    hub = tuple(frame.position.tolist())
    return _Wheel(joint.name, hub, radius, width, inertial.mass, rotation @ inertial.inertia @ rotation.T)


def _steered_frame(description: Description, drive: Drive, wheel: Joint) -> Frame:
    """Returns the frame of a wheel that a steering joint carries, while the wheel points ahead."""
    steering = next((j for j in map(description.joints.__getitem__, drive.steering) if j.child == wheel.parent), None)
    if steering is None or steering.parent not in description.fixed:
        raise ValueError(
            f"wheel joint {wheel.name!r} must be on the base link {description.base!r}, on a link fixed to it or on "
            f"the link of a steering joint of these, it is on {wheel.parent!r}"
        )
    if steering.kind not in ("revolute", "continuous"):
        raise ValueError(f"steering joint {steering.name!r} is {steering.kind}, it must be revolute or continuous")
    frame = description.fixed[steering.parent] @ steering.frame
    _check_axis(f"steering joint {steering.name!r}", "+z, (0, 0, 1)", frame.rotation @ steering.axis, _UP)
    hub = frame @ wheel.frame
    offset = np.linalg.norm(hub.position[:2] - frame.position[:2])
    if not offset <= STEERING_TOLERANCE:
        raise ValueError(
            f"the axis of steering joint {steering.name!r} is {offset:.3g} m from the hub of its wheel; "
            f"{STEERING_TOLERANCE} m is allowed"
        )
    return hub


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
    """Checks that all wheels have the radius, width, mass and inertia of the first."""
    for label, unit in (("radius", "m"), ("width", "m"), ("mass", "kg")):
        named = [(wheel.joint, getattr(wheel, label)) for wheel in wheels if getattr(wheel, label) is not None]
        for joint, value in named[1:]:
            first, expected = named[0]
            if not abs(value - expected) <= RELATIVE_TOLERANCE * expected:
                raise ValueError(
                    f"its wheels are not alike: {first!r} has a {label} of {expected} {unit}, {joint!r} of "
                    f"{value} {unit}; they may differ by {RELATIVE_TOLERANCE:.0%}"
                )
    reference, upper = wheels[0].inertia, np.triu_indices(3)
    for wheel in wheels[1:]:
        if not np.abs(wheel.inertia - reference).max() <= RELATIVE_TOLERANCE * np.abs(reference).max():
            raise ValueError(
                f"its wheels are not alike: {wheels[0].joint!r} has the inertia (xx, xy, xz, yy, yz, zz) = "
                f"{_rounded(reference[upper])} kg m^2, {wheel.joint!r} {_rounded(wheel.inertia[upper])}; "
                f"they may differ by {RELATIVE_TOLERANCE:.0%} of the largest"
            )


def _rounded(values: np.ndarray) -> tuple[float, ...]:
    """Returns values rounded for an error message."""
    # Adding 0 turns -0.0 into 0.0.
    return tuple(round(float(value), 9) + 0.0 for value in values)
