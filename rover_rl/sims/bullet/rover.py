"""Body of a rover in Bullet, from the URDF as Bullet needs it: without bare frames, and with joints for rollers.

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

import numpy as np

from rover_rl.native.bullet import pybullet
from rover_rl.robots import Robot
from rover_rl.robots.description import child
from rover_rl.robots.meshes import find_mesh
from rover_rl.sims.bullet.geometry import ROVERS, STATIC, set_contact
from rover_rl.sims.bullet.settings import BulletSettings
from rover_rl.tiny_xml import parse_xml

_LINK_SHARE = 1e-3
"""Mass and inertia of the small link, relative to those of the wheel."""

_DISTANCE, _NORMAL_FORCE = 8, 9
"""Indices of the distance (m, negative for a penetration) and the normal force (N) in a contact point of PyBullet."""


def load_rover(client: int, urdf: Path, settings: BulletSettings) -> int:
    """Loads a rover without damping and sleeping. Returns the id of its body.

    Raises:
        ValueError: if a link of the robot description has several collision shapes.
    """
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_IMPLICIT_CYLINDER
    body = pybullet.loadURDF(str(urdf), flags=flags | pybullet.URDF_IGNORE_VISUAL_SHAPES, physicsClientId=client)
    for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
        # Bullet sorts contacts by link. The order of a link's contacts would depend on the other rovers.
        if (shapes := len(pybullet.getCollisionShapeData(body, link, physicsClientId=client))) > 1:
            raise ValueError(f"{urdf}: a link may have one collision shape, link {link} has {shapes}")
        pybullet.changeDynamics(
            body,
            link,
            linearDamping=0.0,
            angularDamping=0.0,
            jointDamping=0.0,
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=client,
        )
        # In the call above, the friction would not apply to the wheels.
        set_contact(client, body, link, 1.0, settings)
    clear_contacts(client, body)
    return body


def bounding_box(client: int, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lower and upper corner ``[3]`` (m) of a new rover in its base frame, which is that of the world."""
    links = range(-1, pybullet.getNumJoints(body, physicsClientId=client))
    low, high = np.array([pybullet.getAABB(body, link, physicsClientId=client) for link in links]).transpose(1, 0, 2)
    return low.min(0), high.max(0)


def clear_contacts(client: int, body: int) -> None:
    """Removes a rover's contacts, which Bullet would keep over a reset to a nearby pose."""
    for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
        # Setting the filter, even to its current value, makes Bullet recompute the link's overlapping pairs.
        pybullet.setCollisionFilterGroupMask(body, link, ROVERS, STATIC, physicsClientId=client)


def is_touching(client: int, rover: int, obstacle: int) -> bool:
    """Returns whether the surfaces of a rover and an obstacle overlap, or a force acts between them.

    Bullet also keeps contact points of surfaces up to 2 cm apart. With a ``contact_threshold`` above 0, a force may act
    just before the surfaces meet.
    """
    points = pybullet.getContactPoints(rover, obstacle, physicsClientId=client)
    return any(point[_DISTANCE] <= 0.0 or point[_NORMAL_FORCE] > 0.0 for point in points)


def roller_joint(wheel: str) -> str:
    """Returns the name of the free joint of a wheel."""
    return f"{wheel} roller"


@contextmanager
def bullet_urdf(robot: Robot) -> Iterator[Path]:
    """Provides the URDF of a robot for Bullet: its own if that will do, else a file that is deleted afterwards."""
    root = parse_xml(robot.urdf.read_bytes())
    if not robot.drive.rollers and all(link.find("inertial") is not None for link in root.findall("link")):
        yield robot.urdf
        return
    _weigh_frames(root)
    for wheel, angle in zip(robot.drive.wheels, robot.drive.rollers, strict=False):
        if angle is not None:
            _add_roller(root, wheel, angle, robot.wheels.radius)
    for mesh in root.iterfind("link/collision/geometry/mesh"):
        mesh.set("filename", str(find_mesh(mesh.get("filename", ""), robot.urdf)))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / robot.urdf.name
        ET.ElementTree(root).write(path)
        yield path


def _weigh_frames(root: ET.Element) -> None:
    """Drops links without mass and shape that nothing hangs on, and gives the others without inertia a mass of 0."""
    joints = {child(joint, "child").get("link"): joint for joint in root.findall("joint")}
    for link in reversed(root.findall("link")):
        name, mass = link.get("name"), link.find("inertial/mass")
        weighs = mass is not None and float(mass.get("value", "0")) > 0
        holds = any(parent.get("link") == name for parent in root.iterfind("joint/parent"))
        if not weighs and not holds and name in joints and link.find("collision") is None:
            root.remove(link)
            root.remove(joints[name])
        elif link.find("inertial") is None:
            _add_inertial(link, 0.0, dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), 0.0))


def _add_inertial(link: ET.Element, mass: float, moments: dict[str, float]) -> None:
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "mass", value=str(mass))
    ET.SubElement(inertial, "inertia", {key: str(value) for key, value in moments.items()})


def _add_roller(root: ET.Element, wheel: str, angle: float, radius: float) -> None:
    """Inserts the free joint and the small link of a wheel, and makes its shape a sphere."""
    (joint,) = (each for each in root.findall("joint") if each.get("name") == wheel)
    (link,) = (each for each in root.findall("link") if each.get("name") == child(joint, "child").get("link"))
    parent, origin, small = child(joint, "parent"), joint.find("origin"), f"{roller_joint(wheel)} link"
    free = ET.SubElement(root, "joint", name=roller_joint(wheel), type="continuous")
    ET.SubElement(free, "parent", parent.attrib)
    ET.SubElement(free, "child", link=small)
    ET.SubElement(free, "axis", xyz=f"{math.cos(angle)} {math.sin(angle)} 0")
    if origin is not None:
        joint.remove(origin)
        free.append(origin)
    parent.set("link", small)
    mass = _LINK_SHARE * float(child(link, "inertial/mass").get("value", "0"))
    moments = {key: _LINK_SHARE * float(value) for key, value in child(link, "inertial/inertia").items()}
    _add_inertial(ET.SubElement(root, "link", name=small), mass, moments)
    link.remove(child(link, "collision"))
    geometry = ET.SubElement(ET.SubElement(link, "collision"), "geometry")
    ET.SubElement(geometry, "sphere", radius=str(radius))
