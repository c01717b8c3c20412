"""Parts of movers as bodies of a MuJoCo model.

A body that MuJoCo moves from outside (``mocap``) has no velocity in contacts. A part of a mover is a body on joints
instead, with so much inertia that rovers do not push it: in a control step, it goes on at the velocity that it has at
the start.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from rover_rl.native.mujoco import mujoco
from rover_rl.worlds.movers import Part

INERTIA = 1e6
"""Inertia of a part along and about each axis, kg and kg m^2. A rover of 10 kg slows it by 10 um/s per m/s."""
MAX_NEAR = 8
"""Number of parts of one kind and size that may be near a rover. Of more, the nearest ones push it."""


def slots_of(parts: Sequence[Part]) -> list[Part]:
    """Returns the parts that a rover may meet at once: at most :data:`MAX_NEAR` of each kind and size."""
    forms = Counter((part.kind, part.size) for part in parts)
    example = {(part.kind, part.size): part for part in parts}
    return [example[form] for form, count in forms.items() for _ in range(min(count, MAX_NEAR))]


def add_parts(spec: mujoco.MjSpec, slots: Sequence[Part], **options: Any) -> None:
    """Adds a body for each of the parts ``slots``, on a common body ``"movers"``, after all other joints.

    The bodies are on the joints ``"part 0"``, ``"part 0 x"``, ``"part 0 y"`` and ``"part 0 z"``, and so on. ``options``
    are attributes of their geoms.
    """
    root = spec.worldbody.add_body(name="movers")
    kinds = mujoco.mjtGeom
    for index, part in enumerate(slots):
        body = root.add_body(name=f"part {index}")
        # Gravity acts on the mass alone, which is small beside the inertia of the joints.
        body.explicitinertial, body.mass, body.inertia, body.gravcomp = True, 1.0, (1.0, 1.0, 1.0), 1.0
        for name, axis in zip("xyz", np.eye(3), strict=True):
            body.add_joint(name=f"part {index} {name}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, armature=INERTIA)
        body.add_joint(name=f"part {index}", type=mujoco.mjtJoint.mjJNT_BALL, armature=INERTIA)
        length, width, height = (side / 2 for side in part.size)
        form = {
            "box": (kinds.mjGEOM_BOX, (length, width, height)),
            "cylinder": (kinds.mjGEOM_CYLINDER, (length, height, 0)),
            "capsule": (kinds.mjGEOM_CAPSULE, (length, height - length, 0)),
        }[part.kind]
        body.add_geom(type=form[0], size=form[1], **options)
