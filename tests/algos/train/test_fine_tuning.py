"""A training can start from a trained policy."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from rover_rl.algos.config import UNLIMITED_STEPS, TrainingConfig, training_config, with_settings
from rover_rl.algos.config_files import read_config
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.train import train
from rover_rl.algos.train.fine_tuning import fine_tuning_config
from rover_rl.algos.train.ppo import PPOLearner
from rover_rl.algos.train.run import TrainingSummary
from rover_rl.envs.config import ActionConfig, LidarConfig
from rover_rl.worlds.pool import WorldPool
from tests.algos.train.runs import BOTH, FIELD, equal

Trained = Callable[[str], TrainingSummary]
SMALL: dict[str, Any] = {"num_envs": 4, "workers": 1, "total_steps": 64}


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return Checkpoint.load(folder).actor


@BOTH
def test_it_starts_from_the_policys_weights_and_only_the_critic_learns_at_first(
    config: TrainingConfig, trained: Trained, tmp_path: Path
) -> None:
    source = trained(config.algo).folder
    given = {"world": FIELD, "runs": str(tmp_path), **SMALL}
    if config.algo == "sac":
        given["learning_starts"] = 4
    warm = train(fine_tuning_config(source, **given, name="warm", critic_warmup=1.0))
    assert equal(weights(warm.folder), weights(source))
    changed = train(fine_tuning_config(source, **given, name="changed", critic_warmup=0.0))
    assert not equal(weights(changed.folder), weights(source))
    written = read_config(warm.folder / "config.yaml")
    assert (written.run.started_from, written.env.world) == (str(source.resolve()), FIELD)
    # A run that is continued goes on with its own weights.
    again = train(with_settings(written, total_steps=128), warm.folder)
    assert again.steps == 128


def test_frozen_convolutions_stay_those_of_the_policy_also_in_the_critic(tmp_path: Path) -> None:
    sensors = {"observation": ("target", "heights"), "sensors": ("heights(size=(8, 8))",)}
    seeing = {**sensors, "world": FIELD, "hidden": (8,)}
    source = train(training_config("ppo", **seeing, runs=str(tmp_path), **SMALL)).folder
    config = fine_tuning_config(source, runs=str(tmp_path), freeze_encoder=True, critic_warmup=0.0, **SMALL)
    learned = weights(train(config).folder)
    images = {name for name in learned if ".networks.heights." in name}
    assert images
    for name, weight in weights(source).items():
        assert torch.equal(learned[name], weight) == (name in images), name
    learner = PPOLearner(config)
    learner.start_from(weights(source))
    of_critic = {name: value for name, value in learner.critic.state_dict().items() if ".networks.heights." in name}
    assert sorted(map(torch.sum, of_critic.values())) == sorted(torch.sum(learned[name]) for name in images)
    with pytest.raises(ValueError, match="^freeze_encoder keeps the convolutions .* use --from$"):
        train(training_config("ppo", freeze_encoder=True, runs=str(tmp_path)))
    with pytest.raises(ValueError, match=r"^freeze_encoder needs an image in observation, got \('lidar', "):
        train(training_config("ppo", freeze_encoder=True, started_from=str(source), runs=str(tmp_path)))


def test_defaults_are_those_of_a_short_training_of_the_same_policy() -> None:
    config = fine_tuning_config("pretrained:anywhere", world="maze")
    source = Checkpoint.load(Path(__file__).parents[3] / "rover_rl/algos/pretrained/anywhere.pt").config
    assert (config.network, config.env.lidar, config.env.task) == (source.network, source.env.lidar, source.env.task)
    assert config.algorithm.learning_rate < source.algorithm.learning_rate
    assert (config.run.total_steps, config.run.max_minutes, config.run.name) == (UNLIMITED_STEPS, 2.0, None)
    assert (config.collection.curriculum, config.collection.workers) == ("none", None)
    assert fine_tuning_config("pretrained:anywhere").collection.curriculum == "learnability"
    pool = fine_tuning_config("pretrained:anywhere", world=WorldPool("maze:0-9"), total_steps=9)
    assert (pool.collection.curriculum, pool.run.max_minutes) == ("learnability", None)
    for each in (config, pool):
        each.check()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"hidden": (8,)}, r"hidden=\(16,\) of the policy .* cannot change in fine-tuning, got \(8,\)"),
        ({"memory": "gru"}, r"memory='none' of the policy .* cannot change"),
        (
            {"action": ActionConfig(min_speed=0.0)},
            r"made for actions of \(min_speed, .*, max_sideways, max_yaw_rate, kind\)",
        ),
        ({"lidar": LidarConfig(points=16)}, "made for lidar points 32, and the environment has 16"),
    ],
)
def test_what_a_policy_is_made_of_cannot_change(
    settings: dict[str, Any], message: str, trained: Trained, tmp_path: Path
) -> None:
    config = fine_tuning_config(trained("ppo").folder, **settings, **SMALL, runs=str(tmp_path / "runs"))
    with pytest.raises(ValueError, match=message):
        train(config)
    assert not (tmp_path / "runs").exists()
