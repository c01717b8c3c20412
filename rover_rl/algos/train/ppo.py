"""PPO: collect decisions of a batch of rovers, estimate advantages, take gradient steps.

The loop is explicit instead of TorchRL 0.14's experimental ``PPOTrainer``, which ends without a checkpoint at Ctrl-C,
saves no state of PyTorch's random generator, and with a fixed number of gradient steps skips every second epoch. Its
formulas are those of TorchRL's ``GAE`` and ``ClipPPOLoss``, on plain tensors: observations are encoded once for all
epochs, the gradient of the loss is written out, and threads share the actor and the critic of a minibatch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial, reduce
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import mse_loss
from torchrl.objectives.value.functional import generalized_advantage_estimate

from rover_rl.algos.config import PPOConfig, TrainingConfig
from rover_rl.algos.policy import networks
from rover_rl.algos.policy.expert import PrivilegedExpert
from rover_rl.algos.policy.grid_actions import ACTIONS, LABELS, nearest_index
from rover_rl.algos.policy.grid_planner import Follower, follow
from rover_rl.algos.policy.predictive import InformedPredictive
from rover_rl.algos.policy.recurrent import PlainRecurrent, state_keys
from rover_rl.algos.train.ppo_loss import LOSSES, grid_losses, ppo_losses, squashing
from rover_rl.algos.train.progress import Stopwatch
from rover_rl.algos.train.run import Learner
from rover_rl.envs.config import SCAN_POSE
from rover_rl.envs.sensors.suite import ROBOT, ROUTE
from rover_rl.robots import get_robot
from rover_rl.worlds.pool import WorldPool

__all__ = ["PPOConfig", "PPOLearner"]

LABELLED = 0.25  # share of the decisions that a slow expert labels
_PART, _RECURRENT_PART = 1024, 512  # decisions that a CPU thread takes of a minibatch, without and with a memory


class PPOLearner(Learner):
    """Actor, critic and their PPO update."""

    logged = (LOSSES[0], "loss_critic", *LOSSES[1:])

    def __init__(self, config: TrainingConfig) -> None:
        assert isinstance(config.algorithm, PPOConfig)
        self.config, self._settings = config, config.algorithm
        settings, network, device = config.algorithm, config.network, config.device
        encoder = networks.encoder_of(config)
        self.actor = networks.actor_of(config, encoder, device)
        self.critic = networks.make_critic(encoder, network.hidden, device, network.privileged_critic)
        if settings.freeze_encoder:
            frozen = [*_image_networks(self.actor), *_image_networks(self.critic)]
            if not frozen:
                raise ValueError(f"freeze_encoder needs an image in observation, got {network.observation}")
            for images in frozen:
                images.requires_grad_(False)
        self._loss = nn.ModuleDict({"actor": self.actor, "critic": self.critic})
        self._actor_weights, self._critic_weights = (
            [weight for weight in network.parameters() if weight.requires_grad] for network in self._loss.values()
        )
        # Threads that stay keep the memory that their operators work in.
        self._threads = ThreadPoolExecutor(config.learner_threads)
        self._optimizer = torch.optim.Adam(self._loss.parameters(), lr=settings.learning_rate, fused=True)
        self._expert = self._make_expert() if settings.imitation else None
        self._mirrors = networks.mirrors_of(encoder.sensors, config.env.action.kind)
        self._on_grid = network.distribution == "grid"
        self._encoder, self._spec = encoder, networks.action_spec(config.env.bounded_action, device)
        by_robot = networks.bounds_by_robot(config)
        self._row_bounds = by_robot and by_robot.to(device)
        # An actor is one network, or one with a memory.
        self._network: networks.ActorNetwork | None = self.actor[0].module if network.memory == "none" else None
        self._memory = None if self._network else PlainRecurrent(self.actor[0])
        self._part = _RECURRENT_PART if self._memory else _PART
        self._mirror_memory = self._memory and MirrorMemory(self._memory)

    def start_from(self, actor: Mapping[str, Tensor]) -> None:
        """Loads the weights of a trained policy. The critic, which is new, takes over frozen convolutions."""
        super().start_from(actor)
        if self._settings.freeze_encoder:
            for new, trained in zip(_image_networks(self.critic), _image_networks(self.actor), strict=True):
                new.load_state_dict(trained.state_dict())

    def schedule(self, share: float) -> None:
        """Also sets the largest standard deviation of actions, from ``max_std`` to ``final_std``."""
        super().schedule(share)
        first = self.config.network.max_std
        last = first if self._settings.final_std is None else min(first, self._settings.final_std)
        for module in self.actor.modules():
            if isinstance(module, networks.NormalParameters):
                module.max_std.fill_(first + share * (last - first))

    def update(self, batch: TensorDictBase, share: float, stopwatch: Stopwatch) -> dict[str, float]:
        terms = {"loss_objective": 1.0, "loss_critic": 1.0, "entropy": -self._settings.entropy_coef}
        if self._expert is not None and share < self._settings.imitation:
            # DAgger (Ross et al., 2011): the policy drives, and the expert labels the visited states with its actions.
            batch = batch.copy().update(self._expert(batch))
            terms = {"loss_imitation": 1.0, "loss_critic": 1.0}
        elif share < self._settings.critic_warmup:
            terms = {"loss_critic": 1.0}
        with stopwatch("gradient steps"):
            decisions = self._decisions(batch)
            return self._means([self._gradient_step(decisions, *part, terms) for part in self._minibatches(decisions)])

    @torch.no_grad()
    def _decisions(self, batch: TensorDictBase) -> Decisions:
        """Returns what gradient steps read of a batch ``[N, T]``: decisions, or with a memory sequences of them.

        The mirror images of all follow if the learner learns from them.
        """
        images, count = self._settings.mirror_augmentation, len(batch)
        read = batch.select(*self.actor.in_keys, *self.critic.in_keys, "action", "action_log_prob")
        if LABELS in batch.keys():  # noqa: SIM118
            read[LABELS] = batch[LABELS]
        if self._network and self._network.prior:
            read[networks.DRIVER] = self._network.driver(batch)
        if images:
            every = torch.ones(batch.shape, dtype=torch.bool, device=batch["action"].device)
            read = torch.cat([read, networks.mirrored(read, every, self._mirrors)])
        rows = {"seen": self.critic.module.features(*(read[key] for key in self.critic.in_keys))}
        action, bounds = read["action"], self._bounds(read)
        rows |= {"index": nearest_index(action, *bounds)[..., None]} if self._on_grid else squashing(action, *bounds)
        rows["action_log_prob"] = read["action_log_prob"][..., None]
        rows |= {
            key: value for key in (networks.DRIVER, "is_init", LABELS) if (value := read.get(key, None)) is not None
        }
        for key, value in self._advantages(batch, rows["seen"][:count]).items():
            rows[key] = torch.cat((value, value)) if images else value
        if self._memory is None:
            return Decisions.of({key: value.flatten(0, 1) for key, value in rows.items()})
        state = torch.cat([batch[key][:, 0, 0] for key in state_keys(self.actor)], -1)
        if images and self._mirror_memory:
            image = self._mirror_memory.starts(self._features(rows)[count:], rows["is_init"][count:])
            state = torch.cat((state, image))
        return Decisions.of({key: value.transpose(0, 1) for key, value in rows.items()}, state)

    def _bounds(self, read: TensorDictBase) -> tuple[Tensor, Tensor]:
        if self._row_bounds is not None:
            return self._row_bounds(read[ROBOT])
        return self._spec.space.low, self._spec.space.high

    def _features(self, rows: Mapping[str, Tensor]) -> Tensor:
        # What only the critic sees follows.
        return rows["seen"][..., : self._encoder.features]

    def _advantages(self, batch: TensorDictBase, seen: Tensor) -> dict[str, Tensor]:
        """Returns advantages, standardized, and targets of values, ``[N, T, 1]``."""
        settings, after, critic = self._settings, batch["next"], self.critic.module
        values = critic.body(seen), critic(*(after[key] for key in self.critic.in_keys))
        reward, ends = settings.reward_scale * after["reward"], (after["done"], after["terminated"])
        advantage, target = generalized_advantage_estimate(settings.gamma, settings.lmbda, *values, reward, *ends)
        advantage = (advantage - advantage.mean()) / advantage.std().clamp_min(1e-4)
        return {"advantage": advantage, "value_target": target}

    def _minibatches(self, decisions: Decisions) -> Iterator[tuple[Tensor, Tensor]]:
        """Yields the rows of each minibatch of all epochs, some of them mirror images, and noise for the entropy."""
        settings, device = self._settings, decisions.table.device
        *steps, count, _ = decisions.table.shape
        count = count // 2 if settings.mirror_augmentation else count
        size = max(1, settings.minibatch // settings.rollout_length) if self._memory else settings.minibatch
        for _ in range(settings.epochs):
            rows = torch.randperm(count, device=device)
            if settings.mirror_augmentation:
                rows = rows + count * (torch.rand(count, device=device) < 0.5)
            noise = torch.randn(*steps, count, *self._spec.shape, device=device)
            yield from zip(rows.split(size), noise.split(size, -2), strict=True)

    def _gradient_step(self, decisions: Decisions, rows: Tensor, noise: Tensor, terms: Mapping[str, float]) -> Tensor:
        """Takes a gradient step on the weighted sum of some terms of PPO's loss and returns the logged values.

        Threads share the work: parts of the minibatch, which do not depend on their number, of actor and critic each.
        """
        size = len(rows) if self.config.on_gpu else max(1, self._part * len(rows) // noise[..., 0].numel())
        parts = [*zip(rows.split(size), noise.split(size, -2), strict=True)]
        # While the critic warms up, the actor does not learn.
        actor_weights = self._actor_weights if len(terms) > 1 else []

        def actor(read: Mapping[str, Tensor], noise: Tensor) -> Tensor:
            outputs = self._distribution(read)
            losses, slopes = (grid_losses if self._on_grid else ppo_losses)(
                *outputs, read, noise.flatten(0, -2), self._settings.clip, terms
            )
            return _with_gradient(losses, outputs, actor_weights, slopes)

        def critic(read: Mapping[str, Tensor], _: Tensor) -> Tensor:
            loss = 0.5 * mse_loss(self.critic.module.body(read["seen"]), read["value_target"])
            return _with_gradient(loss.detach()[None], [loss], self._critic_weights)

        def run(task: tuple[Callable[..., Tensor], Tensor, Tensor]) -> Tensor:
            network, part, noise = task
            return network(decisions.rows(part), noise) * (len(part) / len(rows))

        tasks = [(network, *part) for network in (actor, critic) for part in parts]
        found = [*(map if self.config.on_gpu else self._threads.map)(run, tasks)]
        losses, by_actor = reduce(torch.add, found[: len(parts)]).tensor_split([len(LOSSES)])
        loss, by_critic = reduce(torch.add, found[len(parts) :]).tensor_split([1])
        gradient, weights = torch.cat((by_actor, by_critic)), [*actor_weights, *self._critic_weights]
        gradient *= (self._settings.max_grad_norm / (gradient.norm() + 1e-6)).clamp(max=1.0)
        self._loss.zero_grad()
        for weight, grad in zip(weights, gradient.split([weight.numel() for weight in weights]), strict=True):
            weight.grad = grad.view_as(weight)
        self._optimizer.step()
        return torch.cat((losses[:1], loss, losses[1:]))

    def _distribution(self, read: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        if self._network:
            return self._network.distribution(self._features(read), read.get(networks.DRIVER))
        assert self._memory
        loc, scale, _ = self._memory.sequence(self._features(read), read["is_init"], read["state"])
        return loc, scale

    def _make_expert(self) -> Callable[[TensorDictBase], dict[str, Tensor]]:
        """Returns a function of a batch that labels its decisions: their ``action``, or ``LABELS``."""
        kind, env = self._settings.expert, self.config.env
        robot = get_robot(env.robot)
        if kind == "route":
            follower = Follower.of(robot)
            return lambda batch: self._labelled(
                follow(batch["lidar"], batch["imu"], batch[ROUTE], follower, batch.get(SCAN_POSE, None))
            )
        worlds = WorldPool.of(env.world)
        if kind == "predictive":
            return partial(self._label_some, InformedPredictive(worlds, robot))
        expert = PrivilegedExpert(worlds, robot, self.config.device)
        return lambda batch: self._labelled(expert.action(batch))

    def _label_some(self, expert: InformedPredictive, batch: TensorDictBase) -> dict[str, Tensor]:
        """Labels a share of the decisions, at random, as the expert is slow. The others have no weight."""
        chosen = torch.rand(batch.shape, device=batch.device) < LABELLED
        labels = batch["action"].new_zeros(*batch.shape, ACTIONS)
        rows = batch[chosen]
        labels[chosen] = expert.labels(rows, *self._bounds(rows)) / LABELLED
        return {LABELS: labels}

    def _labelled(self, action: Tensor) -> dict[str, Tensor]:
        middle, half = networks.middle_and_half(self._spec)
        return {"action": middle + 0.95 * torch.minimum(torch.maximum(action - middle, -half), half)}


class Decisions(NamedTuple):
    """What gradient steps read of decisions: a table, so that a minibatch is one gather.

    ``table`` is ``[M, K]``, or with a memory ``[T, M, K]``, with ``sizes`` of its columns by name. ``state [M, s]`` is
    that of the memory before each sequence.
    """

    table: Tensor
    sizes: dict[str, int]
    state: Tensor | None = None

    @classmethod
    def of(cls, rows: Mapping[str, Tensor], state: Tensor | None = None) -> Decisions:
        return cls(torch.cat([*rows.values()], -1), {key: value.shape[-1] for key, value in rows.items()}, state)

    def rows(self, index: Tensor) -> dict[str, Tensor]:
        """Returns columns of some rows, ``[m, k]``, or with a memory those of one step after another, ``[T m, k]``."""
        table = self.table.index_select(-2, index).flatten(0, -2)
        read = dict(zip(self.sizes, table.split([*self.sizes.values()], -1), strict=True))
        return read if self.state is None else read | {"state": self.state[index]}


def _with_gradient(
    losses: Tensor, outputs: Sequence[Tensor], weights: Sequence[Tensor], slopes: Sequence[Tensor] | None = None
) -> Tensor:
    """Returns a vector of losses and of the gradient of weights, given the slopes of the loss by outputs."""
    grads = torch.autograd.grad(outputs, weights, slopes, materialize_grads=True) if weights else ()
    return torch.cat([losses, *(grad.flatten() for grad in grads)])


def _image_networks(network: nn.Module) -> list[networks.ImageFeatures]:
    return [module for module in network.modules() if isinstance(module, networks.ImageFeatures)]


class MirrorMemory:
    """Memory that an actor would have if it had seen the mirror image of everything.

    A sequence in a batch starts with the state that the actor had there. The mirror image of the sequence has another
    one: that of an actor that saw the mirror image from the start of the episode. This class computes it, batch by
    batch, with one more pass of the actor over each batch. As the states that the collector stores, it is that of the
    weights with which the batches were collected.
    """

    def __init__(self, memory: PlainRecurrent) -> None:
        self._memory = memory
        self._last: Tensor | None = None

    @torch.no_grad()
    def starts(self, features: Tensor, is_init: Tensor) -> Tensor:
        """Returns the states ``[N, s]`` before the next batch, whose mirror image has ``features [N, T, F]``."""
        start = features.new_zeros(len(features), self._memory.state_size) if self._last is None else self._last
        features, is_init = (part.transpose(0, 1).flatten(0, 1) for part in (features, is_init))
        *_, self._last = self._memory.sequence(features, is_init, start)
        return start
