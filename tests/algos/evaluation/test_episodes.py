from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from rover_rl import RoverEnv, World
from rover_rl.algos.evaluation.episodes import STORED_WORLDS, EpisodeSet, draw_episodes, stored_episodes
from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.paths import shortest_paths
from rover_rl.worlds import Terrain, box, get_world
from tests.algos.evaluation.drives import FIELD

ROVER = get_robot("rover_zero")
WALL = World("wall", Terrain.flat((12.0, 12.0)), [box((0.0, 0.0, 0.5), (0.2, 6.0, 1.0))])


def length(world: World, start: tuple[float, float], goal: tuple[float, float]) -> float:
    return shortest_paths(world, ROVER, torch.tensor([start]), torch.tensor([goal])).item()


def assert_same(a: EpisodeSet, b: EpisodeSet) -> None:
    assert torch.equal(a.start, b.start)
    assert torch.equal(a.goal, b.goal)
    torch.testing.assert_close(a.shortest, b.shortest, rtol=0, atol=1e-4)


# --- sets


def test_a_seed_always_gives_the_same_episodes() -> None:
    episodes = draw_episodes(FIELD, 3, seed=1)
    assert_same(draw_episodes(FIELD, 3, seed=1), episodes)
    assert_same(draw_episodes(FIELD, 5, seed=1).first(3), episodes)
    assert not torch.equal(draw_episodes(FIELD, 3, seed=50).goal, episodes.goal)


def test_a_draw_is_the_first_episode_of_an_environment() -> None:
    drawn = draw_episodes("maze:3", 2, seed=5, min_path=0)
    env = RoverEnv(world_n="maze:3", num_envs=2, seed=5 + 2**32 * 3, backend="warp")
    start, goal = env.reset()["pose"][:, :2], env.goal
    torch.testing.assert_close(start, drawn.start[:, :2], rtol=0, atol=0.05)  # It settles on the ground.
    torch.testing.assert_close(goal, drawn.goal)
    env.close()


def test_only_short_paths_are_skipped() -> None:
    near, far = draw_episodes(FIELD, 40, seed=1, min_path=0), draw_episodes(FIELD, 10, seed=1, min_path=4)
    kept = near.shortest >= 4
    assert 10 <= kept.sum() < 40
    assert torch.equal(near.start[kept][:10], far.start)
    assert torch.equal(near.goal[kept][:10], far.goal)


def test_the_robot_decides_which_ground_is_free() -> None:
    wide = replace(ROVER, radius=0.9)
    default, drawn = draw_episodes(WALL, 30, seed=1), draw_episodes(WALL, 30, seed=1, robot=wide)
    assert_same(draw_episodes(WALL, 30, seed=1, robot="rover_zero"), default)
    free = free_space(WALL, wide)
    assert free.contains(drawn.start[:, :2]).all()
    assert free.contains(drawn.goal).all()
    assert not free.contains(torch.cat((default.start[:, :2], default.goal))).all()
    assert torch.equal(drawn.shortest, shortest_paths(WALL, wide, drawn.start, drawn.goal))


@pytest.mark.parametrize(("world", "count"), [("maze", 32), ("inspect", 64), ("moon", 4)])
def test_stored_episodes_are_the_first_that_are_drawn(world: str, count: int) -> None:
    drawn, stored = draw_episodes(world, count), stored_episodes(world).first(count)
    assert torch.equal(drawn.start, stored.start)
    assert torch.equal(drawn.goal, stored.goal)
    torch.testing.assert_close(drawn.shortest, stored.shortest, rtol=0, atol=2e-3)


@pytest.mark.parametrize("world", STORED_WORLDS)
def test_stored_episodes(world: str) -> None:
    episodes = stored_episodes(world)
    assert len(episodes) == 256
    assert episodes.world is get_world(world)
    assert (episodes.start.shape, episodes.goal.shape) == ((256, 3), (256, 2))
    straight = torch.linalg.vector_norm(episodes.goal - episodes.start[:, :2], dim=1) - 0.5
    assert (episodes.shortest >= straight - 1e-4).all()
    assert episodes.shortest.min() >= 2
    assert episodes.shortest.isfinite().all()


def test_invalid_arguments_raise() -> None:
    for arguments, message in (
        ({"count": 0}, "count must be at least 1"),
        ({"world": "mars"}, "unknown world 'mars'"),
        ({"robot": "tank"}, "unknown robot 'tank'"),
        ({"count": 2, "min_path": 50}, "hardly any shortest path of 50 m"),
    ):
        with pytest.raises(ValueError, match=message):
            draw_episodes(**{"world": FIELD, **arguments})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no episodes are stored for world 'maze:7'"):
        stored_episodes("maze:7")
    with pytest.raises(ValueError, match="count must be between 1 and 256, got 257"):
        stored_episodes("maze").first(257)


def around_the_wall(gap: float) -> float:
    """Length from (-2, 0) to 0.5 m before (2, 0) along arcs of radius ``gap`` around the corners of the wall."""
    to_corner = math.hypot(1.9, 3.0)
    bend = math.atan2(3.0, 1.9) + math.asin(gap / to_corner)
    return 2 * (math.sqrt(to_corner**2 - gap**2) + gap * bend) + 0.2 - 0.5


def test_the_path_around_a_wall() -> None:
    # The rover's disc of 0.35 m stays clear of the wall, to within a cell of 0.1 m.
    path = length(WALL, (-2.0, 0.0), (2.0, 0.0))
    assert around_the_wall(0.35) < path < around_the_wall(0.35 + 0.1 * math.sqrt(2))
    assert length(WALL, (2.0, 0.0), (-2.0, 0.0)) == pytest.approx(path, rel=0.005)
