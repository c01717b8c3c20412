"""Mass properties and collision shapes of a robot, read from its URDF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from rover_rl.robots.description import Description
from rover_rl.robots.robot import Robot

POINT_SPACING = 0.3
"""Maximum spacing of the sample points of the chassis that are tested against the ground, m."""


@dataclass(frozen=True)
class InertialModel:
    """Mass properties and collision shapes of a robot. Float64 arrays in the base frame; m, kg, kg m^2.

    Attributes:
        chassis_mass: mass of the chassis without the wheels.
        chassis_center: center of mass of the chassis, ``[3]``.
        chassis_inertia: inertia of the chassis about its center of mass, ``[3, 3]``.
        wheel_mass: mass of one wheel.
        wheel_spin_inertia: moment of inertia of one wheel about its axle.
        wheel_turn_inertia: moment of inertia of one wheel about an axis perpendicular to its axle.
        hubs: centers of the wheels, in the order of the drive, ``[W, 3]``.
        box_centers: centers of the boxes of the chassis, ``[B, 3]``.
        box_halves: half extents of the boxes of the chassis, ``[B, 3]``.
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
        """Mass properties of the whole rover.

        Args:
            chassis_mass: masses of the chassis, ``[N]``, float64; the inertia of the chassis scales with its mass.

        Returns:
            Mass ``[N]``, center of mass ``[N, 3]``, and inertia about it ``[N, 3, 3]``. The inertia leaves out that of
            the wheels about their axles, since the spin of a wheel is a state of its own.
        """
        return self._table(chassis_mass.device).total(chassis_mass, torch.zeros_like(chassis_mass, dtype=torch.int64))

    def _table(self, device: torch.device) -> MassTable:
        if device not in self._tables:
            self._tables[device] = MassTable([self], device)
        return self._tables[device]

    @cached_property
    def _tables(self) -> dict[torch.device, MassTable]:
        return {}

    def points(self) -> np.ndarray:
        """Sample points on the top and bottom of the boxes, at most :data:`POINT_SPACING` apart, ``[P, 3]``.

        Points inside another box are left out.
        """
        points = []
        for index, (center, half) in enumerate(zip(self.box_centers, self.box_halves, strict=True)):
            counts = np.maximum(np.ceil(2 * half / POINT_SPACING).astype(int), 1)
            axes = [np.linspace(-side, side, count + 1) for side, count in zip(half, counts, strict=True)]
            grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
            # The ground touches the bottom, or the top of a rover that has rolled over.
            own = center + grid[np.abs(grid[:, 2]) > half[2] - 1e-9]
            others = np.delete(self.box_centers, index, 0), np.delete(self.box_halves, index, 0) + 5e-3
            points.append(own[(np.abs(own[:, None] - others[0]) > others[1]).any(2).all(1)])
        return np.concatenate(points)


class MassTable:
    """Mass properties of K robots, copied to a device once: a copy from the host waits for the device.

    Attributes:
        chassis_mass: mass of the chassis of each robot, ``[K]``, kg, float64.
    """

    def __init__(self, models: Sequence[InertialModel], device: torch.device) -> None:
        most = max(len(model.hubs) for model in models)
        # A wheel that a robot lacks has no mass.
        weights = np.array([[float(wheel < len(model.hubs)) for wheel in range(most)] for model in models])
        hubs = [np.pad(model.hubs, ((0, most - len(model.hubs)), (0, 0))) for model in models]
        turns = [np.diag((model.wheel_turn_inertia, 0.0, model.wheel_turn_inertia)) for model in models]
        wheel_mass = np.array([model.wheel_mass for model in models])
        arrays = {
            "mass": [model.chassis_mass for model in models],
            "center": [model.chassis_center for model in models],
            "inertia": [model.chassis_inertia for model in models],
            "wheels_mass": [len(model.hubs) * model.wheel_mass for model in models],
            "wheels_moment": [model.wheel_mass * torch.from_numpy(model.hubs).sum(0).numpy() for model in models],
            "hubs": hubs,
            "wheel": wheel_mass[:, None] * weights,
            "turn": np.array(turns)[:, None] * weights[:, :, None, None],
        }
        tensors = {name: torch.from_numpy(np.array(array, dtype=float)).to(device) for name, array in arrays.items()}
        self.chassis_mass, self._tensors = tensors["mass"], tensors

    def total(self, chassis_mass: Tensor, index: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the mass properties of whole rovers: see :meth:`InertialModel.total`.

        Args:
            chassis_mass: masses of the chassis, ``[N]``, float64.
            index: robot of each rover, int64 ``[N]``.
        """
        own = {name: values[index] for name, values in self._tensors.items()}
        mass = chassis_mass + own["wheels_mass"]
        center = (chassis_mass[:, None] * own["center"] + own["wheels_moment"]) / mass[:, None]
        inertia = (chassis_mass / own["mass"])[:, None, None] * own["inertia"]
        inertia = inertia + _parallel_axis(chassis_mass, own["center"] - center)
        for wheel in range(own["hubs"].shape[1]):
            offset = own["hubs"][:, wheel] - center
            inertia = inertia + own["turn"][:, wheel] + _parallel_axis(own["wheel"][:, wheel], offset)
        return mass, center, inertia


def read_inertial_model(robot: Robot) -> InertialModel:
    """Reads the inertial model of a robot from its URDF.

    Raises:
        ValueError: if the chassis has another collision shape than axis-aligned boxes.
    """
    description = Description(robot.urdf)
    # All wheels of a Robot are alike.
    joint = description.joints[robot.drive.wheels[0]]
    wheel = description.links[joint.child].inertial
    assert wheel is not None
    rotation = (description.frames[joint.child] @ wheel.frame).rotation
    inertia = rotation @ wheel.inertia @ rotation.T if description.frames[joint.child].is_turned else wheel.inertia
    mass, center, chassis_inertia = _chassis(robot, description)
    boxes = _boxes(robot, description)
    return InertialModel(
        chassis_mass=mass,
        chassis_center=center,
        chassis_inertia=chassis_inertia,
        wheel_mass=wheel.mass,
        wheel_spin_inertia=float(inertia[1, 1]),
        wheel_turn_inertia=float(inertia[0, 0]),
        hubs=np.array(robot.wheels.hubs, dtype=float),
        box_centers=np.array([center for center, _ in boxes]).reshape(-1, 3),
        box_halves=np.array([half for _, half in boxes]).reshape(-1, 3),
    )


def _chassis(robot: Robot, description: Description) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, center of mass and inertia about it of the base, the links fixed to it and those of the steering joints."""
    names = [*description.fixed, *(description.joints[name].child for name in robot.drive.steering)]
    stated = [(description.links[name].inertial, description.frames[name]) for name in names]
    parts = [(each, frame @ each.frame) for each, frame in stated if each is not None and each.mass > 0]
    if len(parts) == 1 and not parts[0][1].is_turned:
        return parts[0][0].mass, parts[0][1].position, parts[0][0].inertia
    masses = np.array([each.mass for each, _ in parts])
    mass = float(masses.sum())
    center = masses @ np.stack([pose.position for _, pose in parts]) / mass
    inertia = np.zeros((3, 3))
    for each, pose in parts:
        offset = pose.position - center
        inertia += pose.rotation @ each.inertia @ pose.rotation.T
        inertia += each.mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
    return mass, center, inertia


def _boxes(robot: Robot, description: Description) -> list[tuple[np.ndarray, np.ndarray]]:
    """Center and half extents of each box of the chassis: the base link and all links fixed to it."""
    boxes, unsupported = [], f"robot file {robot.urdf} is not supported by this backend"
    for name, frame in description.fixed.items():
        for shape in description.links[name].shapes:
            pose = frame @ shape.frame
            if shape.kind != "box":
                raise ValueError(
                    f"{unsupported}: a collision shape of {name!r} is a {shape.kind}, but the chassis must be made of "
                    "boxes"
                )
            if pose.is_turned:
                raise ValueError(
                    f"{unsupported}: a collision box of {name!r} must be aligned with the base link, it is rotated"
                )
            boxes.append((pose.position, np.array(shape.sizes) / 2))
    return boxes


def _parallel_axis(mass: Tensor, offset: Tensor) -> Tensor:
    """Inertia of point masses ``[N]`` at offsets ``[N, 3]``, ``m (|r|^2 1 - r r^T)`` (parallel axis theorem)."""
    square = (offset**2).sum(-1)[:, None, None] * torch.eye(3, dtype=mass.dtype, device=mass.device)
    return mass[:, None, None] * (square - offset[:, :, None] * offset[:, None, :])
