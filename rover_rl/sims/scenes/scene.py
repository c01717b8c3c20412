"""The world of a rover as kernels read it, and queries of its ground: height, slope and normal of a triangle."""

from __future__ import annotations

from rover_rl.native.warp import wp


@wp.struct
class Scene:
    """A static world: ground heights on a grid, and convex obstacles. World frame, m.

    Lists of lists are stored flat: entry ``k`` of a list spans ``starts[k]`` to ``starts[k + 1]``.
    """

    # Ground: heights [rows, columns], (x, y) of heights[0, 0], and the grid spacing.
    heights: wp.array2d[float]
    origin: wp.vec2
    cell: float
    # Bounds of the ground: for each block of block x block cells the slopes (dz/dx, dz/dy) of a fitted plane, and
    # the least and greatest height that this plane needs at the middle of the block to bound the ground of the block.
    blocks: wp.array2d[wp.vec4]
    block: int
    # Obstacles: outward planes (n, w) with n . p + w < 0 inside, vertices, and bounding spheres (center, radius).
    planes: wp.array[wp.vec4]
    plane_starts: wp.array[int]
    vertices: wp.array[wp.vec3]
    vertex_starts: wp.array[int]
    spheres: wp.array[wp.vec4]
    # Faces of the obstacles, in the order of their planes: the index of each obstacle's first face, and the corners of
    # each face as numbers of the obstacle's vertices, counter-clockwise seen from outside. Obstacles of the same form
    # share their faces, which keeps a scene small.
    first_faces: wp.array[int]
    face_starts: wp.array[int]
    corners: wp.array[int]
    # Broad phase: uniform grid over (x, y) that lists the obstacles within reach of a rover centered in each cell.
    grid_origin: wp.vec2
    grid_cell: float
    grid_columns: int
    grid_rows: int
    grid_starts: wp.array[int]
    grid_obstacles: wp.array[int]


@wp.func
def ground_at(scene: Scene, x: float, y: float) -> wp.vec4:
    """Terrain triangle at (x, y): slopes dz/dx and dz/dy, ``1 / sqrt(1 + (dz/dx)^2 + (dz/dy)^2)``, and height (m).

    A cell is split along the diagonal from (i + 1, j) to (i, j + 1), as :class:`rover_rl.worlds.Terrain` does. Within
    a cell, u and v in [0, 1] are the coordinates along x and y, and u + v = 1 is the diagonal. Both triangles are
    planes through a right-angle corner c: ``z = z_c + (u - u_c) dz_x + (v - v_c) dz_y``.
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
    """Distance (m) of a point at ``height`` to the plane of its triangle; negative below the ground."""
    return (height - ground[3]) * ground[2]
