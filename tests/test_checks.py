from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from rover_rl import GymVectorWrapper, RoverEnv
from rover_rl.algos.config import training_config
from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.checks import MAX_SEED, check_at_least, check_positive, check_seed
from rover_rl.envs.gym import RoverEnv as GymRoverEnv


@pytest.mark.parametrize("seed", [0, MAX_SEED, np.int32(7), np.uint64(MAX_SEED), torch.tensor(7)])
def test_seeds_of_any_integer_type_are_accepted(seed: Any) -> None:
    assert check_seed(seed) == int(seed)
    assert type(check_seed(seed)) is int


@pytest.mark.parametrize("seed", [-1, MAX_SEED + 1, 10**30, 1.0, math.nan, True, np.True_, "7", None, np.arange(2)])
def test_invalid_seeds_raise_with_the_allowed_range(seed: Any) -> None:
    with pytest.raises(ValueError, match="^seed must be a whole number from 0 to 9223372036854775807, got "):
        check_seed(seed)


def test_consecutive_seeds_must_all_be_in_range() -> None:
    assert check_seed(MAX_SEED - 3, 4) == MAX_SEED - 3
    with pytest.raises(ValueError, match=f"from 0 to {MAX_SEED - 3}, got {MAX_SEED - 2}"):
        check_seed(MAX_SEED - 2, 4)


@pytest.mark.parametrize("seed", [-1, 2**70, 0.5, True])
def test_all_users_of_seeds_reject_the_same_seeds(seed: Any) -> None:
    env, single = RoverEnv(world_n="maze", num_envs=2, seed=MAX_SEED - 1), GymRoverEnv(world_n="maze")
    uses = (
        lambda: RoverEnv(world_n="maze", num_envs=2, seed=seed),
        lambda: GymRoverEnv(world_n="maze", seed=seed),
        lambda: env.set_seed(seed),
        lambda: single.reset(seed=seed),
        lambda: GymVectorWrapper(env).reset(seed=seed),
        lambda: GymVectorWrapper(env).reset(seed=[seed, seed]),
        lambda: draw_episodes("maze", 2, seed),
        lambda: training_config("ppo", seed=seed).check(),
    )
    for use in uses:
        with pytest.raises(ValueError, match=r"^seed must be a whole number from 0 to \d+, got "):
            use()
    env.close()


@pytest.mark.parametrize("number", [0, -1, math.nan, math.inf, 11])
def test_errors_name_the_number_out_of_range(number: float) -> None:
    with pytest.raises(ValueError, match=f"^speed must be positive and at most 10, got {number}$"):
        check_positive(10, seconds=10, speed=number)
    with pytest.raises(ValueError, match=f"^count must be at least 1 and at most 10, got {number}$"):
        check_at_least(1, 10, rows=1, count=number)
