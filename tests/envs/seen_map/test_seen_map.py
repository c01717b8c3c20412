"""Maps of what the lidar has seen, and the routes on them, in worlds of walls that are drawn by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from tensordict import TensorDict
from torch import Tensor

from rover_rl.envs.config import LidarConfig
from rover_rl.envs.seen_map import seen_map
from rover_rl.envs.seen_map.scans import reading_angles
from rover_rl.envs.seen_map.seen_map import SeenMap
from rover_rl.robots import Robot, get_robot
from rover_rl.robots.fleet import Fleet

LIDAR = LidarConfig(points=128, beams=128)
CENTERED = replace(get_robot("rover_zero"), lidar_position=(0.0, 0.0, 0.3))
CELL = 0.15
Wall = tuple[float, float, float, float]
"""Ends x, y, x, y of a wall, m."""
U_SHAPE: tuple[Wall, ...] = ((2.0, -2.0, 2.0, 2.0), (-1.0, 2.0, 2.0, 2.0), (-1.0, -2.0, 2.0, -2.0))
"""A dead end that opens to -x."""


def ranges(position: tuple[float, float], yaw: float, walls: tuple[Wall, ...], points: int = 128) -> Tensor:
    """Readings of a lidar, by intersecting each beam with each wall."""
    angles = yaw + torch.arange(points, dtype=torch.float64) * (2 * math.pi / points)
    beams = torch.stack((angles.cos(), angles.sin()), -1)
    readings = torch.full((points,), LIDAR.max_range, dtype=torch.float64)
    for x0, y0, x1, y1 in walls:
        first = torch.tensor((x0 - position[0], y0 - position[1]), dtype=torch.float64)
        along = torch.tensor((x1 - x0, y1 - y0), dtype=torch.float64)
        across = beams[:, 0] * along[1] - beams[:, 1] * along[0]
        distance = (first[0] * along[1] - first[1] * along[0]) / across
        share = (first[0] * beams[:, 1] - first[1] * beams[:, 0]) / across
        hit = (distance > 0) & (share >= 0) & (share <= 1)
        readings = torch.where(hit, torch.minimum(readings, distance), readings)
    return readings.float()


def observed(
    position: tuple[float, float],
    goal: tuple[float, float],
    walls: tuple[Wall, ...] = (),
    yaw: float = 0.0,
    pitch: float = 0.0,
    z: float = 0.0,
) -> TensorDict:
    """The observation of one rover."""
    offset = goal[0] - position[0], goal[1] - position[1]
    bearing = math.remainder(math.atan2(offset[1], offset[0]) - yaw, 2 * math.pi)
    entries = {
        "lidar": ranges(position, yaw, walls)[None],
        "pose": torch.tensor([[*position, z]]),
        "imu": torch.tensor([[pitch, 0.0, yaw]]),
        "target": torch.tensor([[math.hypot(*offset), bearing]]),
    }
    return TensorDict(entries, batch_size=[1])


def fleet(rows: int, robot: str | Robot = CENTERED) -> Fleet:
    return Fleet.of(get_robot(robot), rows)


def one_map(robot: str | Robot = CENTERED) -> SeenMap:
    return SeenMap(fleet(1, robot), LIDAR)


def is_occupied(seen: SeenMap, x: float, y: float) -> bool:
    return level_at(seen, x, y) == 0


def level_at(seen: SeenMap, x: float, y: float) -> int:
    levels, origin = seen.levels()
    column, row = ((value - low) / CELL for value, low in zip((x, y), origin[0].tolist(), strict=True))
    return int(levels[0, math.floor(row), math.floor(column)])


def test_without_obstacles_the_route_leads_straight_to_the_goal() -> None:
    route = one_map()(observed((0.0, 0.0), (3.0, 4.0), yaw=0.4))[0]
    bearing = math.atan2(4.0, 3.0) - 0.4
    torch.testing.assert_close(route[:4], torch.tensor([5.0, bearing, 5.0, bearing]))
    # Steps in eight directions are at most 8 % longer than the straight line, and a cell is 0.15 m.
    assert 5.0 - 0.3 < route[4] < 5.0 * 1.083 + 0.3
    # To a goal beyond the window, it leads towards its edge.
    route = one_map()(observed((0.0, 0.0), (30.0, 0.0)))[0]
    torch.testing.assert_close(route[:2], torch.tensor([30.0, 0.0]))
    assert 9.0 < route[4] < 11.0


def test_what_the_lidar_does_not_see_is_neither_free_nor_occupied() -> None:
    behind = ((-2.0, -3.0, -2.0, 3.0),)
    front = replace(CENTERED, lidar_view=math.pi)
    for robot, first, then in ((CENTERED, True, False), (front, False, False)):
        seen = one_map(robot)
        seen(observed((0.0, 0.0), (3.0, 4.0), behind))
        assert is_occupied(seen, -2.0, 0.0) == first
        for _ in range(6):
            seen(observed((0.0, 0.0), (3.0, 4.0)))
        assert is_occupied(seen, -2.0, 0.0) == then
    # Nor is what the mask of the lidar names, whatever the robot.
    seen, ahead = one_map(), (reading_angles(LIDAR).cos() > -1e-6).float()[None]
    seen(observed((0.0, 0.0), (3.0, 4.0), behind))
    for mask, then in ((ahead, True), (torch.ones_like(ahead), False)):
        for _ in range(6):
            seen(observed((0.0, 0.0), (3.0, 4.0)).set("lidar_mask", mask))
        assert is_occupied(seen, -2.0, 0.0) == then
    # Seen once and then turned away from, the wall stays.
    seen = one_map(front)
    seen(observed((0.0, 0.0), (3.0, 4.0), behind, yaw=math.pi))
    for _ in range(20):
        seen(observed((0.0, 0.0), (3.0, 4.0)))
    assert is_occupied(seen, -2.0, 0.0)


def test_what_no_beam_has_reached_is_unknown() -> None:
    def known(seen: SeenMap, *places: tuple[float, float]) -> list[bool]:
        (low, *_), cells = seen.levels()[1], seen.known()[0]
        return [bool(cells[math.floor((y - low[1]) / CELL), math.floor((x - low[0]) / CELL)]) for x, y in places]

    seen = one_map(replace(CENTERED, lidar_view=math.pi))
    here, goal, wall = (0.0, 0.0), (3.0, 4.0), (2.0, -1.0, 2.0, 1.0)
    before, at, beyond, aside, behind = (1.8, 0.0), (2.01, 0.0), (2.5, 0.0), (2.5, 2.0), (-2.0, 0.0)
    seen(observed(here, goal, (wall,)))
    assert known(seen, here, before, at, beyond, aside, behind) == [True, True, True, False, True, False]
    # What was seen once stays known in the episode, in the window.
    seen(observed(here, goal, (wall,), yaw=math.pi))
    assert known(seen, before, at, beyond, aside, behind) == [True, True, False, True, True]
    seen(observed(here, goal, (wall,)), renewed=torch.tensor([True]))
    assert known(seen, before, behind) == [True, False]


def test_a_path_is_the_whole_route_and_begins_as_the_route_does() -> None:
    walls = ((1.5, -3.0, 1.5, 1.0), (3.0, -1.0, 3.0, 4.0), (4.5, -3.0, 4.5, 1.0))
    seen, goal = one_map(), (6.0, 0.0)
    seen.keep_paths()
    bounds = torch.tensor([[-1.0, -3.2, 8.0, 4.2]])
    for x, y in ((0.0, 0.0), (2.25, 0.0), (3.75, 0.0), (0.0, 0.0)):
        seen(observed((x, y), goal, walls), bounds=bounds)
    path = [(0.0, 0.0), *map(tuple, seen.paths()[0].tolist())]
    assert torch.equal(seen.paths()[:, :2], seen.corners())
    assert path[-1] == pytest.approx(goal, abs=1e-5)
    ends = {(1.5, 1.0), (3.0, -1.0), (4.5, 1.0)}
    assert all(min(math.dist(end, corner) for corner in path) < 0.6 for end in ends), "around each end"
    steps = [step for step in map(math.dist, path, path[1:]) if step]
    assert len(steps) < 12
    assert sum(steps) == pytest.approx(10.7, abs=1.0), "with half a meter of room at each end"
    # Without a way, it is the goal alone, as the route is.
    seen(observed((0.0, 0.0), (6.0, 0.0), walls), bounds=torch.tensor([[-1.0, -3.2, 8.0, 0.5]]))
    assert (seen.paths()[0] - torch.tensor(goal)).abs().max() < 1e-5


def test_distances_are_to_obstacles_and_to_what_a_lidar_that_sees_ahead_has_never_seen() -> None:
    front, wall = replace(CENTERED, lidar_view=math.pi), ((2.0, -3.0, 2.0, 3.0),)
    bounds = torch.tensor([[-9.0, -9.0, 9.0, 1.0]])
    for robot, behind in ((CENTERED, 0.75), (front, 0.0)):
        seen = one_map(robot)

        def distance(observation: TensorDict, x: float, y: float, seen: SeenMap = seen) -> float:
            seen(observation)
            distances, frame = seen.distances(observation, bounds)
            column, row = ((torch.tensor((x, y)) - frame[0, :2]) / frame[0, 2]).round().int().tolist()
            return distances[0].reshape(128, 128)[row, column].item()

        ahead = observed((0.0, 0.0), (3.0, 4.0), wall)
        assert distance(ahead, 1.625, 0.0) == pytest.approx(0.375, abs=0.08)
        assert distance(ahead, 0.825, 0.525) == pytest.approx(0.525), "the bounds"
        assert distance(ahead, 1.0, 2.0) == 0.0
        assert distance(ahead, 1.0, 0.0) == pytest.approx(0.75)
        assert distance(ahead, -2.0, 0.0) == pytest.approx(behind)
        # Around the body, and where it has looked before.
        assert distance(ahead, -0.2, 0.0) > 0.2
        distance(observed((0.0, 0.0), (3.0, 4.0), wall, yaw=math.pi), 0.0, 0.0)
        assert distance(ahead, -2.0, 0.0) == pytest.approx(0.75)
        # The distances to what has been passed in another episode are forgotten.
        seen(ahead, renewed=torch.tensor([True]))
        assert distance(ahead, -2.0, 0.0) == pytest.approx(behind)


def test_a_route_leads_around_a_wall_within_bounds() -> None:
    observation = observed((0.0, 0.0), (4.0, 0.0), ((2.0, -3.0, 2.0, 1.0),))
    # The shorter way around, to the left, leads out of the bounds.
    assert one_map()(observation, bounds=torch.tensor([[-1.0, -5.0, 6.0, 1.3]]))[0, 1] < -0.5
    distance, angle, _, _, length = one_map()(observation, bounds=torch.tensor([[-1.0, -5.0, 6.0, 5.0]]))[0].tolist()
    corner = distance * math.cos(angle), distance * math.sin(angle)
    # Around its left end, which is nearer than the right one.
    assert 1.4 < corner[0] < 2.6
    assert 1.1 < corner[1] < 2.2
    assert length > 2 * math.hypot(2.0, 1.0)


def test_what_is_behind_the_rover_is_remembered() -> None:
    short = LidarConfig(points=128, beams=128, max_range=3.5)
    seen, fresh = SeenMap(fleet(1), short), SeenMap(fleet(1), short)
    inside, outside = (observed((x, 0.0), (4.0, 0.0), U_SHAPE) for x in (0.0, -3.0))
    outside["lidar"] = outside["lidar"].clamp(max=3.5)
    distance, angle, *_ = seen(inside)[0].tolist()
    assert distance * math.cos(angle) < -1.0, "back, as far as the opening of the dead end"
    remembered, unknown = seen(outside)[0], fresh(outside)[0]
    assert unknown[1].abs() < 0.1, "into the dead end, whose end is out of sight"
    assert remembered[1].abs() > 0.5, "around it"
    assert remembered[4] > unknown[4] + 0.3


def test_a_gap_of_070_m_is_open_and_one_of_050_m_is_not() -> None:
    def length(gap: float) -> float:
        walls = ((1.5, -4.0, 1.5, -gap / 2), (1.5, gap / 2, 1.5, 4.0), (-3.0, -4.0, -3.0, 4.0))
        walls += ((-3.0, 4.0, 1.5, 4.0), (-3.0, -4.0, 1.5, -4.0))
        seen = one_map()
        # From two places, so that the ends of the walls are seen.
        seen(observed((0.0, 0.0), (3.0, 0.0), walls))
        return float(seen(observed((0.5, 0.0), (3.0, 0.0), walls))[0, 4])

    assert 0 < length(0.7) < 10.0
    assert length(0.5) == -1.0, "the room is closed"


def test_a_route_avoids_ground_on_which_the_rover_tilted() -> None:
    seen = one_map()
    # Nose up by 30 degrees: the lidar sees nothing, but the goal is uphill.
    for _ in range(3):
        route = seen(observed((0.0, 0.0), (4.0, 0.0), pitch=-math.radians(30)))[0]
    assert is_occupied(seen, 0.5, 0.0)
    assert abs(float(route[1])) > 0.3
    gentle = one_map()
    assert abs(float(gentle(observed((0.0, 0.0), (4.0, 0.0), pitch=-math.radians(20)))[0, 1])) < 1e-6


def test_on_rough_ground_far_ends_of_beams_may_be_gentle_slopes() -> None:
    far, near = ((3.0, -4.0, 3.0, 4.0),), ((0.6, -4.0, 0.6, 4.0),)
    seen = one_map()
    seen(observed((0.0, 0.0), (6.0, 0.0), far))
    assert is_occupied(seen, 3.0, 0.0), "a wall"
    # Nose up by 6 degrees, and level again.
    seen(observed((0.0, 0.0), (6.0, 0.0), far, pitch=-0.1))
    for _ in range(3):
        _, angle, *_ = seen(observed((0.0, 0.0), (6.0, 0.0), far))[0].tolist()
    assert not is_occupied(seen, 3.0, 0.0)
    assert abs(angle) < 1e-6, "straight on"
    seen(observed((0.0, 0.0), (6.0, 0.0), near))
    assert is_occupied(seen, 0.6, 0.0), "too steep to be climbed"


def test_on_rough_ground_routes_avoid_far_ends_of_beams_unless_the_detour_is_long() -> None:
    def angle(half_width: float) -> float:
        seen = one_map()
        wall = ((3.0, -half_width, 3.0, half_width + 0.1),)
        for pitch in (-0.1, 0.0, 0.0):
            route = seen(observed((0.0, 0.0), (6.0, 0.0), wall, pitch=pitch))[0]
        assert level_at(seen, 3.0, 0.0) == 2, "suspected"
        return float(route[1])

    assert abs(angle(0.3)) > 0.1, "around a boulder"
    assert abs(angle(4.0)) < 1e-6, "across a slope"


@pytest.mark.parametrize("interval", [0.2, 1.0])
def test_a_place_on_the_route_is_closed_if_the_rover_does_not_get_on_for_8_seconds(interval: float) -> None:
    seen = SeenMap(fleet(1), LIDAR, interval=interval)
    scans = round(8.0 / interval)
    for k in range(scans):
        # Back and forth, as in front of a gap that is too narrow, wherever the rover turns.
        route = seen(observed((0.2 * (k % 2), 0.0), (4.0, 0.0), yaw=1.5))
        assert abs(float(route[0, 1]) + 1.5) < 1e-6
    route = seen(observed((0.0, 0.0), (4.0, 0.0)))
    assert is_occupied(seen, 0.45, 0.0)
    assert abs(float(route[0, 1])) > 0.3, "around it"
    for _ in range(12):
        seen(observed((0.0, 0.0), (4.0, 0.0)))
    assert is_occupied(seen, 0.45, 0.0), "no beam clears it"
    seen(observed((0.0, 0.0), (4.0, 0.0)), renewed=torch.tensor([True]))
    for k in range(30):
        seen(observed((0.5 * k * interval, 0.0), (8.0, 0.0)))
        assert (seen.levels()[0] == 4).all(), "it gets on"


def test_ground_between_heights_that_differ_too_much_is_closed() -> None:
    def seen_at(distance: float, pitch: float = -0.1) -> SeenMap:
        """Ground that rises from 0.3 m at x = 2 to 0.6 m some way behind, as the lidar sees it from two heights."""
        seen = one_map()
        seen(observed((0.0, 0.0), (6.0, 0.0), pitch=pitch))
        for z, x in ((0.0, 2.0), (0.3, 2.0 + distance)):
            seen(observed((0.0, 0.0), (6.0, 0.0), ((x, -3.0, x, 3.0),), z=z))
        return seen

    steep = seen_at(0.4)
    assert is_occupied(steep, 2.3, 0.0), "by 37 degrees, at least 27 if the cells are that wide"
    route = steep(observed((0.0, 0.0), (6.0, 0.0), z=0.8))
    assert abs(float(route[0, 1])) > 0.3, "around it, though no beam ends there any more"
    gentle = seen_at(0.7)
    assert not any(is_occupied(gentle, 2.0 + 0.15 * k, 0.0) for k in range(6)), "by 23 degrees"
    level = seen_at(0.4, pitch=0.0)
    for _ in range(12):
        level(observed((0.0, 0.0), (6.0, 0.0)))
    assert not is_occupied(level, 2.3, 0.0), "on level ground, heights close nothing"
    # Ground is as high as the rover stands: down a step of 0.4 m.
    seen = one_map()
    seen(observed((0.0, 0.0), (6.0, 0.0), pitch=-0.1))
    seen(observed((0.5, 0.0), (6.0, 0.0), z=-0.4))
    assert is_occupied(seen, 0.2, 0.0)


@pytest.mark.parametrize(("pitch", "occupied"), [(6.0, False), (8.0, True)], ids=["23 degrees", "25 degrees"])
def test_slopes_are_measured_from_the_ground_below_the_lidar(pitch: float, occupied: bool) -> None:
    """From a lidar at 0.3 m, the line to a point 1 m ahead on the same height rises by 17 degrees."""
    seen = one_map()
    # The walls are drawn in two dimensions, and the beams end 1 m ahead of the lidar along the rover's axis.
    seen(observed((0.0, 0.0), (6.0, 0.0), ((1.0, -4.0, 1.0, 4.0),), pitch=-math.radians(pitch)))
    assert is_occupied(seen, 0.98, 0.0) == occupied


def test_the_ends_of_beams_are_occupied() -> None:
    seen = one_map()
    seen(observed((0.0, 0.0), (4.0, 0.0), ((2.02, -1.0, 2.02, 1.0),)))
    assert all(is_occupied(seen, 2.02, y) for y in (-0.9, -0.5, 0.0, 0.5, 0.9))
    assert not any(is_occupied(seen, x, 0.0) for x in (0.5, 1.0, 1.7, 2.5))
    # The lidar is where the robot carries it.
    seen = one_map(replace(CENTERED, lidar_position=(0.3, -0.2, 0.3), radius=0.4))
    # Facing +y, the lidar is at (0.2, 0.3).
    observation = observed((0.2, 0.3), (4.0, 0.0), ((-1.0, 2.02, 1.0, 2.02),), yaw=math.pi / 2)
    observation["pose"] = torch.zeros(1, 3)
    seen(observation)
    assert is_occupied(seen, 0.2, 2.02)
    with pytest.raises(ValueError, match=r"at most 0\.45 m"):
        one_map(replace(CENTERED, lidar_position=(0.6, 0.0, 0.3), radius=1.0))


@settings(max_examples=10, deadline=None)
@given(st.floats(0.8, 3.0), st.floats(0.0, 2 * math.pi))
def test_levels_tell_how_far_a_wall_is_from_the_middle_of_a_cell(distance: float, direction: float) -> None:
    """A long wall, perpendicular to a direction.

    A box holds the ends of beams in a cell to 1 cm. Its corner can be half of a cell's diagonal in front of the wall.
    """
    normal = torch.tensor((math.cos(direction), math.sin(direction)))
    along = torch.stack((-normal[1], normal[0]))
    ends = torch.cat((distance * normal - 5 * along, distance * normal + 5 * along)).tolist()
    seen = one_map()
    seen(observed((0.0, 0.0), (0.1, 0.0), (tuple(ends),)))
    for share in torch.arange(0.0, distance, 0.1).tolist():
        x, y = (math.floor(value / CELL) * CELL for value in (share * normal).tolist())
        gap = distance - float(torch.tensor((x + CELL / 2, y + CELL / 2)) @ normal)
        level = level_at(seen, x + CELL / 2, y + CELL / 2)
        # Half of the width is 0.225 m: it does not fit below 0.235, hardly below 0.3, and should be slow below 0.45 m.
        least, most = np.searchsorted((-1.0, 0.235, 0.3, 0.45), (gap - 0.13, gap + 0.05), side="right")
        assert least <= level <= most or level == 0, (gap, level)


@pytest.mark.parametrize(("x", "pitch", "level", "scans"), [(1.5, 0.0, 0, 12), (3.0, -0.1, 2, 1)])
def test_beams_clear_what_is_gone_and_what_is_suspected(x: float, pitch: float, level: int, scans: int) -> None:
    seen, fresh = one_map(), observed((0.0, 0.0), (6.0, 0.0))
    seen(observed((0.0, 0.0), (6.0, 0.0), ((x, -0.3, x, 0.3),), pitch=pitch))
    assert level_at(seen, x, 0.0) == level
    for _ in range(scans):
        seen(fresh)
    assert level_at(seen, x, 0.0) == 4
    assert seen(fresh)[0, 4] == one_map()(fresh)[0, 4]


def test_beams_that_point_to_the_ground_mark_nothing() -> None:
    for x, pitch, marked in ((3.1, 0.045, True), (6.1, 0.045, False), (6.1, 0.0, True), (6.1, -0.045, True)):
        seen = one_map()
        seen(observed((0.0, 0.0), (8.0, 0.0), ((x, -1.0, x, 1.0),), pitch=pitch))
        assert is_occupied(seen, x, 0.0) == marked, (x, pitch)


def test_an_episode_begins_with_an_empty_map_on_level_ground() -> None:
    seen = one_map()
    seen(observed((0.0, 0.0), (4.0, 0.0), U_SHAPE, pitch=-0.1))
    for fresh in (observed((0.0, 0.0), (4.0, 0.0)), observed((0.0, 0.0), (6.0, 0.0), ((3.0, -4.0, 3.0, 4.0),))):
        assert torch.equal(seen(fresh, renewed=torch.tensor([True])), one_map()(fresh))
    assert is_occupied(seen, 3.0, 0.0)


@settings(max_examples=10, deadline=None)
@given(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0))
def test_the_window_moves_with_the_rover(x: float, y: float) -> None:
    """What leaves it is forgotten, and what stays is kept."""
    seen = one_map()
    seen(observed((0.0, 0.0), (0.0, 0.0), U_SHAPE))
    before, first = (part.clone() for part in seen.levels())
    # Beams of length 0 clear nothing, and mark the cell of the lidar.
    blind = observed((x, y), (x, y))
    seen(blind.set("lidar", torch.zeros(1, 128)))
    after, second = seen.levels()
    shift = ((second - first)[0] / CELL).round().long().tolist()
    size = before.shape[-1]
    before, after = before == 0, after == 0
    expected = torch.zeros_like(before)
    if max(map(abs, shift)) < size:
        old = [slice(max(0, by), size + min(0, by)) for by in shift]
        new = [slice(max(0, -by), size + min(0, -by)) for by in shift]
        expected[:, new[1], new[0]] = before[:, old[1], old[0]]
    expected[0, size // 2, size // 2] = True
    assert torch.equal(after, expected)


@pytest.mark.parametrize("threads", [1, 2])
def test_rows_are_independent(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(seen_map, "ROWS_PER_THREAD", 1)
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    places = [((0.0, 0.0), U_SHAPE), ((1.0, 1.0), ((2.0, -3.0, 2.0, 1.0),)), ((-3.0, 0.5), ())]
    scans = [observed(place, (4.0, 0.0), walls, yaw=0.3) for place, walls in places]
    together = SeenMap(fleet(3), LIDAR)
    for _ in range(3):
        batch = together(torch.cat(scans))
    for row, scan in enumerate(scans):
        alone = one_map()
        for _ in range(3):
            route = alone(scan)
        assert torch.equal(batch[row], route[0])
    # Rows that are not added keep their maps.
    before = together.levels()[0].clone()
    kept = together(torch.cat([observed((0.0, 0.0), (4.0, 0.0), yaw=0.3)] * 3), torch.tensor([False, True, True]))
    assert torch.equal(kept[0], batch[0])
    assert torch.equal(together.levels()[0][0], before[0])
    assert (together.levels()[0][1] == 0).sum() < (before[1] == 0).sum()


def cheapest(levels: np.ndarray, goal: tuple[int, int]) -> float:
    """Length of the cheapest route from a cell to the middle of a window, by SciPy."""
    size, (column, row) = len(levels), goal
    home, beside = size // 2, np.zeros(levels.shape, dtype=bool)
    for y, x in ((row, column), (home, home)):
        beside[max(0, y - 4) : y + 5, max(0, x - 4) : x + 5] = True
    weights = np.where((levels == 1) & beside, 40, np.array([0, 0, 6, 3, 2])[levels])
    weights[row, column] = weights[row, column] or 2
    free = weights > 0
    free[home, home] = True
    cells = np.arange(size * size).reshape(size, size)
    around, steps = np.pad(cells, 1, constant_values=-1), []
    for dy, dx in product((0, 1, 2), repeat=2):
        to = around[dy : dy + size, dx : dx + size]
        taken = (to >= 0) & (weights > 0) & free.ravel()[to]
        steps.append((cells[taken], to[taken], (7 if dy != 1 and dx != 1 else 5) * weights[taken]))
    start, end, costs = np.concatenate(steps, 1)
    graph = csr_array((costs, (start, end)), shape=(size * size,) * 2)
    cost = dijkstra(graph, indices=cells[row, column])[cells[home, home]]
    return cost * CELL / 10 if np.isfinite(cost) else -1.0


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**31))
def test_the_length_is_that_of_the_cheapest_route(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    draw = (torch.rand(20, 4, generator=generator) * 12 - 6).tolist()
    walls = tuple((x, y, x + (a / 3), y + (b / 3)) for x, y, a, b in draw)
    goal = tuple((torch.rand(2, generator=generator) * 12 - 6).tolist())
    seen = one_map()
    for position in ((0.3, 0.3), (0.0, 0.0)):
        route = seen(observed(position, goal, walls))[0]
    levels, origin = seen.levels()
    cell = tuple(math.floor((value - low) / CELL + 1e-6) for value, low in zip(goal, origin[0].tolist(), strict=True))
    assert float(route[4]) == pytest.approx(cheapest(levels[0].numpy(), cell), abs=1e-4)
