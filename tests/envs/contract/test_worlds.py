"""World-specific parameters: spawn ranges, goal ranges, drop heights and bounds."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl.envs.placement import Placement
from rover_rl.rng import row_keys
from rover_rl.robots import get_robot
from rover_rl.worlds import get_world
from rover_rl.worlds.table import WorldTable
from tests.envs import transcription as contract
from tests.envs.scripted import CPU, WORLD_NAMES, Moment, play, scripted


@pytest.mark.parametrize("name", WORLD_NAMES)
def test_each_world_has_the_contracts_ranges_and_bounds(name):
    world, table = get_world(name), contract.WORLDS[name]
    assert world.name == name
    assert world.goal_range == (table.rand_goal_x_range, table.rand_goal_y_range)
    assert world.spawn_range == (table.rand_x_range, table.rand_y_range)
    assert world.bounds == (table.too_far_away_x, table.too_far_away_y)


def test_rovers_are_dropped_from_0_75_m_and_in_inspect_from_5_5_m_and_6_5_m_in_its_south_west_corner():
    points = torch.tensor([[-20.0, -20.0], [-25.0, -25.0], [-24.5, -25.0], [-25.0, -24.5], [-25.0, -20.0]])
    assert get_world("inspect").drop_height(points).tolist() == [5.5, 6.5, 5.5, 5.5, 5.5]
    for name in ("moon", "maze"):
        assert get_world(name).drop_height(torch.tensor([[0.0, 0.0], [-3.9, -3.9]])).tolist() == [0.75, 0.75]


@pytest.mark.parametrize("name", WORLD_NAMES)
def test_starts_are_drawn_in_the_worlds_ranges_with_any_yaw_and_goals_1_m_away(name):
    rows, table = 2000, contract.WORLDS[name]
    placement = Placement(WorldTable([get_world(name)] * rows), get_robot("rover_zero"), 1.0)
    keys = row_keys(0, rows, CPU)
    start = placement.draw_start(keys)
    goal = placement.draw_goal(keys, torch.zeros_like(keys), start[:, :2])
    drawn = {"start": (start, table.rand_x_range, table.rand_y_range)}
    drawn["goal"] = (goal, table.rand_goal_x_range, table.rand_goal_y_range)
    for points, *ranges in drawn.values():
        for axis, (low, high) in enumerate(ranges):
            # Free cells cover nearly the whole range.
            assert low <= points[:, axis].min() < low + 1
            assert high - 1 < points[:, axis].max() <= high
    assert (goal - start[:, :2]).norm(dim=-1).min() >= 1.0
    assert start[:, 2].abs().max() <= math.pi
    if name != "inspect":
        # Of each eighth of all headings, at least half as many as expected.
        assert min(torch.histc(start[:, 2], 8, -math.pi, math.pi).tolist()) > rows / 16


@pytest.mark.parametrize("name", WORLD_NAMES)
def test_too_far_away_is_outside_of_the_worlds_bounds_on_every_side(name):
    table = contract.WORLDS[name]
    (left, right), (back, front) = table.too_far_away_x, table.too_far_away_y
    x, y = (left + right) / 2, (back + front) / 2

    def around(more: float) -> list[tuple[float, float]]:
        """Places beyond the middle of each side of the bounds."""
        return [(left - more, y), (right + more, y), (x, back - more), (x, front + more)]

    scripts = [[Moment(x, y), Moment(*place)] for place in (*around(-0.01), *around(0.01))]
    result = play(scripted(*scripts, world_n=name), 1, goal=(100.0, 100.0))[0]
    assert result["outcome", "out_of_bounds"].flatten().tolist() == [False] * 4 + [True] * 4
    assert (result["reward"][4:] == -10.0).all()


def test_rows_in_different_worlds_have_their_own_bounds():
    leaves_inspect = [Moment(x=-20.0, y=-20.0), Moment(x=-12.0, y=-20.0)]
    env = scripted(leaves_inspect, leaves_inspect, world_n=["inspect", "maze"])
    result = play(env, 1)[0]
    assert result["terminated"].flatten().tolist() == [True, False]
