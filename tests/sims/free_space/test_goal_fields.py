from __future__ import annotations

import torch
from torch import Tensor

from rover_rl import Terrain, World, box
from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.goal_fields import SAME_GOAL, GoalFields
from rover_rl.sims.free_space.paths import PathDistances
from rover_rl.worlds import get_world

ROVER = get_robot("rover_zero")
WALL = World("wall", Terrain.flat((9, 7)), [box((0, 0, 0.5), (0.4, 4, 1))])
WORLDS = [get_world("maze:1"), WALL, get_world("moon")]


def some(cells: str, count: int) -> tuple[Tensor, Tensor]:
    """Worlds of rows, and a cell in each."""
    world = torch.arange(count) % len(WORLDS)
    found = [getattr(free_space(WORLDS[index], ROVER), cells) for index in world.tolist()]
    numbers = [(997 * row + len(cells) ** 4) % len(values) for row, values in enumerate(found)]
    return world, torch.stack([values[number] for values, number in zip(found, numbers, strict=True)]).float()


def test_lengths_are_those_of_the_shortest_paths() -> None:
    (world, goal), (_, position) = some("goal_cells", 60), some("spawn_cells", 60)
    fields = GoalFields(WORLDS, ROVER)
    fields.aim(world, goal)
    exact = PathDistances(WORLDS, ROVER)(world[:, None], position, goal)[:, 0]
    length, has_path = fields.along(position)
    error = length - exact
    assert has_path.all()
    assert error.abs().mean() < 0.08 * exact.mean()
    assert (error.abs() < 0.2 * exact + 0.6).all()
    # Several positions of a row at once are each of them.
    pair, _ = fields.along(torch.stack((position, goal), 1))
    assert torch.equal(pair[:, 0], length)
    assert (pair[:, 1] < 0.3).all()


def test_the_field_stays_until_the_goal_is_another() -> None:
    (world, goal), (_, position) = some("goal_cells", 6), some("spawn_cells", 6)
    fields = GoalFields(WORLDS, ROVER)
    fields.aim(world, goal)
    before = fields.along(position)[0]
    fields.aim(world, goal + 0.6 * SAME_GOAL)
    assert torch.equal(fields.along(position)[0], before)
    goal[3] = some("goal_cells", 40)[1][36]
    fields.aim(world, goal)
    after = fields.along(position)[0]
    assert after[3] != before[3]
    assert torch.equal(after[:3], before[:3])


def test_a_row_is_the_same_in_any_company() -> None:
    (world, goal), (_, position) = some("goal_cells", 9), some("spawn_cells", 9)
    together = GoalFields(WORLDS, ROVER)
    together.aim(world, goal)
    for row in range(9):
        alone = GoalFields(WORLDS, ROVER)
        alone.aim(world[[row]], goal[[row]])
        assert torch.equal(alone.along(position[[row]])[0], together.along(position)[0][[row]])


def test_no_path_leads_through_walls_and_beyond_the_world() -> None:
    fields = GoalFields([WALL], ROVER)
    fields.aim(torch.tensor([0]), torch.tensor([[2.0, 0.0]]))
    points = torch.tensor([[[-2.0, 0.0], [0.0, 0.0], [0.0, 2.8], [2.0, 0.0], [20.0, 0.0]]])
    length, has_path = fields.along(points)
    assert has_path.tolist() == [[True, False, True, True, False]]
    assert length[0, 0] > length[0, 2] > length[0, 3]
