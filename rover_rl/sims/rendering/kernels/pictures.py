"""Warp kernels that trace a picture in three passes.

:func:`trace_samples` traces a ray for one pixel in nine. :func:`fill_pixels` interpolates the others where the samples
around them see the same smooth surface, and traces their own rays elsewhere. :func:`smooth_edges` traces four more rays
for each pixel that differs from a neighbor, so that edges of things and of shadows are smooth.
A pixel depends on few pixels near it, so that a picture is the same with any number of threads, each of which begins
with the row ``first``.
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.rendering.kernels.rays import (
    ROVER,
    SKY,
    SUN_DIRECTION,
    SUN_RIGHT,
    SUN_SIZE,
    SUN_UP,
    Pinhole,
    Placing,
    Scene,
    Seen,
    look,
    meets_body,
    meets_part,
    shade,
)

EDGE_CONTRAST = 0.08
"""Difference of displayed colors, 0 to 1, above which a pixel lies on an edge."""
STEP = 3
"""Distance between samples, pixels."""
SMOOTH_LIGHT = 0.05
"""Largest difference of the colors of samples between which pixels are interpolated."""
SMOOTH_DEPTH = 0.1
"""Largest relative difference of the distances of such samples."""


@wp.func
def ray_to(view: Pinhole, right: float, down: float) -> wp.vec3:
    """Direction to a point of the picture, in pixels from its center."""
    return wp.normalize(view.forward + right * view.right + down * view.down)


@wp.func
def from_center(index: int, count: int) -> float:
    """Distance of the center of a pixel from the center of the picture, along an axis of ``count`` pixels."""
    return float(index) + 0.5 - 0.5 * float(count)


@wp.func
def displayed(color: wp.vec3) -> wp.vec3:
    """Value of a screen, 0 to 1, that shows a color: gamma correction with an exponent of 2."""
    shown = wp.min(wp.max(color, wp.vec3()), wp.vec3(1.0))
    return wp.vec3(wp.sqrt(shown[0]), wp.sqrt(shown[1]), wp.sqrt(shown[2]))


@wp.func
def contrast(colors: wp.array2d[wp.vec3], color: wp.vec3, row: int, column: int) -> float:
    """Largest difference of a color from that of a pixel, 0 outside of the picture."""
    if row < 0 or column < 0 or row >= colors.shape[0] or column >= colors.shape[1]:
        return 0.0
    return wp.max(wp.abs(colors[row, column] - color))


@wp.kernel
def trace_samples(
    first: int, scene: Scene, placing: Placing, view: Pinhole, height: int, width: int, samples: wp.array2d[Seen]
):
    """Writes what is seen at the center of one pixel in nine."""
    row, column = wp.tid()
    row += first
    ray = ray_to(view, from_center(STEP * column, width), from_center(STEP * row, height))
    samples[row, column] = look(scene, placing, view.eye, ray, SUN_DIRECTION, wp.length(view.right))


@wp.func
def are_alike(a: Seen, b: Seen) -> bool:
    """Whether two samples may belong to one smooth surface in even light."""
    if a.surface != b.surface or wp.max(wp.abs(a.color - b.color)) > SMOOTH_LIGHT:
        return False
    return wp.abs(a.nearness - b.nearness) <= SMOOTH_DEPTH * wp.max(a.nearness, b.nearness)


@wp.func
def mixed(a: Seen, b: Seen, share: float) -> Seen:
    """Sample between two samples that are alike."""
    seen = Seen()
    seen.surface = a.surface
    seen.nearness = wp.lerp(a.nearness, b.nearness, share)
    seen.width = wp.lerp(a.width, b.width, share)
    seen.color = wp.lerp(a.color, b.color, share)
    return seen


@wp.kernel
def fill_pixels(
    first: int, scene: Scene, placing: Placing, view: Pinhole, samples: wp.array2d[Seen], colors: wp.array2d[wp.vec3]
):
    """Writes the displayed color of the center of each pixel."""
    row, column = wp.tid()
    row += first
    ray = ray_to(view, from_center(column, colors.shape[1]), from_center(row, colors.shape[0]))
    up = row / STEP
    left = column / STEP
    down_share = float(row - STEP * up) / float(STEP)
    right_share = float(column - STEP * left) / float(STEP)
    seen = samples[up, left]
    if down_share + right_share > 0.0:
        right = samples[up, left + 1]
        below = samples[up + 1, left]
        across = samples[up + 1, left + 1]
        smooth = are_alike(seen, right) and are_alike(seen, below)
        smooth = smooth and are_alike(seen, across) and are_alike(right, below)
        if smooth and (seen.surface == ROVER + 2 or not meets_body(scene, placing, view.eye, ray)):
            seen = mixed(mixed(seen, right, right_share), mixed(below, across, right_share), down_share)
            if placing.parts > 0 and seen.surface != SKY:
                # Shadows of legs are thinner than the distance between samples.
                if meets_part(placing, view.eye + ray / seen.nearness, SUN_DIRECTION):
                    seen = look(scene, placing, view.eye, ray, SUN_DIRECTION, wp.length(view.right))
        else:
            seen = look(scene, placing, view.eye, ray, SUN_DIRECTION, wp.length(view.right))
    colors[row, column] = displayed(shade(scene, seen, view.eye, ray))


@wp.kernel
def smooth_edges(
    first: int,
    scene: Scene,
    placing: Placing,
    view: Pinhole,
    colors: wp.array2d[wp.vec3],
    picture: wp.array3d[wp.uint8],
):
    """Writes the picture. A pixel on an edge is the mean of four points, which see different points of the sun."""
    row, column = wp.tid()
    row += first
    color = colors[row, column]
    vertical = wp.max(contrast(colors, color, row - 1, column), contrast(colors, color, row + 1, column))
    horizontal = wp.max(contrast(colors, color, row, column - 1), contrast(colors, color, row, column + 1))
    if wp.max(vertical, horizontal) > EDGE_CONTRAST:
        right = from_center(column, colors.shape[1])
        down = from_center(row, colors.shape[0])
        # Offset from the center of the pixel; every turn by 90 degrees gives the next point.
        u = float(0.125)
        v = float(0.375)
        total = wp.vec3()
        for _point in range(4):
            sun = SUN_DIRECTION + SUN_SIZE * (u * SUN_RIGHT + v * SUN_UP)
            ray = ray_to(view, right + u, down + v)
            seen = look(scene, placing, view.eye, ray, sun, wp.length(view.right))
            total += shade(scene, seen, view.eye, ray)
            turned = -v
            v = u
            u = turned
        color = displayed(0.25 * total)
    for channel in range(3):
        picture[row, column, channel] = wp.uint8(255.0 * color[channel] + 0.5)
