"""Bodies of movers in Bullet: those near rovers, which push them.

A part of a mover is a body without mass. Bullet does not move it by forces, but the contacts know its velocity. The
collision groups of Bullet cannot tell the rows of a client apart: the body of a part is in no group, and collides with
the links of the rover of its row alone.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rover_rl.native.bullet import pybullet
from rover_rl.sims.bullet import BulletSettings
from rover_rl.sims.bullet.geometry import set_contact
from rover_rl.sims.bullet.rover import links_of
from rover_rl.sims.movers.near import NearParts, turned
from rover_rl.worlds.movers import Part

_FAR = 1e4
"""Coordinates of where bodies are made, m."""


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
