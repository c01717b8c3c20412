"""Rays against ground and obstacles, compared with geometry."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl.sims.rays import RayCaster
from rover_rl.worlds import Terrain, World, box
from rover_rl.worlds.table import WorldTable

FLAT = World("flat", Terrain.flat((20.0, 12.0), height=0.5))
BOXES = [box((3.0, 0.0, 1.0), (2.0, 2.0, 2.0)), box((3.0, 5.0, 1.0), (1.0, 1.0, 2.0))]
BOX = World("box", Terrain.flat((20.0, 20.0)), BOXES)
SLOPE = World("slope", Terrain([[-5.0, 5.0], [-5.0, 5.0]], cell=20.0))


@pytest.mark.parametrize(
    ("world", "origin", "directions", "expected"),
    [
        (FLAT, (9, -5, 2.5), [(0, 0, -1), (-1, 0, -1), (0, 0, 1), (0, 0, -7)], [2, 2 * math.sqrt(2), math.inf, 2]),
        # Beyond the edge of the terrain there is no return.
        (FLAT, (9, 0, 2.5), [(1, 0, -1)], [math.inf]),
        # Ahead at a box, aside and above of it, and ahead at an angle.
        (
            BOX,
            (0, 0, 1),
            [(1, 0, 0), (1, 1, 0), (2, 0, 1.01), (1, 0.2, 0.1)],
            [2, math.inf, math.inf, 2 * math.sqrt(1 + 0.04 + 0.01)],
        ),
        (BOX, (3, 0, 5), [(0, 0, -1)], [3]),
        # From inside of a solid, and of the ground.
        (BOX, (3, 0, 1), [(1, 0, 0)], [0]),
        (FLAT, (0, 0, 0), [(0, 0, 1)], [0]),
        # The ground rises by 1 m in 2 m along x: a level ray at 1 m meets it at x = 2, and a perpendicular one at once.
        (SLOPE, (-4, 3, 1), [(1, 0, 0), (0.5, 0, -1)], [6, 3 * 2 / math.sqrt(5)]),
    ],
)
def test_ranges_are_those_of_geometry(world: World, origin: Any, directions: Any, expected: list[float]) -> None:
    origins = torch.tensor(origin, dtype=torch.float32).expand(1, len(directions), 3)
    ranges = RayCaster(WorldTable([world])).cast(origins, torch.tensor(directions, dtype=torch.float32)[None])
    assert ranges[0].tolist() == pytest.approx(expected, rel=1e-6, abs=0)


@settings(deadline=None, max_examples=20)
@given(
    seed=st.integers(0, 2**31),
    # Starts and directions on lines, corners and diagonals of the grid, too.
    start=st.tuples(st.floats(-4, 4) | st.integers(-4, 4), st.floats(-3, 3) | st.integers(-3, 3), st.floats(0.3, 3)),
    heading=st.sampled_from([0.0, math.pi / 2, math.pi, math.pi / 4, -math.pi / 4]) | st.floats(0, 2 * math.pi),
    pitch=st.floats(-math.pi / 2, 0.3),
    farthest=st.sampled_from([2.0, math.inf]),
)
def test_a_ray_ends_where_it_meets_the_ground_and_not_before(
    seed: int, start: tuple[float, ...], heading: float, pitch: float, farthest: float
) -> None:
    hills = Terrain(torch.rand(13, 17, generator=torch.Generator().manual_seed(seed)), cell=0.5)
    direction = torch.tensor(
        [math.cos(pitch) * math.cos(heading), math.cos(pitch) * math.sin(heading), math.sin(pitch)]
    )
    origin = torch.tensor(start)
    origin[2] += hills.height_at(origin[:2])
    caster = RayCaster(WorldTable([World("hills", hills)]))
    length = caster.cast(origin.expand(1, 1, 3), direction.expand(1, 1, 3), farthest).item()
    assert length == math.inf or length < farthest
    way = torch.linspace(0, min(length, farthest, 12.0), 500)[:-1, None]
    points = origin + way * direction
    (left, right), (bottom, top) = hills.extent
    inside = ((points[:, :2] >= torch.tensor((left, bottom))) & (points[:, :2] <= torch.tensor((right, top)))).all(-1)
    assert (points[:, 2] - hills.height_at(points[:, :2]))[inside].min() > -1e-4
    if length < math.inf:
        end = origin + length * direction
        assert end[2].item() == pytest.approx(hills.height_at(end[:2]).item(), abs=2e-4)


def test_each_row_is_in_its_own_world_which_may_change() -> None:
    table = WorldTable([FLAT, FLAT], spare=0)
    caster = RayCaster(table)
    origins, down = torch.tensor([[[3.0, 0.0, 5.0]]] * 2), torch.tensor([[[0.0, 0.0, -1.0]]] * 2)
    assert caster.cast(origins, down).flatten().tolist() == [4.5, 4.5]
    table.assign(torch.tensor([1]), [BOX])
    assert caster.cast(origins, down).flatten().tolist() == [4.5, 3.0]
    table.assign(torch.tensor([0, 1]), [SLOPE, FLAT])
    assert caster.cast(origins, down).flatten().tolist() == pytest.approx([3.5, 4.5], rel=1e-6)
