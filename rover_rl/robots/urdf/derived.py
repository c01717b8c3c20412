"""Writes the URDF that simulators load: a body of boxes, wheels alike about +y, and the mounts of sensors."""

from __future__ import annotations

import hashlib
import math
import os
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rover_rl.files import cache_folder, written_whole
from rover_rl.robots.description import Frame, Shape
from rover_rl.robots.urdf.body import Mass


class Wheel(NamedTuple):
    """A wheel: the name of its joint, its hub ``[3]``, m, and the name of the steering joint that carries it."""

    joint: str
    hub: tuple[float, float, float]
    steering: str | None = None


class Derived(NamedTuple):
    """Robot as simulators load it. Base frame: on the ground below the center; x forward, y left, z up; m, kg."""

    name: str
    body: Mass
    boxes: Sequence[tuple[np.ndarray, np.ndarray]]
    wheels: Sequence[Wheel]
    wheel: Mass
    radius: float
    width: float
    mounts: dict[str, tuple[float, float, float]]
    visuals: Sequence[tuple[Frame, Shape]]

    def text(self, source: str) -> str:
        """Returns the URDF."""
        root = ET.Element("robot", name=self.name)
        root.append(ET.Comment(f" Derived from {source.replace('--', '- -')} "))
        base = ET.SubElement(root, "link", name="base_link")
        _add_inertial(base, self.body)
        for frame, shape in self.visuals:
            _add_shape(base, "visual", frame, shape)
        for number, (low, high) in enumerate(self.boxes, 1):
            link = ET.SubElement(root, "link", name=f"body_{number}")
            _add_shape(link, "collision", _at(np.zeros(3)), _box(high - low))
            _add_joint(root, f"body_{number}_joint", "fixed", "base_link", f"body_{number}", (low + high) / 2)
        for wheel in self.wheels:
            self._add_wheel(root, wheel)
        for name, place in self.mounts.items():
            ET.SubElement(root, "link", name=name)
            _add_joint(root, f"{name}_joint", "fixed", "base_link", name, place)
        ET.indent(root)
        return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n"

    def _add_wheel(self, root: ET.Element, wheel: Wheel) -> None:
        parent, place = "base_link", wheel.hub
        if wheel.steering is not None:
            parent = f"{wheel.steering}_carrier"
            ET.SubElement(root, "link", name=parent)
            _add_joint(root, wheel.steering, "continuous", "base_link", parent, place, axis="0 0 1")
            place = (0.0, 0.0, 0.0)
        link = ET.SubElement(root, "link", name=f"{wheel.joint}_wheel")
        _add_inertial(link, self.wheel)
        sphere = Shape("sphere", _at(np.zeros(3)), (self.radius,), "", None)
        cylinder = Shape("cylinder", _at(np.zeros(3)), (self.radius, self.width), "", None)
        axle = Frame(np.zeros(3), Rotation.from_rotvec((np.pi / 2, 0, 0)).as_matrix())
        _add_shape(link, "collision", axle, cylinder if self.width else sphere)
        _add_joint(root, wheel.joint, "continuous", parent, f"{wheel.joint}_wheel", place, axis="0 1 0")


def store(derived: Derived, source: Path | str) -> Path:
    """Writes the URDF to the cache, under a name of its content, and returns its path. It names its ``source``."""
    text = derived.text(source if isinstance(source, str) else str(source.resolve()))
    key = hashlib.sha256(text.encode()).hexdigest()[:16]
    folders = cache_folder(), Path(tempfile.gettempdir()) / f"rover_rl-{os.getuid() if hasattr(os, 'getuid') else ''}"
    for folder in folders:
        path = folder / "robots" / key / f"{derived.name}.urdf"
        try:
            if not path.is_file():
                with written_whole(path) as temporary:
                    temporary.write_text(text, encoding="utf-8")
            return path
        except OSError:
            # A home without write access.
            if folder is folders[-1]:
                raise
    raise AssertionError


def _at(position: np.ndarray) -> Frame:
    return Frame(position, np.eye(3))


def _box(size: np.ndarray) -> Shape:
    return Shape("box", _at(np.zeros(3)), tuple(size.tolist()), "", None)


def _add_inertial(link: ET.Element, mass: Mass) -> None:
    inertial = ET.SubElement(link, "inertial")
    if np.any(mass.center):
        ET.SubElement(inertial, "origin", xyz=_text(mass.center))
    ET.SubElement(inertial, "mass", value=_text([mass.mass]))
    names = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2))
    ET.SubElement(inertial, "inertia", {name: _text([mass.inertia[i, j]]) for name, i, j in names})


def _add_shape(link: ET.Element, tag: str, frame: Frame, shape: Shape) -> None:
    element = ET.SubElement(link, tag)
    attributes = {"xyz": _text(frame.position)}
    if frame.is_turned:
        attributes["rpy"] = _text(_angles(frame.rotation))
    ET.SubElement(element, "origin", attributes)
    geometry = ET.SubElement(element, "geometry")
    if shape.kind == "mesh":
        ET.SubElement(geometry, "mesh", filename=shape.file, scale=_text(shape.sizes))
    elif shape.kind == "box":
        ET.SubElement(geometry, "box", size=_text(shape.sizes))
    else:
        names = ("radius", "length")[: len(shape.sizes)]
        sizes = {name: _text([size]) for name, size in zip(names, shape.sizes, strict=True)}
        ET.SubElement(geometry, shape.kind, sizes)
    if shape.color is not None:
        material = ET.SubElement(element, "material", name="")
        ET.SubElement(material, "color", rgba=_text([*shape.color, 1.0]))


def _angles(rotation: np.ndarray) -> tuple[float, float, float]:
    """Returns roll, pitch and yaw, rad."""
    pitch = math.atan2(-rotation[2, 0], math.hypot(rotation[0, 0], rotation[1, 0]))
    if abs(abs(pitch) - math.pi / 2) < 1e-6:
        # Roll and yaw turn about the same axis: one of them is enough.
        return math.atan2(-rotation[1, 2], rotation[1, 1]), pitch, 0.0
    return math.atan2(rotation[2, 1], rotation[2, 2]), pitch, math.atan2(rotation[1, 0], rotation[0, 0])


def _add_joint(
    root: ET.Element, name: str, kind: str, parent: str, child: str, place: Iterable[float], axis: str | None = None
) -> None:
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=_text(place))
    if axis is not None:
        ET.SubElement(joint, "axis", xyz=axis)


def _text(numbers: Iterable[float]) -> str:
    # Adding 0 turns -0.0 into 0.0.
    return " ".join(f"{float(number) + 0.0:.9g}" for number in numbers)
