"""A robot's masses and shapes, read from its description."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.robots import Robot

POINT_SPACING = 0.3
"""Metres between the points of the chassis that may touch the ground, at most."""


@dataclass(frozen=True)
class Figures:
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


def read_figures(robot: Robot) -> Figures:
    """Reads a robot's URDF.

    Raises:
        ValueError: for a description without what is needed, wheels that differ, or a chassis that is not made of boxes
            along its axes and of one mass.
    """
    try:
        return _Description(robot).figures()
    except (ValueError, ET.ParseError) as error:
        raise ValueError(f"the warp backend cannot drive {robot.urdf}: {error}") from error


class _Description:
    """A URDF of a chassis, which may have links fixed to it, and wheels."""

    def __init__(self, robot: Robot) -> None:
        root = ET.parse(robot.urdf).getroot()
        self._links = {_word(link, "name"): link for link in root.findall("link")}
        self._joints = {_word(joint, "name"): joint for joint in root.findall("joint")}
        names = (*robot.left_wheels, *robot.right_wheels)
        if missing := [name for name in names if name not in self._joints]:
            raise ValueError(f"it has no wheel joint {missing[0]!r}; its joints are {sorted(self._joints)}")
        self._wheels = [self._joints[name] for name in names]
        for joint in self._wheels:
            axis = joint.find("axis")
            if any(_numbers(joint, "rpy")) or axis is None or _word(axis, "xyz").split() != ["0", "1", "0"]:
                raise ValueError(f"wheel joint {joint.get('name')!r} must turn about +y of an upright frame")
        self._hubs = np.array(robot.wheel_positions, dtype=float)

    def figures(self) -> Figures:
        wheels = {_inertial(self._child(joint)) for joint in self._wheels}
        if len(wheels) != 1:
            raise ValueError("its wheels are not alike")
        ((wheel_mass, _, (turn, _, _, spin, _, _)),) = wheels
        chassis = _word(_part(self._wheels[0], "parent"), "link")
        mass, center, (ixx, ixy, ixz, iyy, iyz, izz) = _inertial(self._links[chassis])
        boxes = [box for name, offset in self._fixed_to(chassis).items() for box in _boxes(self._links[name], offset)]
        return Figures(
            chassis_mass=mass,
            chassis_center=np.array(center),
            chassis_inertia=np.array(((ixx, ixy, ixz), (ixy, iyy, iyz), (ixz, iyz, izz))),
            wheel_mass=wheel_mass,
            wheel_spin_inertia=spin,
            wheel_turn_inertia=turn,
            hubs=self._hubs,
            box_centers=np.array([center for center, _ in boxes]).reshape(-1, 3),
            box_halves=np.array([half for _, half in boxes]).reshape(-1, 3),
        )

    def _fixed_to(self, chassis: str) -> dict[str, np.ndarray]:
        """The chassis and what is fixed to it, with the place of each."""
        places = {chassis: np.zeros(3)}
        fixed = [joint for joint in self._joints.values() if joint.get("type") == "fixed"]
        # A link may come before the one that it is fixed to.
        for _ in fixed:
            for joint in fixed:
                parent, child = (_word(_part(joint, end), "link") for end in ("parent", "child"))
                if parent in places and child not in places:
                    places[child] = places[parent] + _place(joint)
                    if _inertial(self._links[child])[0] > 0:
                        raise ValueError(f"the mass of {child!r} must be that of {chassis!r}, which it is fixed to")
        return places

    def _child(self, joint: ET.Element) -> ET.Element:
        return self._links[_word(_part(joint, "child"), "link")]


def _inertial(link: ET.Element) -> tuple[float, tuple[float, ...], tuple[float, ...]]:
    """Mass, centre of mass, and ixx, ixy, ixz, iyy, iyz, izz of a link."""
    inertial = _part(link, "inertial")
    if any(_numbers(inertial, "rpy")):
        raise ValueError(f"the inertia of {link.get('name')!r} must be along its own axes")
    inertia = _part(inertial, "inertia")
    tensor = tuple(float(inertia.get(name, 0)) for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
    return float(_word(_part(inertial, "mass"), "value")), _numbers(inertial, "xyz"), tensor


def _boxes(link: ET.Element, offset: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Centre and half of the sides of each of a link's collision shapes."""
    boxes = []
    for collision in link.findall("collision"):
        sides = _word(_part(collision, "geometry/box"), "size").split()
        boxes.append((offset + _place(collision), np.array([float(side) for side in sides]) / 2))
    return boxes


def _place(element: ET.Element) -> np.ndarray:
    """Where a joint or a shape is, ``[3]``."""
    if any(_numbers(element, "rpy")):
        raise ValueError("its chassis must be of boxes that are not turned")
    return np.array(_numbers(element, "xyz"))


def _numbers(element: ET.Element, name: str) -> tuple[float, ...]:
    """Of an element's origin."""
    origin = element.find("origin")
    return tuple(float(number) for number in ("0 0 0" if origin is None else origin.get(name, "0 0 0")).split())


def _part(element: ET.Element, path: str) -> ET.Element:
    part = element.find(path)
    if part is None:
        raise ValueError(f"{element.tag} {element.get('name', '')!r} has no {path}")
    return part


def _word(element: ET.Element, name: str) -> str:
    word = element.get(name)
    if word is None:
        raise ValueError(f"a {element.tag} has no {name}")
    return word


def _moved(mass: Tensor, offset: Tensor) -> Tensor:
    """What the parallel axis theorem adds for masses ``[N]`` at offsets ``[N, 3]``: ``[N, 3, 3]``."""
    square = (offset**2).sum(-1)[:, None, None] * torch.eye(3, dtype=mass.dtype, device=mass.device)
    return mass[:, None, None] * (square - offset[:, :, None] * offset[:, None, :])
