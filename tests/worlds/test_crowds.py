"""Worlds in which something moves, and walkers in any world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rover_rl.cli import main
from rover_rl.worlds import Region, Terrain, World, box, get_world, register_world, with_walkers
from rover_rl.worlds.movers import Person, Wander
from tests.worlds.movers.crowds import begun, walk

NUMBERS = {"plaza": (6, 12, 24), "corridor": (3, 6, 10), "crossing": (4, 8, 16), "maze+walkers": (1, 3, 6)}


@pytest.mark.parametrize(("name", "numbers"), NUMBERS.items())
def test_the_difficulty_sets_how_many_people_walk_and_how_fast(name, numbers):
    levels = [[get_world(f"{name}:{seed}@{level}").movers for seed in range(20)] for level in (0, 0.5, 1)]
    assert [{len(movers) for movers in level} for level in levels] == [{number} for number in numbers]
    speeds = [np.mean([mover.motion.speed for movers in level for mover in movers]) for level in levels]
    assert speeds == pytest.approx([0.6, 1.0, 1.34], rel=0.08)
    assert all(isinstance(mover.shape, Person) for level in levels for movers in level for mover in movers)


def test_a_tenth_of_the_obstacles_of_a_field_rests_and_the_others_are_as_fast_as_it_says():
    movers = [mover for seed in range(30) for mover in get_world(f"field:{seed}@1").movers]
    assert len(movers) == 30 * 22
    speeds = [mover.motion.speed for mover in movers]
    assert 0.8 <= min(speeds) < 0.85
    assert 1.9 < max(speeds) <= 1.95
    # Four walls, and two obstacles at rest.
    assert len(get_world("field@1").obstacles) == 4 + 2


@pytest.mark.parametrize(
    ("level", "count", "slowest", "fastest"), [(0, 5, 0.5, 0.95), (0.5, 15, 1, 1.45), (1, 24, 1.5, 1.95)]
)
def test_cylinders_of_a_yard_go_round_at_constant_speed(level, count, slowest, fastest):
    field = begun([get_world(f"yard:3@{level}")] * 2)
    assert field.state.position.shape[1] == count
    # Each episode begins elsewhere on the paths.
    assert not torch.isclose(field.state.position[0], field.state.position[1]).any()
    speed = walk(field, 20, keep="velocity").norm(dim=-1)
    assert ((slowest - 0.01 < speed) & (speed < fastest + 0.01)).all()
    assert field.state.position.abs().max() < 9.01


@pytest.mark.usefixtures("own_registries")
def test_walkers_are_added_to_any_world(tmp_path):
    still = World("yard", Terrain.flat((10, 10)), [box((2, 0, 0.5), (1, 1, 1))])
    register_world("yard-for-walkers", still)
    still.save(tmp_path / "yard.world.npz")
    for base in ("yard-for-walkers", str(tmp_path / "yard.world.npz")):
        world = get_world(f"{base}+walkers:4@1")
        assert (world.name, len(world.obstacles), len(world.movers)) == ("yard+walkers", 1, 6)
        assert get_world(f"{base}+walkers:4@1") is world
        assert get_world(f"{base}+walkers:5@1").movers != world.movers
    assert torch.equal(get_world("maze+walkers:7").obstacles[5].vertices, get_world("maze:7").obstacles[5].vertices)
    assert with_walkers(get_world("maze:7"), seed=7).movers == get_world("maze+walkers:7").movers
    with pytest.raises(ValueError, match="unknown world 'nowhere'"):
        get_world("nowhere+walkers")


def test_the_number_of_walkers_follows_the_ground_of_the_episodes(tmp_path, capsys):
    corner = Region.polygon([(0, 0), (10, 0), (10, 3), (3, 3), (3, 9), (0, 9)])
    office = World("office", Terrain.flat((22, 22)), spawn_range=corner.bounds, spawn_region=corner, goal_region=corner)
    assert [len(with_walkers(office, difficulty=level).movers) for level in (0, 0.5, 1)] == [1, 2, 5]  # 48 m^2
    whole = replace(office, spawn_region=None, goal_region=None)
    assert len(with_walkers(whole, difficulty=1).movers) == round(0.1 * 10 * 9)
    with_walkers(office, difficulty=0.6).save(tmp_path / "many.world.npz")
    assert main(["worlds", "show", str(tmp_path / "many.world.npz"), "--out", str(tmp_path / "many.png")]) == 0
    shown = capsys.readouterr().out
    assert "3 movers (6.2 per 100 m^2 where episodes start and end" in shown
    assert "which is many (docs/movers.md)" in shown


def test_walkers_stay_where_episodes_start_and_end():
    world = get_world("inspect+walkers:3@1")
    assert all(isinstance(mover.motion, Wander) and mover.motion.area == world.spawn_range for mover in world.movers)
    places = walk(begun([world] * 4), 100)
    low, high = torch.tensor(world.spawn_range).T
    assert ((places > low) & (places < high)).all()


@pytest.mark.parametrize("name", ["corridor", "crossing"])
def test_people_walk_to_their_goals_and_come_by(name):
    field = begun([get_world(f"{name}@1")] * 4)
    began = field.state.position.clone()
    farthest = (walk(field, 300) - began).norm(dim=-1).amax(0)
    # A way of 8 m and more; a fifth of the people may have a short one.
    assert (farthest > 5).float().mean() > 0.8
