"""Weights of the worlds that episodes draw."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rover_rl import RoverEnv, Terrain, World
from rover_rl.sims.worlds.pool import WorldPool

FIELDS = [World(f"field {k}", Terrain.flat((8.0 + k, 8.0))) for k in range(5)]
WEIGHTS = torch.tensor([0.0, 3.0, 1.0, 0.0, 4.0])


def make(num_envs: int = 8, seed: int = 0, world_n=None, **settings) -> RoverEnv:
    pool = WorldPool(*FIELDS) if world_n is None else world_n
    return RoverEnv(world_n=pool, num_envs=num_envs, seed=seed, backend="warp", lidar_beams=32, **settings)


def draws(env: RoverEnv, count: int) -> Tensor:
    """Worlds of the next episodes of each row, ``[count, N]``."""
    return torch.stack([env.reset()["outcome", "world"].squeeze(-1) for _ in range(count)])


def test_worlds_are_drawn_by_their_weights() -> None:
    env = make(64)
    env.set_world_weights(WEIGHTS)
    env.reset()
    counts = draws(env, 10).flatten().bincount(minlength=5)
    assert counts[[0, 3]].tolist() == [0, 0]
    # Of 640 draws, 240, 80 and 320 are expected: three standard deviations are 37, 25 and 38.
    assert (counts - 640 * WEIGHTS / WEIGHTS.sum()).abs().max() < 38


def test_weighted_draws_depend_on_the_row_and_the_episode_alone() -> None:
    company, again = make(8, seed=3), make(8, seed=3)
    alone = make(1, seed=3 + 5)
    for env in (company, again, alone):
        env.set_world_weights(WEIGHTS)
    drawn = draws(company, 12)
    assert torch.equal(draws(again, 12), drawn)
    assert torch.equal(draws(alone, 12)[:, 0], drawn[:, 5])
    assert len(drawn[:, 5].unique()) > 1
    for env in (company, again):
        env.set_seed(3)
        env.reset()
    assert torch.equal(draws(company, 11), draws(again, 11))


def test_the_next_episode_of_each_row_has_drawn_before_the_weights_change() -> None:
    env, plain = make(16, seed=1), make(16, seed=1)
    expected = draws(plain, 3)
    assert torch.equal(draws(env, 2), expected[:2])
    env.set_world_weights(torch.tensor([0.0, 0.0, 0.0, 0.0, 1.0]))
    assert torch.equal(draws(env, 1), expected[2:])
    assert (draws(env, 2) == 4).all()


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (torch.ones(4), r"weights must have the shape \(5,\), one for each world, got \(4,\)"),
        (torch.tensor([1.0, -1, 0, 0, 0]), "weights must be finite and not negative, and not all 0"),
        (torch.tensor([1.0, torch.nan, 0, 0, 0]), "weights must be finite"),
        (torch.tensor([1.0, torch.inf, 0, 0, 0]), "weights must be finite"),
        (torch.zeros(5), "not all 0"),
    ],
)
def test_invalid_weights_raise(weights: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(1).set_world_weights(weights)


def test_worlds_that_are_not_drawn_have_no_weights() -> None:
    with pytest.raises(ValueError, match="weights are for a range of worlds"):
        make(2, world_n=FIELDS[:2]).set_world_weights(torch.ones(2))
    with pytest.raises(ValueError, match="rows keep their worlds in BulletSimulator"):
        RoverEnv(world_n=WorldPool(*FIELDS), num_envs=1, seed=0).set_world_weights(WEIGHTS)
