"""The map and the route as tensor operations, against the kernels."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from rover_rl.envs.config import LidarConfig
from rover_rl.envs.seen_map.plain_map import PlainSeenMap
from rover_rl.envs.seen_map.plain_scans import levels, unpacked
from rover_rl.envs.seen_map.seen_map import BOUNDS, NO_BOUNDS, ROUTE_KEYS, SeenMap, clearance_of
from rover_rl.sims.robots import get_robot
from tests.envs.seen_map.test_seen_map import U_SHAPE, Wall, observed

LIDAR = LidarConfig(points=128, beams=128)
ROBOT = replace(get_robot("rover_zero"), lidar=(0.17, -0.05, 0.3))


class Both:
    """The kernels and the tensor operations, side by side, on the same observations of one rover."""

    def __init__(self, interval: float = 0.2) -> None:
        self.kernels = SeenMap(1, LIDAR, ROBOT, interval=interval)
        self.plain = PlainSeenMap(LIDAR, ROBOT, interval)
        self.state = torch.zeros(1, self.plain.state_size)
        self.lengths: list[float] = []
        self.decisions = self.same_routes = self.cells = self.same_cells = 0

    def __call__(self, observation: TensorDict, bounds: tuple[float, ...] = NO_BOUNDS) -> None:
        area = torch.tensor([bounds])
        expected = self.kernels(observation, bounds=area)
        route, self.state = self.plain(self.state, *(observation[key] for key in ROUTE_KEYS), area)
        around = self.kernels.levels()[0]
        self.decisions, self.cells = self.decisions + 1, self.cells + around.numel()
        self.same_routes += int(torch.allclose(route, expected, atol=1e-4))
        self.same_cells += int((self.levels() == around).sum())
        self.lengths.append(float(expected[0, 4]))

    def levels(self) -> Tensor:
        cells = unpacked(self.state[:, 8:].reshape(1, 2, 128, 128)[:, 0])
        return levels(cells, self.state[:, 2:3] > 0, clearance_of(ROBOT))

    def assert_same(self) -> None:
        """Sines and cosines of two libraries may differ in the last bit, so that a beam ends in another cell."""
        assert self.same_cells >= 0.999 * self.cells
        assert self.same_routes >= 0.99 * self.decisions


def drawn_walls(generator: torch.Generator, count: int) -> tuple[Wall, ...]:
    ends = (torch.rand(count, 4, generator=generator) * 12 - 6).tolist()
    return tuple((x, y, x + a / 3, y + b / 3) for x, y, a, b in ends)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**31), st.booleans(), st.sampled_from((0.0, 0.04, 0.2)))
def test_it_computes_what_the_kernels_compute(seed: int, bounded: bool, tilt: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    walls = drawn_walls(generator, 16)
    both = Both()
    position, yaw = torch.rand(2, generator=generator) * 4 - 2, 0.0
    bounds = (-4.0, -5.0, 6.5, 7.0) if bounded else NO_BOUNDS
    for step in range(6):
        draw = torch.rand(7, generator=generator).tolist()
        # Goals inside and outside of the window and of the bounds, and a few jumps.
        goal = (24 * draw[0] - 12, 24 * draw[1] - 12)
        position = position + (torch.tensor(draw[2:4]) - 0.5) * (20.0 if step == 4 else 1.0)
        yaw += draw[4] - 0.5
        observation = observed(
            (position[0].item(), position[1].item()), goal, walls, yaw, tilt * (2 * draw[5] - 1), z=draw[6]
        )
        both(observation, bounds)
    both.assert_same()


def test_a_dead_end_is_left_on_the_same_route() -> None:
    both = Both()
    for x in (-3.0, -1.5, 0.0, 0.0, -1.5):
        both(observed((x, 0.1), (5.0, 0.2), U_SHAPE, yaw=0.3 * x))
    both.assert_same()
    assert both.lengths[-1] > 8.0


def test_a_closed_room_has_no_route() -> None:
    room: tuple[Wall, ...] = (
        (-1.6, -1.6, -1.6, 1.7),
        (-1.6, 1.7, 1.8, 1.7),
        (1.8, 1.7, 1.8, -1.6),
        (1.8, -1.6, -1.6, -1.6),
    )
    both = Both()
    both(observed((0.0, 0.1), (4.0, 0.0), room))
    both.assert_same()
    assert both.lengths == [-1.0]


def test_steep_ground_is_kept_and_what_is_gone_is_cleared() -> None:
    both = Both()
    wall = ((3.5, -0.5, 3.5, 0.5),)
    both(observed((0.0, 0.0), (4.0, 0.0), wall, yaw=0.4, pitch=-0.5))
    both(observed((0.0, 0.0), (4.0, 0.0), wall, yaw=0.4))
    occupied = int((both.levels() == 0).sum())
    for _ in range(12):
        both(observed((0.0, 0.0), (4.0, 0.0), yaw=0.4))
    both.assert_same()
    # The cell uphill.
    assert occupied > int((both.levels() == 0).sum()) == 1


@pytest.mark.parametrize("start", [0.0, 5.0])
def test_a_place_on_the_route_is_closed_at_the_same_scan(start: float) -> None:
    both, closed = Both(interval=2.0), []
    for k in range(11):
        both(observed((start + 0.1 * (k % 3), 0.0), (9.0, 0.3), yaw=0.2 * k))
        closed.append(int((both.levels() == 0).sum()))
    both.assert_same()
    assert closed == [0] * 4 + [1] * 4 + [2] * 3


def test_ground_between_heights_that_differ_too_much_is_closed() -> None:
    both = Both()
    for k in range(6):
        x, z = 0.25 * k, 0.12 * k
        wall = ((2.0 + 0.2 * k, -3.0, 2.1 + 0.2 * k, 3.0),)
        both(observed((x, 0.1), (5.0, 0.1), wall, yaw=0.2 * k, pitch=-0.1, z=z))
    both.assert_same()
    assert int((both.levels() == 0).sum()) > 5


def test_suspected_cells_are_cleared_and_hit() -> None:
    both = Both()
    wall = ((2.0, -0.5, 2.0, 0.5),)
    for x, walls in ((0.0, wall), (0.1, wall), (0.1, ()), (0.2, wall), (1.4, wall), (0.4, wall)):
        both(observed((x, 0.0), (5.0, 0.1), walls, pitch=-0.06))
    both.assert_same()


@pytest.mark.parametrize("goal", [(0.02, 0.03), (0.2, 0.1), (1.5, 0.0), (40.0, -3.0)])
def test_goals_here_beside_the_rover_in_a_wall_and_far_away(goal: tuple[float, float]) -> None:
    both = Both()
    for yaw in (0.1, 0.2):
        both(observed((0.04, 0.05), goal, ((1.5, -2.5, 1.5, 1.5),), yaw))
    both.assert_same()


def test_rows_are_independent() -> None:
    plain = PlainSeenMap(LIDAR, ROBOT)
    scans = [observed((0.0, 0.0), (4.0, 0.0), U_SHAPE), observed((1.0, 1.0), (-4.0, 2.0), (), yaw=0.5)]
    for scan in scans:
        scan[BOUNDS] = torch.tensor([NO_BOUNDS])
    keys = (*ROUTE_KEYS, BOUNDS)
    states = torch.zeros(2, plain.state_size)
    alone = [plain(states[:1], *(scan[key] for key in keys)) for scan in scans]
    together = plain(states, *(torch.cat(scans)[key] for key in keys))
    for part, parts in zip(together, zip(*alone, strict=True), strict=True):
        assert torch.equal(part, torch.cat(parts))


def test_a_lidar_far_from_the_center_is_refused() -> None:
    with pytest.raises(ValueError, match=r"at most 0\.45 m"):
        PlainSeenMap(LIDAR, replace(ROBOT, lidar=(0.0, math.pi, 0.3), radius=4.0))
