"""Warp kernel that intersects rays with the meshes of worlds."""

from __future__ import annotations

from rover_rl.sims.native.warp import wp

FAR = 1.0e4
"""Length of rays, m."""


@wp.kernel
def cast_rays(
    meshes: wp.array[wp.uint64],
    slots: wp.array[wp.int64],
    origins: wp.array2d[wp.vec3],
    directions: wp.array2d[wp.vec3],
    ranges: wp.array2d[float],
):
    """Writes the distance along each ray of each row to the mesh of the row's slot."""
    row, ray = wp.tid()
    mesh = meshes[int(slots[row])]
    query = wp.mesh_query_ray(mesh, origins[row, ray], wp.normalize(directions[row, ray]), FAR)
    if query.result:
        # A ray that meets a back side starts inside of a solid.
        ranges[row, ray] = wp.where(query.sign > 0.0, query.t, 0.0)
