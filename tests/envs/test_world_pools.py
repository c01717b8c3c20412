"""Episodes that draw their worlds from a pool."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl import EnvConfig, GymWrapper, RoverEnv, Terrain, World, box, make_env
from rover_rl.worlds.pool import WorldPool

ROOMS = [
    World(f"room {k}", Terrain.flat((12, 12)), [box((0.9 * k - 2, 1.5, 0.5), (0.6, 2.0 + 0.2 * k, 1))])
    for k in range(5)
]
OBSERVED = ("lidar", "pose", "imu", "target", "velocities", "reward", "done", ("outcome", "world"))
WEIGHTS = torch.tensor([0.0, 3.0, 1.0, 0.0, 4.0])


def make(num_envs: int, seed: int = 0, world_n=None, **settings) -> RoverEnv:
    pool = WorldPool(*ROOMS) if world_n is None else world_n
    defaults = {"backend": "warp", "length": 12, "lidar_beams": 32}
    return make_env(world_n=pool, num_envs=num_envs, seed=seed, **{**defaults, **settings})


def rollout(env: RoverEnv, actions: torch.Tensor) -> TensorDictBase:
    """Results of steps with ``actions [steps, N, 2]``, with resets in between: ``[steps, N]``."""
    td, records = env.reset(), []
    for action in actions:
        step, td = env.step_and_maybe_reset(td.set("action", action))
        records.append(step["next"].select(*OBSERVED))
    return torch.stack(records)


def drawn_actions(rows: int, steps: int = 60) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.rand(steps, rows, 2, generator=generator) * torch.tensor([0.8, 1.0]) + torch.tensor([0.2, -0.5])


def draws(env: RoverEnv, count: int) -> Tensor:
    """Worlds of the next episodes of each row, ``[count, N]``."""
    return torch.stack([env.reset()["outcome", "world"].squeeze(-1) for _ in range(count)])


class Forgetful(WorldPool):
    """A pool that makes another object of a world each time."""

    def __getitem__(self, index: int) -> World:
        return replace(super().__getitem__(index))


def test_each_episode_draws_a_world_that_is_made_once() -> None:
    env = make(8, world_n=Forgetful(*ROOMS))
    drawn, seen = [], {*env.worlds}
    for _ in range(20):
        drawn.append(env.reset()["outcome", "world"])
        assert [world.name for world in env.worlds] == [f"room {k}" for k in drawn[-1].flatten().tolist()]
        seen |= {*env.worlds}
    counts = torch.cat(drawn).flatten().bincount(minlength=5)
    # 160 draws, 32 expected of each.
    assert counts.min() >= 15
    assert counts.max() <= 50
    assert sorted(world.name for world in seen) == [world.name for world in ROOMS]


def test_the_lidar_sees_the_world_that_was_drawn() -> None:
    env, start = make(6, seed=3), torch.tensor([[0.0, 0.0, 1.57]] * 6)
    for _ in range(2):
        td = env.reset(start=start)
        alone = make(6, world_n=list(env.worlds)).reset(start=start)
        assert torch.equal(td["lidar"], alone["lidar"])
    assert len({id(world) for world in env.worlds}) > 1


def eventful_rollout(env: RoverEnv, actions: torch.Tensor, resets: torch.Tensor) -> TensorDictBase:
    """Results of 40 steps with partial resets ``[steps, N, 1]``, other weights after 12 steps, and a close after 26."""
    td, records = env.reset(), []
    for number, (action, reset) in enumerate(zip(actions, resets, strict=True)):
        if number == 12:
            env.set_world_weights(torch.tensor([1.0, 0, 2, 3, 0]))
        if number == 26:
            env.close()
            td = env.reset()
        step, td = env.step_and_maybe_reset(td.set("action", action))
        records.append(step["next"].select(*OBSERVED))
        assert env.worlds == [ROOMS[k] for k in td["outcome", "world"].flatten().tolist()]
        if reset.any():
            td = env.reset(td.set("_reset", reset)).exclude("_reset")
    return torch.stack(records)


def test_episodes_are_the_same_whether_all_worlds_fit_on_the_device_or_not() -> None:
    """With six rows, all five worlds stay on the device. With three rows, worlds are copied as they are drawn."""
    actions = drawn_actions(6, 40)
    resets = torch.rand(40, 6, 1, generator=torch.Generator().manual_seed(4)) < 0.15
    whole = eventful_rollout(make(6, seed=4), actions, resets)
    for first in (0, 3):
        rows = slice(first, first + 3)
        part = eventful_rollout(make(3, seed=4 + first), actions[:, rows], resets[:, rows])
        for key in OBSERVED:
            assert torch.equal(part[key], whole[key][:, rows]), key
    assert len(whole["outcome", "world"].unique()) == 5


def test_a_row_is_the_same_after_its_pool_has_changed() -> None:
    """Worlds that were drawn before leave nothing behind in the slots that others use again."""
    env, actions = make(4, seed=2, world_n="maze:0-49"), drawn_actions(4, 16)
    expected = rollout(env, actions)
    for _ in range(8):
        env.reset()
    env.set_seed(2)
    found = rollout(env, actions)
    for key in OBSERVED:
        assert torch.equal(found[key], expected[key]), key


def test_a_mixed_pool_has_as_many_episodes_in_each_entry() -> None:
    env = make(64, world_n=[ROOMS[0], "maze:0-3"])
    assert env.pool.sizes == (1, 4)
    assert 96 <= (draws(env, 4) == 0).sum() <= 160


def test_a_list_of_worlds_is_assigned_to_blocks_of_rows_for_life_and_one_world_adds_nothing_to_the_outcome() -> None:
    assert draws(make(4, world_n=ROOMS[:2]), 3).tolist() == [[0, 0, 1, 1]] * 3
    assert "world" not in make(2, world_n=ROOMS[0]).reset()["outcome"].keys()  # noqa: SIM118


def test_every_simulator_draws_the_same_and_in_bullet_a_row_keeps_the_world_of_its_first_episode() -> None:
    in_warp, in_bullet = make(6, seed=5), make(6, seed=5, backend="bullet")
    first = in_warp.reset()
    for number in range(3):
        td = in_bullet.reset()
        assert torch.equal(td["outcome", "world"], first["outcome", "world"])
        assert number or torch.equal(td["target"], first["target"])
    assert len(first["outcome", "world"].unique()) > 1


def test_gymnasium_and_configuration_take_ranges() -> None:
    env = GymWrapper(RoverEnv(world_n="maze:0-4", backend="warp", seed=0))
    env.reset(seed=0)
    assert 0 <= env.step(env.action_space.sample())[4]["world"] < 5
    config = EnvConfig(world=("maze:0-4", "moon"), num_envs=2, backend="warp")
    assert config.world_names == ("maze:0-4", "moon")
    assert len(make_env(config).pool) == 6


def test_worlds_are_drawn_by_their_weights_which_change_after_the_next_episode_of_each_row() -> None:
    env, plain = make(64, seed=1), make(64, seed=1)
    expected = draws(plain, 3)
    assert torch.equal(draws(env, 2), expected[:2])
    env.set_world_weights(WEIGHTS)
    assert torch.equal(draws(env, 1), expected[2:])
    counts = draws(env, 10).flatten().bincount(minlength=5)
    assert counts[[0, 3]].tolist() == [0, 0]
    # Of 640 draws, 240, 80 and 320 are expected: three standard deviations are 37, 25 and 38.
    assert (counts - 640 * WEIGHTS / WEIGHTS.sum()).abs().max() < 38


def test_weighted_draws_depend_on_the_row_and_the_episode_alone() -> None:
    company, alone = make(8, seed=3), make(1, seed=3 + 5)
    for env in (company, alone):
        env.set_world_weights(WEIGHTS)
    drawn = draws(company, 12)
    assert torch.equal(draws(alone, 12)[:, 0], drawn[:, 5])
    assert len(drawn[:, 5].unique()) > 1


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (torch.ones(4), r"weights must have the shape \(5,\), one for each world, got \(4,\)"),
        (torch.tensor([1.0, -1, 0, 0, 0]), "weights must be finite and not negative, and not all 0"),
        (torch.tensor([1.0, torch.nan, 0, 0, 0]), "weights must be finite"),
        (torch.zeros(5), "not all 0"),
    ],
)
def test_invalid_weights_raise(weights: Tensor, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(1).set_world_weights(weights)


def test_worlds_that_are_not_drawn_have_no_weights() -> None:
    with pytest.raises(ValueError, match="weights are for a range of worlds"):
        make(2, world_n=ROOMS[:2]).set_world_weights(torch.ones(2))
    with pytest.raises(ValueError, match="rows keep their worlds in BulletSimulator"):
        RoverEnv(world_n=WorldPool(*ROOMS), num_envs=1, seed=0).set_world_weights(WEIGHTS)
