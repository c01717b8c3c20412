from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from rich.console import Console
from tensordict import TensorDict

pytest.importorskip("stable_baselines3")

from benchmarks import against_sb3
from benchmarks.against_sb3 import Curve, Options, Point
from rover_rl.algos.config import with_settings
from rover_rl.algos.policy.networks import ObservationEncoder, make_action_critic, make_actor, make_critic
from rover_rl.envs.config import ActionConfig
from rover_rl.envs.sb3 import SB3VecEnv
from tests.fork_server import quick_workers


def settings(algo: str, folder=None, **changes):
    config = Options(algo=algo, world="maze", minutes=0.02, num_envs=2).config(folder)
    return with_settings(config, workers=1, length=40, **changes)


def batch(config) -> SB3VecEnv:
    return SB3VecEnv(against_sb3.rovers_for_sb3(config))


@pytest.fixture(scope="module")
def models():
    """SB3's algorithms with small networks of ours."""
    made = {}
    for algo in ("ppo", "sac"):
        config = settings(algo, hidden=(24, 16), minibatch=32)
        made[algo] = against_sb3.make_sb3(config, batch(config), against_sb3.WallClock(config).learning_rate)
    return made


def count(*modules) -> int:
    return sum(parameter.numel() for module in modules for parameter in module.parameters())


def test_sb3_gets_networks_of_the_same_size(models):
    hidden = (24, 16)
    actor, value = count(make_actor(hidden=hidden)), count(make_critic(hidden=hidden))
    action_value = count(make_action_critic(ObservationEncoder(), hidden))
    sac, ppo = models["sac"], models["ppo"]
    assert count(sac.actor) == actor
    assert count(sac.critic) == 2 * action_value
    assert count(ppo.policy.mlp_extractor.value_net, ppo.policy.value_net) == value
    # PPO's spread is one number for each action instead of an output of the network.
    spread = 16 * 2 + 2
    assert count(ppo.policy.mlp_extractor.policy_net, ppo.policy.action_net) == actor - spread
    assert all(isinstance(layer, torch.nn.Linear | torch.nn.ReLU) for layer in ppo.policy.mlp_extractor.policy_net)


def test_sb3_sees_what_ours_sees(models):
    sac, ppo = models["sac"], models["ppo"]
    observation = {key: torch.as_tensor(value) for key, value in ppo.env.reset().items()}
    keys = settings("sac").network.observation
    expected = ObservationEncoder(keys)(*(observation[key] for key in keys))
    for owner in (sac.actor, sac.critic, ppo.policy):
        assert torch.equal(owner.extract_features(observation, owner.features_extractor), expected)


@pytest.mark.parametrize("slowest", [-1.0, 0.0])
def test_a_policy_of_sb3_drives_without_exploration(models, slowest):
    for model in models.values():
        policy = against_sb3.policy_of_sb3(model.policy, ActionConfig(min_speed=slowest))
        observation = {key: torch.as_tensor(value) for key, value in models["ppo"].env.reset().items()}
        now = TensorDict(observation, batch_size=[2])
        scaled, _ = model.predict({key: value.numpy() for key, value in observation.items()}, deterministic=True)
        low, high = np.array([slowest, -np.pi], np.float32), np.array([1.0, np.pi], np.float32)
        expected = torch.from_numpy(low + (scaled + 1) / 2 * (high - low))
        torch.testing.assert_close(policy(now)["action"], expected)
        assert torch.equal(policy(now)["action"], policy(now)["action"])


def curve(name: str, *success: float) -> Curve:
    return Curve(name, [Point(minute, 100 * minute, value, 0.0, 1.0) for minute, value in enumerate(success, 1)])


def test_ours_is_compared_at_the_success_that_theirs_ends_with():
    result = against_sb3.compare(curve("ours", 0.2, 0.6, 0.5, 0.9), curve("theirs", 0.1, 0.7, 0.4, 0.5))
    assert (result.success, result.minutes, result.first_minutes) == (0.5, 4, 2)
    assert (result.our_minutes, result.share) == (2, 0.5)


def test_ours_may_never_get_there(tmp_path):
    ours, theirs = curve("rover_rl", 0.1, 0.2), curve("SB3, our batch", 0.1, 0.3)
    result = against_sb3.compare(ours, theirs)
    assert (result.our_minutes, result.share) == (None, None)
    against_sb3.draw(tmp_path / "picture.png", settings("ppo", tmp_path), 2, [ours, theirs], [result])
    against_sb3.show(Console(), [ours, theirs])


@pytest.mark.slow
def test_one_command_runs_all(tmp_path):
    options = Options(algo="ppo", world="maze", minutes=0.005, num_envs=2, count=2, seconds=0.5, runs=tmp_path)
    with quick_workers():
        against_sb3.main(options)
    results = json.loads((tmp_path / "against_sb3-ppo-maze" / "against_sb3.json").read_text())
    assert [curve["name"] for curve in results["curves"]] == list(against_sb3.CONTENDERS)
    assert all(curve["points"][-1]["steps"] > 0 for curve in results["curves"])
    assert len(results["comparisons"]) == 2
    assert (tmp_path / "against_sb3-ppo-maze" / "against_sb3.png").stat().st_size > 1000
