"""Warp kernel of the social force model of Helbing and Molnar (1995)."""

from __future__ import annotations

from rover_rl.native.warp import wp
from rover_rl.worlds.movers.motions.walking_kernels import (
    OWN,
    SPEED,
    CourseArrays,
    Crowd,
    Walls,
    finish_step,
    kept_distance,
    step_noise,
    walked,
    wall_at,
    way_to,
)

# Settings of a mover, by index, in the order of the fields of `SocialForce`.
SEES_ROVER = wp.constant(OWN)
RELAXATION = wp.constant(OWN + 1)
STRENGTH = wp.constant(OWN + 2)
REACH = wp.constant(OWN + 3)
WALL_STRENGTH = wp.constant(OWN + 4)
WALL_REACH = wp.constant(OWN + 5)
BEHIND = wp.constant(OWN + 6)
FORESIGHT = wp.constant(OWN + 7)
FLUCTUATION = wp.constant(OWN + 8)

PAPER_RADIUS = wp.constant(0.2)
"""Radius of the people who are points in the paper, m."""
COS_VIEW = wp.constant(-0.1736482)
"""Cosine of 100 degrees, half the angle of sight."""
MAX_FACTOR = wp.constant(1.3)
"""Largest speed, in desired speeds."""
MAX_PUSH = wp.constant(0.1)
"""Largest way by which movers that overlap are pushed apart in a step, m."""
CUT_OFF = wp.constant(10.0)
"""Distance without a force, in ranges of the potential: exp(-10) is 5e-5."""
ROOT_3 = wp.constant(1.7320508)


@wp.func
def repulsion(offset: wp.vec2, stride: wp.vec2, excess: float, strength: float, reach: float) -> wp.vec2:
    """Acceleration by another mover: minus the gradient of ``strength exp(-b / reach)``, m/s^2.

    ``b`` is the minor half-axis of the ellipse through the mover whose foci are where the other one is now and after
    its next step.

    Args:
        offset: from the other mover to this one, m.
        stride: next step of the other one, m.
        excess: by how much the two are larger than in the paper, m.
        strength: potential, m^2/s^2.
        reach: range of the potential, m.
    """
    if wp.length(offset) > CUT_OFF * reach + excess + wp.length(stride):
        return wp.vec2(0.0, 0.0)
    ahead = offset - stride
    near = wp.max(wp.length(offset), 1.0e-4)
    far = wp.max(wp.length(ahead), 1.0e-4)
    both = near + far
    b = 0.5 * wp.sqrt(wp.max(both * both - wp.length_sq(stride), 1.0e-6))
    slope = both / (4.0 * b) * (offset / near + ahead / far)
    return strength / reach * wp.exp(-wp.max(b - excess, 0.0) / reach) * slope


@wp.func
def weight(force: wp.vec2, direction: wp.vec2, behind: float) -> float:
    """Weight of a force of something in sight of the desired direction, or behind."""
    return wp.where(-wp.dot(force, direction) >= COS_VIEW * wp.length(force), 1.0, behind)


@wp.func
def push_apart(offset: wp.vec2, least: float, share: float) -> wp.vec2:
    """Way of a mover that overlaps with another one, whose centers must be ``least`` apart."""
    square = wp.length_sq(offset)
    if square >= least * least:
        return wp.vec2(0.0, 0.0)
    distance = wp.max(wp.sqrt(square), 1.0e-4)
    return (least - distance) * share * offset / distance


@wp.func
def acceleration(crowd: Crowd, walls: Walls, before: CourseArrays, row: int, mover: int, way: wp.vec2) -> wp.vec2:
    """Sum of the forces on a mover whose desired direction is ``way``, m/s^2."""
    point = before.position[row, mover]
    radius = crowd.radius[row, mover]
    strength = crowd.settings[row, mover, STRENGTH]
    reach = crowd.settings[row, mover, REACH]
    behind = crowd.settings[row, mover, BEHIND]
    foresight = crowd.settings[row, mover, FORESIGHT]
    desired = crowd.settings[row, mover, SPEED] * way
    sum = (desired - before.velocity[row, mover]) / crowd.settings[row, mover, RELAXATION]
    for other in range(crowd.present.shape[1]):
        if crowd.present[row, other] and other != mover:
            stride = foresight * before.velocity[row, other]
            excess = radius + crowd.radius[row, other] - 2.0 * PAPER_RADIUS
            force = repulsion(point - before.position[row, other], stride, excess, strength, reach)
            sum += weight(force, way, behind) * force
    if crowd.settings[row, mover, SEES_ROVER] > 0.0:
        for k in range(crowd.rovers.shape[1]):
            stride = foresight * crowd.rover_velocities[row, k]
            excess = radius + crowd.rover_radius - 2.0 * PAPER_RADIUS
            force = repulsion(point - crowd.rovers[row, k], stride, excess, strength, reach)
            sum += weight(force, way, behind) * force
    wall = wall_at(walls, row, point)
    wall_reach = crowd.settings[row, mover, WALL_REACH]
    gap = wp.max(wall[0] - radius + PAPER_RADIUS, 0.0)
    sum += (
        crowd.settings[row, mover, WALL_STRENGTH] / wall_reach * wp.exp(-gap / wall_reach) * wp.vec2(wall[1], wall[2])
    )
    return sum


@wp.kernel
def follow_forces(crowd: Crowd, walls: Walls, before: CourseArrays, after: CourseArrays):
    """Moves movers by one step of the social force model; thread ``(row, mover)``."""
    row, mover = wp.tid()
    if not crowd.mine[row, mover]:
        return
    dt = crowd.dt
    start = before.position[row, mover]
    clock = before.clock[row, mover]
    if clock < 0.0:
        finish_step(crowd, walls, before, after, row, mover, start, clock)
        return
    way = way_to(crowd, walls, row, mover, start, before.goal[row, mover], before.draws[row, mover])
    # Uniform numbers of the standard deviation that is set.
    noise = step_noise(crowd, row, mover)
    sum = acceleration(crowd, walls, before, row, mover, way)
    sum += crowd.settings[row, mover, FLUCTUATION] * 2.0 * ROOT_3 * noise
    velocity = before.velocity[row, mover] + dt * sum
    most = MAX_FACTOR * crowd.settings[row, mover, SPEED]
    velocity = velocity * wp.min(1.0, most / wp.max(wp.length(velocity), 1.0e-6))
    # Contact, where the others will be if they go on.
    next = start + dt * velocity
    radius = crowd.radius[row, mover]
    push = wp.vec2(0.0, 0.0)
    for other in range(crowd.present.shape[1]):
        if crowd.present[row, other] and other != mover:
            share = wp.where(crowd.mine[row, other], 0.5, 1.0)
            offset = next - before.position[row, other] - dt * before.velocity[row, other]
            push += push_apart(offset, radius + crowd.radius[row, other], share)
    if crowd.settings[row, mover, SEES_ROVER] > 0.0:
        for k in range(crowd.rovers.shape[1]):
            offset = next - crowd.rovers[row, k] - dt * crowd.rover_velocities[row, k]
            push += push_apart(offset, radius + crowd.rover_radius, 1.0)
    push = push * wp.min(1.0, MAX_PUSH / wp.max(wp.length(push), 1.0e-6))
    point = walked(walls, row, start, next - start + push, kept_distance(walls, row, radius))
    finish_step(crowd, walls, before, after, row, mover, point, clock)
