"""Robot descriptions: links, joints, masses and collision shapes of a URDF."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

_SIZES = {"box": ("size",), "cylinder": ("radius", "length"), "sphere": ("radius",)}
"""Attributes that hold the sizes of a shape, by its kind."""


@dataclass(frozen=True)
class Frame:
    """Pose in a parent frame.

    Attributes:
        position: ``[3]``, m.
        rotation: matrix ``[3, 3]``; its columns are the frame's axes.
    """

    position: np.ndarray
    rotation: np.ndarray

    @property
    def is_turned(self) -> bool:
        """Whether its axes are not those of the parent frame."""
        return not np.array_equal(self.rotation, np.eye(3))

    def __matmul__(self, inner: Frame) -> Frame:
        """The pose of ``inner``, which is given in this frame, in the parent frame."""
        return Frame(self.position + self.rotation @ inner.position, self.rotation @ inner.rotation)


@dataclass(frozen=True)
class Inertial:
    """Mass of a link.

    Attributes:
        mass: kg.
        frame: its origin is the center of mass, in the frame of the link.
        inertia: about the center of mass along the axes of ``frame``, ``[3, 3]``, kg m^2.
    """

    mass: float
    frame: Frame
    inertia: np.ndarray


@dataclass(frozen=True)
class Shape:
    """Collision shape of a link.

    Attributes:
        kind: ``"box"``, ``"cylinder"``, ``"sphere"``, or another element of URDF's ``geometry``.
        frame: its pose in the frame of the link; a cylinder lies along z.
        sizes: m. Of a box: x, y, z; of a cylinder: radius, length; of a sphere: radius; of others: empty.
    """

    kind: str
    frame: Frame
    sizes: tuple[float, ...]


@dataclass(frozen=True)
class Link:
    """Rigid part of a robot. ``inertial`` is ``None`` where the URDF states no mass."""

    name: str
    inertial: Inertial | None
    shapes: tuple[Shape, ...]


@dataclass(frozen=True)
class Joint:
    """Connection of two links.

    Attributes:
        name: its name.
        kind: ``"fixed"``, ``"continuous"``, or another type of URDF's.
        parent: name of the link it is on.
        child: name of the link it moves.
        frame: the child's frame in the parent's.
        axis: direction in ``frame`` about which it turns, ``[3]``.
    """

    name: str
    kind: str
    parent: str
    child: str
    frame: Frame
    axis: np.ndarray


Part = TypeVar("Part", Link, Joint)


class Description:
    """Contents of a URDF.

    Args:
        path: the URDF.

    Attributes:
        links: by name.
        joints: by name.
        base: name of the link that is on no other. Its frame is the base frame.
        fixed: frames of the base and of all links fixed to it, in the base frame, by name of the link.

    Raises:
        ValueError: for a file that is not XML, or not the URDF of one robot.
    """

    def __init__(self, path: Path) -> None:
        try:
            root = ET.parse(path).getroot()
        except ET.ParseError as error:
            raise ValueError(f"it is not XML ({error})") from error
        self.links = _by_name(map(_link, root.findall("link")))
        self.joints = _by_name(map(_joint, root.findall("joint")))
        if not self.links:
            raise ValueError("it has no links")
        self.base = self._find_base()
        self.fixed = self._place_fixed()

    def _find_base(self) -> str:
        ends = {joint.parent for joint in self.joints.values()} | {joint.child for joint in self.joints.values()}
        if unknown := sorted(ends - self.links.keys()):
            raise ValueError(f"a joint names link {unknown[0]!r}, its links are {sorted(self.links)}")
        bases = self.links.keys() - {joint.child for joint in self.joints.values()}
        if len(bases) != 1:
            raise ValueError(f"one link must be the child of no joint, it has {sorted(bases)}")
        return bases.pop()

    def _place_fixed(self) -> dict[str, Frame]:
        frames = {self.base: Frame(np.zeros(3), np.eye(3))}
        fixed = [joint for joint in self.joints.values() if joint.kind == "fixed"]
        # A link may come before the one that it is fixed to.
        for _ in fixed:
            for joint in fixed:
                if joint.parent in frames and joint.child not in frames:
                    frames[joint.child] = frames[joint.parent] @ joint.frame
        return frames


def _by_name(parts: Iterable[Part]) -> dict[str, Part]:
    named: dict[str, Part] = {}
    for part in parts:
        if part.name in named:
            raise ValueError(f"two {type(part).__name__.lower()}s are named {part.name!r}")
        named[part.name] = part
    return named


def _link(element: ET.Element) -> Link:
    name = _word(element, "name")
    inertial = element.find("inertial")
    try:
        return Link(
            name,
            None if inertial is None else _inertial(inertial),
            tuple(_shape(collision) for collision in element.findall("collision")),
        )
    except ValueError as error:
        raise ValueError(f"link {name!r}: {error}") from error


def _inertial(element: ET.Element) -> Inertial:
    mass = _numbers(_part(element, "mass"), "value", 1)[0]
    moments = _part(element, "inertia")
    xx, xy, xz, yy, yz, zz = (_numbers(moments, f"i{axes}", 1, "0")[0] for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))
    return Inertial(mass, _frame(element), np.array(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))))


def _shape(element: ET.Element) -> Shape:
    geometry = next(iter(_part(element, "geometry")), None)
    if geometry is None:
        raise ValueError("a collision shape has an empty geometry")
    sizes: list[float] = []
    for name in _SIZES.get(geometry.tag, ()):
        sizes += _numbers(geometry, name, 3 if name == "size" else 1)
    return Shape(geometry.tag, _frame(element), tuple(sizes))


def _joint(element: ET.Element) -> Joint:
    name = _word(element, "name")
    try:
        parent, child = (_word(_part(element, end), "link") for end in ("parent", "child"))
        axis = element.find("axis")
        # URDF's default is x.
        direction = np.array((1.0, 0.0, 0.0) if axis is None else _numbers(axis, "xyz", 3))
        return Joint(name, _word(element, "type"), parent, child, _frame(element), direction)
    except ValueError as error:
        raise ValueError(f"joint {name!r}: {error}") from error


def _frame(element: ET.Element) -> Frame:
    origin = element.find("origin")
    if origin is None:
        return Frame(np.zeros(3), np.eye(3))
    position, angles = (_numbers(origin, name, 3, "0 0 0") for name in ("xyz", "rpy"))
    return Frame(np.array(position), _rotation(*angles))


def _rotation(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Matrix ``[3, 3]`` of turns about the fixed axes x, y, z, one after the other (rad)."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(angle), math.sin(angle)) for angle in (roll, pitch, yaw))
    about_x = np.array(((1, 0, 0), (0, cr, -sr), (0, sr, cr)))
    about_y = np.array(((cp, 0, sp), (0, 1, 0), (-sp, 0, cp)))
    about_z = np.array(((cy, -sy, 0), (sy, cy, 0), (0, 0, 1)))
    return about_z @ about_y @ about_x


def _part(element: ET.Element, tag: str) -> ET.Element:
    part = element.find(tag)
    if part is None:
        raise ValueError(f"{element.tag} has no {tag}")
    return part


def _word(element: ET.Element, name: str, default: str | None = None) -> str:
    word = element.get(name, default)
    if word is None:
        raise ValueError(f"{element.tag} has no {name}")
    return word


def _numbers(element: ET.Element, name: str, count: int, default: str | None = None) -> list[float]:
    """The numbers of an attribute, which must be finite."""
    text = _word(element, name, default)
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        allowed = "a finite number" if count == 1 else f"{count} finite numbers"
        raise ValueError(f"{name} of {element.tag} must be {allowed}, got {text!r}")
    return numbers
