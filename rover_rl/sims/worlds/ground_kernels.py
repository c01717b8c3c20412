"""Warp kernels over the ground of a world."""

from __future__ import annotations

from rover_rl.sims.native.warp import wp
from rover_rl.sims.worlds.terrain import Terrain


@wp.struct
class Ground:
    """Heights of a terrain: see :class:`Terrain`."""

    heights: wp.array2d[float]
    origin: wp.vec2d
    cell: wp.float64


def ground_of(terrain: Terrain) -> Ground:
    """Returns a terrain as a struct of the kernels."""
    ground = Ground()
    ground.heights = wp.from_numpy(terrain.heights.numpy(), dtype=float, device="cpu")
    ground.origin, ground.cell = wp.vec2d(*terrain.origin), terrain.cell
    return ground


@wp.func
def plane_at(ground: Ground, x: wp.float64, y: wp.float64) -> wp.vec3d:
    """Height (m) and slopes along x and y of the terrain's triangle at a point, as :meth:`Terrain.height_at`."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    rows = ground.heights.shape[0]
    columns = ground.heights.shape[1]
    u = wp.clamp((x - ground.origin[0]) / ground.cell, zero, wp.float64(columns - 1))
    v = wp.clamp((y - ground.origin[1]) / ground.cell, zero, wp.float64(rows - 1))
    i = wp.min(int(u), columns - 2)
    j = wp.min(int(v), rows - 2)
    u = u - wp.float64(i)
    v = v - wp.float64(j)
    h10 = wp.float64(ground.heights[j, i + 1])
    h01 = wp.float64(ground.heights[j + 1, i])
    if u + v > one:
        h11 = wp.float64(ground.heights[j + 1, i + 1])
        rise_x = h11 - h01
        rise_y = h11 - h10
        return wp.vec3d(h11 - (one - u) * rise_x - (one - v) * rise_y, rise_x / ground.cell, rise_y / ground.cell)
    h00 = wp.float64(ground.heights[j, i])
    rise_x = h10 - h00
    rise_y = h01 - h00
    return wp.vec3d(h00 + u * rise_x + v * rise_y, rise_x / ground.cell, rise_y / ground.cell)


@wp.kernel
def measure_extremes(
    ground: Ground,
    lows: wp.array[wp.vec2d],
    highs: wp.array[wp.vec2d],
    steps: wp.array[int],
    extremes: wp.array[wp.vec2d],
):
    """Least and greatest height (m) at ``steps`` x ``steps`` samples of a rectangle; thread ``t`` does rectangle ``t``."""
    t = wp.tid()
    start = lows[t]
    spacing = (highs[t] - start) / wp.float64(steps[t] - 1)
    least = wp.float64(wp.inf)
    greatest = wp.float64(-wp.inf)
    for j in range(steps[t]):
        for i in range(steps[t]):
            height = plane_at(ground, start[0] + wp.float64(i) * spacing[0], start[1] + wp.float64(j) * spacing[1])[0]
            least = wp.min(least, height)
            greatest = wp.max(greatest, height)
    extremes[t] = wp.vec2d(least, greatest)
