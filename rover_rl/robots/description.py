"""URDF parser: links, joints, masses, and collision and visual shapes of a robot."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from rover_rl.robots.expressions import expression_in, leave_out_expressions
from rover_rl.tiny_xml import parse_xml

_SIZES = {"box": {"size": 3}, "cylinder": {"radius": 1, "length": 1}, "sphere": {"radius": 1}}
"""URDF attributes with the dimensions of a shape, and how many numbers each has, by kind of shape."""

Color: TypeAlias = tuple[float, ...]
"""Red, green and blue, 0 to 1."""


class Frame(NamedTuple):
    """Pose in a parent frame: origin ``[3]``, m, and rotation matrix ``[3, 3]``, whose columns are the axes."""

    position: np.ndarray
    rotation: np.ndarray

    @property
    def is_turned(self) -> bool:
        """Whether the frame is rotated relative to the parent frame."""
        return not np.array_equal(self.rotation, np.eye(3))

    def __matmul__(self, inner: Frame) -> Frame:
        """Returns the pose in the parent frame of ``inner``, which is relative to this frame."""
        return Frame(self.position + self.rotation @ inner.position, self.rotation @ inner.rotation)


_IDENTITY = Frame(np.zeros(3), np.eye(3))


class Inertial(NamedTuple):
    """Mass of a link, kg, and its inertia about the center of mass, the origin of ``frame``: ``[3, 3]``, kg m^2."""

    mass: float
    frame: Frame
    inertia: np.ndarray


class Shape(NamedTuple):
    """Collision or visual shape of a link.

    ``kind`` is ``"box"``, ``"cylinder"`` (along z), ``"sphere"``, ``"mesh"``, or another element of URDF's
    ``geometry``. ``sizes`` are x, y, z of a box; radius, length of a cylinder; the radius of a sphere, m; or the
    factors of the coordinates of a mesh, whose ``file`` is as the URDF states it. Only a visual shape has a color.
    """

    kind: str
    frame: Frame
    sizes: tuple[float, ...]
    file: str
    color: Color | None


class Link(NamedTuple):
    """Rigid part of a robot, with its collision shapes and its visual shapes."""

    name: str
    inertial: Inertial | None
    shapes: tuple[Shape, ...]
    visuals: tuple[Shape, ...]


class Joint(NamedTuple):
    """Connection of two links: ``frame`` is that of the child in the parent, and ``axis [3]`` is in this frame.

    ``limits`` are the lowest and highest position, rad or m; ``None`` if the file states none.
    """

    name: str
    kind: str
    parent: str
    child: str
    frame: Frame
    axis: np.ndarray
    limits: tuple[float, float] | None = None


class Description:
    """Contents of a URDF file.

    Args:
        path: path of the file.
        lenient: whether expressions of xacro are left out with what they are in, where a robot drives without it.

    Attributes:
        left_out: what is left out, a sentence each.
        name: name of the robot. Empty if the file states none.
        links: links by name.
        joints: joints by name.
        base: name of the link that is the child of no joint. Its frame is the base frame.
        fixed: poses in the base frame of the base and of all links fixed to it, by link name.
        frames: poses in the base frame of all links while the angles and positions of all joints are zero, by name.

    Raises:
        ValueError: if the file is not XML, or not the URDF of one robot.
    """

    def __init__(self, path: Path, lenient: bool = False) -> None:
        root = _parsed(path)
        self.left_out = leave_out_expressions(root) if lenient else []
        _check_expanded(root)
        self.name = root.get("name", "")
        materials = {each.get("name"): color for each in root.iter("material") if (color := _color(each))}
        self.links: dict[str, Link] = _read(root, "link", partial(_link, materials=materials))
        self.joints: dict[str, Joint] = _read(root, "joint", _joint)
        if not self.links:
            raise ValueError("it has no links")
        self.base = self._find_base()
        self.fixed = self._place([joint for joint in self.joints.values() if joint.kind == "fixed"])
        self.frames = self._place(self.joints.values())

    def _find_base(self) -> str:
        children: dict[str, str] = {}
        for joint in self.joints.values():
            if joint.child in children:
                both = f"joints {children[joint.child]!r} and {joint.name!r}"
                raise ValueError(f"link {joint.child!r} is the child of {both}: a URDF has no loops")
            children[joint.child] = joint.name
        ends = children.keys() | {joint.parent for joint in self.joints.values()}
        if unknown := sorted(ends - self.links.keys()):
            raise ValueError(f"a joint names link {unknown[0]!r}, its links are {sorted(self.links)}")
        bases = self.links.keys() - children.keys()
        if len(bases) != 1:
            raise ValueError(f"one link must be the child of no joint, it has {sorted(bases)}")
        base = bases.pop()
        reached = self._reached(base)
        if loop := sorted(self.links.keys() - reached):
            raise ValueError(f"links {loop} hang on one another and not on {base!r}: a URDF has no loops")
        return base

    def _reached(self, base: str) -> set[str]:
        """Returns the links that hang on the base, and the base."""
        reached, news = {base}, {base}
        while news:
            news = {joint.child for joint in self.joints.values() if joint.parent in news} - reached
            reached |= news
        return reached

    def _place(self, joints: Iterable[Joint]) -> dict[str, Frame]:
        """Returns the poses of the base and of all links that ``joints`` connect to it."""
        frames = {self.base: _IDENTITY}
        # A URDF may list a link before its parent, so one pass is not enough.
        for _ in joints:
            for joint in joints:
                if joint.parent in frames and joint.child not in frames:
                    frames[joint.child] = frames[joint.parent] @ joint.frame
        return frames


EXPAND = "expand it first: xacro FILE > robot.urdf"
"""What to do with a xacro file."""
_ROOTS = {"sdf": "an SDF model", "mujoco": "a MuJoCo model", "COLLADA": "a COLLADA mesh"}
"""Other files that describe robots, by their root element."""


def _parsed(path: Path) -> ET.Element:
    """Returns the root element of a URDF file. Says what another file is."""
    data = path.read_bytes()
    try:
        root = parse_xml(data)
    except ValueError as error:
        raise ValueError(
            f"it is a xacro file; {EXPAND}" if b"<xacro:" in data else f"it is not XML ({error})"
        ) from error
    if root.tag != "robot":
        other = _ROOTS.get(root.tag, f"XML with the root element {root.tag!r}")
        raise ValueError(f"it is {other}; a URDF is needed, whose root element is 'robot'")
    return root


def _check_expanded(root: ET.Element) -> None:
    """Raises a ``ValueError`` if a file has macros, or expressions in its links and joints."""
    parts = [root, *(part for tag in ("link", "joint") for each in root.findall(tag) for part in each.iter())]
    macros = (element.tag for element in [*root, *parts] if element.tag.startswith("xacro:"))
    if found := next(macros, "") or next(filter(None, map(expression_in, parts)), ""):
        raise ValueError(f"it is a xacro file, with {found}; {EXPAND}")


def _read(root: ET.Element, tag: str, read: Callable[[str, ET.Element], Any]) -> dict[str, Any]:
    """Reads all links or joints, by name."""
    parts: dict[str, Any] = {}
    for element in root.findall(tag):
        name = _attribute(element, "name")
        if name in parts:
            raise ValueError(f"two {tag}s are named {name!r}")
        try:
            parts[name] = read(name, element)
        except ValueError as error:
            raise ValueError(f"{tag} {name!r}: {error}") from error
    return parts


def _link(name: str, element: ET.Element, materials: Mapping[str | None, Color]) -> Link:
    inertial = element.find("inertial")
    shapes = (_shape(each, {}) for each in element.findall("collision"))
    visuals = (_shape(each, materials) for each in element.findall("visual"))
    return Link(name, None if inertial is None else _inertial(inertial), tuple(shapes), tuple(visuals))


def _joint(name: str, element: ET.Element) -> Joint:
    parent, below = (_attribute(child(element, end), "link") for end in ("parent", "child"))
    axis = element.find("axis")
    # The default axis of URDF is x.
    direction = np.array((1.0, 0.0, 0.0) if axis is None else _numbers(axis, "xyz", 3, "1 0 0"))
    return Joint(name, _attribute(element, "type"), parent, below, _frame(element), direction, _limits(element))


def _limits(joint: ET.Element) -> tuple[float, float] | None:
    limit = joint.find("limit")
    if limit is None or not {"lower", "upper"} & set(limit.keys()):
        return None
    (lower,), (upper,) = (_numbers(limit, name, 1, "0") for name in ("lower", "upper"))
    return lower, upper


def _inertial(element: ET.Element) -> Inertial:
    (mass,), moments = _numbers(child(element, "mass"), "value", 1), child(element, "inertia")
    xx, xy, xz, yy, yz, zz = (_numbers(moments, f"i{axes}", 1, "0")[0] for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))
    return Inertial(mass, _frame(element), np.array(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))))


def _shape(element: ET.Element, materials: Mapping[str | None, Color]) -> Shape:
    geometry = next(iter(child(element, "geometry")), None)
    if geometry is None:
        raise ValueError(f"a {element.tag} shape has an empty geometry")
    material = element.find("material")
    color = None if material is None else _color(material) or materials.get(material.get("name"))
    if geometry.tag == "mesh":
        sizes, file = _numbers(geometry, "scale", 3, "1 1 1"), _attribute(geometry, "filename")
    else:
        counts, file = _SIZES.get(geometry.tag, {}), ""
        sizes = [size for name, count in counts.items() for size in _numbers(geometry, name, count)]
    return Shape(geometry.tag, _frame(element), tuple(sizes), file, color)


def _color(material: ET.Element) -> Color | None:
    """Returns the color of a material without its opacity. ``None`` if it only refers to another by name."""
    color = material.find("color")
    return None if color is None else tuple(_numbers(color, "rgba", 4)[:3])


def _frame(element: ET.Element) -> Frame:
    origin = element.find("origin")
    if origin is None:
        return _IDENTITY
    # Successive rotations about the fixed axes x, y and z.
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in _numbers(origin, "rpy", 3, "0 0 0"))
    about_x = np.array(((1, 0, 0), (0, cr, -sr), (0, sr, cr)))
    about_y = np.array(((cp, 0, sp), (0, 1, 0), (-sp, 0, cp)))
    about_z = np.array(((cy, -sy, 0), (sy, cy, 0), (0, 0, 1)))
    return Frame(np.array(_numbers(origin, "xyz", 3, "0 0 0")), about_z @ about_y @ about_x)


def child(element: ET.Element, tag: str) -> ET.Element:
    """Returns the first child with a tag. Raises a ``ValueError`` if there is none."""
    part = element.find(tag)
    if part is None:
        raise ValueError(f"{element.tag} has no {tag}")
    return part


def _attribute(element: ET.Element, name: str, default: str | None = None) -> str:
    value = element.get(name, default)
    if value is None:
        raise ValueError(f"{element.tag} has no {name}")
    return value


def _numbers(element: ET.Element, name: str, count: int, default: str | None = None) -> list[float]:
    """Returns the ``count`` finite numbers of an attribute."""
    text = _attribute(element, name, default)
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        allowed = "a finite number" if count == 1 else f"{count} finite numbers"
        raise ValueError(f"{name} of {element.tag} must be {allowed}, got {text!r}")
    return numbers
