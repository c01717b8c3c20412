"""Specs of the environment, and rewards with custom components."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torchrl.data import Composite
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from rover_rl import RewardComponent, RewardConfig, RoverEnv, contract_reward, make_env
from rover_rl.envs.make import add_terms
from rover_rl.envs.rewards import TotalReward
from rover_rl.envs.task import EVENTS, StepEvent

NAMES = ["goal", "progress", "velocity", "turn", "collision", "stuck", "general", "out_of_bounds"]
COMPONENTS = [("reward_components", name) for name in NAMES]
OBSERVATION = ("lidar", "pose", "imu", "target", "velocities")


class Tilt(RewardComponent):
    """Active in every step, and written for batches."""

    name = "tilt"

    def value(self, outcome, observation):
        return -0.1 * observation["imu"][:, :2].abs().sum(-1, keepdim=True)


class CollisionHeat(RewardComponent):
    """Custom component that is active only in collisions."""

    name = "heat"
    phases = (StepEvent.COLLISION,)

    def value(self, outcome, observation):
        return -2.0


def rovers(num_envs: int = 2, **settings):
    return make_env(world_n="maze", num_envs=num_envs, seed=0, backend="warp", lidar_beams=32, **settings)


def rollout(env, steps: int = 12):
    torch.manual_seed(0)
    return env.rollout(steps, break_when_any_done=False)["next"]


def test_specs_have_the_contracts_five_keys_the_outcome_and_rewards_with_a_feature_for_each_rover():
    bare, env = rovers(3, reward="task"), rovers(3)
    assert isinstance(bare, RoverEnv)
    assert bare.reward_keys == ["reward"]
    assert isinstance(env.reward_spec, Composite)
    assert set(env.reward_keys) == {"reward", *COMPONENTS}
    for each in (bare, env):
        assert each.batch_size == torch.Size([3])
        assert each.batch_locked
        for spec in (each.observation_spec, each.full_done_spec, each.full_action_spec, each.full_reward_spec):
            assert all(leaf.shape[0] == 3 and leaf.ndim == 2 for leaf in spec.values(True, True))
        assert set(each.observation_spec.keys()) == {*OBSERVATION, "outcome"}
        fields = {"progress", "alignment", "linear_velocity", "angular_velocity", "steps", "total_steps", "phase"}
        assert set(each.observation_spec["outcome"].keys()) == {*EVENTS, *fields}
        assert all(each.observation_spec["outcome", event].dtype == torch.bool for event in EVENTS)
    td = rollout(env)
    assert all(env.observation_spec[key].is_in(td[key][:, k]) for key in OBSERVATION for k in range(12))


def test_later_steps_do_not_write_to_returned_tensordicts():
    env = rovers()
    td, kept, copies = env.reset(), [], []
    for _ in range(3):
        td = env.step(td.set("action", torch.tensor([[1.0, 0.3], [0.5, -0.3]])))["next"]
        kept.append(td.copy())
        copies.append(td.clone())
    assert all((one == other).all() for one, other in zip(kept, copies, strict=True))
    assert not torch.equal(kept[0]["pose"], kept[2]["pose"])


def test_components_can_be_dropped_and_reweighted():
    default = rollout(rovers())
    kept = rollout(rovers(reward=[component for component in contract_reward() if component.name != "progress"]))
    assert set(kept["reward_components"].keys()) == {*NAMES} - {"progress"}
    config = RewardConfig(distance_delta_scale=0.6, idle_penalty=-0.06, velocity_scale=0.25, turn_scale=-0.003)
    changed = rollout(rovers(reward=config))
    assert torch.equal(default["pose"], changed["pose"])
    for name, factor in (("progress", 2), ("velocity", 100), ("turn", 2)):
        assert default["reward_components", name].any()
        torch.testing.assert_close(changed["reward_components", name], factor * default["reward_components", name])
    for td in (kept, changed):
        torch.testing.assert_close(td["reward"], sum(td["reward_components"].values()))


def test_custom_components_are_added_to_the_total():
    env = rovers(reward=[*contract_reward(), Tilt(), CollisionHeat()])
    check_env_specs(env, break_when_any_done="both")
    td = rollout(env)
    assert set(td["reward_components"].keys()) == {*NAMES, "tilt", "heat"}
    tilt = -0.1 * td["imu"][..., :2].abs().sum(-1, keepdim=True)
    assert tilt.any()
    torch.testing.assert_close(td["reward_components", "tilt"], tilt)
    assert torch.equal(td["reward_components", "heat"] != 0, td["outcome", "phase"] == StepEvent.COLLISION)
    torch.testing.assert_close(td["reward"], sum(td["reward_components"].values()))


def test_add_terms_adds_a_reward_to_an_existing_environment_and_a_total_without_components_raises():
    bare = RoverEnv(world_n="maze", seed=0, backend="warp", lidar_beams=32)
    total = TransformedEnv(bare, TotalReward())
    with pytest.raises(RuntimeError, match="RewardComponent"):
        total.step(total.rand_action(total.reset()))
    bare = RoverEnv(world_n="maze", seed=0, backend="warp", lidar_beams=32)
    env = add_terms(bare, replace(bare.config, reward=tuple(contract_reward()[1:4])))
    assert set(rollout(env)["reward_components"].keys()) == {"progress", "velocity", "turn"}
