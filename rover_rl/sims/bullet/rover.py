"""Bodies in Bullet: rovers, from a URDF that is written for them, what they feel, and movers that push them.

Bullet has no friction that acts in one direction of a turning wheel. A mecanum wheel is a sphere instead, between which
and the base is a free joint along the roller on the ground::

    base -> free joint about the roller's axle -> small link -> motor about +y -> sphere

The sphere rolls freely across the roller's axle and is driven along it. The free joint is turned back to zero after
each physics step (``BulletGroup.step``), since a roller on the ground does not turn with the wheel.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rover_rl.files import errors_name
from rover_rl.native.bullet import pybullet
from rover_rl.robots import Robot
from rover_rl.robots.shapes import WEIGHTLESS, Mass
from rover_rl.sims.bullet import BulletSettings
from rover_rl.sims.bullet.geometry import ROVERS, STATIC, set_contact
from rover_rl.sims.rover_state import SIDES, Force, by_side
from rover_rl.sims.world_groups import NearParts, turned
from rover_rl.worlds.movers import Part

_LINK_SHARE = 1e-3
"""Mass and inertia of the small link, relative to those of the wheel."""
_NORMAL, _DISTANCE, _NORMAL_FORCE = 7, 8, 9
"""Indices in a contact point of PyBullet: the normal toward the first body, the distance (m, negative for a
penetration) and the normal force (N)."""
_TORQUE = 3
"""Index of the torque of the motor in the state of a joint, N m."""
_FAR = 1e4
"""Coordinates of where bodies are made, m."""


def load_rovers(client: int, robot: Robot, settings: BulletSettings, count: int) -> list[int]:
    """Loads rovers without damping and sleeping. Returns the ids of their bodies."""
    bodies = []
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_IMPLICIT_CYLINDER
    awake = pybullet.ACTIVATION_STATE_DISABLE_SLEEPING
    undamped = {"linearDamping": 0.0, "angularDamping": 0.0, "jointDamping": 0.0, "activationState": awake}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rover.urdf"
        with errors_name(path):
            path.write_text(rover_urdf(robot), encoding="utf-8")
        for _ in range(count):
            body = pybullet.loadURDF(str(path), flags=flags, physicsClientId=client)
            for link in links_of(client, body):
                pybullet.changeDynamics(body, link, **undamped, physicsClientId=client)
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
            joint, limits = drive.steering[carrier], robot.steering_limits
            links += [_link(small, robot.knuckle or WEIGHTLESS)]
            links += [_joint(joint, "continuous", "base", hub, (0, 0, 1), small, limits)]
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


def _joint(name, kind, parent, place, axis=(0, 1, 0), child: str = "", limits=None) -> str:
    ends = f'<parent link="{parent}"/><child link="{child or name}"/>'
    limit = ""
    if limits is not None:
        kind, limit = "revolute", f'<limit lower="{limits[0]}" upper="{limits[1]}" effort="1" velocity="1"/>'
    origin = f'<origin xyz="{_text(place)}"/><axis xyz="{_text(axis)}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{origin}{limit}</joint>'


def _text(numbers: Iterable[float]) -> str:
    return " ".join(map(repr, numbers))


def roller_joint(wheel: str) -> str:
    return f"{wheel} roller"


def links_of(client: int, body: int) -> range:
    return range(-1, pybullet.getNumJoints(body, physicsClientId=client))


def bounding_box(client: int, body: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lower and upper corner ``[3]`` (m) of a new rover in its base frame, which is that of the world."""
    boxes = [pybullet.getAABB(body, link, physicsClientId=client) for link in links_of(client, body)]
    low, high = np.array(boxes).transpose(1, 0, 2)
    return low.min(0), high.max(0)


def clear_contacts(client: int, body: int) -> None:
    """Removes a rover's contacts, which Bullet would keep over a reset to a nearby pose."""
    for link in links_of(client, body):
        # Setting the filter, even to its current value, makes Bullet recompute the link's overlapping pairs.
        pybullet.setCollisionFilterGroupMask(body, link, ROVERS, STATIC, physicsClientId=client)


def feel(rovers: Sequence[tuple[int, int]], pairs: Iterable[tuple[int, int]], touched: np.ndarray) -> None:
    """Sets which of the ``rovers`` (client and body) touch, in ``touched``, from pairs of a row and a body near it.

    They touch if their surfaces overlap, or a force acts between them. Bullet also keeps contact points of surfaces up
    to 2 cm apart. With a ``contact_threshold`` above 0, a force may act just before the surfaces meet.
    """
    for row, body in pairs:
        if not touched[row]:
            client, rover = rovers[row]
            points = pybullet.getContactPoints(rover, body, physicsClientId=client)
            touched[row] = any(point[_DISTANCE] <= 0.0 or point[_NORMAL_FORCE] > 0.0 for point in points)


class Meters:
    """Measures the fields ``reports``, ``[count, k]`` each, of the ``rovers`` (client and body) in one world.

    ``wheels`` are the joints with motors, and ``inertial`` is the orientation of the inertial frame, which Bullet
    states, in the base frame, (x, y, z, w).
    """

    def __init__(
        self,
        reports: Mapping[Force, np.ndarray],
        rovers: Sequence[tuple[int, int]],
        wheels: Sequence[int],
        inertial: np.ndarray,
        substeps: int,
    ) -> None:
        self._reports, self._rovers, self._wheels = reports, rovers, wheels
        self._to_base, self._substeps = Rotation.from_quat(inertial).inv(), substeps
        self._pushes: list[tuple[int, int, Sequence[float], Sequence[float]]] = []
        self._torques = np.zeros((len(rovers), len(wheels)))

    def read(self, client: int, obstacles: Iterable[tuple[int, int]], movers: Iterable[tuple[int, int]]) -> None:
        """Reads what acts in a physics step that a client has just taken, from rows and bodies that may touch."""
        if "contact_force" in self._reports:
            for column, pairs in ((0, obstacles), (len(SIDES), movers)):
                for row, body in pairs:
                    rover = self._rovers[row][1]
                    points = pybullet.getContactPoints(rover, body, physicsClientId=client)
                    points = [point for point in points if point[_NORMAL_FORCE] > 0.0]
                    orientation = pybullet.getBasePositionAndOrientation(rover, client)[1] if points else ()
                    for point in points:
                        push = [point[_NORMAL_FORCE] * part for part in point[_NORMAL]]
                        self._pushes.append((row, column, push, orientation))
        if "wheel_torque" in self._reports:
            for row, (own, rover) in enumerate(self._rovers):
                if own == client:
                    states = pybullet.getJointStates(rover, self._wheels, client)
                    self._torques[row] += [state[_TORQUE] for state in states]

    def finish(self, moved: np.ndarray) -> None:
        """Writes the means over a control step to the arrays, for the rovers ``moved``."""
        if "contact_force" in self._reports:
            forces = np.zeros((len(self._rovers), 2 * len(SIDES)))
            if self._pushes:
                rows, columns, pushes, orientations = (np.array(part) for part in zip(*self._pushes, strict=True))
                pushed = (Rotation.from_quat(orientations) * self._to_base).apply(pushes, inverse=True)
                places = rows[:, None], columns[:, None] + np.arange(len(SIDES))
                np.add.at(forces, places, by_side(pushed[:, :2]) / self._substeps)
            self._reports["contact_force"][moved] = forces[moved]
        if "wheel_torque" in self._reports:
            self._reports["wheel_torque"][moved, : len(self._wheels)] = self._torques[moved] / self._substeps
        self._pushes, self._torques = [], np.zeros_like(self._torques)


class MoverBodies:
    """Bodies of the parts of movers near the ``rovers`` (client and body) of one world."""

    def __init__(self, rovers: Sequence[tuple[int, int]], parts: Sequence[Part], settings: BulletSettings) -> None:
        self._rovers, self._parts, self._settings = rovers, parts, settings
        self._links = links_of(*rovers[0])
        # Shapes by client, kind and size, and bodies by row and part.
        self._shapes: dict[tuple, int] = {}
        self._bodies: dict[tuple[int, int], int] = {}
        # Of each client: row and part of the bodies, and where they are in ``_near``.
        self._pairs: dict[int, list[tuple[int, int]]] = {}
        self._near: dict[int, NearParts] = {}

    def approach(self, near: NearParts) -> None:
        """Adds the bodies of parts that have come near rovers, and removes those of parts that have left."""
        pairs = list(zip(near.row.tolist(), near.part.tolist(), strict=True))
        for row, part in self._bodies.keys() - set(pairs):
            self._remove(row, part)
        for row, part in pairs:
            if (row, part) not in self._bodies:
                self._bodies[row, part] = self._add(row, part)
        clients = np.array([self._rovers[row][0] for row, _ in pairs], dtype=int)
        for client in set(self._near) | set(clients.tolist()):
            own = np.flatnonzero(clients == client)
            self._near[client], self._pairs[client] = near.chosen(own), [pairs[index] for index in own]

    def clear(self, rows: Sequence[int]) -> None:
        """Removes the bodies in rows whose rovers are placed anew."""
        chosen = set(rows)
        for row, part in [pair for pair in self._bodies if pair[0] in chosen]:
            self._remove(row, part)

    def move(self, client: int, time: float) -> None:
        """Sets pose and velocity of the bodies in a client at a time since the start of the control step, s."""
        if not self._pairs.get(client):
            return
        near = self._near[client]
        places = (near.start + near.velocity * time).tolist()
        orientations = turned(near.orientation, near.turn * time).tolist()
        motions = zip(places, orientations, near.velocity.tolist(), near.turn.tolist(), strict=True)
        for pair, (place, orientation, velocity, turn) in zip(self._pairs[client], motions, strict=True):
            pybullet.resetBasePositionAndOrientation(self._bodies[pair], place, orientation, client)
            pybullet.resetBaseVelocity(self._bodies[pair], velocity, (0.0, 0.0, turn), client)

    def near(self, client: int) -> list[tuple[int, int]]:
        """Returns the rows and bodies of the parts near the rovers of a client."""
        return [(row, self._bodies[row, part]) for row, part in self._pairs.get(client, ())]

    def _add(self, row: int, part: int) -> int:
        client, rover = self._rovers[row]
        shape, awake = self._shape(client, self._parts[part]), pybullet.ACTIVATION_STATE_DISABLE_SLEEPING
        # Far from all others until the pairs are set.
        body = pybullet.createMultiBody(0, shape, basePosition=(_FAR, _FAR, _FAR), physicsClientId=client)
        pybullet.setCollisionFilterGroupMask(body, -1, 0, 0, physicsClientId=client)
        pybullet.changeDynamics(body, -1, activationState=awake, physicsClientId=client)
        set_contact(client, body, -1, self._settings.obstacle_friction, self._settings)
        for link in self._links:
            pybullet.setCollisionFilterPair(rover, body, link, -1, 1, client)
        return body

    def _remove(self, row: int, part: int) -> None:
        (client, rover), body = self._rovers[row], self._bodies.pop((row, part))
        for link in self._links:
            # Bullet keeps this for the next body with the same id.
            pybullet.setCollisionFilterPair(rover, body, link, -1, 0, client)
        pybullet.removeBody(body, physicsClientId=client)

    def _shape(self, client: int, part: Part) -> int:
        """Returns the shape of a part in a client, which many bodies share."""
        key = (client, part.kind, part.size)
        if key not in self._shapes:
            length, _, height = part.size
            form = {
                "box": {"shapeType": pybullet.GEOM_BOX, "halfExtents": [side / 2 for side in part.size]},
                "cylinder": {"shapeType": pybullet.GEOM_CYLINDER, "radius": length / 2, "height": height},
                "capsule": {"shapeType": pybullet.GEOM_CAPSULE, "radius": length / 2, "height": height - length},
            }[part.kind]
            self._shapes[key] = pybullet.createCollisionShape(**form, physicsClientId=client)
        return self._shapes[key]
