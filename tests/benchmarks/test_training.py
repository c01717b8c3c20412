"""SB3 is given networks, inputs and settings of ours, so that the speeds of training compare."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

pytest.importorskip("stable_baselines3")

from benchmarks import training
from benchmarks.options import Options
from rover_rl.algos.config import with_settings
from rover_rl.algos.policy.networks import ObservationEncoder, make_action_critic, make_actor, make_critic
from rover_rl.envs.sb3 import SB3VecEnv
from tests.fork_server import quick_workers

OPTIONS = Options(rovers=2, workers=2, world="maze", minutes=0.005)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """SB3's algorithms with small networks of ours."""
    made = {}
    for algo in ("ppo", "sac"):
        config = training.make_config(OPTIONS, algo, tmp_path_factory.mktemp("runs"))
        config = with_settings(config, workers=1, hidden=(24, 16), minibatch=32)
        made[algo] = training.make_sb3(config, SB3VecEnv(training.rovers_for_sb3(config)))
    return made


def count(*modules) -> int:
    return sum(parameter.numel() for module in modules for parameter in module.parameters())


def test_sb3_gets_networks_of_the_same_size(models):
    hidden = (24, 16)
    actor, value = count(make_actor(hidden=hidden)), count(make_critic(hidden=hidden))
    sac, ppo = models["sac"], models["ppo"]
    assert count(sac.actor) == actor
    assert count(sac.critic) == 2 * count(make_action_critic(ObservationEncoder(), hidden))
    assert count(ppo.policy.mlp_extractor.value_net, ppo.policy.value_net) == value
    # PPO's standard deviation is one number for each action instead of an output of the network.
    assert count(ppo.policy.mlp_extractor.policy_net, ppo.policy.action_net) == actor - (16 * 2 + 2)


def test_sb3_sees_what_ours_sees(models):
    sac, ppo = models["sac"], models["ppo"]
    observation = {key: torch.as_tensor(value) for key, value in ppo.env.reset().items()}
    encoder = ObservationEncoder()
    expected = encoder(*(observation[key] for key in encoder.keys))
    for owner in (sac.actor, sac.critic, ppo.policy):
        assert torch.equal(owner.extract_features(observation, owner.features_extractor), expected)


@pytest.mark.slow
def test_ppo_trains_in_all_three(tmp_path: Path) -> None:
    with quick_workers():
        for name, contender in training.CONTENDERS.items():
            assert contender(training.make_config(OPTIONS, "ppo", tmp_path / name)) > 0
