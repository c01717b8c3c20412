"""Random draws: reproducible, independent of the batch size, and uniform."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch
from scipy.stats import chisquare
from torch import Tensor
from torchrl.envs import EnvBase

from rover_rl.rng import episode_keys, random_bits, row_keys, to_index, to_unit
from tests.envs.scripted import CPU, Moment, bare, scripted


def test_draws_are_the_same_in_a_batch_of_any_size():
    many = random_bits(episode_keys(row_keys(7, 300, CPU), torch.full((300, 1), 4)), 2, 5, 6)
    for rows in (1, 16, 299):
        few = random_bits(episode_keys(row_keys(7, rows, CPU), torch.full((rows, 1), 4)), 2, 5, 6)
        assert torch.equal(few, many[:rows])


@pytest.mark.parametrize("seed", [0, 1, 12345, 2**31, 2**63 - 5, -4])
def test_row_i_seeded_s_is_row_0_seeded_s_plus_i(seed):
    keys = row_keys(seed, 9, CPU)
    assert keys.flatten().tolist() == [row_keys(seed + i, 1, CPU).item() for i in range(9)]


def test_seeds_episodes_streams_draws_and_lanes_all_give_other_numbers():
    bits = [
        random_bits(episode_keys(row_keys(seed, 1, CPU), torch.tensor([[episode]])), stream, draw, 4)
        for seed, episode, stream, draw in product(range(5), range(5), range(3), range(5))
    ]
    numbers = torch.cat(bits).flatten()
    assert len(numbers.unique()) == len(numbers)


def draws(kind: str, count: int = 20_000) -> Tensor:
    """Random bits along one of their dimensions: rows, episodes, draws or lanes."""
    one, numbers = torch.ones(1, 1, dtype=torch.int64), torch.arange(count)[:, None]
    row = row_keys(0, 1, CPU)
    if kind == "row":
        return random_bits(episode_keys(row_keys(0, count, CPU), one), 0, 0, 1)
    if kind == "episode":
        return random_bits(episode_keys(row.expand(count, 1), numbers), 0, 0, 1)
    if kind == "draw":
        return random_bits(row.expand(count, 1), 1, numbers, 1)
    return random_bits(row, 1, 0, count).T


@pytest.mark.parametrize("kind", ["row", "episode", "draw", "lane"])
def test_draws_are_uniform_and_neighbours_are_independent(kind):
    bits = draws(kind).flatten()
    unit = to_unit(bits)
    index = to_index(bits, torch.tensor(40))
    assert unit.dtype == torch.float32
    assert unit.min() >= 0
    assert unit.max() < 1
    assert index.min() == 0
    assert index.max() == 39
    assert chisquare(np.histogram(unit, 50, (0, 1))[0]).pvalue > 1e-3
    assert chisquare(torch.bincount(index, minlength=40)).pvalue > 1e-3
    # Pairs of neighbors, and pairs of the number and the index from the same bits.
    for a, b in ((unit[:-1], unit[1:]), (unit, (index + 0.5) / 40)):
        assert chisquare(np.histogram2d(a, b, 10, ((0, 1), (0, 1)))[0].flatten()).pvalue > 1e-3


def test_the_same_seed_gives_the_same_episodes_and_another_seed_others():
    def goals(env: EnvBase) -> list[list[float]]:
        return [(env.reset(), bare(env).goal[0].tolist())[1] for _ in range(3)]

    first, second, third = (scripted([Moment()], seed=seed) for seed in (1, 1, 2))
    episodes = goals(first)
    assert episodes == goals(second)
    assert len({tuple(goal) for goal in episodes}) == 3
    assert episodes != goals(third)
    third.set_seed(1)
    assert episodes == goals(third)
