"""A distribution over the actions of a grid: its actors, losses, mirror images and export."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict
from torch.distributions import Categorical
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.config import with_settings
from rover_rl.algos.deploy.export import export
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.grid_actions import ACTIONS, GridDistribution, grid_actions, mirrored_labels, nearest_index
from rover_rl.algos.policy.networks import make_actor
from rover_rl.algos.train.ppo_loss import LOSSES, grid_losses
from rover_rl.envs.actions import Heading
from rover_rl.envs.config import ActionConfig
from tests.algos.train.runs import FIELD, PPO, progress_of, run

LOW, HIGH, ROWS = torch.tensor([-0.5, -3.0]), torch.tensor([1.0, 3.0]), 64


def test_samples_have_the_probabilities_of_the_logits_and_the_mode_is_the_likeliest() -> None:
    torch.manual_seed(0)
    logits = torch.randn(ACTIONS)
    grid = GridDistribution(logits, logits[:0], LOW, HIGH)
    actions = grid.sample((20_000,))
    counts = nearest_index(actions, LOW, HIGH).bincount(minlength=ACTIONS) / len(actions)
    torch.testing.assert_close(counts, logits.softmax(-1), atol=0.01, rtol=0)
    torch.testing.assert_close(grid.log_prob(actions), logits.log_softmax(-1)[nearest_index(actions, LOW, HIGH)])
    assert torch.equal(grid.deterministic_sample, grid_actions(LOW, HIGH)[logits.argmax()])
    assert ((actions >= LOW) & (actions <= HIGH)).all()


def test_mirror_images_of_actions_are_on_the_grid() -> None:
    actions = grid_actions(LOW, HIGH)
    labels = torch.rand(3, ACTIONS)
    index = nearest_index(Heading.mirror(actions), LOW, HIGH)
    torch.testing.assert_close(actions[index], Heading.mirror(actions))
    assert torch.equal(mirrored_labels(labels), labels[:, index])


@pytest.mark.parametrize("labelled", [False, True])
def test_losses_have_the_gradients_of_the_distribution(labelled: bool) -> None:
    torch.manual_seed(0)
    logits, index = torch.randn(ROWS, ACTIONS, requires_grad=True), torch.randint(ACTIONS, (ROWS, 1))
    grid = Categorical(logits=logits)
    log_prob = grid.log_prob(index[:, 0])[:, None]
    rows = {"index": index.float(), "advantage": torch.randn(ROWS, 1)}
    rows["action_log_prob"] = log_prob.detach() + 0.3 * torch.randn(ROWS, 1)
    if labelled:
        rows["labels"] = torch.rand(ROWS, ACTIONS)
    ratio = (log_prob - rows["action_log_prob"]).exp()
    gain, bound = ratio * rows["advantage"], ratio.clamp(0.8, 1.2) * rows["advantage"]
    imitated = (rows["labels"] * grid.logits).sum(-1).mean() if labelled else log_prob.mean()
    expected = {"loss_objective": -torch.minimum(gain, bound).mean(), "loss_imitation": -imitated}
    for name, loss in expected.items():
        losses, (slope, _) = grid_losses(logits, logits[:, :0], rows, torch.zeros(0), 0.2, {name: 0.5, "entropy": -0.1})
        found = dict(zip(LOSSES, losses, strict=True))
        torch.testing.assert_close(found["loss_objective"], loss)
        torch.testing.assert_close(found["entropy"], grid.entropy().mean())
        total = 0.5 * loss - 0.1 * grid.entropy().mean()
        torch.testing.assert_close(slope, torch.autograd.grad(total, logits, retain_graph=True)[0])


@pytest.mark.parametrize("memory", ["none", "gru"])
def test_a_policy_on_a_grid_learns_is_stored_and_exported(memory: str, tmp_path: Path) -> None:
    config = with_settings(PPO, world=FIELD, distribution="grid", memory=memory, memory_size=8)
    folder = run(config, tmp_path).folder
    checkpoint = Checkpoint.load(folder)
    assert progress_of(folder)["entropy"][0] == pytest.approx(torch.tensor(float(ACTIONS)).log().item(), abs=0.01)
    assert export(checkpoint, tmp_path / "policy.onnx") < 1e-6
    actor = checkpoint.make_actor()
    keys = ("lidar", "imu", "target", "velocities")
    observation = TensorDict(
        {key: torch.rand(5, 32 if key == "lidar" else 3 if key == "imu" else 2) for key in keys}, 5
    )
    if memory == "gru":
        observation.update({"memory_hidden": torch.zeros(5, 1, 8), "is_init": torch.ones(5, 1, dtype=torch.bool)})
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        chosen = actor(observation)
    assert torch.equal(chosen["action"], actor.get_dist(observation).deterministic_sample)


def test_experts_that_name_one_action_are_imitated_on_a_grid(tmp_path: Path) -> None:
    settings = {"imitation": 1.0, "epochs": 30, "learning_rate": 3e-3, "anneal": False, "minibatch": 16}
    folder = run(PPO, tmp_path, world=FIELD, total_steps=512, hidden=(64,), distribution="grid", **settings).folder
    surprise, by_chance = progress_of(folder)["loss_objective"], math.log(ACTIONS)
    assert sum(surprise[-4:]) / 4 < by_chance - 1


def test_a_grid_is_for_headings_without_a_prior() -> None:
    with pytest.raises(ValueError, match="^distribution='grid' is for PPO without a prior and the action heading, got"):
        with_settings(PPO, distribution="grid", action=ActionConfig(kind="twist")).check()
    assert make_actor(distribution="grid").out_keys[-1] == "action_log_prob"
