"""Warp kernels of the ray tracer: what a ray sees, for films and for color cameras.

A scene is a mesh of the ground and the obstacles, and bodies around, each an instance of a mesh with a pose: robot,
post of the goal, parts of movers. Rays are transformed to the frame of a body to intersect it.

Lengths in m. Colors are intensities, proportional to light; :func:`displayed` converts them.
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.rendering.scenery import GRID, GROUND, HORIZON, SUN, ZENITH

FAR = 1.0e4
"""Length of rays, m."""
OFFSET = 1.0e-3
"""Distance from the surface at which shadow rays start, so that rounding does not hide their own triangle, m."""
SUN_DIRECTION = wp.normalize(wp.vec3(*SUN))
SUN_RIGHT = wp.normalize(wp.cross(SUN_DIRECTION, wp.vec3(0.0, 0.0, 1.0)))
SUN_UP = wp.cross(SUN_RIGHT, SUN_DIRECTION)
SUN_SIZE = 0.025
"""Angular size of the sun, rad: larger than the real one, for softer edges of shadows."""
SUNLIGHT, SKYLIGHT, GROUNDLIGHT = wp.vec3(1.36, 1.24, 1.04), wp.vec3(0.36, 0.42, 0.51), wp.vec3(0.24, 0.21, 0.18)
"""Light of the sun, the sky and the ground on surfaces that face them."""
GROUND_COLOR, HORIZON_COLOR, ZENITH_COLOR = (wp.vec3(*(c * c for c in color)) for color in (GROUND, HORIZON, ZENITH))
GLOW = wp.vec3(0.16, 0.12, 0.06)
"""Light around the sun."""
HAZE_DISTANCE = 45.0
"""Distance at which 63% of the light comes from the haze, m."""
LINE_WIDTH, LINE_SHADE = 0.02, 0.22
"""Width of the lines of the grid on the ground, m, and share of the light that they absorb."""
EDGE_CONTRAST = 0.08
"""Difference of displayed colors, 0 to 1, above which a pixel lies on an edge."""


@wp.struct
class Shape:
    """A mesh, whose velocities are the unit normals of its vertices, and colors of its triangles, with 1 for ground."""

    mesh: wp.uint64
    colors: wp.array[wp.vec4]


@wp.struct
class Scenery:
    """Ground and obstacles of a world, and the height of the plane around its terrain."""

    shape: Shape
    level: float


@wp.struct
class Bodies:
    """Pose and shape of each body, and a tree of boxes around them, of which ``root`` is a branch (-1: all)."""

    tree: wp.uint64
    root: int
    poses: wp.array[wp.transform]
    numbers: wp.array[int]
    shapes: wp.array[Shape]


@wp.struct
class Pinhole:
    """Pinhole camera: position and direction, and the vectors from one pixel to the next at distance 1."""

    eye: wp.vec3
    forward: wp.vec3
    right: wp.vec3
    down: wp.vec3


@wp.struct
class Hit:
    """Where a ray meets a surface: normal of the triangle, smooth normal, and color with 1 for ground, else 0."""

    distance: float
    flat: wp.vec3
    normal: wp.vec3
    color: wp.vec4


@wp.func
def hit_of(shape: Shape, pose: wp.transform, query: wp.MeshQueryRay) -> Hit:
    hit = Hit()
    hit.distance = query.t
    hit.flat = wp.transform_vector(pose, query.normal)
    normal = wp.mesh_eval_velocity(shape.mesh, query.face, query.u, query.v)
    hit.normal = wp.normalize(wp.transform_vector(pose, normal))
    hit.color = shape.colors[query.face]
    return hit


@wp.func
def first_hit(scenery: Scenery, bodies: Bodies, start: wp.vec3, direction: wp.vec3) -> Hit:
    """First intersection of a ray with the scene; its distance is ``FAR`` if there is none."""
    hit = Hit()
    hit.distance = FAR
    query = wp.mesh_query_ray(scenery.shape.mesh, start, direction, FAR)
    if query.result:
        hit = hit_of(scenery.shape, wp.transform_identity(), query)
    boxes = wp.bvh_query_ray(bodies.tree, start, direction, bodies.root)
    body = int(0)
    while wp.bvh_query_next(boxes, body, hit.distance):
        pose = bodies.poses[body]
        shape = bodies.shapes[bodies.numbers[body]]
        inverse = wp.transform_inverse(pose)
        local = wp.transform_vector(inverse, direction)
        query = wp.mesh_query_ray(shape.mesh, wp.transform_point(inverse, start), local, hit.distance)
        if query.result:
            hit = hit_of(shape, pose, query)
    return hit


@wp.func
def is_lit(scenery: Scenery, bodies: Bodies, start: wp.vec3, sun: wp.vec3) -> bool:
    """Whether nothing lies between a point and the sun."""
    if wp.mesh_query_ray_anyhit(scenery.shape.mesh, start, sun, FAR):
        return False
    boxes = wp.bvh_query_ray(bodies.tree, start, sun, bodies.root)
    body = int(0)
    while wp.bvh_query_next(boxes, body, FAR):
        inverse = wp.transform_inverse(bodies.poses[body])
        mesh = bodies.shapes[bodies.numbers[body]].mesh
        local = wp.transform_vector(inverse, sun)
        if wp.mesh_query_ray_anyhit(mesh, wp.transform_point(inverse, start), local, FAR):
            return False
    return True


@wp.func
def sky_color(direction: wp.vec3) -> wp.vec3:
    """Color of the sky: from the color of the horizon to that of the zenith, with a glow around the sun."""
    below = 1.0 - wp.max(direction[2], 0.0)
    glow = wp.max(wp.dot(direction, SUN_DIRECTION), 0.0)
    return wp.lerp(ZENITH_COLOR, HORIZON_COLOR, below * below * below) + glow * glow * glow * glow * GLOW


@wp.func
def line_coverage(x: float, width: float) -> float:
    """Share of a pixel at ``x`` across the lines of the grid that a line covers. The pixel's width blurs it."""
    distance = GRID * wp.abs(x / GRID - wp.round(x / GRID))
    blurred = wp.max(width, LINE_WIDTH)
    return wp.clamp(0.5 + (0.5 * LINE_WIDTH - distance) / blurred, 0.0, 1.0) * LINE_WIDTH / blurred


@wp.func
def ground_pattern(x: float, y: float, width: float) -> float:
    """Brightness of the ground: patches, grain near the camera, and a grid, which show how the rover moves."""
    brightness = 1.0 + 0.12 * wp.noise(wp.uint32(7), wp.vec2(0.4 * x, 0.4 * y))
    detail = 1.0 - 20.0 * width
    if detail > 0.0:
        fine = wp.noise(wp.uint32(7), wp.vec2(19.0 * x, 19.0 * y))
        brightness += detail * (0.08 * wp.noise(wp.uint32(7), wp.vec2(4.0 * x, 4.0 * y)) + 0.06 * fine)
    lines = wp.max(line_coverage(x, width), line_coverage(y, width))
    return brightness * (1.0 - LINE_SHADE * lines)


@wp.func
def look(scenery: Scenery, bodies: Bodies, start: wp.vec3, direction: wp.vec3, sun: wp.vec3, spread: float) -> wp.vec3:
    """Color that a ray sees: that of a surface in its light, behind haze of ``1 - exp(-(t / t_haze)^2)``, or sky.

    The light on a surface of normal n is ``max(n . s, 0) sunlight + ambient(n)`` with the direction s to the ``sun``
    (Lambert's law) and the ambient light of a sky above a bright ground. ``spread`` is the width of a pixel at
    distance 1, m, which blurs the pattern of the ground.
    """
    haze = sky_color(direction)
    hit = first_hit(scenery, bodies, start, direction)
    if hit.distance == FAR:
        # Around the terrain, the ground is a plane.
        hit.distance = (scenery.level - start[2]) / direction[2]
        if hit.distance <= 0.0 or direction[2] == 0.0:
            return haze
        hit.flat = wp.vec3(0.0, 0.0, 1.0)
        hit.normal = hit.flat
        hit.color = wp.vec4(GROUND_COLOR[0], GROUND_COLOR[1], GROUND_COLOR[2], 1.0)
    # Triangles are seen from both sides.
    side = -wp.sign(wp.dot(hit.flat, direction))
    flat = side * hit.flat
    normal = side * hit.normal
    point = start + hit.distance * direction + OFFSET * flat
    light = wp.lerp(GROUNDLIGHT, SKYLIGHT, 0.5 + 0.5 * normal[2])
    facing = wp.dot(normal, SUN_DIRECTION)
    if facing > 0.0 and wp.dot(flat, SUN_DIRECTION) > 0.0:
        if is_lit(scenery, bodies, point, sun):
            light += facing * SUNLIGHT
    color = wp.cw_mul(wp.vec3(hit.color[0], hit.color[1], hit.color[2]), light)
    if hit.color[3] == 1.0:
        # A pixel is longer on ground that is seen at a flat angle.
        width = spread * hit.distance / wp.max(-wp.dot(direction, flat), 0.05)
        color *= ground_pattern(point[0], point[1], width)
    depth = hit.distance / HAZE_DISTANCE
    return wp.lerp(haze, color, wp.exp(-depth * depth))


@wp.func
def displayed(color: wp.vec3) -> wp.vec3:
    """Value of a screen, 0 to 1, that shows a color: gamma correction with an exponent of 2."""
    shown = wp.min(wp.max(color, wp.vec3()), wp.vec3(1.0))
    return wp.vec3(wp.sqrt(shown[0]), wp.sqrt(shown[1]), wp.sqrt(shown[2]))


@wp.kernel
def trace_colors(
    sceneries: wp.array[Scenery],
    slots: wp.array[wp.int64],
    bodies: Bodies,
    origins: wp.array2d[wp.vec3],
    directions: wp.array2d[wp.vec3],
    spread: float,
    colors: wp.array3d[float],
):
    """Writes the displayed color of what each ray of each row sees in the scenery of the row's slot."""
    row, ray = wp.tid()
    bodies.root = wp.bvh_get_group_root(bodies.tree, row)
    direction = wp.normalize(directions[row, ray])
    color = displayed(look(sceneries[int(slots[row])], bodies, origins[row, ray], direction, SUN_DIRECTION, spread))
    for channel in range(3):
        colors[row, channel, ray] = color[channel]


@wp.func
def ray_to(view: Pinhole, column: float, row: float, width: int, height: int) -> wp.vec3:
    """Direction to a point of a picture, in pixels from its upper left corner."""
    right = column - 0.5 * float(width)
    down = row - 0.5 * float(height)
    return wp.normalize(view.forward + right * view.right + down * view.down)


@wp.kernel
def trace_pixels(first: int, scenery: Scenery, bodies: Bodies, view: Pinhole, colors: wp.array2d[wp.vec3]):
    """Writes the displayed color at the center of each pixel."""
    row, column = wp.tid()
    row += first
    ray = ray_to(view, float(column) + 0.5, float(row) + 0.5, colors.shape[1], colors.shape[0])
    colors[row, column] = displayed(look(scenery, bodies, view.eye, ray, SUN_DIRECTION, wp.length(view.right)))


@wp.kernel
def smooth_edges(
    first: int,
    scenery: Scenery,
    bodies: Bodies,
    view: Pinhole,
    colors: wp.array2d[wp.vec3],
    picture: wp.array3d[wp.uint8],
):
    """Writes the picture. A pixel on an edge is the mean of 2 x 2 points, which see different points of the sun."""
    row, column = wp.tid()
    row += first
    color = colors[row, column]
    contrast = float(0.0)
    for k in range(4):
        # Left, above, below and right.
        y = wp.clamp(row + (k % 3) - 1 if k > 0 and k < 3 else row, 0, colors.shape[0] - 1)
        x = wp.clamp(column + (k // 3) * 2 - 1 if k == 0 or k == 3 else column, 0, colors.shape[1] - 1)
        contrast = wp.max(contrast, wp.max(wp.abs(colors[y, x] - color)))
    if contrast > EDGE_CONTRAST:
        total = wp.vec3()
        for k in range(4):
            u = 0.5 * float(k % 2) - 0.25
            v = 0.5 * float(k / 2) - 0.25
            sun = SUN_DIRECTION + SUN_SIZE * (u * SUN_RIGHT + v * SUN_UP)
            ray = ray_to(view, float(column) + 0.5 + u, float(row) + 0.5 + v, colors.shape[1], colors.shape[0])
            total += look(scenery, bodies, view.eye, ray, sun, wp.length(view.right))
        color = displayed(0.25 * total)
    for channel in range(3):
        picture[row, column, channel] = wp.uint8(255.0 * color[channel] + 0.5)


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
