"""Warp kernels that run once per scene, and that find hidden points."""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.rendering.kernels.rays import FAR, NOISE_CELLS, NOISE_SAMPLES, OFFSET, SUN_DIRECTION


@wp.kernel
def find_openness(
    first: int,
    mesh: wp.uint64,
    vertices: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    reach: float,
    openness: wp.array[float],
):
    """Writes the visible share of the sky for each vertex of a mesh, which darkens corners.

    Ambient occlusion: the mean over rays of ``min(t / reach, 1)``, where t is the distance to the first triangle. A
    sum of the normal and a point on the unit sphere (``directions``) gives rays in proportion to the cosine of their
    angle to the normal, as they contribute to the light.
    """
    vertex = first + wp.tid()
    normal = normals[vertex]
    start = vertices[vertex] + 10.0 * OFFSET * normal
    total = float(0.0)
    for k in range(directions.shape[0]):
        query = wp.mesh_query_ray(mesh, start, wp.normalize(normal + directions[k]), reach)
        # A vertex inside of a body, which sees back sides, is hidden. It counts half, as its triangle may reach out.
        total += wp.where(query.result, wp.where(query.sign > 0.0, query.t / reach, 0.5), 1.0)
    openness[vertex] = total / float(directions.shape[0])


@wp.kernel
def find_sunshine(
    first: int, mesh: wp.uint64, vertices: wp.array[wp.vec3], normals: wp.array[wp.vec3], sunshine: wp.array[float]
):
    """Writes whether the sun reaches each vertex of a mesh, 0 or 1, so that most pixels need no shadow ray."""
    vertex = first + wp.tid()
    start = vertices[vertex] + 10.0 * OFFSET * normals[vertex]
    sunshine[vertex] = wp.where(wp.mesh_query_ray_anyhit(mesh, start, SUN_DIRECTION, FAR), 0.0, 1.0)


@wp.kernel
def find_noise(first: int, noise: wp.array2d[float]):
    """Writes the periodic noise of the ground (Perlin)."""
    row, column = wp.tid()
    row += first
    at = wp.vec2(float(column) / float(NOISE_SAMPLES), float(row) / float(NOISE_SAMPLES))
    noise[row, column] = wp.pnoise(wp.uint32(7), at, NOISE_CELLS, NOISE_CELLS)


@wp.kernel
def find_hidden(
    first: int,
    mesh: wp.uint64,
    starts: wp.array[wp.vec3],
    ends: wp.array[wp.vec3],
    fraction: float,
    hidden: wp.array[wp.uint8],
):
    """Writes whether a mesh crosses the first ``fraction`` of the line from each start to its end."""
    point = first + wp.tid()
    sight = ends[point] - starts[point]
    length = wp.length(sight)
    if length > 0.0:
        if wp.mesh_query_ray_anyhit(mesh, starts[point], sight / length, fraction * length):
            hidden[point] = wp.uint8(1)
