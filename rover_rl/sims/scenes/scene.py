"""The world of a rover as kernels read it."""

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
