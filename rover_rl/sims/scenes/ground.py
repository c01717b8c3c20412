"""Terrain queries: height, slope and normal of the triangulated height grid.

World frame, m. Each grid cell is split into two triangles along the diagonal from (i + 1, j) to (i, j + 1), exactly as
:class:`rover_rl.worlds.Terrain` does. Outside the grid, the height of the nearest edge continues.
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.scenes.scene import Scene


@wp.func
def ground_at(scene: Scene, x: float, y: float) -> wp.vec4:
    """Terrain triangle below or above the point (x, y).

    Within a cell, u and v in [0, 1] are the coordinates along x and y, and u + v = 1 is the diagonal. Both triangles
    are planes through a right-angle corner c: ``z = z_c + (u - u_c) dz_x + (v - v_c) dz_y``.

    Returns:
        Slopes dz/dx and dz/dy, cosine of the tilt ``1 / sqrt(1 + (dz/dx)^2 + (dz/dy)^2)``, and height (m).
    """
    rows = scene.heights.shape[0]
    columns = scene.heights.shape[1]
    # Clamping continues the nearest edge outside of the grid.
    u = wp.clamp((x - scene.origin[0]) / scene.cell, 0.0, float(columns - 1))
    v = wp.clamp((y - scene.origin[1]) / scene.cell, 0.0, float(rows - 1))
    i = wp.min(int(u), columns - 2)
    j = wp.min(int(v), rows - 2)
    u = u - float(i)
    v = v - float(j)
    # Lower triangle: right angle at (i, j).
    h00 = scene.heights[j, i]
    h10 = scene.heights[j, i + 1]
    h01 = scene.heights[j + 1, i]
    rise_x = h10 - h00
    rise_y = h01 - h00
    height = h00 + u * rise_x + v * rise_y
    if u + v > 1.0:
        # Upper triangle: right angle at (i + 1, j + 1).
        h11 = scene.heights[j + 1, i + 1]
        rise_x = h11 - h01
        rise_y = h11 - h10
        height = h11 - (1.0 - u) * rise_x - (1.0 - v) * rise_y
    rise_x = rise_x / scene.cell
    rise_y = rise_y / scene.cell
    return wp.vec4(rise_x, rise_y, 1.0 / wp.sqrt(1.0 + rise_x * rise_x + rise_y * rise_y), height)


@wp.func
def ground_normal(ground: wp.vec4) -> wp.vec3:
    """Upward unit normal ``cos(tilt) (-dz/dx, -dz/dy, 1)`` of a triangle returned by :func:`ground_at`."""
    return wp.vec3(-ground[0] * ground[2], -ground[1] * ground[2], ground[2])


@wp.func
def ground_gap(ground: wp.vec4, height: float) -> float:
    """Distance (m) of a point at ``height`` to the plane of its triangle, ``(z - z_ground) cos(tilt)``.

    Negative below the ground.
    """
    return (height - ground[3]) * ground[2]
