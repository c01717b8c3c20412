"""What all generators have in common: the layouts of before, difficulties, determinism, and ways to every goal."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
import torch

from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.paths import shortest_paths
from rover_rl.worlds import WORLDS

NAMES = sorted(WORLDS)
DEFAULT_LAYOUTS = {
    ("maze", 0): "f6f06cadf7cce79a",
    ("maze", 3): "a01b027d4e1a6cc4",
    ("maze", 17): "2646dbc2dd0e5ffa",
    ("maze", 10063): "2408d25cb26f037e",
    ("moon", 0): "52aaa7cc14ae750e",
    ("moon", 3): "2ef2a97fe65ccd8a",
    ("moon", 17): "629d16ac0d10b78c",
    ("moon", 10063): "937f1742eb322dcd",
    ("inspect", 0): "fefc6ad423026b8f",
    ("inspect", 3): "4ceb1f91bb81ebf2",
    ("inspect", 17): "8c7312be8a05ded3",
    ("inspect", 10063): "0ebad298d05e6410",
}
"""Digests of layouts from before generators had a difficulty."""


def digest(world) -> str:
    """Digest of heights and vertices, in units of 0.1 mm: it does not depend on the last bits of a processor."""
    digest = hashlib.sha256()
    for numbers in (world.terrain.heights.double(), *(obstacle.vertices for obstacle in world.obstacles)):
        digest.update(np.rint(numbers.numpy() * 1e4).astype("<i8").tobytes())
    digest.update(repr(world.movers).encode() if world.movers else b"")
    return digest.hexdigest()[:16]


@pytest.mark.parametrize(("name", "seed"), DEFAULT_LAYOUTS)
def test_layouts_of_the_default_difficulty_never_change(name, seed):
    assert digest(WORLDS[name](seed)) == DEFAULT_LAYOUTS[name, seed]


@pytest.mark.parametrize("name", NAMES)
def test_seed_and_difficulty_determine_a_layout(name):
    layouts = [digest(WORLDS[name](seed, difficulty)) for seed in (3, 4) for difficulty in (0.0, 0.8) for _ in range(2)]
    assert layouts[::2] == layouts[1::2]
    assert len(set(layouts)) == 4
    assert digest(WORLDS[name](5)) == digest(WORLDS[name](seed=5, difficulty=0.5))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("difficulty", [-0.01, 1.01, float("nan")])
def test_a_difficulty_out_of_range_raises(name, difficulty):
    with pytest.raises(ValueError, match="^difficulty must be a number from 0 to 1, got"):
        WORLDS[name](0, difficulty)


@pytest.mark.parametrize(
    ("name", "task_area", "bounds", "spawn_height"),
    [
        ("inspect", ((-27, -19), (-27, -19)), ((-29, -13), (-29, -17)), 5.5),
        ("moon", ((-4, 4), (-4, 4)), ((-20, 10), (-20, 20)), 0.75),
        ("maze", ((-4, 4), (-4, 4)), ((-30, 30), (-30, 30)), 0.75),
        ("forest", ((-4, 4), (-4, 4)), ((-5, 5), (-5, 5)), 0.75),
        ("hills", ((-6, 6), (-6, 6)), ((-10, 10), (-10, 10)), 0.75),
        ("rooms", ((-7, 7), (-7, 7)), ((-8, 8), (-8, 8)), 0.75),
        ("ramps", (pytest.approx((-8.2, 8.2)),) * 2, (pytest.approx((-8.8, 8.8)),) * 2, 0.75),
    ],
)
def test_names_areas_and_spawn_heights(name, task_area, bounds, spawn_height):
    world = WORLDS[name](1, 0.7)
    assert world.name == name
    assert world.spawn_range == world.goal_range == task_area
    assert world.bounds == bounds
    assert world.spawn_height == spawn_height


@pytest.mark.parametrize("name", NAMES)
def test_the_hardest_layouts_have_a_way_to_every_goal(name):
    world, robot = WORLDS[name](11, 1.0), get_robot("rover_zero")
    free = free_space(world, robot)
    assert min(len(free.spawn_cells), len(free.goal_cells)) > 500
    picks = torch.Generator().manual_seed(0)
    start = free.spawn_cells[torch.randint(len(free.spawn_cells), (4,), generator=picks)]
    goal = free.goal_cells[torch.randint(len(free.goal_cells), (4,), generator=picks)]
    lengths = shortest_paths(world, robot, start, goal)
    assert lengths.isfinite().all()
    assert (lengths >= (goal - start).norm(dim=1) - 0.5 - 1e-4).all()
