"""The loss of PPO on plain tensors is that of TorchRL, and threads share its minibatches."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss

from rover_rl.algos.config import TrainingConfig, with_settings
from rover_rl.algos.policy.networks import BoundedTanhNormal, NormalParameters
from rover_rl.algos.train.collectors import collect
from rover_rl.algos.train.ppo import PPOLearner
from rover_rl.algos.train.ppo_loss import LOSSES, ppo_losses, squashing
from rover_rl.algos.train.progress import Stopwatch
from rover_rl.algos.train.run import prepare
from tests.algos.train.runs import FIELD, PPO, equal

LOW, HIGH = torch.tensor([-0.5, -3.0]), torch.tensor([1.0, 3.0])
ROWS = 64


def test_losses_and_their_gradients_are_those_of_torchrl() -> None:
    torch.manual_seed(0)
    body, critic = nn.Sequential(nn.Linear(5, 4), NormalParameters(1.0)), nn.Linear(5, 1)
    actor = ProbabilisticActor(
        TensorDictModule(body, ["features"], ["loc", "scale"]),
        ["loc", "scale"],
        distribution_class=BoundedTanhNormal,
        distribution_kwargs={"low": LOW, "high": HIGH},
    )
    rows = {"features": torch.randn(ROWS, 5), "action": LOW + (HIGH - LOW) * (0.01 + 0.98 * torch.rand(ROWS, 2))}
    log_prob = actor.get_dist(TensorDict(rows, [ROWS])).log_prob(rows["action"]).detach()
    rows["action_log_prob"] = log_prob + 0.3 * torch.randn(ROWS)
    rows |= {"advantage": torch.randn(ROWS, 1), "value_target": torch.randn(ROWS, 1)}
    options = {"clip_epsilon": 0.2, "entropy_coeff": 0.01, "critic_coeff": 0.5, "loss_critic_type": "l2"}
    loss = ClipPPOLoss(actor, ValueOperator(critic, ["features"]), **options)
    torch.manual_seed(1)
    expected = loss(TensorDict(rows, [ROWS]))
    torch.manual_seed(1)
    noise = torch.randn(1, ROWS, 2)[0]
    plain = rows | squashing(rows["action"], LOW, HIGH) | {"action_log_prob": rows["action_log_prob"][:, None]}
    outputs = body(rows["features"])
    terms = {"loss_objective": 1.0, "entropy": -0.01}
    losses, slopes = ppo_losses(*outputs, plain, noise, 0.2, terms)
    found = dict(zip(LOSSES, losses, strict=True))
    for name, value in found.items():
        torch.testing.assert_close(value, expected[name])
    assert 0 < found["clip_fraction"] < 1
    gradients = torch.autograd.grad(outputs, [*body.parameters()], slopes)
    sum(value for name, value in expected.items() if name.startswith("loss_")).backward()
    theirs = [weight.grad for weight in loss.actor_network_params.parameters()]
    torch.testing.assert_close([*gradients], theirs, rtol=1e-4, atol=1e-5)


def test_imitation_and_entropy_have_the_gradients_of_the_distribution() -> None:
    torch.manual_seed(0)
    body, features, noise = nn.Sequential(nn.Linear(5, 4), NormalParameters(1.0)), torch.randn(ROWS, 5), torch.randn(2)
    loc, scale = body(features)
    action = LOW + (HIGH - LOW) * (0.01 + 0.98 * torch.rand(ROWS, 2))
    rows = squashing(action, LOW, HIGH) | {"action_log_prob": torch.zeros(ROWS, 1), "advantage": torch.ones(ROWS, 1)}
    distribution = BoundedTanhNormal(loc, scale, LOW, HIGH)
    sample = distribution._t(loc + scale * noise)
    log_probs = {"loss_imitation": distribution.log_prob(action), "entropy": distribution.log_prob(sample)}
    for name, log_prob in log_probs.items():
        losses, slopes = ppo_losses(loc, scale, rows, noise.expand(ROWS, 2), 0.2, {name: 0.5})
        torch.testing.assert_close(losses[0 if name == "loss_imitation" else LOSSES.index(name)], -log_prob.mean())
        found, expected = (
            torch.autograd.grad(outputs, [*body.parameters()], by, retain_graph=True)
            for outputs, by in (((loc, scale), slopes), (-0.5 * log_prob.mean(), None))
        )
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_weights_do_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    size = {"num_envs": 128, "rollout_length": 16, "minibatch": 2048}
    config, learned = with_settings(PPO, world=FIELD, action_repeat=1, epochs=1, **size), []
    for threads in (1, 3):
        monkeypatch.setattr(TrainingConfig, "learner_threads", threads)
        learner = PPOLearner(prepare(config))
        with collect(config, learner.actor) as batches:
            learner.update(next(batches), 0.0, Stopwatch())
        learned.append(learner.weights())
    assert equal(*learned)
