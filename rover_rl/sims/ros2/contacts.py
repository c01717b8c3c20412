"""Contact forces on a live rover, from ``ros_gz_interfaces/Contacts``, the message of Gazebo's contact sensors."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rover_rl.robots.footprint import Footprint
from rover_rl.rotations import rotate
from rover_rl.sims.ros2.messages import Contact, Contacts, Entity, Header, JointWrench, Vector3, Wrench
from rover_rl.sims.ros2.poses import read_finite
from rover_rl.sims.rover_state import SIDES, by_side

MAX_RISE = 0.5**0.5
"""Largest vertical part of the normal of an obstacle, that of 45 degrees. A contact with a larger one is the ground."""
COLLISION = 5
"""Type of a collision shape in ``ros_gz_interfaces/Entity``."""
INVERSE = torch.tensor([-1.0, -1.0, -1.0, 1.0])
"""Signs of the components of the inverse of a unit quaternion (x, y, z, w)."""


class Touches(NamedTuple):
    """Points at which obstacles and movers push the rover.

    Attributes:
        points: positions in the world, ``[k, 3]``, m.
        normals: unit normals in the world, ``[k, 3]``, toward the rover or away from it.
        forces: normal forces, ``[k]``, N.
        moves: whether it is a mover that pushes, bool ``[k]``.
    """

    points: Tensor
    normals: Tensor
    forces: Tensor
    moves: Tensor


def read_contacts(msg: Any, model: str, mover_names: Collection[str]) -> Touches:
    """Returns what pushes the rover, of a ``ros_gz_interfaces/Contacts``. Contacts with the ground are left out.

    Args:
        msg: message. Positions, normals and forces are in the frame of the world (``ExtraContactDataT`` of gz-physics).
        model: name of the rover, one of the parts between ``::`` in the names of its collision shapes.
        mover_names: what the names of the collision shapes of movers contain, in upper or lower case.

    Raises:
        ValueError: if a contact is not of the rover, lacks a normal or a force, or a number is not finite.
    """
    numbers: list[float] = []
    moves: list[bool] = []
    for contact in msg.contacts:
        names = contact.collision1.name, contact.collision2.name
        own = [model in name.split("::") for name in names]
        if not any(own):
            raise ValueError(f"a contact must be of the rover, model {model!r}, got {names[0]!r} with {names[1]!r}")
        count = len(contact.positions)
        if not len(contact.normals) == len(contact.wrenches) == count:
            raise ValueError(
                f"a contact must have a normal and a wrench for each position, got {count} positions, "
                f"{len(contact.normals)} normals and {len(contact.wrenches)} wrenches"
            )
        if all(own):
            continue  # of two parts of the rover
        for position, normal, wrench in zip(contact.positions, contact.normals, contact.wrenches, strict=True):
            force = (wrench.body_1_wrench if own[0] else wrench.body_2_wrench).force
            numbers += [getattr(vector, axis) for vector in (position, normal, force) for axis in "xyz"]
        moves += [any(word.lower() in names[own.index(False)].lower() for word in mover_names)] * count
    points, normals, forces = read_finite("contact", *numbers).view(-1, 9).split(3, -1)
    length = torch.linalg.vector_norm(normals, dim=-1, keepdim=True)
    if not (length > 0).all():
        raise ValueError("the normal of a contact must not be zero")
    normals = normals / length
    felt = Touches(points, normals, (forces * normals).sum(-1).abs(), torch.tensor(moves, dtype=torch.bool))
    is_side = normals[:, 2].abs() <= MAX_RISE
    return Touches(*(values[is_side] for values in felt))


def contact_force(felt: Touches, position: Tensor, orientation: Tensor) -> Tensor:
    """Returns the forces on a rover with a pose in the world, ``RoverState.contact_force`` ``[8]``, N.

    What touches the rover pushes it away, whatever the sign of its normal. Gazebo's message does not tell it: its first
    collision is that of the sensor, but normals and forces are for the order of the physics engine, which varies.
    """
    points, normals = (rotate(orientation * INVERSE, of)[:, :2] for of in (felt.points - position, felt.normals))
    inward = normals * -(points * normals).sum(-1, keepdim=True).sign()
    sides = torch.from_numpy(by_side((felt.forces[:, None] * inward).numpy()))
    return torch.cat([sides[felt.moves == moves].sum(0) for moves in (False, True)])


def contacts_message(
    forces: Tensor, outline: Footprint, position: Tensor, orientation: Tensor, model: str, stamp: Any
) -> Any:
    """Builds a ``ros_gz_interfaces/Contacts`` of the forces ``[8]`` (N) on a rover with a pose in the world.

    Each force is a contact at the middle of a side of the outline, with one shape of obstacles and one of movers.
    """
    edges = [[outline.front, 0.0, 0.0], [0.0, outline.left, 0.0], [outline.back, 0.0, 0.0], [0.0, outline.right, 0.0]]
    points = torch.tensor(edges, dtype=orientation.dtype)
    normals = rotate(orientation, -torch.nn.functional.normalize(points, dim=-1))
    points = position + rotate(orientation, points)
    contacts = []
    for number, force in enumerate(forces.tolist()):
        if force > 0:
            side, other = number % len(SIDES), "mover" if number >= len(SIDES) else "obstacle"
            push = normals[side] * force
            wrench = JointWrench(
                body_1_wrench=Wrench(Vector3(*push.tolist())), body_2_wrench=Wrench(Vector3(*(-push).tolist()))
            )
            shapes = (Entity(name=f"{name}::link::collision", type=COLLISION) for name in (model, other))
            place, normal = (Vector3(*of[side].tolist()) for of in (points, normals))
            contacts.append(Contact(*shapes, [place], [normal], np.zeros(1), [wrench]))
    return Contacts(Header(stamp, "world"), contacts)
