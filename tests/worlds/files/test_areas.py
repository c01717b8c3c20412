"""Areas of imported worlds: starts and goals lie inside of what is enclosed, or where the options say."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.path import Path as Outline

from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.worlds import World
from tests.extras import needs_worlds
from tests.worlds.files.test_maps import write_map
from tests.worlds.files.test_sdf import link, model, world_of

pytestmark = needs_worlds
Wall = tuple[float, float, float, float]
ROVER = get_robot("rover_zero")


def rectangle(x: float, y: float, width: float, depth: float, door: float = 0.0) -> list[Wall]:
    """Walls around a rectangle, with a door in the middle of the south wall."""
    right, top, middle = x + width, y + depth, x + width / 2
    south = [(x, y, middle - door / 2, y), (middle + door / 2, y, right, y)] if door else [(x, y, right, y)]
    return [*south, (right, y, right, top), (right, top, x, top), (x, top, x, y)]


def building(folder: Path, *walls: Wall, **options) -> World:
    """World of walls 0.2 m thick, each from a point to another, on an infinite plane."""
    links = (
        link(
            f"<box><size>{math.hypot(c - a, d - b)} 0.2 2</size></box>",
            f"{(a + c) / 2} {(b + d) / 2} 1 0 0 {math.atan2(d - b, c - a)}",
            f"l{k}",
        )
        for k, (a, b, c, d) in enumerate(walls)
    )
    return world_of(folder, model("".join(links)), size="9 9", **options)


HOUSE = [(0, 0), (8, 0), (8, 6), (0, 6)]
L_HALL = [(0, 0), (12, 0), (12, 4), (4, 4), (4, 12), (0, 12)]
BUILDINGS: dict[str, tuple[list[tuple[float, float]], list[Wall]]] = {
    "L-shaped hall": (L_HALL, [(*a, *b) for a, b in zip(L_HALL, L_HALL[1:] + L_HALL[:1], strict=True)]),
    "two rooms with a door": (HOUSE, [*rectangle(0, 0, 8, 6), (5, 0, 5, 2.4), (5, 3.6, 5, 6)]),
    "house with a shut box": (HOUSE, rectangle(0, 0, 8, 6) + rectangle(2, 2, 2, 2)),
}


@pytest.mark.parametrize("name", BUILDINGS)
def test_starts_and_goals_are_on_the_largest_ground_that_is_enclosed(tmp_path, name):
    outline, walls = BUILDINGS[name]
    world = building(tmp_path, *walls)
    assert any("areas: enclosed ground" in note for note in world.notes)
    space, inside = free_space(world, ROVER), Outline(outline)
    for cells in (space.spawn_cells.numpy(), space.goal_cells.numpy()):
        assert len(cells) > 1000
        assert inside.contains_points(cells, radius=0).all()
        # All of the building is used, but for a strip along the walls.
        corners = np.array(outline) * 0.8 + np.mean(outline, 0) * 0.2 if len(outline) == 4 else np.array(outline)
        assert all(np.linalg.norm(cells - corner, axis=1).min() < 1.3 for corner in corners)


@pytest.mark.parametrize(
    "walls",
    [
        [(x, y, x + 0.25, y) for x in np.arange(-5, 5, 1.3) for y in np.arange(-5, 5, 1.3)],
        rectangle(0, 0, 8, 6, door=1.2),
        rectangle(0, 0, 2, 2),
    ],
    ids=["trunks", "a house with a door", "a box"],
)
def test_without_any_they_are_on_the_largest_ground(tmp_path, walls):
    world = building(tmp_path, *walls)
    assert any("areas: open ground" in note for note in world.notes)
    assert world.spawn_range[0][0] < walls[0][0] - 2


def test_areas_that_are_given_are_kept(tmp_path):
    areas = {"spawn_range": ((-1, 1), (-2, 2)), "goal_range": ((0, 3), (0, 3)), "bounds": ((-4, 4), (-4, 4))}
    world = building(tmp_path, *rectangle(-5, -5, 10, 10), **areas)
    assert {name: getattr(world, name) for name in areas} == areas


def test_a_point_is_the_free_ground_around_it(tmp_path):
    walls = rectangle(0, 0, 5, 6) + rectangle(5, 0, 3, 6)
    world = building(tmp_path, *walls, spawn_range=(7.0, 3.0))
    assert free_space(world, ROVER).spawn_cells[:, 0].min() > 5
    assert any("spawn area: the free ground around (7, 3)" in note for note in world.notes)
    with pytest.raises(ValueError, match="in an obstacle, too close to one"):
        building(tmp_path, *walls, spawn_range=(0.0, 3.0))


def test_an_area_may_be_a_polygon(tmp_path):
    world = building(tmp_path, *rectangle(0, 0, 8, 6), spawn_range=[(1, 1), (7, 1), (1, 5)])
    cells = free_space(world, ROVER).spawn_cells
    assert (cells[:, 1] - 1 < (7 - cells[:, 0]) * 4 / 6).all()


def test_starts_of_a_map_are_on_known_ground(tmp_path):
    states = np.full((80, 100), 205)
    states[10:70, 10:90] = 254
    states[10:70, [10, 89]] = states[[10, 69], 10:90] = 0
    states[20:50, 40:60] = 205
    world = World.from_file(write_map(tmp_path, states))
    cells = free_space(world, ROVER).spawn_cells
    unseen = torch.tensor([3.0, 1.0]), torch.tensor([5.0, 4.0])
    assert len(cells) > 1000
    assert not ((cells > unseen[0]) & (cells < unseen[1])).all(-1).any()
