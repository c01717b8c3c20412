"""The map and the route as tensor operations, against the kernels."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from rover_rl.envs.config import LidarConfig
from rover_rl.envs.seen_map.plain_map import PlainSeenMap
from rover_rl.envs.seen_map.seen_map import NO_BOUNDS, ROUTE_KEYS, SeenMap
from rover_rl.robots import Robot, get_robot
from tests.envs.seen_map.test_seen_map import U_SHAPE, Wall, observed

LIDAR = LidarConfig(points=128, beams=128)
ROBOT = replace(get_robot("rover_zero"), lidar=(0.17, -0.05, 0.3))
ROOM: tuple[Wall, ...] = (
    (-1.6, -1.6, -1.6, 1.7),
    (-1.6, 1.7, 1.8, 1.7),
    (1.8, 1.7, 1.8, -1.6),
    (1.8, -1.6, -1.6, -1.6),
)


def compare(
    observations: list[TensorDict], bounds: tuple[float, ...] = NO_BOUNDS, interval: float = 0.2, robot: Robot = ROBOT
) -> tuple[list[float], list[int]]:
    """Checks that both compute the same; returns the lengths of the routes and the numbers of occupied cells.

    The geometry of the scans is computed by the same code. Where the kernels multiply and add to find the cell of a
    point, they may round otherwise, so that one in a thousand cells may differ.
    """
    kernels, plain = SeenMap(1, LIDAR, robot, interval=interval), PlainSeenMap(LIDAR, robot, interval)
    state, area = torch.zeros(1, plain.state_size), torch.tensor([bounds])
    lengths, occupied, same_cells, same_routes = [], [], 0.0, 0
    for observation in observations:
        expected = kernels(observation, bounds=area)
        mask = observation.get("lidar_mask", None)
        route, state = plain(state, *(observation[key] for key in ROUTE_KEYS), area, lidar_mask=mask)
        levels = plain.levels(state)
        same_routes += int(torch.allclose(route, expected, atol=1e-4))
        same_cells += float((levels == kernels.levels()[0][0]).float().mean())
        lengths.append(float(expected[0, 4]))
        occupied.append(int((levels == 0).sum()))
    assert same_cells >= 0.999 * len(observations)
    assert same_routes >= 0.99 * len(observations)
    return lengths, occupied


@settings(max_examples=8, deadline=None)
@given(
    st.integers(0, 2**31), st.booleans(), st.sampled_from((0.0, 0.04, 0.2)), st.sampled_from((2 * math.pi, 4.7, None))
)
def test_it_computes_what_the_kernels_compute(seed: int, bounded: bool, tilt: float, view: float | None) -> None:
    generator = torch.Generator().manual_seed(seed)
    ends = (torch.rand(16, 4, generator=generator) * 12 - 6).tolist()
    walls = tuple((x, y, x + a / 3, y + b / 3) for x, y, a, b in ends)
    position, yaw, observations = torch.rand(2, generator=generator) * 4 - 2, 0.0, []
    for step in range(6):
        draw = torch.rand(7, generator=generator).tolist()
        # Goals inside and outside of the window and of the bounds, and a jump.
        goal = (24 * draw[0] - 12, 24 * draw[1] - 12)
        position = position + (torch.tensor(draw[2:4]) - 0.5) * (20.0 if step == 4 else 1.0)
        yaw += draw[4] - 0.5
        x, y = position.tolist()
        observations.append(observed((x, y), goal, walls, yaw, tilt * (2 * draw[5] - 1), z=draw[6]))
        if view is None:
            observations[-1]["lidar_mask"] = (torch.rand(1, LIDAR.points, generator=generator) > 0.3).float()
    robot = replace(ROBOT, lidar_view=view or ROBOT.lidar_view)
    compare(observations, (-4.0, -5.0, 6.5, 7.0) if bounded else NO_BOUNDS, robot=robot)


def test_a_dead_end_is_left_and_a_closed_room_has_no_route() -> None:
    drive = [observed((x, 0.1), (5.0, 0.2), U_SHAPE, yaw=0.3 * x) for x in (-3.0, -1.5, 0.0, 0.0, -1.5)]
    assert compare(drive)[0][-1] > 8.0
    assert compare([observed((0.0, 0.1), (4.0, 0.0), ROOM)])[0] == [-1.0]


def test_steep_ground_is_kept_and_what_is_gone_is_cleared() -> None:
    wall = ((3.5, -0.5, 3.5, 0.5),)
    drive = [observed((0.0, 0.0), (4.0, 0.0), wall, yaw=0.4, pitch=pitch) for pitch in (-0.5, 0.0)]
    occupied = compare(drive + [observed((0.0, 0.0), (4.0, 0.0), yaw=0.4)] * 12)[1]
    # The cell uphill.
    assert occupied[1] > occupied[-1] == 1


@pytest.mark.parametrize("start", [0.0, 5.0])
def test_a_place_on_the_route_is_closed_at_the_same_scan(start: float) -> None:
    drive = [observed((start + 0.1 * (k % 3), 0.0), (9.0, 0.3), yaw=0.2 * k) for k in range(11)]
    assert compare(drive, interval=2.0)[1] == [0] * 4 + [1] * 4 + [2] * 3


def test_ground_between_heights_that_differ_too_much_is_closed() -> None:
    walls = [((2.0 + 0.2 * k, -3.0, 2.1 + 0.2 * k, 3.0),) for k in range(6)]
    drive = [
        observed((0.25 * k, 0.1), (5.0, 0.1), wall, yaw=0.2 * k, pitch=-0.1, z=0.12 * k) for k, wall in enumerate(walls)
    ]
    assert compare(drive)[1][-1] > 5


def test_suspected_cells_are_cleared_and_hit() -> None:
    wall = ((2.0, -0.5, 2.0, 0.5),)
    places = ((0.0, wall), (0.1, wall), (0.1, ()), (0.2, wall), (1.4, wall), (0.4, wall))
    compare([observed((x, 0.0), (5.0, 0.1), walls, pitch=-0.06) for x, walls in places])


@pytest.mark.parametrize("goal", [(0.02, 0.03), (0.2, 0.1), (1.5, 0.0), (40.0, -3.0)])
def test_goals_here_beside_the_rover_in_a_wall_and_far_away(goal: tuple[float, float]) -> None:
    compare([observed((0.04, 0.05), goal, ((1.5, -2.5, 1.5, 1.5),), yaw) for yaw in (0.1, 0.2)])
