"""What kernels are told about a world, a robot, and the state of its rovers."""

from __future__ import annotations

from rover_rl.sims.warp.library import wp

MAX_WHEELS = 6
"""Wheels that a rover may have: the size of what a thread keeps for them."""


@wp.struct
class Scene:
    """A world: ground heights on a grid, and convex obstacles as planes, corners and polygons.

    Lists of lists are flat, with the start of each entry and the end of the last in ``..._starts``.
    """

    # Ground: heights [rows, columns] (m), its first corner, and the spacing.
    heights: wp.array2d[float]
    corner: wp.vec2
    cell: float
    # Blocks of ``block`` x ``block`` cells: slopes of a plane, and its least and greatest height at the block's middle
    # with all of the block's ground between.
    blocks: wp.array2d[wp.vec4]
    block: int
    # Obstacles: outward planes (a point p is inside where n . p + w < 0), corners, and the sphere around them.
    planes: wp.array[wp.vec4]
    plane_starts: wp.array[int]
    vertices: wp.array[wp.vec3]
    vertex_starts: wp.array[int]
    spheres: wp.array[wp.vec4]
    # The polygon of each plane: corners in order, counter-clockwise from outside, and the sphere around them.
    polygons: wp.array[wp.vec3]
    polygon_starts: wp.array[int]
    polygon_spheres: wp.array[wp.vec4]
    # Obstacles within reach of a rover whose centre is in a cell of this grid.
    near_corner: wp.vec2
    near_cell: float
    near_columns: int
    near_rows: int
    near_starts: wp.array[int]
    near: wp.array[int]


@wp.struct
class Rover:
    """A robot: what all rovers have in common. Positions (m) are in its base frame."""

    wheels: int
    # Those of the left side come first.
    left_wheels: int
    wheel_radius: float
    wheel_half_width: float
    wheel_inertia: float
    hubs: wp.array[wp.vec3]
    # The chassis: boxes along the axes of the base frame, and points on them that may touch the ground.
    box_centers: wp.array[wp.vec3]
    box_halves: wp.array[wp.vec3]
    points: wp.array[wp.vec3]
    # No part of the rover is farther from its centre of mass than this, whatever its chassis weighs.
    reach: float
    lidar: wp.vec3
    lidar_range: float


@wp.struct
class Solver:
    """Numbers of the physics."""

    dt: float
    substeps: int
    iterations: int
    # A contact yields: share of a penetration that a substep takes away, velocity for each unit of impulse, and the
    # greatest speed (m/s) at which a penetration is taken away.
    correction: float
    softness: float
    max_correction: float
    # Gap (m) from which on a wheel's contact is of no interest.
    margin: float
    ground_friction: float
    obstacle_friction: float


@wp.struct
class Rovers:
    """The state of all rovers, a row each, and what sets them apart. Vectors are in the world's frame."""

    # Of the centre of mass.
    position: wp.array[wp.vec3]
    orientation: wp.array[wp.quat]
    velocity: wp.array[wp.vec3]
    angular_velocity: wp.array[wp.vec3]
    # Of each wheel about its axle, as seen from the world, rad/s.
    spins: wp.array2d[float]
    # What the solver begins with: impulses of the last substep.
    impulses: wp.array2d[float]
    # Mass (kg), centre of mass in the base frame, inertia about it without the wheels' about their axles, its inverse.
    mass: wp.array[float]
    center: wp.array[wp.vec3]
    inertia: wp.array[wp.mat33]
    inverse_inertia: wp.array[wp.mat33]
    # Factor of all friction, and the most torque of a wheel's motor, N m.
    grip: wp.array[float]
    torque: wp.array[float]
    # Wheel speeds to hold, left and right (rad/s), and whether time passes.
    speeds: wp.array[wp.vec2]
    active: wp.array[wp.bool]
    # For the task: position and orientation of the base frame, and mean speed of the left and right wheels.
    body: wp.array2d[float]
    ranges: wp.array2d[float]
