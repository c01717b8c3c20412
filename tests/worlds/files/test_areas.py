"""Areas of imported buildings: starts and goals lie inside."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.path import Path as Outline

from rover_rl.envs.placement import Placement
from rover_rl.rng import episode_keys, row_keys
from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.worlds import World
from rover_rl.worlds.table import WorldTable
from tests.extras import needs_worlds
from tests.worlds.files.test_maps import write_map

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
    parts = "".join(
        f"<collision name='c{k}'><pose>{(a + c) / 2} {(b + d) / 2} 1 0 0 {math.atan2(d - b, c - a)}</pose><geometry>"
        f"<box><size>{math.hypot(c - a, d - b)} 0.2 2</size></box></geometry></collision>"
        for k, (a, b, c, d) in enumerate(walls)
    )
    plane = "<collision name='p'><geometry><plane><size>9 9</size></plane></geometry></collision>"
    model = f"<model name='m'><static>1</static><link name='l'>{plane}{parts}</link></model>"
    (folder / "building.sdf").write_text(f"<sdf version='1.9'><world name='default'>{model}</world></sdf>")
    return World.from_file(folder / "building.sdf", **options)


HOUSE = [(0, 0), (8, 0), (8, 6), (0, 6)]
L_HALL = [(0, 0), (12, 0), (12, 4), (4, 4), (4, 12), (0, 12)]
DIVIDED = [(5, 0, 5, 2.4), (5, 3.6, 5, 6)]
"""A wall with a door between two rooms of the house."""
BUILDINGS: dict[str, tuple[list[tuple[float, float]], list[Wall]]] = {
    "shut house": (HOUSE, rectangle(0, 0, 8, 6)),
    "house in a yard with trees": (HOUSE, [*rectangle(0, 0, 8, 6, 1.0), (-9, -8, -8.8, -8), (15, 12, 15.2, 12)]),
    "shut house in a fenced yard": (HOUSE, rectangle(0, 0, 8, 6) + rectangle(-6, -6, 20, 18)),
    "open house in a fenced yard": (HOUSE, rectangle(0, 0, 8, 6, 1.2) + rectangle(-6, -6, 20, 18)),
    "yard with a gate": (HOUSE, rectangle(0, 0, 8, 6, 0.9) + rectangle(-6, -6, 20, 18, 3.0)),
    "L-shaped hall": (L_HALL, [(*a, *b) for a, b in zip(L_HALL, L_HALL[1:] + L_HALL[:1], strict=True)]),
    "two rooms with a door": (HOUSE, rectangle(0, 0, 8, 6) + DIVIDED),
    "two rooms with doors in a yard": (HOUSE, rectangle(0, 0, 8, 6, 1.0) + DIVIDED + rectangle(-6, -6, 20, 18)),
    "hall with a gate": ([(0, 0), (20, 0), (20, 12), (0, 12)], rectangle(0, 0, 20, 12, 3.6)),
}


@pytest.mark.parametrize("name", BUILDINGS)
def test_starts_and_goals_of_a_building_lie_inside(tmp_path, name):
    outline, walls = BUILDINGS[name]
    world = building(tmp_path, *walls)
    assert world.name == "building"
    assert any("the interior that the obstacles enclose" in note for note in world.notes)
    space, inside = free_space(world, ROVER), Outline(outline)
    for cells in (space.spawn_cells.numpy(), space.goal_cells.numpy()):
        assert len(cells) > 1000
        assert inside.contains_points(cells, radius=0).all()
        # All of the building is used, but for a strip along the walls.
        corners = np.array(outline) * 0.8 + np.mean(outline, 0) * 0.2 if len(outline) == 4 else np.array(outline)
        assert all(np.linalg.norm(cells - corner, axis=1).min() < 1.3 for corner in corners)


def test_a_thousand_episodes_start_and_end_inside(tmp_path):
    outline, walls = BUILDINGS["two rooms with doors in a yard"]
    placement = Placement(WorldTable([building(tmp_path, *walls)] * 1000), ROVER, 1.0)
    keys = episode_keys(row_keys(0, 1000, "cpu"), 1)
    starts = placement.draw_start(keys)[:, :2]
    goals = placement.draw_goal(keys, torch.zeros_like(keys), starts)
    for points in (starts.numpy(), goals.numpy()):
        assert Outline(outline).contains_points(points).all()
        assert 200 < (points[:, 0] > 5).sum() < 800


def test_a_cabin_in_a_hall_and_rooms_around_a_corridor_are_no_buildings_in_a_yard(tmp_path):
    hall = building(tmp_path, *rectangle(0, 0, 30, 20), *rectangle(20, 12, 4, 4, 0.9))
    assert free_space(hall, ROVER).spawn_cells.amin(0).tolist() == pytest.approx([0.5, 0.5], abs=0.2)
    rooms = [*rectangle(5, 5, 4, 4, 0.9), *rectangle(9, 5, 4, 4, 0.9), *rectangle(13, 5, 4, 4, 0.9)]
    office = building(tmp_path, *rectangle(2.8, 2.8, 16.4, 8.4), *rooms)
    assert free_space(office, ROVER).spawn_cells.amax(0).tolist() == pytest.approx([18.7, 10.7], abs=0.2)


def test_scattered_obstacles_enclose_nothing(tmp_path):
    trunks = [(x, y, x + 0.25, y) for x in np.arange(-5, 5, 1.3) for y in np.arange(-5, 5, 1.3)]
    world = building(tmp_path, *trunks)
    assert world.spawn_region is None
    assert any("open ground" in note for note in world.notes)


def test_a_point_is_the_room_around_it(tmp_path):
    outline, walls = BUILDINGS["two rooms with doors in a yard"]
    world = building(tmp_path, *walls, spawn_range=(2.0, 3.0), goal_range=(7.0, 3.0))
    space = free_space(world, ROVER)
    assert space.spawn_cells[:, 0].max() < 5 < space.goal_cells[:, 0].min()
    assert world.notes == (
        "spawn area: the room around (2, 3), 21 m^2 of free ground",
        "goal area: the room around (7, 3), 10 m^2 of free ground",
    )
    yard = free_space(building(tmp_path, *walls, spawn_range=(-3, -3)), ROVER).spawn_cells
    assert not Outline(outline).contains_points(yard.numpy()).any()
    for point, message in (
        ((0, 3), "in an obstacle, or too close to one"),
        ((-8, 3), "lies outside"),
        ((90, 0), "out"),
    ):
        with pytest.raises(ValueError, match=message):
            building(tmp_path, *walls, spawn_range=point)


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
