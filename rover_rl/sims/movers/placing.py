"""Places the parts of movers on the ground."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from rover_rl.native.warp import stream_of, wp
from rover_rl.sims.movers.parts import Parts
from rover_rl.sims.movers.placing_kernels import Placed, Solid, place_parts
from rover_rl.worlds.ground_kernels import grounds_of
from rover_rl.worlds.movers.motions.base import Courses
from rover_rl.worlds.table import TerrainRows


def place(
    parts: Parts,
    yaw: Tensor,
    local: Mapping[str, Tensor],
    course: Courses,
    swing: Tensor,
    terrains: TerrainRows,
    rows: Tensor,
    begins: bool,
    dt: float,
) -> None:
    """Places parts on the ground, in place.

    Args:
        parts: parts, whose position, orientation, velocity and yaw rate change.
        yaw: heading of each part's mover after the last step, which changes, ``[N, P]``, rad.
        local: mover, center, orientation and swing of the parts in the frames of their movers, ``[N, P, ...]``.
        course: where the movers are.
        swing: how far legs are ahead, relative to their amplitude, ``[N, M]``.
        terrains: terrains of the rows.
        rows: rows whose movers move, bool ``[N, 1]``.
        begins: whether their episodes begin, so that parts are at rest.
        dt: duration of a step, s.
    """
    with wp.ScopedStream(stream_of(yaw.device)):
        placed, solid = Placed(), Solid()
        placed.position = wp.from_torch(parts.position, dtype=wp.vec3)
        placed.orientation = wp.from_torch(parts.orientation, dtype=wp.quat)
        placed.velocity = wp.from_torch(parts.velocity, dtype=wp.vec3)
        placed.turn, placed.yaw = wp.from_torch(parts.turn), wp.from_torch(yaw)
        solid.mover, solid.swing = wp.from_torch(local["mover"]), wp.from_torch(local["swing"])
        solid.center = wp.from_torch(local["center"], dtype=wp.vec3)
        solid.orientation = wp.from_torch(local["orientation"], dtype=wp.quat)
        movers = [wp.from_torch(course.position.contiguous(), dtype=wp.vec2)]
        movers += [wp.from_torch(values.contiguous()) for values in (course.yaw, swing)]
        grounds, moving = grounds_of(terrains), wp.from_torch(rows.squeeze(-1).contiguous())
        inputs = [*movers, solid, grounds, moving, begins, dt, placed]
        wp.launch(place_parts, yaw.shape, inputs, device=wp.device_from_torch(yaw.device))
