"""Where a part of a rover, a box or a wheel, gets into a convex obstacle.

By Minkowski portal refinement (G. Snethen, "XenoCollide: complex collision made simple", Game Programming Gems 7,
2008): the direction in which the two overlap least, looked for from a point of each on the line between them. The line
is taken across the face of the obstacle that the part is before, so that the direction found is that of least overlap
also beside long walls.
"""

from __future__ import annotations

from rover_rl.sims.warp.kernels.types import Rover, Scene
from rover_rl.sims.warp.library import wp

PORTALS = 24
"""Portals tried at most."""
TOLERANCE = 1.0e-4
"""Metres to which a depth is found."""
INSET = 0.02
"""Depth (m) of the point within an obstacle that is looked from."""


@wp.struct
class Overlap:
    """How far a part is within an obstacle.

    ``depth`` (m) is negative without an overlap; ``normal`` points from the obstacle to the rover, ``arm`` from its
    centre of mass to the contact, both in its frame.
    """

    depth: float
    normal: wp.vec3
    arm: wp.vec3


@wp.struct
class Support:
    """A point of the difference of two shapes, and the rover's point in it."""

    difference: wp.vec3
    arm: wp.vec3


@wp.func
def foremost_plane(scene: Scene, obstacle: int, point: wp.vec3) -> wp.vec4:
    """The plane of an obstacle that a point is farthest outside of: its normal, and the distance (m)."""
    best = wp.vec4(0.0, 0.0, 1.0, -1.0e9)
    for k in range(scene.plane_starts[obstacle], scene.plane_starts[obstacle + 1]):
        plane = scene.planes[k]
        distance = plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] + plane[3]
        if distance > best[3]:
            best = wp.vec4(plane[0], plane[1], plane[2], distance)
    return best


@wp.func
def is_near(scene: Scene, obstacle: int, point: wp.vec3, radius: float) -> bool:
    """Whether an obstacle may be within ``radius`` of a point: first by the sphere around it, then by its planes."""
    sphere = scene.spheres[obstacle]
    reach = sphere[3] + radius
    if wp.length_sq(wp.vec3(sphere[0], sphere[1], sphere[2]) - point) > reach * reach:
        return False
    return foremost_plane(scene, obstacle, point)[3] < radius


@wp.func
def part_center(rover: Rover, part: int) -> wp.vec3:
    """Middle of a part in the base frame: boxes of the chassis come first, then wheels."""
    boxes = rover.box_centers.shape[0]
    if part < boxes:
        return rover.box_centers[part]
    return rover.hubs[part - boxes]


@wp.func
def part_radius(rover: Rover, part: int) -> float:
    """Radius (m) of the sphere around a part."""
    if part < rover.box_centers.shape[0]:
        return wp.length(rover.box_halves[part])
    return wp.sqrt(rover.wheel_radius * rover.wheel_radius + rover.wheel_half_width * rover.wheel_half_width)


@wp.func
def part_support(rover: Rover, part: int, direction: wp.vec3) -> wp.vec3:
    """The point of a part that is farthest in ``direction``, in the base frame."""
    boxes = rover.box_centers.shape[0]
    if part < boxes:
        half = rover.box_halves[part]
        return rover.box_centers[part] + wp.vec3(
            wp.where(direction[0] < 0.0, -half[0], half[0]),
            wp.where(direction[1] < 0.0, -half[1], half[1]),
            wp.where(direction[2] < 0.0, -half[2], half[2]),
        )
    across = wp.sqrt(direction[0] * direction[0] + direction[2] * direction[2])
    scale = rover.wheel_radius / wp.max(across, 1.0e-9)
    width = wp.where(direction[1] < 0.0, -rover.wheel_half_width, rover.wheel_half_width)
    return rover.hubs[part - boxes] + wp.vec3(direction[0] * scale, width, direction[2] * scale)


@wp.func
def support(
    scene: Scene,
    rover: Rover,
    center: wp.vec3,
    position: wp.vec3,
    rotation: wp.mat33,
    part: int,
    obstacle: int,
    direction: wp.vec3,
) -> Support:
    """The point of part minus obstacle that is farthest in ``direction``, in the rover's frame."""
    point = Support()
    point.arm = part_support(rover, part, direction) - center
    back = rotation * direction
    start = scene.vertex_starts[obstacle]
    best = scene.vertices[start]
    least = wp.dot(best, back)
    for k in range(start + 1, scene.vertex_starts[obstacle + 1]):
        vertex = scene.vertices[k]
        value = wp.dot(vertex, back)
        if value < least:
            least = value
            best = vertex
    point.difference = point.arm - wp.transpose(rotation) * (best - position)
    return point


@wp.func
def point_within(scene: Scene, obstacle: int, point: wp.vec3) -> wp.vec3:
    """A point inside of an obstacle near ``point``."""
    for _ in range(6):
        plane = foremost_plane(scene, obstacle, point)
        if plane[3] > -0.5 * INSET:
            point = point - (plane[3] + INSET) * wp.vec3(plane[0], plane[1], plane[2])
    return point


@wp.func
def overlap(
    scene: Scene, rover: Rover, center: wp.vec3, position: wp.vec3, rotation: wp.mat33, part: int, obstacle: int
) -> Overlap:
    """How far ``part`` of the rover at ``position`` (of its centre of mass) is within ``obstacle``."""
    result = Overlap()
    result.depth = -1.0
    middle = part_center(rover, part) - center
    away = position + rotation * middle
    inner = point_within(scene, obstacle, away)
    v0 = wp.transpose(rotation) * (away - inner)
    if wp.length_sq(v0) < 1.0e-8:
        plane = foremost_plane(scene, obstacle, away)
        v0 = wp.transpose(rotation) * wp.vec3(plane[0], plane[1], plane[2]) * 1.0e-3

    one = support(scene, rover, center, position, rotation, part, obstacle, -v0)
    if wp.dot(one.difference, v0) >= 0.0:
        return result
    n = wp.cross(one.difference, v0)
    if wp.length_sq(n) < 1.0e-12:
        # The nearest point is straight ahead.
        n = wp.normalize(-v0)
        result.depth = wp.dot(one.difference, n)
        result.normal = -n
        result.arm = one.arm
        return result
    two = support(scene, rover, center, position, rotation, part, obstacle, n)
    if wp.dot(two.difference, n) <= 0.0:
        return result
    n = wp.cross(one.difference - v0, two.difference - v0)
    if wp.dot(n, v0) > 0.0:
        swap = one
        one = two
        two = swap
        n = -n

    # A triangle that the ray from v0 through the origin goes through.
    three = support(scene, rover, center, position, rotation, part, obstacle, n)
    found = int(0)
    for _ in range(PORTALS):
        if found == 0:
            if wp.dot(three.difference, n) <= 0.0:
                return result
            if wp.dot(wp.cross(one.difference, three.difference), v0) < 0.0:
                two = three
                n = wp.cross(one.difference - v0, three.difference - v0)
                three = support(scene, rover, center, position, rotation, part, obstacle, n)
            elif wp.dot(wp.cross(three.difference, two.difference), v0) < 0.0:
                one = three
                n = wp.cross(three.difference - v0, two.difference - v0)
                three = support(scene, rover, center, position, rotation, part, obstacle, n)
            else:
                found = 1
    if found == 0:
        return result

    # The triangle is moved outwards until it lies on the surface.
    for _ in range(PORTALS):
        if found == 1:
            n = wp.normalize(wp.cross(two.difference - one.difference, three.difference - one.difference))
            four = support(scene, rover, center, position, rotation, part, obstacle, n)
            beyond = wp.dot(four.difference, n)
            if beyond <= 0.0:
                return result
            if beyond - wp.dot(three.difference, n) <= TOLERANCE:
                found = 2
            else:
                side = wp.cross(four.difference, v0)
                if wp.dot(one.difference, side) > 0.0:
                    if wp.dot(two.difference, side) > 0.0:
                        one = four
                    else:
                        three = four
                elif wp.dot(three.difference, side) > 0.0:
                    two = four
                else:
                    one = four
    result.depth = wp.dot(one.difference, n)
    result.normal = -n
    # The contact is where the origin lies on the triangle.
    a = wp.max(wp.dot(wp.cross(two.difference, three.difference), n), 0.0)
    b = wp.max(wp.dot(wp.cross(three.difference, one.difference), n), 0.0)
    c = wp.max(wp.dot(wp.cross(one.difference, two.difference), n), 0.0)
    total = wp.max(a + b + c, 1.0e-12)
    result.arm = (a * one.arm + b * two.arm + c * three.arm) / total
    return result
