"""Movers that walk keep off walls, and their statistics are as documented."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from rover_rl.worlds import World, box, get_world
from rover_rl.worlds.movers import Cross, Cylinder, Motion, Mover, Orca, Person, SocialForce, Wander
from rover_rl.worlds.movers.motions import Walk
from tests.worlds.movers.crowds import DT, ROVER_RADIUS, begun, walk, yard

MOTIONS = [Wander(), Cross(), SocialForce(), Orca()]
CENTER = ((-4.0, 4.0), (-3.0, 3.0))


def distance_to_obstacles(world: World, points: Tensor) -> Tensor:
    """Returns the horizontal distance of points outside obstacles to their outlines, 0 inside a box, ``[P]``, m."""
    nearest = torch.full_like(points[:, 0], math.inf)
    for obstacle in world.obstacles:
        outline, inside = obstacle.footprint.to(points), torch.ones_like(nearest, dtype=torch.bool)
        for a, b in zip(outline, outline.roll(-1, 0), strict=True):
            edge, offset = b - a, points - a
            share = ((offset @ edge) / (edge @ edge)).clamp(0, 1)
            nearest = torch.minimum(nearest, (offset - share[:, None] * edge).norm(dim=-1))
            inside &= edge[0] * offset[:, 1] - edge[1] * offset[:, 0] > 0
        nearest = nearest.masked_fill(inside, 0.0)
    return nearest


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
def test_movers_do_not_enter_walls(motion: Motion) -> None:
    maze = replace(get_world("maze"), movers=[Mover(motion, Cylinder(0.3))] * 20)
    points = walk(begun([maze], 4), 1000).reshape(-1, 2)
    assert distance_to_obstacles(maze, points).min() > 0.28
    (x_low, x_high), (y_low, y_high) = maze.bounds
    assert (abs(points[:, 0] - (x_low + x_high) / 2).max()) < (x_high - x_low) / 2 - 0.28
    assert (abs(points[:, 1] - (y_low + y_high) / 2).max()) < (y_high - y_low) / 2 - 0.28


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
def test_random_starts_are_free_and_away_from_the_rover(motion: Motion) -> None:
    maze = replace(get_world("maze"), movers=[Mover(motion, Cylinder(0.3))] * 6)
    rovers = torch.tensor([[-5.0, -5.0], [0.0, 0.0]]).repeat(32, 1)
    field = begun([maze] * 64, rovers=rovers)
    gaps = (field.course.position - rovers[:, None]).norm(dim=-1)
    assert gaps.min() > 1.5 + 0.3 + ROVER_RADIUS - 1e-4
    apart = torch.cdist(field.course.position, field.course.position) + torch.eye(6)
    assert apart.min() > 0.6 - 1e-4


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
def test_the_heading_turns_to_the_direction_of_walking_at_a_limited_rate(motion: Motion) -> None:
    yaws = walk(begun([yard([Mover(motion, Person())] * 8, 8.0)]), 600, keep="yaw")[:, 0]
    turns = torch.remainder(yaws.diff(dim=0) + math.pi, 2 * math.pi) - math.pi
    assert turns.abs().max() < math.pi * DT + 1e-4
    field = begun([yard([Mover(motion)] * 8, 100.0)] * 4)
    walk(field, 200)
    velocity, yaw = field.course.velocity, field.course.yaw
    along = (velocity * torch.stack((yaw.cos(), yaw.sin()), -1)).sum(-1) / velocity.norm(dim=-1)
    assert (along > 0.98).float().mean() > 0.7


def test_a_wanderer_keeps_its_speed_and_turns_as_often_as_set() -> None:
    field = begun([yard([Mover(Wander(speed=0.8, turn_time=2.0))] * 8, 400.0)] * 8)
    velocity = walk(field, 1000, keep="velocity")
    assert (velocity.norm(dim=-1) - 0.8).abs().max() < 2e-3
    turns = (velocity.diff(dim=0).norm(dim=-1) > 0.02).sum().item()
    # 1600 turns are expected in 64 x 50 s: a standard deviation is 2.5 %.
    assert turns == pytest.approx(64 * 999 * DT / 2.0, rel=0.08)
    headings = field.course.draws.sum().item()
    assert headings >= turns


def test_a_wanderer_bounces_off_walls_and_stays_in_its_area() -> None:
    field = begun([yard([Mover(Wander(speed=1.5, turn_time=1e5, area=CENTER))] * 8)] * 4)
    points = walk(field, 1500)
    (x_low, x_high), (y_low, y_high) = CENTER
    assert points[..., 0].min() > x_low - 0.02
    assert points[..., 0].max() < x_high + 0.02
    assert points[..., 1].min() > y_low - 0.02
    assert points[..., 1].max() < y_high + 0.02
    # It is everywhere in the area for as long.
    share = (points[..., 0] < -2.0).float().mean().item()
    assert share == pytest.approx(0.25, abs=0.06)
    assert (points.diff(dim=0).norm(dim=-1) / DT).mean() == pytest.approx(1.5, rel=0.02)


def test_goals_are_uniform_in_their_area() -> None:
    goal = ((-2.0, 6.0), (-6.0, 2.0))
    field = begun([yard([Mover(Cross(speed=8.0, goal=goal))] * 8)] * 16)
    goals = walk(field, 400, keep="goal")
    changed = (goals.diff(dim=0) != 0).any(-1)
    drawn = goals[1:][changed]
    assert len(drawn) > 1500
    assert drawn.mean(0).tolist() == pytest.approx([2.0, -2.0], abs=0.25)
    assert drawn.std(0).tolist() == pytest.approx([8 / math.sqrt(12)] * 2, rel=0.06)


def test_a_mover_goes_to_and_fro_between_its_places_and_rests_there() -> None:
    motion = Cross(speed=1.0, start=(-3.0, 0.0), goal=(3.0, 0.0), pause=2.0)
    field = begun([yard([Mover(motion)])], rovers=torch.tensor([[0.0, 5.0]]))
    assert field.course.position[0, 0].tolist() == [-3.0, 0.0]
    x = walk(field, 800)[:, 0, 0, 0]
    assert x.max() > 2.79
    assert x[x.argmax() :].min() < -2.79
    rests = (x.diff().abs() < 1e-6).float().mean().item()
    # It rests 2 s after each way of 5.6 to 5.8 m.
    assert rests == pytest.approx(2.0 / 7.7, abs=0.06)


def test_a_mover_that_makes_no_way_takes_another_goal() -> None:
    motion = Cross(goal=(0.0, 0.0), start=(-4.0, 0.0), patience=2.0)
    cell = [box((x, y, 0.5), size) for x, y, size in ((0, 2, (5, 1, 1)), (0, -2, (5, 1, 1)), (2, 0, (1, 5, 1)))]
    closed = [*cell, box((-2.0, 0.0, 0.5), (1.0, 5.0, 1.0))]
    field = begun([yard([Mover(motion, Cylinder(0.3))], obstacles=closed)], rovers=torch.tensor([[0.0, 8.0]]))
    draws = walk(field, 800, keep="draws")[:, 0, 0]
    assert draws[40] == 2
    assert draws[-1] >= 4


def test_a_mover_walks_around_a_pillar() -> None:
    motion = Cross(start=(-4.0, 0.0), goal=(4.0, 0.1))
    world = yard([Mover(motion, Cylinder(0.3))], obstacles=[box((0.0, 0.0, 0.5), (1.0, 1.5, 1.0))])
    points = walk(begun([world], rovers=torch.tensor([[0.0, 8.0]])), 200)[:, 0, 0]
    assert (points - torch.tensor([4.0, 0.1])).norm(dim=-1).min() < 0.21


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"speed": math.nan}, "speed must be positive and at most 10, got nan"),
        ({"speed": -1.0}, "speed must be positive"),
        ({"pause": -1.0}, "pause must be at least 0"),
        ({"patience": 0.0}, "patience must be positive"),
        ({"start": ((1.0, 0.0), (0.0, 1.0))}, "start must be a point"),
        ({"goal": (0.0, math.inf)}, "goal must be a point"),
        ({"goal": "here"}, "goal must be a point"),
        ({"goal": 3.0}, "goal must be a point"),
    ],
)
@pytest.mark.parametrize("motion", Walk.__subclasses__())
def test_a_wrong_setting_of_a_walk_is_told_in_a_sentence(
    motion: type[Walk], arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message) as raised:
        motion(**arguments)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"speed": 0.0}, "speed must be positive"),
        ({"turn_time": 0.0}, "turn_time must be positive"),
        ({"area": (0.0, 1.0)}, "area must be"),
        ({"area": ((0.0, 1.0), (2.0, 2.0))}, "area must be"),
    ],
)
def test_a_wrong_setting_of_a_wanderer_is_told_in_a_sentence(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Wander(**arguments)


def test_a_fixed_start_inside_an_obstacle_is_refused() -> None:
    with pytest.raises(ValueError, match="'mover' of world 'yard' starts at .* inside an obstacle"):
        yard([Mover(Cross(start=(0.0, 0.0)))], obstacles=[box((0.0, 0.0, 0.5), (1.0, 1.0, 1.0))])
