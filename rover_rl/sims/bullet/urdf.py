"""URDF of a robot as Bullet needs it: without bare frames, and with joints for the rollers of mecanum wheels.

Bullet takes a link that states no inertia for one of 1 kg. Here, links without mass and shape are dropped, and other
links without inertia get a mass of 0.

Bullet has no friction that acts in one direction of a turning wheel. A mecanum wheel is a sphere instead, between which
and the base is a free joint along the roller on the ground::

    base -> free joint about the roller's axle -> small link -> motor about +y -> sphere

The sphere rolls freely across the roller's axle and is driven along it. The free joint is turned back to zero after
each physics step (:meth:`RoverPhysics.step`), since a roller on the ground does not turn with the wheel.
"""

from __future__ import annotations

import math
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rover_rl.sims.rendering.robot_surface import find_mesh
from rover_rl.sims.robots import Robot

_LINK_SHARE = 1e-3
"""Mass and inertia of the small link, relative to those of the wheel."""


def roller_joint(wheel: str) -> str:
    """Returns the name of the free joint of a wheel."""
    return f"{wheel} roller"


@contextmanager
def bullet_urdf(robot: Robot) -> Iterator[Path]:
    """Provides the URDF of a robot for Bullet: its own if that will do, else a file that is deleted afterwards."""
    root = ET.parse(robot.urdf).getroot()
    if not robot.drive.rollers and all(link.find("inertial") is not None for link in root.findall("link")):
        yield robot.urdf
        return
    _weigh_frames(root)
    for wheel, angle in zip(robot.drive.wheels, robot.drive.rollers, strict=False):
        _add_roller(root, wheel, angle, robot.wheels.radius)
    for mesh in root.iterfind("link/collision/geometry/mesh"):
        mesh.set("filename", str(find_mesh(mesh.get("filename", ""), robot.urdf)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / robot.urdf.name
        ET.ElementTree(root).write(path)
        yield path


def _weigh_frames(root: ET.Element) -> None:
    """Drops links without mass and shape that nothing hangs on, and gives the others without inertia a mass of 0."""
    joints = {_child_of(joint): joint for joint in root.findall("joint")}
    for link in reversed(root.findall("link")):
        name, mass = link.get("name", ""), link.find("inertial/mass")
        weighs = mass is not None and float(mass.get("value", "0")) > 0
        holds = any(parent.get("link") == name for parent in root.iterfind("joint/parent"))
        if not weighs and not holds and name in joints and link.find("collision") is None:
            root.remove(link)
            root.remove(joints[name])
        elif link.find("inertial") is None:
            inertial = ET.SubElement(link, "inertial")
            ET.SubElement(inertial, "mass", value="0")
            ET.SubElement(inertial, "inertia", dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), "0"))


def _add_roller(root: ET.Element, wheel: str, angle: float, radius: float) -> None:
    """Inserts the free joint and the small link of a wheel, and makes its shape a sphere."""
    joint = _named(root, "joint", wheel)
    parent, origin = joint.find("parent"), joint.find("origin")
    assert parent is not None
    link = _named(root, "link", _child_of(joint))
    name = roller_joint(wheel)
    free = ET.SubElement(root, "joint", name=name, type="continuous")
    ET.SubElement(free, "parent", link=parent.get("link", ""))
    ET.SubElement(free, "child", link=f"{name} link")
    ET.SubElement(free, "axis", xyz=f"{math.cos(angle)} {math.sin(angle)} 0")
    if origin is not None:
        joint.remove(origin)
        free.append(origin)
    parent.set("link", f"{name} link")
    small = ET.SubElement(root, "link", name=f"{name} link")
    small.append(_scaled_inertial(link))
    shape = link.find("collision")
    assert shape is not None
    link.remove(shape)
    geometry = ET.SubElement(ET.SubElement(link, "collision"), "geometry")
    ET.SubElement(geometry, "sphere", radius=str(radius))


def _scaled_inertial(link: ET.Element) -> ET.Element:
    inertial = ET.Element("inertial")
    mass, inertia = link.find("inertial/mass"), link.find("inertial/inertia")
    assert mass is not None
    assert inertia is not None
    ET.SubElement(inertial, "mass", value=str(_LINK_SHARE * float(mass.get("value", "0"))))
    ET.SubElement(inertial, "inertia", {key: str(_LINK_SHARE * float(value)) for key, value in inertia.items()})
    return inertial


def _named(root: ET.Element, tag: str, name: str) -> ET.Element:
    return next(each for each in root.findall(tag) if each.get("name") == name)


def _child_of(joint: ET.Element) -> str:
    child = joint.find("child")
    assert child is not None
    return child.get("link", "")
