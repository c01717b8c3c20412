"""Success rates and learnability of worlds, from attempts in them."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rover_rl import Terrain, World
from rover_rl.algos.train.learnability import Learnability
from rover_rl.sims.worlds.pool import WorldPool


def attempt(learnability: Learnability, world: int, successes: int, failures: int) -> None:
    learnability.add(torch.tensor([world]), torch.tensor([successes]), torch.tensor([failures]))


def test_many_attempts_in_a_world_decide_its_rate_and_few_that_of_its_group() -> None:
    learnability = Learnability(WorldPool("maze:0-9@0.2", "maze:0-9@0.8", "moon:0-9"))
    attempt(learnability, 0, 90, 10)
    attempt(learnability, 10, 2, 98)
    rates = learnability.success_rate
    assert rates[0] == pytest.approx(0.9, abs=0.03)
    assert rates[1:10].tolist() == pytest.approx([0.9] * 9, abs=0.03)
    assert rates[10:20].tolist() == pytest.approx([0.02] * 10, abs=0.03)
    # Nothing is known of the moon, except for the mean of all worlds.
    assert rates[20:].tolist() == pytest.approx([0.46] * 10, abs=0.02)
    torch.testing.assert_close(learnability.values, rates * (1 - rates))


def test_worlds_of_your_own_are_one_group() -> None:
    worlds = [World(f"field {k}", Terrain.flat((8.0, 8.0))) for k in range(3)]
    learnability = Learnability(WorldPool(*worlds, "moon:0"))
    attempt(learnability, 0, 0, 200)
    assert learnability.success_rate[1] == learnability.success_rate[2] < 0.05
    assert learnability.difficulty.isnan().all()


def test_attempts_are_forgotten() -> None:
    learnability = Learnability(WorldPool("maze:0-1"))
    attempt(learnability, 0, 0, 200)
    before = learnability.attempts[0].item()
    attempt(learnability, 1, 1_000, 1_000)
    assert learnability.attempts[0].item() == pytest.approx(before / 2)
    attempt(learnability, 0, 800, 0)
    assert learnability.success_rate[0] > 0.85


def test_attempts_of_many_rows_are_added_up() -> None:
    several, single = (Learnability(WorldPool("maze:0-3")) for _ in range(2))
    several.add(torch.tensor([[2], [2], [1]]), torch.tensor([[1], [1], [0]]), torch.tensor([[0], [1], [0]]))
    attempt(single, 2, 2, 1)
    assert torch.equal(several.attempts, single.attempts)
    assert torch.equal(several.success_rate, single.success_rate)


def test_without_attempts_draws_are_those_without_a_curriculum() -> None:
    learnability = Learnability(WorldPool("maze:0-3", "moon"))
    expected = torch.tensor([0.125] * 4 + [0.5], dtype=torch.float64)
    torch.testing.assert_close(learnability.probabilities(0.5, 0.25), expected)


def test_draws_prefer_worlds_of_half_the_attempts_and_a_share_stays_even() -> None:
    learnability = Learnability(WorldPool("maze:0-2"))
    for world, successes in enumerate((2, 50, 97)):
        attempt(learnability, world, successes, 100 - successes)
    even, mixed, sharp = (learnability.probabilities(*each) for each in ((0.0, 0.25), (0.4, 0.25), (1.0, 0.02)))
    assert even.tolist() == pytest.approx([1 / 3] * 3)
    for probabilities in (mixed, sharp):
        assert probabilities.sum().item() == pytest.approx(1)
    assert mixed.min() >= 0.6 / 3
    assert mixed[1] > 0.59
    assert sharp[1] > 0.999


def test_difficulty_rises_with_success() -> None:
    """A learner whose skill rises reaches its goals where the difficulty is below its skill, give or take 0.1."""
    learnability, generator = Learnability(WorldPool("maze:0-999@0-1")), torch.Generator().manual_seed(0)
    difficulties = []
    for skill in (0.2, 0.5, 0.8):
        for _ in range(20):
            probabilities = learnability.probabilities(1.0, 0.25)
            drawn = torch.multinomial(probabilities, 200, replacement=True, generator=generator)
            rate = torch.sigmoid((skill - learnability.difficulty[drawn]) / 0.05)
            reached = (torch.rand(200, generator=generator) < rate).long()
            learnability.add(drawn, reached, 1 - reached)
        difficulties.append(_mean(learnability.difficulty, learnability.probabilities(1.0, 0.25)))
    assert difficulties == pytest.approx([0.2, 0.5, 0.8], abs=0.08)


def _mean(values: Tensor, probabilities: Tensor) -> float:
    return (values * probabilities).sum().item()


def test_the_state_is_restored() -> None:
    first, second = (Learnability(WorldPool("maze:0-3")) for _ in range(2))
    attempt(first, 2, 3, 5)
    second.load_state_dict(first.state_dict())
    assert torch.equal(second.values, first.values)
    attempt(second, 2, 3, 5)
    assert not torch.equal(second.attempts, first.attempts)
