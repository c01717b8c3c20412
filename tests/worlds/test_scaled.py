"""Worlds with wider passages have the same layout."""

from __future__ import annotations

import pytest
import torch

from rover_rl import World
from rover_rl.worlds import Terrain, get_world, takes_scale

UNSCALED = f"{__name__}:unscaled"


def unscaled(seed: int) -> World:
    return World(f"unscaled-{seed}", Terrain.flat((10, 10)))


def middle(world):
    return torch.tensor([(low + high) / 2 for low, high in world.spawn_range])


@pytest.mark.parametrize("name", ["maze:3", "rooms:3@1", "forest:3", "inspect:3@1", "moon:3", "ramps:3"])
def test_points_are_inside_of_the_same_obstacles_on_the_same_ground(name):
    world, wide = get_world(name), get_world(f"{name}*1.7")
    assert len(wide.obstacles) == len(world.obstacles)
    upward = 1.0 if world.terrain.is_flat else 1.7
    xy = middle(world) + 16 * (
        torch.rand(2000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5
    )
    moved = middle(world) + 1.7 * (xy - middle(world))
    ground = world.height_at(xy)
    assert torch.allclose(wide.height_at(moved), upward * ground, atol=1e-6)
    points = torch.cat((xy, ground[:, None] + 0.3), -1)
    inside = torch.stack([obstacle.contains(points) for obstacle in world.obstacles])
    points = torch.cat((moved, upward * (ground[:, None] + 0.3)), -1)
    assert torch.equal(torch.stack([obstacle.contains(points) for obstacle in wide.obstacles]), inside)
    assert world.terrain.is_flat or inside.any(0).float().mean() < 0.9


def test_people_stay_as_large_as_they_are_where_ways_are_wider():
    for name in ("plaza:3", "corridor:3", "crossing:3", "field:3", "yard:3"):
        world, wide = get_world(name), get_world(f"{name}*1.5")
        assert [mover.shape for mover in wide.movers] == [mover.shape for mover in world.movers]
        for (low, high), (wide_low, wide_high) in zip(world.bounds, wide.bounds, strict=True):
            assert wide_high - wide_low == pytest.approx(1.5 * (high - low))
    assert len(get_world("maze+walkers:3*1.5").movers) > len(get_world("maze+walkers:3").movers)
    with pytest.raises(ValueError, match="has movers: only its function can scale it"):
        get_world("maze+walkers:3").scaled(1.5)


def test_a_scale_of_1_is_the_world_itself_and_a_scale_that_a_world_does_not_take_is_refused():
    assert get_world("maze:3*1") is get_world("maze:3")
    assert get_world(f"{UNSCALED}:3*1") is get_world(f"{UNSCALED}:3")
    for name, message in {
        f"{UNSCALED}:3*2": f"world '{UNSCALED}' takes no scale, got 2",
        "yard.yaml*2": "world 'yard.yaml' takes no scale, got 2",
    }.items():
        with pytest.raises(ValueError, match=message):
            get_world(name)


def test_only_worlds_whose_layout_can_be_larger_take_a_scale():
    names = {"maze:*": True, "maze:3*2": False, f"{UNSCALED}:3": False, "a/b.sdf": False}
    assert {name: takes_scale(name) for name in names} == names
