"""Worlds in which people and obstacles move: plaza, corridor, crossing, field, yard; and walkers in any world.

A ``scale`` is a factor of the lengths, for larger robots. What moves stays as large as it is.

The walking speed of people is 1.34 +- 0.26 m/s (U. Weidmann, "Transporttechnik der Fussgaenger", ETH Zurich, 1993).
Here, it rises with the difficulty to that. The numbers and speeds of the field span those of the DynaBARN worlds, 5 to
24 cylinders with a radius of 0.5 m and 0.5 to 1.95 m/s, and the moving boxes of ros_jackal, 10 to 14 of 0.5 to 1.5 m/s
(Z. Xu et al., "Benchmarking reinforcement learning techniques for autonomous navigation", ICRA 2023).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rover_rl.worlds.generators.layouts import DEFAULT, enclosing_walls, raised, scaled, square
from rover_rl.worlds.movers import Box, Cross, Cylinder, Motion, Mover, Person, SocialForce, Wander, Waypoints
from rover_rl.worlds.region import Area, union
from rover_rl.worlds.solids import Solids, boxes, cylinders
from rover_rl.worlds.terrain import Terrain
from rover_rl.worlds.world import World

HEIGHTS = (1.55, 1.95)
"""Least and greatest height of a person, m."""
PACE, SPREAD = (0.6, 1.0, 1.34), 0.26
"""Mean walking speed at difficulty 0, 0.5 and 1, and its standard deviation, m/s."""
WALKERS = (0.02, 0.05, 0.10)
"""Walkers per square meter of the ground on which episodes start and end, at difficulty 0, 0.5 and 1."""
MOST_WALKERS = 64
"""Maximum number of walkers that are added to a world."""
PLAZA, PLAZA_PEOPLE = 16.0, (6, 12, 24)
"""Side of the plaza, m, and number of people on it."""
LENGTH, WIDTH, CORRIDOR_PEOPLE = 20.0, 4.0, (3, 6, 10)
"""Length and width of the corridor, m, and number of people in it."""
ARM, CROSSING_PEOPLE = 4.0, (4, 8, 16)
"""Width of the ways that cross, m, and number of people on them."""
FIELD, FIELD_MOVERS, FIELD_SPEEDS = 20.0, (5, 14, 24), ((0.4, 0.9), (0.5, 1.45), (0.8, 1.95))
"""Side of the field, m, number of obstacles that move in it, and their least and greatest speed, m/s."""
YARD_MOVERS, YARD_SPEEDS, YARD_RADIUS = (5, 15, 24), ((0.5, 0.95), (1.0, 1.45), (1.5, 1.95)), 0.5
"""Number of cylinders in a yard, their least and greatest speed, m/s, and their radius, m."""
CORNERS = (3, 6)
"""Least and greatest number of corners of a cylinder's path."""
WALL, HEIGHT = 0.2, 2.0
"""Thickness and height of walls, m."""


def with_walkers(world: World, seed: int = 0, difficulty: float = DEFAULT) -> World:
    """Returns a world in which people walk around.

    Args:
        world: any world.
        seed: seed of their speeds and heights.
        difficulty: difficulty in [0, 1]: the number and the speed of the people. At 0.5, there is one for each 20
            square meters of the ground on which episodes start and end, and they walk at 1 m/s. There is
            at least one, with a warning on less than 5 square meters.

    Raises:
        ValueError: if the difficulty is not in [0, 1].

    Example:
        >>> from rover_rl.worlds import get_world
        >>> len(with_walkers(get_world("maze")).movers), len(get_world("maze+walkers").movers)
        (3, 3)
    """
    rng, area, ground = (
        np.random.default_rng((seed, 1)),
        union(world.spawn_range, world.goal_range),
        ground_of_episodes(world),
    )
    count = min(max(round(ground * scaled(difficulty, *WALKERS)), 1), MOST_WALKERS)
    if 2 * WALKERS[-1] * ground < count == 1:
        warnings.warn(f"{world.name}+walkers: a person on {ground:.1f} m^2 of ground leaves no way past", stacklevel=2)
    walkers = _people(rng, difficulty, count, lambda number, speed: Wander(speed, area=area), "walker")
    return replace(world, name=f"{world.name}+walkers", movers=(*world.movers, *walkers))


def ground_of_episodes(world: World) -> float:
    """Returns the size of the ground on which episodes start and end, m^2: that of the regions, else of the areas."""
    (left, right), (bottom, top) = union(world.spawn_range, world.goal_range)
    # Both may be the same, or not.
    regions = {(region.origin, region.area) for region in (world.spawn_region, world.goal_region) if region}
    return sum(area for _, area in regions) or (right - left) * (top - bottom)


def plaza(seed: int = 0, difficulty: float = DEFAULT, scale: float = 1.0) -> World:
    """Creates a plaza with some columns and planters, which people cross from edge to edge.

    With the difficulty, there are 6, 12 (at 0.5) and 24 people, who walk at 0.6 to 1.34 m/s on average.
    """
    rng = np.random.default_rng(seed)
    side, rim, edge = round(PLAZA * scale, 1), 0.5 * scale, 1.5 * scale
    half = side / 2
    low, high, along = (-half + rim, -half + edge), (half - edge, half - rim), (-half + rim, half - rim)
    edges: list[Area] = [(low, along), (high, along), (along, low), (along, high)]

    def across(number: int, speed: float) -> SocialForce:
        start, goal = rng.permutation(4)[:2]
        return SocialForce(speed, edges[start], edges[goal])

    movers = _people(rng, difficulty, round(scaled(difficulty, *PLAZA_PEOPLE)), across)
    # Columns and planters on a jittered grid, so that wide ways lead between them.
    spots = np.array([(x, y) for x in (-4.0, 0.0, 4.0) for y in (-4.0, 0.0, 4.0)]) + rng.uniform(-0.8, 0.8, (9, 2))
    spots = scale * spots[rng.permutation(9)[:5]]
    columns = cylinders(raised(spots[:3], 1.0), rng.uniform(0.15, 0.3, 3), 2.0, 16)
    planters = boxes(raised(spots[3:], 0.3), np.column_stack((rng.uniform(0.6, 1.6, (2, 2)), (0.6, 0.6))))
    obstacles = enclosing_walls(side), columns, planters
    return World("plaza", Terrain.flat((side, side)), obstacles, square(half - 2 * scale), movers=movers)


def corridor(seed: int = 0, difficulty: float = DEFAULT, scale: float = 1.0) -> World:
    """Creates a corridor along x in which people come towards the rover, and some walk its way.

    Episodes start at the western end, and goals are at the eastern one. With the difficulty, there are 3, 6 (at 0.5)
    and 10 people, who walk at 0.6 to 1.34 m/s on average.
    """
    rng = np.random.default_rng(seed)
    length, width = round(LENGTH * scale, 1), round(WIDTH * scale, 1)
    half, side, rim, end = length / 2, width / 2 - 0.4 * scale, 0.5 * scale, 3 * scale
    across = (-side, side)
    west, east = ((-half + rim, -half + end), across), ((half - end, half - rim), across)
    middle: Area = ((-half + 2 * end, half - rim), across)

    def along(number: int, speed: float) -> SocialForce:
        return SocialForce(speed, middle, east if number % 4 == 3 else west)

    movers = _people(rng, difficulty, round(scaled(difficulty, *CORRIDOR_PEOPLE)), along)
    walls = boxes([(0, y, HEIGHT / 2) for y in (-(width + WALL) / 2, (width + WALL) / 2)], (length, WALL, HEIGHT))
    spawn, goal = ((-half + scale, -half + end), across), ((half - end, half - scale), across)
    return World("corridor", Terrain.flat((length, width)), walls, spawn, goal, movers=movers)


def crossing(seed: int = 0, difficulty: float = DEFAULT, scale: float = 1.0) -> World:
    """Creates two ways that cross. The rover goes along one, and people walk back and forth along the other.

    With the difficulty, there are 4, 8 (at 0.5) and 16 people, who walk at 0.6 to 1.34 m/s on average.
    """
    rng = np.random.default_rng(seed)
    length, rim, end = round(PLAZA * scale, 1), 0.5 * scale, 3 * scale
    half, arm = length / 2, ARM * scale / 2
    across = (-arm + 0.4 * scale, arm - 0.4 * scale)
    ends: list[Area] = [(across, (-half + rim, -half + end)), (across, (half - end, half - rim))]

    def back_and_forth(number: int, speed: float) -> Cross:
        return Cross(speed, ends[number % 2], ends[1 - number % 2])

    movers = _people(rng, difficulty, round(scaled(difficulty, *CROSSING_PEOPLE)), back_and_forth)
    block, middle = half - arm, (half + arm) / 2
    corners = [(x, y, HEIGHT / 2) for x in (-middle, middle) for y in (-middle, middle)]
    obstacles = enclosing_walls(length), boxes(corners, (block, block, HEIGHT))
    spawn, goal = ((-half + scale, -half + end), across), ((half - end, half - scale), across)
    return World("crossing", Terrain.flat((length, length)), obstacles, spawn, goal, movers=movers)


def field(seed: int = 0, difficulty: float = DEFAULT, scale: float = 1.0) -> World:
    """Creates an open field within walls, in which cylinders and boxes move fast, and a tenth of them rests.

    With the difficulty, there are 5, 14 (at 0.5) and 24 obstacles of 0.4 to 1.95 m/s.
    """
    rng = np.random.default_rng(seed)
    low, high = (scaled(difficulty, *ends) for ends in zip(*FIELD_SPEEDS, strict=True))
    side = round(FIELD * scale, 1)
    half = side / 2
    reach, inner = half - 2 * scale, square(half - 0.7 * scale)
    movers, rest = [], list[Solids]()
    for number in range(round(scaled(difficulty, *FIELD_MOVERS))):
        length, width = rng.uniform(0.3, 1.0, 2).round(2).tolist()
        shape = Cylinder(length / 2, 1.0) if rng.random() < 0.7 else Box(length, width, 1.0)
        speed, turn_time = round(rng.uniform(low, high), 3), round(rng.uniform(2.0, 8.0), 1)
        if number % 10 == 9:
            rest.append(cylinders(raised(rng.uniform(-reach, reach, (1, 2)), 0.5), length / 2, 1.0, 16))
        else:
            movers.append(Mover(Wander(speed, turn_time, inner), shape, f"obstacle {number}"))
    obstacles = enclosing_walls(side), *rest
    return World("field", Terrain.flat((side, side)), obstacles, square(half - scale), movers=movers)


def yard(seed: int = 0, difficulty: float = DEFAULT, scale: float = 1.0) -> World:
    """Creates a yard within walls, in which cylinders go round closed paths with corners, again and again.

    With the difficulty, there are 5, 15 (at 0.5) and 24 cylinders. At 0, 0.5 and 1, their speeds are those of
    DynaBARN's easy (0.5 to 0.95 m/s), medium (1 to 1.45) and hard worlds (1.5 to 1.95).
    """
    rng = np.random.default_rng(seed)
    low, high = (scaled(difficulty, *ends) for ends in zip(*YARD_SPEEDS, strict=True))
    side = round(FIELD * scale, 1)
    reach = side / 2 - scale
    movers = []
    for number in range(round(scaled(difficulty, *YARD_MOVERS))):
        corners = rng.uniform(-reach, reach, (rng.integers(CORNERS[0], CORNERS[1] + 1), 2)).round(2)
        path = Waypoints(_round_trip(corners, round(rng.uniform(low, high), 3)), "loop", random_start=True)
        movers.append(Mover(path, Cylinder(YARD_RADIUS, 1.0), f"cylinder {number}"))
    return World("yard", Terrain.flat((side, side)), enclosing_walls(side), square(reach), movers=movers)


def _round_trip(corners: np.ndarray, speed: float) -> list[tuple[float, float, float, float]]:
    """Keyframes of a closed path through corners ``[n, 2]`` (m) at a speed (m/s)."""
    path = np.vstack((corners, corners[:1]))
    steps = np.diff(path, axis=0)
    times = np.concatenate(([0.0], np.cumsum(np.linalg.norm(steps, axis=1) / speed)))
    yaws = np.arctan2(steps[:, 1], steps[:, 0])
    keys = np.column_stack((times, path, np.append(yaws, yaws[0]))).round(3)
    return [(time, x, y, yaw) for time, x, y, yaw in keys.tolist()]


def _people(
    rng: np.random.Generator,
    difficulty: float,
    count: int,
    motion: Callable[[int, float], Motion],
    name: str = "person",
) -> list[Mover]:
    """Draws people. ``motion`` gets the number of a person and the walking speed, m/s."""
    pace = scaled(difficulty, *PACE)
    speeds = np.clip(rng.normal(pace, SPREAD * pace / PACE[-1], count), 0.3, 2.0).round(3).tolist()
    heights = rng.uniform(*HEIGHTS, count).round(2).tolist()
    people = enumerate(zip(speeds, heights, strict=True))
    return [Mover(motion(number, speed), Person(height), f"{name} {number}") for number, (speed, height) in people]
