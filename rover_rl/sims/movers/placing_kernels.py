"""Warp kernel that places the parts of movers on the ground."""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.movers.parts import MAX_SPEED
from rover_rl.worlds.ground_kernels import Grounds, height_at

PI = wp.constant(3.14159265358979)
FASTEST = wp.constant(MAX_SPEED)


@wp.struct
class Placed:
    """Parts of the movers of all rows, which change: see :class:`~rover_rl.sims.movers.parts.Parts`."""

    position: wp.array2d[wp.vec3]
    orientation: wp.array2d[wp.quat]
    velocity: wp.array2d[wp.vec3]
    turn: wp.array2d[float]
    # Heading of the mover of each part, rad.
    yaw: wp.array2d[float]


@wp.struct
class Solid:
    """Parts in the frames of their movers: see :class:`~rover_rl.worlds.movers.shapes.Part`."""

    mover: wp.array2d[wp.int64]
    center: wp.array2d[wp.vec3]
    orientation: wp.array2d[wp.quat]
    swing: wp.array2d[float]


@wp.kernel
def place_parts(
    positions: wp.array2d[wp.vec2],
    yaws: wp.array2d[float],
    swings: wp.array2d[float],
    solids: Solid,
    grounds: Grounds,
    rows: wp.array[wp.bool],
    begins: bool,
    dt: float,
    placed: Placed,
):
    """Places a part of a mover; thread ``(row, part)``. Parts of rows that are not in ``rows`` do not move.

    ``positions``, ``yaws`` and ``swings`` (by how much of their amplitude legs are ahead) are those of the movers. The
    pose of a part is that in the frame of its mover, turned by the yaw about the vertical and moved. With ``begins``,
    the part is at rest; else its velocity is the way from where it was, in ``dt`` (s).
    """
    row, part = wp.tid()
    if not rows[row]:
        placed.velocity[row, part] = wp.vec3(0.0, 0.0, 0.0)
        placed.turn[row, part] = 0.0
        return
    mover = int(solids.mover[row, part])
    at = positions[row, mover]
    yaw = yaws[row, mover]
    turn = wp.quat(0.0, 0.0, wp.sin(yaw / 2.0), wp.cos(yaw / 2.0))
    center = solids.center[row, part] + wp.vec3(solids.swing[row, part] * swings[row, mover], 0.0, 0.0)
    ground = height_at(grounds, row, wp.float64(at[0]), wp.float64(at[1]))
    position = wp.vec3(at[0], at[1], ground) + wp.quat_rotate(turn, center)
    velocity = (position - placed.position[row, part]) / dt
    change = yaw - placed.yaw[row, part]
    change = change - 2.0 * PI * wp.round(change / (2.0 * PI))
    if begins or not wp.length(velocity) <= FASTEST:
        velocity = wp.vec3(0.0, 0.0, 0.0)
        change = 0.0
    placed.position[row, part] = position
    placed.orientation[row, part] = turn * solids.orientation[row, part]
    placed.velocity[row, part] = velocity
    placed.turn[row, part] = change / dt
    placed.yaw[row, part] = yaw
