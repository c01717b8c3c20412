"""Body of a rover in Bullet, from a URDF that is written for it.

Bullet has no friction that acts in one direction of a turning wheel. A mecanum wheel is a sphere instead, between which
and the base is a free joint along the roller on the ground::

    base -> free joint about the roller's axle -> small link -> motor about +y -> sphere

The sphere rolls freely across the roller's axle and is driven along it. The free joint is turned back to zero after
each physics step (:meth:`RoverPhysics.step`), since a roller on the ground does not turn with the wheel.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from rover_rl.files import errors_name
from rover_rl.native.bullet import pybullet
from rover_rl.robots import Robot
from rover_rl.robots.shapes import WEIGHTLESS, Mass
from rover_rl.sims.bullet.geometry import ROVERS, STATIC, set_contact
from rover_rl.sims.bullet.settings import BulletSettings

_LINK_SHARE = 1e-3
"""Mass and inertia of the small link, relative to those of the wheel."""
_DISTANCE, _NORMAL_FORCE = 8, 9
"""Indices of the distance (m, negative for a penetration) and the normal force (N) in a contact point of PyBullet."""


def load_rovers(client: int, robot: Robot, settings: BulletSettings, count: int) -> list[int]:
    """Loads rovers without damping and sleeping. Returns the ids of their bodies."""
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_IMPLICIT_CYLINDER
    bodies = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rover.urdf"
        with errors_name(path):
            path.write_text(rover_urdf(robot), encoding="utf-8")
        for _ in range(count):
            body = pybullet.loadURDF(str(path), flags=flags, physicsClientId=client)
            for link in range(-1, pybullet.getNumJoints(body, physicsClientId=client)):
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
            bodies.append(body)
    return bodies


def rover_urdf(robot: Robot) -> str:
    """Returns a URDF of a robot without visual shapes, whose joints have the names of its drive.

    A link has one collision shape: Bullet sorts contacts by link, and the order of those of one link would depend on
    other rovers. All links state an inertia: Bullet takes one without for a link of 1 kg.
    """
    on_base = [box for box in robot.boxes if box.mass is None][:1]
    links = [_link("base", robot.body, "".join(_box(box.center, box.size) for box in on_base))]
    for number, box in enumerate(box for box in robot.boxes if box not in on_base):
        mass = box.mass or WEIGHTLESS
        center = np.subtract(mass.center, box.center).tolist() if mass.mass else mass.center
        links += [_link(f"box {number}", mass._replace(center=center), _box((0.0, 0.0, 0.0), box.size))]
        links += [_joint(f"box {number}", "fixed", "base", box.center)]
    drive, wheels = robot.drive, robot.wheels
    rollers = drive.rollers or (None,) * len(wheels.hubs)
    steering = wheels.steering or (-1,) * len(wheels.hubs)
    parts = [*zip(drive.wheels, wheels.hubs, steering, rollers, strict=True)]
    order = robot.order or drive.wheels
    for name, hub, carrier, roller in sorted(parts, key=lambda part: order.index(part[0])):
        parent, small = "base", f"{name} carrier"
        sizes = f'radius="{wheels.radius}" length="{wheels.width}"'
        shape = f'<origin rpy="1.5707963267948966 0 0"/><geometry><cylinder {sizes}/></geometry>'
        if roller is not None or not wheels.width:
            shape = f'<geometry><sphere radius="{wheels.radius}"/></geometry>'
        if carrier >= 0:
            links += [
                _link(small, robot.knuckle or WEIGHTLESS),
                _joint(drive.steering[carrier], "continuous", "base", hub, (0, 0, 1), small, robot.steering_limits),
            ]
        elif roller is not None:
            axis = (math.cos(roller), math.sin(roller), 0)
            light = Mass.of(_LINK_SHARE * robot.wheel.mass, np.zeros(3), _LINK_SHARE * np.array(robot.wheel.inertia))
            links += [_link(small, light), _joint(roller_joint(name), "continuous", "base", hub, axis, small)]
        if carrier >= 0 or roller is not None:
            parent, hub = small, (0.0, 0.0, 0.0)
        links += [_link(f"{name} wheel", robot.wheel, f"<collision>{shape}</collision>")]
        links += [_joint(name, "continuous", parent, hub, (0, 1, 0), f"{name} wheel")]
    return f'<robot name="rover">{"".join(links)}</robot>'


def _link(name: str, mass: Mass, shape: str = "") -> str:
    (xx, xy, xz), (_, yy, yz), (*_, zz) = mass.inertia
    moments = f'ixx="{xx}" ixy="{xy}" ixz="{xz}" iyy="{yy}" iyz="{yz}" izz="{zz}"'
    inertial = f'<origin xyz="{_text(mass.center)}"/><mass value="{mass.mass}"/><inertia {moments}/>'
    return f'<link name="{name}"><inertial>{inertial}</inertial>{shape}</link>'


def _box(center: Iterable[float], size: Iterable[float]) -> str:
    return f'<collision><origin xyz="{_text(center)}"/><geometry><box size="{_text(size)}"/></geometry></collision>'


def _joint(
    name: str,
    kind: str,
    parent: str,
    place: Iterable[float],
    axis: Iterable[float] = (0, 1, 0),
    child: str = "",
    limits: tuple[float, float] | None = None,
) -> str:
    ends = f'<parent link="{parent}"/><child link="{child or name}"/>'
    limit = ""
    if limits is not None:
        kind, limit = "revolute", f'<limit lower="{limits[0]}" upper="{limits[1]}" effort="1" velocity="1"/>'
    origin = f'<origin xyz="{_text(place)}"/><axis xyz="{_text(axis)}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{origin}{limit}</joint>'


def _text(numbers: Iterable[float]) -> str:
    return " ".join(map(repr, numbers))


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
