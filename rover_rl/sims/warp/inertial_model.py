"""A robot's masses and shapes, read from its description."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.robots import Robot
from rover_rl.sims.robots.description import Description, Inertial, Link

POINT_SPACING = 0.3
"""Metres between the points of the chassis that may touch the ground, at most."""


@dataclass(frozen=True)
class InertialModel:
    """What the physics needs to know of a robot. Float64 arrays in the base frame; m, kg, kg m^2.

    Attributes:
        chassis_mass: without the wheels.
        chassis_center: its centre of mass, ``[3]``.
        chassis_inertia: about that, ``[3, 3]``.
        wheel_mass: of one wheel.
        wheel_spin_inertia: of one wheel about its axle.
        wheel_turn_inertia: of one wheel about the other axes.
        hubs: wheels' centres, left then right, ``[W, 3]``.
        box_centers, box_halves: boxes of the chassis and half of their sides, ``[B, 3]`` each.
    """

    chassis_mass: float
    chassis_center: np.ndarray
    chassis_inertia: np.ndarray
    wheel_mass: float
    wheel_spin_inertia: float
    wheel_turn_inertia: float
    hubs: np.ndarray
    box_centers: np.ndarray
    box_halves: np.ndarray

    def total(self, chassis_mass: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The whole rover, for chassis of masses ``[N]`` (float64), whose inertia is in proportion.

        Returns:
            Mass ``[N]``, centre of mass ``[N, 3]``, and inertia about it ``[N, 3, 3]`` without that of the wheels
            about their axles, which spin by themselves.
        """
        device = chassis_mass.device
        chassis_center, chassis_inertia, hubs = (
            torch.from_numpy(values).to(device) for values in (self.chassis_center, self.chassis_inertia, self.hubs)
        )
        mass = chassis_mass + len(hubs) * self.wheel_mass
        center = (chassis_mass[:, None] * chassis_center + self.wheel_mass * hubs.sum(0)) / mass[:, None]
        inertia = chassis_mass[:, None, None] / self.chassis_mass * chassis_inertia
        inertia = inertia + _moved(chassis_mass, chassis_center - center)
        turn = torch.tensor((self.wheel_turn_inertia, 0.0, self.wheel_turn_inertia), dtype=mass.dtype, device=device)
        wheel = torch.full_like(chassis_mass, self.wheel_mass)
        for hub in hubs:
            inertia = inertia + turn.diag() + _moved(wheel, hub - center)
        return mass, center, inertia

    def points(self) -> np.ndarray:
        """Points on the boxes at most :data:`POINT_SPACING` apart along their edges, and in between: ``[P, 3]``."""
        points = []
        for index, (center, half) in enumerate(zip(self.box_centers, self.box_halves, strict=True)):
            counts = np.maximum(np.ceil(2 * half / POINT_SPACING).astype(int), 1)
            axes = [np.linspace(-side, side, count + 1) for side, count in zip(half, counts, strict=True)]
            grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
            # Ground is met from the outside by the top and the bottom.
            points.append(self._outside(center + grid[np.abs(grid[:, 2]) > half[2] - 1e-9], index))
        return np.concatenate(points)

    def _outside(self, points: np.ndarray, own: int) -> np.ndarray:
        """Those that are in no other box, nor on one."""
        for index, (center, half) in enumerate(zip(self.box_centers, self.box_halves, strict=True)):
            if index != own:
                points = points[(np.abs(points - center) > half + 5e-3).any(1)]
        return points


def read_inertial_model(robot: Robot) -> InertialModel:
    """Reads a robot's URDF.

    Raises:
        ValueError: for wheels whose joints, masses or inertias are turned or not centred, or a chassis that is not made
            of boxes along its axes and of one mass.
    """
    try:
        return _inertial_model(robot, Description(robot.urdf))
    except ValueError as error:
        raise ValueError(f"the warp backend cannot drive {robot.urdf}: {error}") from error


def _inertial_model(robot: Robot, description: Description) -> InertialModel:
    wheels = [_wheel(description, name) for name in (*robot.left_wheels, *robot.right_wheels)]
    # Those of a Robot are alike.
    wheel = wheels[0]
    chassis = _inertial(description.links[description.base])
    boxes = _boxes(description)
    return InertialModel(
        chassis_mass=chassis.mass,
        chassis_center=chassis.frame.position,
        chassis_inertia=chassis.inertia,
        wheel_mass=wheel.mass,
        wheel_spin_inertia=float(wheel.inertia[1, 1]),
        wheel_turn_inertia=float(wheel.inertia[0, 0]),
        hubs=np.array(robot.wheel_positions, dtype=float),
        box_centers=np.array([center for center, _ in boxes]).reshape(-1, 3),
        box_halves=np.array([half for _, half in boxes]).reshape(-1, 3),
    )


def _wheel(description: Description, name: str) -> Inertial:
    """Mass and inertia of the wheel at a joint."""
    joint = description.joints[name]
    if (description.fixed[joint.parent] @ joint.frame).is_turned:
        raise ValueError(f"wheel joint {name!r} must turn about +y of an upright frame")
    return _inertial(description.links[joint.child])


def _inertial(link: Link) -> Inertial:
    """Mass and inertia of a link, along its own axes."""
    if link.inertial is None:
        raise ValueError(f"link {link.name!r} has no inertial")
    if link.inertial.frame.is_turned:
        raise ValueError(f"the inertia of {link.name!r} must be along its own axes")
    return link.inertial


def _boxes(description: Description) -> list[tuple[np.ndarray, np.ndarray]]:
    """Centre and half of the sides of each box of the chassis, which is the base link and all that is fixed to it."""
    boxes = []
    for name, frame in description.fixed.items():
        link = description.links[name]
        if name != description.base and _inertial(link).mass > 0:
            raise ValueError(f"the mass of {name!r} must be that of {description.base!r}, which it is fixed to")
        for shape in link.shapes:
            if shape.kind != "box":
                raise ValueError(f"a collision shape of {name!r} has no geometry/box, it is a {shape.kind}")
            place = frame @ shape.frame
            if place.is_turned:
                raise ValueError("its chassis must be of boxes that are not turned")
            boxes.append((place.position, np.array(shape.sizes) / 2))
    return boxes


def _moved(mass: Tensor, offset: Tensor) -> Tensor:
    """What the parallel axis theorem adds for masses ``[N]`` at offsets ``[N, 3]``: ``[N, 3, 3]``."""
    square = (offset**2).sum(-1)[:, None, None] * torch.eye(3, dtype=mass.dtype, device=mass.device)
    return mass[:, None, None] * (square - offset[:, :, None] * offset[:, None, :])
