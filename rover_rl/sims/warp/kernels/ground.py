"""The ground: triangles over a grid of heights, as :class:`rover_rl.sims.worlds.Terrain` has them."""

from __future__ import annotations

from rover_rl.sims.warp.kernels.types import Scene
from rover_rl.sims.warp.library import wp


@wp.func
def ground_at(scene: Scene, x: float, y: float) -> wp.vec4:
    """Slopes dz/dx and dz/dy of the triangle below a point, the cosine of its tilt, and its height (m)."""
    rows = scene.heights.shape[0]
    columns = scene.heights.shape[1]
    u = wp.clamp((x - scene.corner[0]) / scene.cell, 0.0, float(columns - 1))
    v = wp.clamp((y - scene.corner[1]) / scene.cell, 0.0, float(rows - 1))
    i = wp.min(int(u), columns - 2)
    j = wp.min(int(v), rows - 2)
    u = u - float(i)
    v = v - float(j)
    low_left = scene.heights[j, i]
    low_right = scene.heights[j, i + 1]
    high_left = scene.heights[j + 1, i]
    rise_x = low_right - low_left
    rise_y = high_left - low_left
    height = low_left + u * rise_x + v * rise_y
    if u + v > 1.0:
        high_right = scene.heights[j + 1, i + 1]
        rise_x = high_right - high_left
        rise_y = high_right - low_right
        height = high_right - (1.0 - u) * rise_x - (1.0 - v) * rise_y
    rise_x = rise_x / scene.cell
    rise_y = rise_y / scene.cell
    return wp.vec4(rise_x, rise_y, 1.0 / wp.sqrt(1.0 + rise_x * rise_x + rise_y * rise_y), height)


@wp.func
def normal_of(ground: wp.vec4) -> wp.vec3:
    """Unit normal of what :func:`ground_at` found."""
    return wp.vec3(-ground[0] * ground[2], -ground[1] * ground[2], ground[2])


@wp.func
def gap_to(ground: wp.vec4, height: float) -> float:
    """Distance (m) of a point at ``height`` from the triangle below it; negative underground."""
    return (height - ground[3]) * ground[2]
