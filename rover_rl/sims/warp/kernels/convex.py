"""Narrow phase: penetration of a part of the rover, a box or a wheel, into a convex obstacle.

Method: Minkowski portal refinement (G. Snethen, "XenoCollide: Complex Collision Made Simple", Game Programming Gems 7,
2008). Part A and obstacle B overlap where the origin lies in the Minkowski difference A - B. A ray goes from a point
``v0`` inside A - B through the origin. The triangle of support points (the portal) that it passes through is moved
outward until it lies on the surface of A - B: its normal and distance are the contact normal and the depth.

The point of B behind ``v0`` is just inside the face nearest to the part. The ray then crosses that face, and the result
is close to the direction of least penetration even beside long walls.

Frames: obstacles are given in the world frame; the Minkowski difference, normals and arms are in the body frame (axes
of the base frame, origin at the center of mass). Lengths in m.
"""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.sims.scenes.scene import Scene
from rover_rl.sims.warp.kernels.types import Body, RobotModel

MAX_PORTALS = 24
"""Maximum number of iterations, of the portal's discovery and of its refinement."""
TOLERANCE = 1.0e-4
"""Accuracy of the penetration depth, m."""
INSET = 0.02
"""Depth of the interior point of an obstacle below its nearest face, m."""


@wp.struct
class Overlap:
    """Penetration of a part into an obstacle, in the body frame: its depth (m) is negative without an overlap.

    ``normal`` points from the obstacle to the rover, and ``arm`` is the contact point.
    """

    depth: float
    normal: wp.vec3
    arm: wp.vec3


@wp.struct
class Support:
    """A support point of the Minkowski difference part - obstacle, and the part's point that it comes from (m)."""

    difference: wp.vec3
    arm: wp.vec3


@wp.func
def max_separation_plane(scene: Scene, obstacle: int, point: wp.vec3) -> wp.vec4:
    """Face plane of an obstacle with the greatest signed distance to a world point: unit normal and distance (m).

    The distance is a lower bound of the true distance outside, and minus the depth inside.
    """
    best = wp.vec4(0.0, 0.0, 1.0, -1.0e9)
    for k in range(scene.plane_starts[obstacle], scene.plane_starts[obstacle + 1]):
        plane = scene.planes[k]
        distance = plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] + plane[3]
        if distance > best[3]:
            best = wp.vec4(plane[0], plane[1], plane[2], distance)
    return best


@wp.func
def is_near(scene: Scene, obstacle: int, point: wp.vec3, radius: float) -> bool:
    """Conservative test whether an obstacle is within ``radius`` (m) of a world point: bounding sphere, then planes."""
    sphere = scene.spheres[obstacle]
    reach = sphere[3] + radius
    if wp.length_sq(wp.vec3(sphere[0], sphere[1], sphere[2]) - point) > reach * reach:
        return False
    return max_separation_plane(scene, obstacle, point)[3] < radius


@wp.func
def part_center(model: RobotModel, part: int) -> wp.vec3:
    """Center of a part in the base frame. Parts are numbered with the chassis boxes first, then the wheels."""
    boxes = model.box_centers.shape[0]
    if part < boxes:
        return model.box_centers[part]
    return model.hubs[part - boxes]


@wp.func
def part_radius(model: RobotModel, part: int) -> float:
    """Radius of the bounding sphere of a part, m."""
    if part < model.box_centers.shape[0]:
        return wp.length(model.box_halves[part])
    return wp.sqrt(model.wheel_radius * model.wheel_radius + model.wheel_half_width * model.wheel_half_width)


@wp.func
def is_straight(axle: wp.vec3) -> bool:
    """Whether a wheel points ahead. Most do, and the branch saves a sixth of the time of a step."""
    return axle[1] == 1.0


@wp.func
def part_support(model: RobotModel, part: int, axle: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """Support point of a part, the point farthest along ``direction``, in the base frame.

    It is a corner of a box. A wheel, a cylinder of radius r and width w about its axle, a horizontal unit vector a, has
    it on the rim of an end face: ``hub + r p / |p| + sign(d . a) a w / 2`` with ``p = d - (d . a) a``.
    """
    boxes = model.box_centers.shape[0]
    if part < boxes:
        half = model.box_halves[part]
        return model.box_centers[part] + wp.vec3(
            wp.where(direction[0] < 0.0, -half[0], half[0]),
            wp.where(direction[1] < 0.0, -half[1], half[1]),
            wp.where(direction[2] < 0.0, -half[2], half[2]),
        )
    if is_straight(axle):
        radial = wp.sqrt(direction[0] * direction[0] + direction[2] * direction[2])
        scale = model.wheel_radius / wp.max(radial, 1.0e-9)
        width = wp.where(direction[1] < 0.0, -model.wheel_half_width, model.wheel_half_width)
        return model.hubs[part - boxes] + wp.vec3(direction[0] * scale, width, direction[2] * scale)
    along = wp.dot(direction, axle)
    across = direction - along * axle
    scale = model.wheel_radius / wp.max(wp.length(across), 1.0e-9)
    width = wp.where(along < 0.0, -model.wheel_half_width, model.wheel_half_width)
    return model.hubs[part - boxes] + scale * across + width * axle


@wp.func
def support(
    scene: Scene, model: RobotModel, body: Body, part: int, axle: wp.vec3, obstacle: int, direction: wp.vec3
) -> Support:
    """Support point of the Minkowski difference along ``direction``, in the body frame: ``s_A(d) - s_B(-d)``.

    The obstacle's vertices are compared in the world frame, and only the one chosen is transformed.
    """
    point = Support()
    point.arm = part_support(model, part, axle, direction) - body.center
    world_direction = body.rotation * direction
    start = scene.vertex_starts[obstacle]
    best = scene.vertices[start]
    least = wp.dot(best, world_direction)
    for k in range(start + 1, scene.vertex_starts[obstacle + 1]):
        vertex = scene.vertices[k]
        value = wp.dot(vertex, world_direction)
        if value < least:
            least = value
            best = vertex
    point.difference = point.arm - wp.transpose(body.rotation) * (best - body.position)
    return point


@wp.func
def interior_point(scene: Scene, obstacle: int, point: wp.vec3) -> wp.vec3:
    """A point inside an obstacle close to ``point``, in the world frame.

    Projects the point to ``INSET`` below the face it is farthest outside of, and repeats for obstacles with edges.
    """
    for _ in range(6):
        plane = max_separation_plane(scene, obstacle, point)
        if plane[3] > -0.5 * INSET:
            point = point - (plane[3] + INSET) * wp.vec3(plane[0], plane[1], plane[2])
    return point


@wp.func
def find_overlap(scene: Scene, model: RobotModel, body: Body, part: int, axle: wp.vec3, obstacle: int) -> Overlap:
    """Penetration of a part, which has the axle if it is a wheel, into an obstacle."""
    result = Overlap()
    result.depth = -1.0
    # v0: a point inside part - obstacle, where the ray to the origin begins.
    part_arm = part_center(model, part) - body.center
    part_position = body.position + body.rotation * part_arm
    inner = interior_point(scene, obstacle, part_position)
    v0 = wp.transpose(body.rotation) * (part_position - inner)
    if wp.length_sq(v0) < 1.0e-8:
        # The part's center is the interior point itself: leave through the nearest face.
        plane = max_separation_plane(scene, obstacle, part_position)
        v0 = wp.transpose(body.rotation) * wp.vec3(plane[0], plane[1], plane[2]) * 1.0e-3

    # First support point, toward the origin. A support point that does not pass the origin separates the two shapes.
    v1 = support(scene, model, body, part, axle, obstacle, -v0)
    if wp.dot(v1.difference, v0) >= 0.0:
        return result
    n = wp.cross(v1.difference, v0)
    if wp.length_sq(n) < 1.0e-12:
        # v0, the origin and v1 are collinear: the surface point is v1.
        n = wp.normalize(-v0)
        result.depth = wp.dot(v1.difference, n)
        result.normal = -n
        result.arm = v1.arm
        return result
    # Second support point, perpendicular to the plane of v0, v1 and the origin.
    v2 = support(scene, model, body, part, axle, obstacle, n)
    if wp.dot(v2.difference, n) <= 0.0:
        return result
    # Orient the portal so that its normal points away from v0.
    n = wp.cross(v1.difference - v0, v2.difference - v0)
    if wp.dot(n, v0) > 0.0:
        swap = v1
        v1 = v2
        v2 = swap
        n = -n

    # Portal discovery: find a triangle (v1, v2, v3) that the ray from v0 through the origin passes through.
    v3 = support(scene, model, body, part, axle, obstacle, n)
    # 0: no portal yet, 1: a portal, 2: a portal on the surface.
    stage = int(0)
    for _ in range(MAX_PORTALS):
        if stage == 0:
            if wp.dot(v3.difference, n) <= 0.0:
                return result
            if wp.dot(wp.cross(v1.difference, v3.difference), v0) < 0.0:
                # The origin is outside the plane (v0, v1, v3): drop v2.
                v2 = v3
                n = wp.cross(v1.difference - v0, v3.difference - v0)
                v3 = support(scene, model, body, part, axle, obstacle, n)
            elif wp.dot(wp.cross(v3.difference, v2.difference), v0) < 0.0:
                # The origin is outside the plane (v0, v3, v2): drop v1.
                v1 = v3
                n = wp.cross(v3.difference - v0, v2.difference - v0)
                v3 = support(scene, model, body, part, axle, obstacle, n)
            else:
                stage = 1
    if stage == 0:
        return result

    # Portal refinement: move the triangle outward until it lies on the surface of the Minkowski difference.
    for _ in range(MAX_PORTALS):
        if stage == 1:
            n = wp.normalize(wp.cross(v2.difference - v1.difference, v3.difference - v1.difference))
            v4 = support(scene, model, body, part, axle, obstacle, n)
            beyond = wp.dot(v4.difference, n)
            if beyond <= 0.0:
                # The support plane separates the origin from A - B: no overlap.
                return result
            if beyond - wp.dot(v3.difference, n) <= TOLERANCE:
                stage = 2
            else:
                # The plane through v0, v4 and the origin tells which of the three new triangles the ray passes.
                side = wp.cross(v4.difference, v0)
                if wp.dot(v1.difference, side) > 0.0:
                    if wp.dot(v2.difference, side) > 0.0:
                        v1 = v4
                    else:
                        v3 = v4
                elif wp.dot(v3.difference, side) > 0.0:
                    v2 = v4
                else:
                    v1 = v4
    result.depth = wp.dot(v1.difference, n)
    result.normal = -n
    # Contact point: the origin projected on the portal has barycentric coordinates a, b, c; the same combination of the
    # part's support points is the contact on the part.
    a = wp.max(wp.dot(wp.cross(v2.difference, v3.difference), n), 0.0)
    b = wp.max(wp.dot(wp.cross(v3.difference, v1.difference), n), 0.0)
    c = wp.max(wp.dot(wp.cross(v1.difference, v2.difference), n), 0.0)
    total = wp.max(a + b + c, 1.0e-12)
    result.arm = (a * v1.arm + b * v2.arm + c * v3.arm) / total
    return result
