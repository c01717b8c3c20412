"""Rays against ground and obstacles, compared with geometry."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl.sims.rays import RayCaster
from rover_rl.sims.worlds import Terrain, World, box
from rover_rl.sims.worlds.table import WorldTable

FLAT = World("flat", Terrain.flat((20.0, 12.0), height=0.5))
BOXES = [box((3.0, 0.0, 1.0), (2.0, 2.0, 2.0)), box((3.0, 5.0, 1.0), (1.0, 1.0, 2.0))]
BOX = World("box", Terrain.flat((20.0, 20.0)), BOXES)
SLOPE = World("slope", Terrain([[-5.0, 5.0], [-5.0, 5.0]], cell=20.0))


def cast(world: World, origin: tuple[float, ...], *directions: tuple[float, ...]) -> list[float]:
    origins = torch.tensor(origin).expand(1, len(directions), 3)
    return RayCaster(WorldTable([world])).cast(origins, torch.tensor(directions)[None])[0].tolist()


def test_flat_ground() -> None:
    down, across, up, long = cast(FLAT, (9.0, -5.0, 2.5), (0, 0, -1), (-1, 0, -1), (0, 0, 1), (0, 0, -7))
    assert (down, across, up, long) == pytest.approx((2.0, 2 * math.sqrt(2), math.inf, 2.0), rel=1e-6)


def test_beyond_the_edge_of_the_terrain_there_is_no_return() -> None:
    assert cast(FLAT, (9.0, 0.0, 2.5), (1.0, 0.0, -1.0)) == [math.inf]


def test_a_box() -> None:
    ahead, aside, over, above = cast(BOX, (0.0, 0.0, 1.0), (1, 0, 0), (1, 1, 0), (2, 0, 1.01), (1, 0.2, 0.1))
    assert ahead == pytest.approx(2.0, rel=1e-6)
    assert aside == math.inf
    assert over == math.inf
    assert above == pytest.approx(2.0 * math.sqrt(1 + 0.04 + 0.01), rel=1e-6)
    assert cast(BOX, (3.0, 0.0, 5.0), (0.0, 0.0, -1.0)) == pytest.approx([3.0], rel=1e-6)


def test_a_ray_from_inside_of_a_solid_is_0() -> None:
    assert cast(BOX, (3.0, 0.0, 1.0), (1.0, 0.0, 0.0)) == [0.0]
    assert cast(FLAT, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)) == [0.0]


def test_a_slope() -> None:
    # The ground rises by 1 m in 2 m along x: a level ray at 1 m meets it at x = 2, and a perpendicular one at once.
    level, steep = cast(SLOPE, (-4.0, 3.0, 1.0), (1.0, 0.0, 0.0), (0.5, 0.0, -1.0))
    assert level == pytest.approx(6.0, rel=1e-6)
    assert steep == pytest.approx(3.0 * 2 / math.sqrt(5), rel=1e-6)


def test_hills_have_the_heights_of_the_terrain() -> None:
    generator = torch.Generator().manual_seed(0)
    hills = Terrain(torch.rand(21, 31, generator=generator), cell=0.5)
    points = torch.rand(1, 500, 2, generator=generator) * torch.tensor([14.0, 9.0]) - torch.tensor([7.0, 4.5])
    origins = torch.cat((points, torch.full((1, 500, 1), 3.0)), -1)
    down = torch.tensor([0.0, 0.0, -1.0]).expand_as(origins)
    ranges = RayCaster(WorldTable([World("hills", hills)])).cast(origins, down)
    torch.testing.assert_close(3.0 - ranges, hills.height_at(points), atol=1e-5, rtol=0)


def test_each_row_is_in_its_own_world_and_independent_of_the_others() -> None:
    generator = torch.Generator().manual_seed(1)
    origins = torch.rand(6, 40, 3, generator=generator) * 4 + torch.tensor([-3.0, -2.0, 0.6])
    directions = torch.randn(6, 40, 3, generator=generator)
    worlds = [FLAT, BOX, SLOPE, BOX, FLAT, SLOPE]
    together = RayCaster(WorldTable(worlds)).cast(origins, directions)
    for row, world in enumerate(worlds):
        alone = RayCaster(WorldTable([world])).cast(origins[row : row + 1], directions[row : row + 1])
        assert torch.equal(together[row], alone[0])


def test_rows_change_worlds() -> None:
    table = WorldTable([FLAT, FLAT], spare=0)
    caster = RayCaster(table)
    origins, down = torch.tensor([[[3.0, 0.0, 5.0]]] * 2), torch.tensor([[[0.0, 0.0, -1.0]]] * 2)
    assert caster.cast(origins, down).flatten().tolist() == [4.5, 4.5]
    table.assign(torch.tensor([1]), [BOX])
    assert caster.cast(origins, down).flatten().tolist() == [4.5, 3.0]
    table.assign(torch.tensor([0, 1]), [SLOPE, FLAT])
    assert caster.cast(origins, down).flatten().tolist() == pytest.approx([3.5, 4.5], rel=1e-6)
