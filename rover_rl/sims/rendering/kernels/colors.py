"""Warp kernel of color cameras: one launch for the pixels of all rows."""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.rendering.kernels.pictures import displayed
from rover_rl.sims.rendering.kernels.rays import SUN_DIRECTION, Placing, Scene, look, shade


@wp.kernel
def trace_colors(
    scenes: wp.array[Scene],
    slots: wp.array[wp.int64],
    poses: wp.array2d[wp.transform],
    placing: Placing,
    origins: wp.array2d[wp.vec3],
    directions: wp.array2d[wp.vec3],
    spread: float,
    colors: wp.array3d[float],
):
    """Writes the displayed color of what each ray of each row sees in the scene of the row's slot.

    ``poses`` are those of the bodies of each row. The parts of movers in ``placing`` are those of all rows.
    """
    row, ray = wp.tid()
    scene = scenes[int(slots[row])]
    placing.poses = poses[row]
    if placing.parts > 0:
        placing.root = wp.bvh_get_group_root(placing.tree, row)
    start = origins[row, ray]
    direction = wp.normalize(directions[row, ray])
    seen = look(scene, placing, start, direction, SUN_DIRECTION, spread)
    color = displayed(shade(scene, seen, start, direction))
    for channel in range(3):
        colors[row, channel, ray] = color[channel]
