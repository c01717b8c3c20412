"""Warp functions of the renderer: what a ray from the camera sees.

The scene consists of bodies, each a triangle mesh with a pose: body 0 is the scenery, whose pose is the world frame,
body 1 the rover, in its base frame, body 2 the post of the goal. To intersect a ray with a body, the kernels transform
the ray to the frame of the body. Vertices and triangles of all bodies are numbered consecutively. The parts of movers
are the bodies from 3 on, each an instance of one of the meshes of :class:`Forms`.

Lengths in m. Colors are intensities, proportional to light; :func:`~rover_rl.sims.rendering.kernels.pictures.displayed`
converts them.
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.rendering.scenery import GRID, GROUND, HORIZON, SUN, ZENITH

SCENERY = 0
"""Body of the ground and the obstacles."""
ROVER = 1
"""Body of the rover."""
MOVERS = 3
"""Body of the first part of a mover."""
FAR = 1.0e4
"""Length of rays, m."""
OFFSET = 1.0e-3
"""Distance from the surface at which secondary rays start, so that rounding does not hide their own triangle, m."""

SUN_DIRECTION = wp.normalize(wp.vec3(*SUN))
SUN_RIGHT = wp.normalize(wp.cross(SUN_DIRECTION, wp.vec3(0.0, 0.0, 1.0)))
SUN_UP = wp.cross(SUN_RIGHT, SUN_DIRECTION)
SUN_SIZE = 0.025
"""Angular size of the sun, rad: larger than the real one, for softer edges of shadows."""
SUNLIGHT = wp.vec3(1.36, 1.24, 1.04)
"""Light of the sun on a surface that faces it."""
SKYLIGHT = wp.vec3(0.36, 0.42, 0.51)
"""Light of the sky on a surface that faces up."""
GROUNDLIGHT = wp.vec3(0.24, 0.21, 0.18)
"""Light of the ground on a surface that faces down."""
GROUND_COLOR = wp.vec3(*(c * c for c in GROUND))
HORIZON_COLOR = wp.vec3(*(c * c for c in HORIZON))
ZENITH_COLOR = wp.vec3(*(c * c for c in ZENITH))
GLOW = wp.vec3(0.16, 0.12, 0.06)
"""Light around the sun."""
HAZE_DISTANCE = 45.0
"""Distance at which 63% of the light comes from the haze, m."""
ROVER_SHADE = 0.35
"""Distance from the rover up to which it hides a part of the sky, m."""
LINE_WIDTH = 0.02
"""Width of the lines of the grid on the ground, m."""
LINE_SHADE = 0.22
"""Share of the light that lines absorb."""
NOISE_CELLS = 64
"""Number of cells of the noise on the ground along each axis, after which it repeats."""
NOISE_SAMPLES = 8
"""Number of stored values of the noise per cell and axis."""
SKY = 0
"""Surface of rays that meet nothing."""
GROUND_SURFACE = 1
"""Surface of the terrain and of the plane around it. That of other triangles is their body + 2."""


@wp.struct
class Scene:
    """Meshes of all bodies and the properties of their vertices and triangles."""

    # Per body: BVH in its own frame, radius of a sphere around the origin that contains it, and its first triangle.
    meshes: wp.array[wp.uint64]
    radii: wp.array[float]
    first_triangles: wp.array[int]
    # Per triangle: its three vertices, and its color with 1 for the ground and 0 for anything else.
    triangles: wp.array2d[int]
    colors: wp.array[wp.vec4]
    # Per vertex: unit normal in the frame of the body, visible share of the sky (0 to 1), and light of the sun: 0 in
    # the shadow of the scenery, 1 outside of it, 0.5 where a ray must tell.
    normals: wp.array[wp.vec3]
    openness: wp.array[float]
    sunshine: wp.array[float]
    # Height of the ground around the terrain.
    level: float
    # Box around the rover in its base frame: center and half side lengths.
    rover_center: wp.vec3
    rover_half: wp.vec3
    # Periodic noise, -1 to 1.
    noise: wp.array2d[float]


@wp.struct
class Forms:
    """Meshes of the parts of movers, with the fields of :class:`Scene`. Movers light nothing and shade no vertex."""

    meshes: wp.array[wp.uint64]
    first_triangles: wp.array[int]
    triangles: wp.array2d[int]
    colors: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]


@wp.struct
class Placing:
    """Where things are in a picture."""

    # Poses of the first three bodies.
    poses: wp.array[wp.transform]
    # Number of parts of movers, tree of boxes around them, its branch with those in this picture (-1: all), and the
    # pose and form of each.
    parts: int
    tree: wp.uint64
    root: int
    part_poses: wp.array[wp.transform]
    part_forms: wp.array[int]
    forms: Forms


@wp.struct
class Pinhole:
    """Pinhole camera: position and direction, and the vectors from one pixel to the next at distance 1."""

    eye: wp.vec3
    forward: wp.vec3
    right: wp.vec3
    down: wp.vec3


@wp.struct
class Hit:
    """First intersection of a ray. ``normal`` is that of the triangle, in the world frame; (u, v) are barycentric."""

    distance: float
    body: int
    triangle: int
    u: float
    v: float
    normal: wp.vec3


@wp.struct
class Seen:
    """What a ray from the camera sees: a surface, at the distance 1 / ``nearness``."""

    surface: int
    nearness: float
    # Width of a pixel on the surface.
    width: float
    # Color times light, without the pattern of the ground and without haze.
    color: wp.vec3


@wp.func
def to_body(pose: wp.transform, point: wp.vec3) -> wp.vec3:
    """Converts a point from the world frame to the frame of a body."""
    return wp.quat_rotate_inv(wp.transform_get_rotation(pose), point - wp.transform_get_translation(pose))


@wp.func
def may_hit(pose: wp.transform, radius: float, start: wp.vec3, direction: wp.vec3) -> bool:
    """Whether a ray passes through the sphere around a body."""
    offset = wp.transform_get_translation(pose) - start
    along = wp.max(wp.dot(offset, direction), 0.0)
    return wp.length_sq(offset - along * direction) < radius * radius


@wp.func
def closest_part(placing: Placing, start: wp.vec3, direction: wp.vec3, farthest: float) -> Hit:
    """First intersection of a ray with a part of a mover; ``body`` is -1 if there is none."""
    hit = Hit()
    hit.distance = farthest
    hit.body = -1
    query = wp.bvh_query_ray(placing.tree, start, direction, placing.root)
    part = int(0)
    while wp.bvh_query_next(query, part, hit.distance):
        pose = placing.part_poses[part]
        mesh = placing.forms.meshes[placing.part_forms[part]]
        local_direction = wp.quat_rotate_inv(wp.transform_get_rotation(pose), direction)
        found = wp.mesh_query_ray(mesh, to_body(pose, start), local_direction, hit.distance)
        if found.result:
            hit.distance = found.t
            hit.body = MOVERS + part
            hit.triangle = placing.forms.first_triangles[placing.part_forms[part]] + found.face
            hit.u = found.u
            hit.v = found.v
            hit.normal = wp.transform_vector(pose, found.normal)
    return hit


@wp.func
def meets_part(placing: Placing, start: wp.vec3, direction: wp.vec3) -> bool:
    """Whether a ray meets a part of a mover."""
    query = wp.bvh_query_ray(placing.tree, start, direction, placing.root)
    part = int(0)
    while wp.bvh_query_next(query, part, FAR):
        pose = placing.part_poses[part]
        mesh = placing.forms.meshes[placing.part_forms[part]]
        local_direction = wp.quat_rotate_inv(wp.transform_get_rotation(pose), direction)
        if wp.mesh_query_ray_anyhit(mesh, to_body(pose, start), local_direction, FAR):
            return True
    return False


@wp.func
def closest_hit(scene: Scene, placing: Placing, start: wp.vec3, direction: wp.vec3) -> Hit:
    """First intersection of a ray with the scene; ``body`` is -1 if there is none."""
    hit = Hit()
    hit.distance = FAR
    hit.body = -1
    scenery = wp.mesh_query_ray(scene.meshes[SCENERY], start, direction, FAR)
    if scenery.result:
        hit.distance = scenery.t
        hit.body = SCENERY
        hit.triangle = scenery.face
        hit.u = scenery.u
        hit.v = scenery.v
        hit.normal = scenery.normal
    for body in range(ROVER, scene.meshes.shape[0]):
        pose = placing.poses[body]
        if may_hit(pose, scene.radii[body], start, direction):
            local_start = to_body(pose, start)
            local_direction = wp.quat_rotate_inv(wp.transform_get_rotation(pose), direction)
            query = wp.mesh_query_ray(scene.meshes[body], local_start, local_direction, hit.distance)
            if query.result:
                hit.distance = query.t
                hit.body = body
                hit.triangle = query.face
                hit.u = query.u
                hit.v = query.v
                hit.normal = wp.transform_vector(pose, query.normal)
    hit.triangle += scene.first_triangles[wp.max(hit.body, 0)]
    if placing.parts > 0:
        nearer = closest_part(placing, start, direction, hit.distance)
        if nearer.body >= 0:
            return nearer
    return hit


@wp.func
def meets_body(scene: Scene, placing: Placing, start: wp.vec3, direction: wp.vec3) -> bool:
    """Whether a ray meets the rover, the post or a mover, which may be thinner than the distance between samples."""
    for body in range(ROVER, scene.meshes.shape[0]):
        pose = placing.poses[body]
        if may_hit(pose, scene.radii[body], start, direction):
            local_start = to_body(pose, start)
            local_direction = wp.quat_rotate_inv(wp.transform_get_rotation(pose), direction)
            if wp.mesh_query_ray_anyhit(scene.meshes[body], local_start, local_direction, FAR):
                return True
    if placing.parts > 0:
        return meets_part(placing, start, direction)
    return False


@wp.func
def is_lit(scene: Scene, placing: Placing, start: wp.vec3, sun: wp.vec3, sunshine: float) -> bool:
    """Whether nothing lies between a point and the sun. Where ``sunshine`` is neither 0 nor 1, a ray must tell."""
    if sunshine == 0.0:
        return False
    if sunshine < 1.0:
        if wp.mesh_query_ray_anyhit(scene.meshes[SCENERY], start, sun, FAR):
            return False
    return not meets_body(scene, placing, start, sun)


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
def noise_at(noise: wp.array2d[float], x: float, y: float) -> float:
    """Noise at a point, in cells, interpolated between its stored values."""
    u = float(NOISE_SAMPLES) * x
    v = float(NOISE_SAMPLES) * y
    column = int(wp.floor(u))
    row = int(wp.floor(v))
    u -= float(column)
    v -= float(row)
    last = NOISE_CELLS * NOISE_SAMPLES - 1
    # The number of values is a power of two.
    left = column & last
    right = (column + 1) & last
    low = row & last
    high = (row + 1) & last
    below = wp.lerp(noise[low, left], noise[low, right], u)
    return wp.lerp(below, wp.lerp(noise[high, left], noise[high, right], u), v)


@wp.func
def ground_pattern(noise: wp.array2d[float], x: float, y: float, width: float) -> float:
    """Brightness of the ground: patches, grain near the camera, and a grid, which show how the rover moves."""
    brightness = 1.0 + 0.12 * noise_at(noise, 0.4 * x, 0.4 * y)
    detail = 1.0 - 20.0 * width
    if detail > 0.0:
        grain = 0.08 * noise_at(noise, 4.0 * x, 4.0 * y) + 0.06 * noise_at(noise, 19.0 * x, 19.0 * y)
        brightness += detail * grain
    lines = wp.max(line_coverage(x, width), line_coverage(y, width))
    return brightness * (1.0 - LINE_SHADE * lines)


@wp.func
def rover_openness(scene: Scene, pose: wp.transform, point: wp.vec3) -> float:
    """Share of the skylight that the rover leaves to a point beside or below it."""
    reach = scene.radii[ROVER] + ROVER_SHADE
    if wp.length_sq(point - wp.transform_get_translation(pose)) > reach * reach:
        return 1.0
    offset = to_body(pose, point) - scene.rover_center
    gap = wp.max(wp.vec3(wp.abs(offset[0]), wp.abs(offset[1]), wp.abs(offset[2])) - scene.rover_half, wp.vec3())
    near = wp.max(1.0 - wp.length(gap) / ROVER_SHADE, 0.0)
    return 1.0 - 0.7 * near * near


@wp.func
def normal_on_part(placing: Placing, hit: Hit) -> wp.vec3:
    """Smooth normal where a ray meets a part of a mover, in the world frame."""
    forms = placing.forms
    a = forms.triangles[hit.triangle, 0]
    b = forms.triangles[hit.triangle, 1]
    c = forms.triangles[hit.triangle, 2]
    normal = hit.u * forms.normals[a] + hit.v * forms.normals[b] + (1.0 - hit.u - hit.v) * forms.normals[c]
    return wp.normalize(wp.transform_vector(placing.part_poses[hit.body - MOVERS], normal))


@wp.func
def look(scene: Scene, placing: Placing, start: wp.vec3, direction: wp.vec3, sun: wp.vec3, spread: float) -> Seen:
    """What a ray from the camera sees.

    The light on a surface of normal n is ``max(n . s, 0) sunlight + openness ambient(n)`` with the direction s to the
    ``sun`` (Lambert's law) and the ambient light of a sky above a bright ground. ``spread`` is the width of a pixel at
    distance 1.
    """
    seen = Seen()
    hit = closest_hit(scene, placing, start, direction)
    # Around the terrain, the ground is a plane.
    normal = wp.vec3(0.0, 0.0, 1.0)
    flat = normal
    openness = float(1.0)
    sunshine = float(1.0)
    color = GROUND_COLOR
    seen.surface = GROUND_SURFACE
    if hit.body < 0:
        hit.distance = (scene.level - start[2]) / direction[2]
        if hit.distance <= 0.0 or direction[2] == 0.0:
            seen.surface = SKY
            return seen
    elif hit.body >= MOVERS:
        # Triangles are seen from both sides.
        side = -wp.sign(wp.dot(hit.normal, direction))
        flat = side * hit.normal
        normal = side * normal_on_part(placing, hit)
        color = placing.forms.colors[hit.triangle]
        sunshine = 0.5
        seen.surface = hit.body + 2
    else:
        a = scene.triangles[hit.triangle, 0]
        b = scene.triangles[hit.triangle, 1]
        c = scene.triangles[hit.triangle, 2]
        w = 1.0 - hit.u - hit.v
        side = -wp.sign(wp.dot(hit.normal, direction))
        flat = side * hit.normal
        normal = hit.u * scene.normals[a] + hit.v * scene.normals[b] + w * scene.normals[c]
        normal = side * wp.normalize(wp.transform_vector(placing.poses[hit.body], normal))
        openness = hit.u * scene.openness[a] + hit.v * scene.openness[b] + w * scene.openness[c]
        sunshine = (scene.sunshine[a] + scene.sunshine[b] + scene.sunshine[c]) / 3.0
        paint = scene.colors[hit.triangle]
        color = wp.vec3(paint[0], paint[1], paint[2])
        if paint[3] != 1.0:
            seen.surface = hit.body + 2
    point = start + hit.distance * direction + OFFSET * flat
    if hit.body != ROVER:
        openness *= rover_openness(scene, placing.poses[ROVER], point)
    light = openness * wp.lerp(GROUNDLIGHT, SKYLIGHT, 0.5 + 0.5 * normal[2])
    facing = wp.dot(normal, SUN_DIRECTION)
    if facing > 0.0 and wp.dot(flat, SUN_DIRECTION) > 0.0:
        if is_lit(scene, placing, point, sun, sunshine):
            light += facing * SUNLIGHT
    seen.nearness = 1.0 / hit.distance
    # A pixel is longer on ground that is seen at a flat angle.
    seen.width = spread * hit.distance / wp.max(-wp.dot(direction, flat), 0.05)
    seen.color = wp.cw_mul(color, light)
    return seen


@wp.func
def shade(scene: Scene, seen: Seen, start: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """Color of what a ray sees, with the pattern of the ground and haze, ``1 - exp(-(t / t_haze)^2)`` at distance t."""
    haze = sky_color(direction)
    if seen.surface == SKY:
        return haze
    color = seen.color
    distance = 1.0 / seen.nearness
    if seen.surface == GROUND_SURFACE:
        point = start + distance * direction
        color *= ground_pattern(scene.noise, point[0], point[1], seen.width)
    depth = distance / HAZE_DISTANCE
    return wp.lerp(haze, color, wp.exp(-depth * depth))
