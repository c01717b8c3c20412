"""Consistency check of a robot's parameters with its URDF.

Some backends read a value from the parameters and others read it from the URDF. If the two differ, the same robot
drives differently in each simulator.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np

from rover_rl.sims.robots.description import Description, Frame, Inertial, Joint, Link, Shape

LENGTH_TOLERANCE = 1e-3
"""Tolerance of positions and widths, m."""
RELATIVE_TOLERANCE = 0.01
"""Relative tolerance of radii, and of masses and moments of inertia between wheels."""
AXIS_TOLERANCE = 0.01
"""Tolerance of the directions of wheel axes, rad."""

_LEFT = np.array((0.0, 1.0, 0.0))


class RobotParameters(Protocol):
    """Parameters that a URDF also holds: those of :class:`~rover_rl.sims.robots.robot.Robot`."""

    @property
    def name(self) -> str: ...  # noqa: D102
    @property
    def urdf(self) -> Path: ...  # noqa: D102
    @property
    def left_wheels(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def right_wheels(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def wheel_positions(self) -> tuple[tuple[float, float, float], ...]: ...  # noqa: D102
    @property
    def wheel_radius(self) -> float: ...  # noqa: D102
    @property
    def wheel_width(self) -> float: ...  # noqa: D102


def check_consistency(robot: RobotParameters) -> None:
    """Checks the parameters of a robot against its URDF.

    Raises:
        ValueError: if the URDF cannot be parsed, if wheel joints or wheel shapes contradict the robot's parameters, or
            if a wheel or the base has no valid mass and inertia of a rigid body.
    """
    try:
        description = Description(robot.urdf)
        _check_inertial(description.links[description.base], "base link")
        wheels = []
        for joint, position in zip(_wheel_joints(robot, description), robot.wheel_positions, strict=True):
            frame = _check_joint(joint, description, position)
            link = description.links[joint.child]
            _check_shape(robot, link, frame)
            inertial = _check_inertial(link, "wheel link")
            rotation = (frame @ inertial.frame).rotation
            wheels.append((joint.name, inertial.mass, rotation @ inertial.inertia @ rotation.T))
        _check_wheels_alike(wheels)
    except ValueError as error:
        raise ValueError(f"robot {robot.name!r} cannot be driven with its URDF {robot.urdf}: {error}") from error


def _wheel_joints(robot: RobotParameters, description: Description) -> list[Joint]:
    """Returns the joints of all wheels, left then right."""
    for field in ("left_wheels", "right_wheels"):
        for name in getattr(robot, field):
            if name not in description.joints:
                raise ValueError(
                    f"{field} names {name!r}, the URDF has no wheel joint {name!r}; "
                    f"its joints are {sorted(description.joints)}"
                )
    return [description.joints[name] for name in (*robot.left_wheels, *robot.right_wheels)]


def _check_joint(joint: Joint, description: Description, position: tuple[float, float, float]) -> Frame:
    """Checks the joint of a wheel. Returns the wheel's frame in the base frame."""
    wheel = f"wheel joint {joint.name!r}"
    if joint.kind != "continuous":
        raise ValueError(f"{wheel} is {joint.kind}, it must be continuous")
    if joint.parent not in description.fixed:
        raise ValueError(
            f"{wheel} must be on the base link {description.base!r} or on a link fixed to it, it is on {joint.parent!r}"
        )
    frame = description.fixed[joint.parent] @ joint.frame
    if not np.allclose(frame.position, position, rtol=0, atol=LENGTH_TOLERANCE):
        raise ValueError(
            f"wheel_positions has {wheel} at {_rounded(position)} m, the URDF at {_rounded(frame.position)} m; "
            f"each coordinate may differ by {LENGTH_TOLERANCE} m"
        )
    axis = frame.rotation @ joint.axis
    if not np.linalg.norm(axis - _LEFT) <= AXIS_TOLERANCE:
        raise ValueError(f"{wheel} must turn about +y, (0, 1, 0), of the base frame, it turns about {_rounded(axis)}")
    return frame


def _check_shape(robot: RobotParameters, link: Link, frame: Frame) -> None:
    """Checks the collision shape of a wheel whose link has the pose ``frame``."""
    wheel = f"wheel link {link.name!r}"
    kinds = [shape.kind for shape in link.shapes]
    if kinds not in (["cylinder"], ["sphere"]):
        raise ValueError(f"{wheel} must have one collision shape, a cylinder or a sphere, it has {kinds or 'none'}")
    (shape,) = link.shapes
    _check_shape_pose(wheel, shape, frame)
    radius = shape.sizes[0]
    if not abs(radius - robot.wheel_radius) <= RELATIVE_TOLERANCE * robot.wheel_radius:
        raise ValueError(
            f"wheel_radius is {robot.wheel_radius} m, the {shape.kind} of {wheel} has a radius of {radius} m; "
            f"they may differ by {RELATIVE_TOLERANCE:.0%}"
        )
    if shape.kind == "cylinder" and not abs(shape.sizes[1] - robot.wheel_width) <= LENGTH_TOLERANCE:
        raise ValueError(
            f"wheel_width is {robot.wheel_width} m, the cylinder of {wheel} has a length of {shape.sizes[1]} m; "
            f"they may differ by {LENGTH_TOLERANCE} m"
        )


def _check_shape_pose(wheel: str, shape: Shape, frame: Frame) -> None:
    offset = np.linalg.norm(shape.frame.position)
    if not offset <= LENGTH_TOLERANCE:
        raise ValueError(
            f"the {shape.kind} of {wheel} is {offset:.6g} m from its joint; {LENGTH_TOLERANCE} m is allowed"
        )
    axis = (frame @ shape.frame).rotation[:, 2]
    if shape.kind == "cylinder" and not np.linalg.norm(np.cross(axis, _LEFT)) <= AXIS_TOLERANCE:
        raise ValueError(f"the cylinder of {wheel} must lie along y of the base frame, it lies along {_rounded(axis)}")


def _check_inertial(link: Link, kind: str) -> Inertial:
    """Checks that a link has the mass and inertia of a rigid body. Returns them."""
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


def _check_wheels_alike(wheels: list[tuple[str, float, np.ndarray]]) -> None:
    """Checks that all wheels have the mass and inertia of the first.

    Args:
        wheels: name, mass (kg) and inertia (kg m^2, ``[3, 3]`` along the axes of the base frame) of each wheel.
    """
    first, first_mass, first_inertia = wheels[0]
    for name, mass, inertia in wheels[1:]:
        if not abs(mass - first_mass) <= RELATIVE_TOLERANCE * first_mass:
            raise ValueError(
                f"its wheels are not alike: {first!r} has a mass of {first_mass} kg, {name!r} of {mass} kg; "
                f"they may differ by {RELATIVE_TOLERANCE:.0%}"
            )
        if not np.abs(inertia - first_inertia).max() <= RELATIVE_TOLERANCE * np.abs(first_inertia).max():
            upper = np.triu_indices(3)
            raise ValueError(
                f"its wheels are not alike: {first!r} has the inertia (xx, xy, xz, yy, yz, zz) = "
                f"{_rounded(first_inertia[upper])} kg m^2, {name!r} {_rounded(inertia[upper])}; "
                f"they may differ by {RELATIVE_TOLERANCE:.0%} of the largest"
            )


def _rounded(values: np.ndarray | tuple[float, ...]) -> tuple[float, ...]:
    """Returns values rounded for an error message."""
    # Adding 0 turns -0.0 into 0.0.
    return tuple(round(float(value), 9) + 0.0 for value in values)
