"""Sets of episodes: drawn, stored, in one world and in several."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from rover_rl import RoverEnv
from rover_rl.algos.evaluation.episodes import STORED_WORLDS, EpisodeSet, draw_episodes, stored_episodes
from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.paths import shortest_paths
from rover_rl.worlds import get_world
from tests.algos.evaluation.drives import CRATES, EPISODES, FIELD, POOL, WALL

ROVER = get_robot("rover_zero")


def assert_same(a: EpisodeSet, b: EpisodeSet) -> None:
    assert torch.equal(a.start, b.start)
    assert torch.equal(a.goal, b.goal)
    torch.testing.assert_close(a.shortest, b.shortest, rtol=0, atol=1e-4)


def test_a_seed_always_gives_the_same_episodes_and_only_short_paths_are_skipped() -> None:
    episodes = draw_episodes(FIELD, 3, seed=1)
    assert_same(draw_episodes(FIELD, 3, seed=1), episodes)
    assert_same(draw_episodes(FIELD, 5, seed=1).first(3), episodes)
    assert not torch.equal(draw_episodes(FIELD, 3, seed=50).goal, episodes.goal)
    near, far = draw_episodes(FIELD, 40, seed=1, min_path=0), draw_episodes(FIELD, 10, seed=1, min_path=4)
    kept = near.shortest >= 4
    assert 10 <= kept.sum() < 40
    assert torch.equal(near.start[kept][:10], far.start)
    assert torch.equal(near.goal[kept][:10], far.goal)


def test_a_draw_is_the_first_episode_of_an_environment() -> None:
    drawn = draw_episodes("maze:3", 2, seed=5, min_path=0)
    env = RoverEnv(world_n="maze:3", num_envs=2, seed=5 + 2**32 * 3, backend="warp")
    start, goal = env.reset()["pose"][:, :2], env.goal
    torch.testing.assert_close(start, drawn.start[:, :2], rtol=0, atol=0.05)  # It settles on the ground.
    torch.testing.assert_close(goal, drawn.goal)
    env.close()


def test_each_world_has_the_episodes_that_it_has_alone() -> None:
    assert EPISODES.name == "field, wall, crates"
    assert EPISODES.world_index.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert EPISODES.worlds[3:6] == [WALL] * 3
    assert [EPISODES.world_name(episode) for episode in (0, 3, 8)] == ["field", "wall", "crates"]
    here = EPISODES.part(6, 9)
    assert_same(here, draw_episodes(CRATES, 3, seed=1))
    assert here.world is POOL[2]
    with pytest.raises(ValueError, match="the episodes are in 3 worlds"):
        _ = EPISODES.world


def test_the_robot_decides_which_ground_is_free() -> None:
    wide = replace(ROVER, radius=0.9)
    default, drawn = draw_episodes(WALL, 30, seed=1), draw_episodes(WALL, 30, seed=1, robot=wide)
    free = free_space(WALL, wide)
    assert free.contains(drawn.start[:, :2]).all()
    assert free.contains(drawn.goal).all()
    assert not free.contains(torch.cat((default.start[:, :2], default.goal))).all()
    assert torch.equal(drawn.shortest, shortest_paths(WALL, wide, drawn.start, drawn.goal))


@pytest.mark.parametrize("world", STORED_WORLDS)
def test_stored_episodes_are_the_first_that_are_drawn(world: str) -> None:
    episodes, drawn = stored_episodes(world), draw_episodes(world, 4)
    assert (episodes.start.shape, episodes.goal.shape) == ((256, 3), (256, 2))
    assert episodes.world is get_world(world)
    straight = torch.linalg.vector_norm(episodes.goal - episodes.start[:, :2], dim=1) - 0.5
    assert (episodes.shortest >= straight - 1e-4).all()
    assert episodes.shortest.min() >= 2
    assert episodes.shortest.max() < math.inf
    assert torch.equal(drawn.start, episodes.start[:4])
    assert torch.equal(drawn.goal, episodes.goal[:4])
    torch.testing.assert_close(drawn.shortest, episodes.shortest[:4], rtol=0, atol=2e-3)


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


def test_the_path_around_a_wall() -> None:
    def length(gap: float) -> float:
        """From (-2, 0) to 0.5 m before (2, 0) along arcs of radius ``gap`` around the ends of the wall."""
        to_corner = math.hypot(1.8, 2.0)
        bend = math.atan2(2.0, 1.8) + math.asin(gap / to_corner)
        return 2 * (math.sqrt(to_corner**2 - gap**2) + gap * bend) + 0.4 - 0.5

    start, goal = torch.tensor([[-2.0, 0.0], [2.0, 0.0]]), torch.tensor([[2.0, 0.0], [-2.0, 0.0]])
    there, back = shortest_paths(WALL, ROVER, start, goal).tolist()
    # The rover's disc of 0.35 m stays clear of the wall, to within a cell of 0.1 m.
    assert length(0.35) < there < length(0.35 + 0.1 * math.sqrt(2))
    assert there == pytest.approx(back, rel=0.005)
