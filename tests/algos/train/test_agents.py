"""Training and evaluation of rovers that share worlds."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from rover_rl import EnvConfig
from rover_rl.algos.config import with_settings
from rover_rl.algos.evaluation.episodes import draw_episodes, endless_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.cli import main
from tests.algos.train.runs import PPO, progress_of

ENV = EnvConfig(backend="warp", agents=4)


def test_the_command_line_trains_and_evaluates_groups(tmp_path: Path) -> None:
    run = tmp_path / "run"
    options = "--agents 4 --num-envs 8 --world maze:0-3 --length 40 --rollout-length 4 --minibatch 8 --hidden 16"
    assert main(["train", *options.split(), *f"--total-steps 384 --runs {tmp_path} --name run".split()]) == 0
    assert len(progress_of(run)["steps"]) >= 3
    seconds = "--seconds 1 --workers 1"
    assert main(["evaluate", str(run), *f"--world maze --backend warp --agents 4 --count 8 {seconds}".split()]) == 0
    result = json.loads((run / "evaluation.json").read_text())
    assert "agents" in json.dumps(result)


def test_workers_have_whole_groups() -> None:
    assert with_settings(PPO, backend="bullet", num_envs=12, agents=6, workers=None).workers <= 2
    with pytest.raises(ValueError, match="num_envs must be a multiple of agents=3, got 4"):
        with_settings(PPO, agents=3).check()
    with pytest.raises(ValueError, match="agents=4 rovers share worlds, and each of workers=2 has fewer"):
        with_settings(PPO, agents=4, workers=2, world="maze:0-9").check()


def test_episodes_of_a_group_are_apart_and_driven_at_once() -> None:
    episodes = draw_episodes("maze:0-1", 8, agents=4)
    for places in (episodes.start[:, :2], episodes.goal):
        groups = places.reshape(4, 4, 2)
        distances = torch.cdist(groups, groups) + 9 * torch.eye(4)
        assert distances.min() > 1.5
    result = evaluate(None, episodes, seconds=0.5, env=ENV)
    assert len(result.trajectories) == 16
    assert all(torch.equal(t.position[0, :2], s[:2]) for t, s in zip(result.trajectories, episodes.start, strict=True))
    with pytest.raises(ValueError, match="agents=4 consecutive episodes must be in the same world"):
        evaluate(None, episodes.part(0, 6), seconds=1, env=ENV)
    with pytest.raises(ValueError, match="count must be a multiple of agents=4, got 6"):
        draw_episodes("maze", 6, agents=4)
    assert len(evaluate(None, endless_episodes("maze", 8), seconds=0.5, env=ENV).trajectories) == 8
