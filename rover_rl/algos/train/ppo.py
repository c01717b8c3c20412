"""PPO: collect decisions of a batch of rovers, estimate advantages, take gradient steps.

The loop is explicit instead of TorchRL 0.14's experimental ``PPOTrainer``, which ends without a checkpoint at Ctrl-C,
saves no state of PyTorch's random generator, and with a fixed number of gradient steps skips every second epoch. Its
formulas are those of TorchRL's ``GAE`` and ``ClipPPOLoss``, on plain tensors: observations are encoded once for all
epochs, and threads share the decisions of a minibatch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.objectives.value.functional import generalized_advantage_estimate

from rover_rl.algos.config import PPOConfig, TrainingConfig
from rover_rl.algos.policy import networks
from rover_rl.algos.policy.expert import PrivilegedExpert
from rover_rl.algos.policy.grid_planner import Follower, follow
from rover_rl.algos.policy.recurrent import PlainRecurrent, state_keys
from rover_rl.algos.train.ppo_loss import ppo_losses, squashing
from rover_rl.algos.train.progress import Stopwatch
from rover_rl.algos.train.run import Learner
from rover_rl.envs.config import SCAN_POSE
from rover_rl.envs.sensors.suite import ROBOT, ROUTE
from rover_rl.robots import get_robot
from rover_rl.worlds.pool import WorldPool

__all__ = ["PPOConfig", "PPOLearner"]

_PART = 1024  # number of decisions of a minibatch that a thread takes at a time, on the CPU


class PPOLearner(Learner):
    """Actor, critic and their PPO update."""

    logged = ("loss_objective", "loss_critic", "entropy", "kl_approx", "clip_fraction")

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
        self._weights = [weight for weight in self._loss.parameters() if weight.requires_grad]
        self._optimizer = torch.optim.Adam(self._loss.parameters(), lr=settings.learning_rate, fused=True)
        self._expert = _make_expert(config) if settings.imitation else None
        self._mirrors = networks.mirrors_of(encoder.sensors, config.env.action.kind)
        self._encoder, self._spec = encoder, networks.action_spec(config.env.bounded_action, device)
        # An actor is one network, or one with a memory.
        self._network: networks.ActorNetwork | None = self.actor[0].module if network.memory == "none" else None
        self._memory = None if self._network else PlainRecurrent(self.actor[0])
        self._mirror_memory = self._memory and MirrorMemory(self._memory)

    def start_from(self, actor: Mapping[str, Tensor]) -> None:
        """Loads the weights of a trained policy. The critic, which is new, takes over frozen convolutions."""
        super().start_from(actor)
        if self._settings.freeze_encoder:
            for new, trained in zip(_image_networks(self.critic), _image_networks(self.actor), strict=True):
                new.load_state_dict(trained.state_dict())

    def update(self, batch: TensorDictBase, share: float, stopwatch: Stopwatch) -> dict[str, float]:
        self._set_learning_rate(share)
        terms = {"loss_objective": 1.0, "loss_critic": 1.0, "entropy": -self._settings.entropy_coef}
        if self._expert is not None and share < self._settings.imitation:
            # DAgger (Ross et al., 2011): the policy drives, and the expert labels the visited states with its actions.
            batch = batch.copy().set("action", self._inside_bounds(self._expert(batch)))
            terms = {"loss_imitation": 1.0, "loss_critic": 1.0}
        elif share < self._settings.critic_warmup:
            terms = {"loss_critic": 1.0}
        with stopwatch("gradient steps"), ThreadPoolExecutor(self.config.learner_threads) as pool:
            decisions = self._decisions(batch)
            steps = [self._gradient_step(decisions, *part, terms, pool) for part in self._minibatches(decisions)]
            return self._means(steps)

    @torch.no_grad()
    def _decisions(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Returns what gradient steps read of a batch ``[N, T]``, by name.

        It is flat, ``[N T, ...]``, or with a memory in sequences, ``[N, T, ...]``. The mirror images of all follow if
        the learner learns from them.
        """
        images, count = self._settings.mirror_augmentation, len(batch)
        read = batch.select(*self.actor.in_keys, *self.critic.in_keys, "action", "action_log_prob")
        if self._network and self._network.prior:
            read[networks.DRIVER] = self._network.driver(batch)
        if images:
            every = torch.ones(batch.shape, dtype=torch.bool, device=batch["action"].device)
            read = torch.cat([read, networks.mirrored(read, every, self._mirrors)])
        kept = ("action_log_prob", networks.DRIVER, "is_init")
        rows = {key: value for key in kept if (value := read.get(key, None)) is not None}
        rows |= squashing(read["action"], *self._bounds(read))
        rows["features"] = self._encoder(*(read[key] for key in self._encoder.keys))
        if self.config.network.privileged_critic:
            rows["seen"] = self.critic.module.features(*(read[key] for key in self.critic.in_keys))
        for key, value in self._advantages(batch, rows.get("seen", rows["features"])[:count]).items():
            rows[key] = torch.cat((value, value)) if images else value
        if self._memory is None:
            return {key: value.flatten(0, 1) for key, value in rows.items()}
        rows["state"] = torch.cat([batch[key][:, 0, 0] for key in state_keys(self.actor)], -1)
        if images and self._mirror_memory:
            image = self._mirror_memory.starts(rows["features"][count:], rows["is_init"][count:])
            rows["state"] = torch.cat((rows["state"], image))
        return rows

    def _bounds(self, read: TensorDictBase) -> tuple[Tensor, Tensor]:
        if self._network and self._network.by_robot:
            return self._network.bounds(read[ROBOT])
        return self._spec.space.low, self._spec.space.high

    def _advantages(self, batch: TensorDictBase, seen: Tensor) -> dict[str, Tensor]:
        """Returns advantages ``[N, T]``, standardized, and targets of values ``[N, T, 1]``."""
        settings, after, critic = self._settings, batch["next"], self.critic.module
        values = critic.body(seen), critic(*(after[key] for key in self.critic.in_keys))
        reward, ends = settings.reward_scale * after["reward"], (after["done"], after["terminated"])
        advantage, target = generalized_advantage_estimate(settings.gamma, settings.lmbda, *values, reward, *ends)
        advantage = (advantage - advantage.mean()) / advantage.std().clamp_min(1e-4)
        return {"advantage": advantage.squeeze(-1), "value_target": target}

    def _minibatches(self, decisions: Mapping[str, Tensor]) -> Iterator[tuple[Tensor, Tensor]]:
        """Yields the rows of each minibatch of all epochs, some of them mirror images, and noise for the entropy."""
        settings, action = self._settings, decisions["unsquashed"]
        count = len(action) // 2 if settings.mirror_augmentation else len(action)
        size = max(1, settings.minibatch // settings.rollout_length) if self._memory else settings.minibatch
        for _ in range(settings.epochs):
            rows = torch.randperm(count, device=action.device)
            if settings.mirror_augmentation:
                rows = rows + count * (torch.rand(count, device=action.device) < 0.5)
            yield from zip(rows.split(size), torch.randn_like(action[:count]).split(size), strict=True)

    def _gradient_step(
        self, decisions: Mapping[str, Tensor], rows: Tensor, noise: Tensor, terms: Mapping[str, float], pool: Executor
    ) -> Tensor:
        """Takes a gradient step on the weighted sum of some terms of PPO's loss and returns the logged values.

        The parts of the minibatch do not depend on the number of threads. For imitation, ``loss_objective`` is the
        negative log-likelihood of ``action``.
        """
        size = len(rows) if self.config.on_gpu else max(1, _PART // noise[0, ..., 0].numel())
        logged = ["loss_imitation" if "loss_imitation" in terms else "loss_objective", *self.logged[1:]]

        def gradients(part: Tensor, noise: Tensor) -> tuple[tuple[Tensor | None, ...], Tensor]:
            read, share = {key: value[part] for key, value in decisions.items()}, len(part) / len(rows)
            value = self.critic.module.body(read.get("seen", read["features"]))
            losses = ppo_losses(*self._distribution(read), value, read, noise, self._settings.clip)
            loss = torch.stack([factor * losses[name] for name, factor in terms.items()]).sum()
            told = torch.stack([losses[name].detach() for name in logged])
            return torch.autograd.grad(share * loss, self._weights, allow_unused=True), share * told

        each = pool.map if len(rows) > size else map
        found = [*each(gradients, rows.split(size), noise.split(size))]
        for weight, *parts in zip(self._weights, *(grads for grads, _ in found), strict=True):
            weight.grad = None if parts[0] is None else torch.stack(parts).sum(0)
        torch.nn.utils.clip_grad_norm_(self._weights, self._settings.max_grad_norm)
        self._optimizer.step()
        return torch.stack([told for _, told in found]).sum(0)

    def _distribution(self, read: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        if self._network:
            return self._network.distribution(read["features"], read.get(networks.DRIVER))
        assert self._memory
        loc, scale, _ = self._memory.sequence(read["features"], read["is_init"], read["state"])
        return loc, scale

    def _inside_bounds(self, action: Tensor) -> Tensor:
        middle, half = networks.middle_and_half(self._spec)
        return middle + 0.95 * torch.minimum(torch.maximum(action - middle, -half), half)


def _image_networks(network: nn.Module) -> list[networks.ImageFeatures]:
    return [module for module in network.modules() if isinstance(module, networks.ImageFeatures)]


def _make_expert(config: TrainingConfig) -> Callable[[TensorDictBase], Tensor]:
    assert isinstance(config.algorithm, PPOConfig)
    robot = get_robot(config.env.robot)
    if config.algorithm.expert == "route":
        follower = Follower.of(robot)
        return lambda decisions: follow(
            decisions["lidar"], decisions["imu"], decisions[ROUTE], follower, decisions.get(SCAN_POSE, None)
        )
    return PrivilegedExpert(WorldPool.of(config.env.world), robot, config.device).action


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
        *_, self._last = self._memory.sequence(features, is_init, start)
        return start
