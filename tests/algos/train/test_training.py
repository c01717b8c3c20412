"""PPO and SAC train and write the folder of a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.config import UNLIMITED_STEPS, TrainingConfig, training_config, with_settings
from rover_rl.algos.config_files import read_config
from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.experiments.runs import RunFiles
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.train.progress import TIME
from rover_rl.algos.train.run import TrainingSummary
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.rover import RoverEnv
from tests.algos.train.runs import BOTH, FIELD, PPO, equal, progress_of, run, state_of

Trained = Callable[[str], TrainingSummary]


@BOTH
def test_a_run_writes_settings_progress_and_policies_that_can_be_evaluated(
    config: TrainingConfig, trained: Trained
) -> None:
    summary = trained(config.algo)
    folder = summary.folder
    assert folder.name == f"{config.algo}-maze"
    assert (summary.steps, summary.interrupted) == (256, False)
    names = {file.name for file in folder.iterdir()}
    assert names == {"config.yaml", "progress.csv", "checkpoint.pt", "training_state.pt", "snapshots"}
    assert read_config(folder / "config.yaml") == with_settings(config, runs=str(folder.parent))
    columns = progress_of(folder)
    taken = config.num_envs * config.algorithm.rollout_length * config.collection.action_repeat
    assert columns["steps"] == list(range(taken, 257, taken))
    assert columns["updates"] == list(range(1, 256 // taken + 1))
    assert columns["learning_rate"][0] == config.algorithm.learning_rate > columns["learning_rate"][-1]
    assert sorted(file.name for file in (folder / "snapshots").iterdir()) == ["000000128.pt", "000000256.pt"]
    assert sum(summary.shares.values()) == pytest.approx(1)
    files = RunFiles(folder)
    assert files.env == read_config(folder / "config.yaml").env
    steps, curves = files.curves()
    assert steps[-1] == 256
    assert sum(curves[TIME + name.replace(" ", "_")][-1] for name in summary.shares) == pytest.approx(1, abs=1e-4)
    critic = files.critic()
    assert (critic is not None) == (config.algo == "ppo")
    if critic is not None:
        values = [critic(RoverEnv(replace(config.env, num_envs=1, seed=seed)).reset()) for seed in (0, 1)]
        assert values[0] != values[1]
    assert all(share >= 0 for share in summary.shares.values())
    checkpoint = Checkpoint.load(summary.checkpoint)
    assert (checkpoint.config.algo, checkpoint.steps) == (config.algo, 256)
    assert len(evaluate(checkpoint.make_actor(), draw_episodes("maze", 2, 0), seconds=1).endings) == 2


@pytest.mark.slow
def test_ppo_learns_to_reach_goals(tmp_path: Path) -> None:
    """After these steps, 32 of 32 goals were reached with either seed, at random none."""
    few = {"num_envs": 64, "rollout_length": 16, "minibatch": 256, "epochs": 10}
    config = training_config("ppo", world="inspect", total_steps=40_000, seed=0, **few)
    actor = Checkpoint.load(run(config, tmp_path).checkpoint).make_actor()
    episodes = draw_episodes("inspect", 8, seed=0)
    assert evaluate(actor, episodes, env=EnvConfig(backend="warp"), seconds=40).success_rate >= 0.8


@BOTH
def test_the_same_seed_gives_the_same_weights_to_the_last_bit(
    config: TrainingConfig, trained: Trained, tmp_path: Path
) -> None:
    runs = [trained(config.algo), *(run(config, tmp_path, seed=config.seed + more) for more in (0, 1))]
    first, again, other = (state_of(each.folder)["learner"] for each in runs)
    assert equal(first, again)
    assert not equal(first, other)


def test_imitation_makes_the_experts_actions_more_likely(tmp_path: Path) -> None:
    settings = {"imitation": 1.0, "epochs": 30, "learning_rate": 3e-3, "anneal": False, "minibatch": 16}
    folder = run(PPO, tmp_path, world=FIELD, total_steps=512, hidden=(64,), **settings).folder
    surprise = progress_of(folder)["loss_objective"]
    assert sum(surprise[-4:]) < sum(surprise[:4]) - 1
    actor = Checkpoint.load(folder).make_actor()
    # The goal is to the left on free ground: the expert turns left and drives.
    lidar, imu = torch.full((1, 32), 12.0), torch.zeros(1, 3)
    target, velocities = torch.tensor([[5.0, 0.8]]), torch.zeros(1, 2)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        seen = TensorDict({"lidar": lidar, "imu": imu, "target": target, "velocities": velocities}, batch_size=[1])
        assert (actor(seen)["action"] > 0.2).all()


def test_the_time_limit_ends_a_run(tmp_path: Path) -> None:
    summary = run(PPO, tmp_path, total_steps=UNLIMITED_STEPS, max_minutes=1e-6)
    assert len(progress_of(summary.folder)["steps"]) == 1
    assert [file.name for file in (summary.folder / "snapshots").iterdir()] == ["000000064.pt"]
    assert not summary.interrupted
