"""What all generators have in common: names, areas, difficulties, scales, determinism, and ways to every goal."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
import torch

from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.paths import shortest_paths
from rover_rl.worlds import WORLDS, Terrain, World, get_world, takes_scale

NAMES = sorted(WORLDS)
DEFAULT_LAYOUTS = {
    ("maze", 0): "f6f06cadf7cce79a",
    ("maze", 10063): "2408d25cb26f037e",
    ("moon", 0): "52aaa7cc14ae750e",
    ("moon", 10063): "937f1742eb322dcd",
    ("inspect", 0): "fefc6ad423026b8f",
    ("inspect", 10063): "0ebad298d05e6410",
}
"""Digests of layouts from before generators had a difficulty."""
UNSCALED = f"{__name__}:unscaled"


def unscaled(seed: int) -> World:
    return World(f"unscaled-{seed}", Terrain.flat((10, 10)))


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
    layouts = [digest(WORLDS[name](seed, level)) for seed, level in ((3, 0), (3, 0), (4, 0), (3, 0.8))]
    assert layouts[0] == layouts[1]
    assert len(set(layouts)) == 3
    assert digest(WORLDS[name](5)) == digest(WORLDS[name](seed=5, difficulty=0.5))
    for difficulty in (-0.01, 1.01, float("nan")):
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
    assert (world.name, world.bounds, world.spawn_height) == (name, bounds, spawn_height)
    assert world.spawn_range == world.goal_range == task_area


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


@pytest.mark.parametrize("name", ["maze:3", "forest:3", "inspect:3@1", "moon:3"])
def test_points_are_inside_of_the_same_obstacles_on_the_same_ground_of_a_wider_world(name):
    world, wide = get_world(name), get_world(f"{name}*1.7")
    middle = torch.tensor(world.spawn_range, dtype=torch.float64).mean(1)
    noise = torch.rand(2000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    xy, upward = middle + 16 * (noise - 0.5), 1.0 if world.terrain.is_flat else 1.7
    moved, ground = middle + 1.7 * (xy - middle), world.height_at(xy)[:, None]
    assert torch.allclose(wide.height_at(moved)[:, None], upward * ground, atol=1e-6)
    points, wide_points = torch.cat((xy, ground + 0.3), -1), torch.cat((moved, upward * (ground + 0.3)), -1)
    for obstacle, other in zip(world.obstacles, wide.obstacles, strict=True):
        assert torch.equal(other.contains(wide_points), obstacle.contains(points))


def test_people_stay_as_large_as_they_are_where_ways_are_wider():
    for name in ("plaza:3", "corridor:3", "crossing:3", "field:3", "yard:3"):
        world, wide = get_world(name), get_world(f"{name}*1.5")
        assert [mover.shape for mover in wide.movers] == [mover.shape for mover in world.movers]
        for (low, high), (wide_low, wide_high) in zip(world.bounds, wide.bounds, strict=True):
            assert wide_high - wide_low == pytest.approx(1.5 * (high - low))
    assert len(get_world("maze+walkers:3*1.5").movers) > len(get_world("maze+walkers:3").movers)
    with pytest.raises(ValueError, match="has movers: only its function can scale it"):
        get_world("maze+walkers:3").scaled(1.5)


def test_only_worlds_whose_layout_can_be_larger_take_a_scale():
    names = {"maze:*": True, "maze:3*2": False, f"{UNSCALED}:3": False, "a/b.sdf": False}
    assert {name: takes_scale(name) for name in names} == names
    assert get_world("maze:3*1") is get_world("maze:3")
    assert get_world(f"{UNSCALED}:3*1") is get_world(f"{UNSCALED}:3")
    for name, part in ((f"{UNSCALED}:3*2", UNSCALED), ("yard.yaml*2", "yard.yaml")):
        with pytest.raises(ValueError, match=f"world '{part}' takes no scale, got 2"):
            get_world(name)
