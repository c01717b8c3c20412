"""PPO with TorchRL: collect decisions of a batch of rovers, estimate advantages, take gradient steps.

The loop is explicit instead of TorchRL 0.14's experimental ``PPOTrainer``, which trains equally well and fast, but ends
without a checkpoint at Ctrl-C, saves no state of PyTorch's random generator, and with a fixed number of gradient steps
skips every second epoch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor, set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from rover_rl.algos.config import PPOConfig, TrainingConfig
from rover_rl.algos.policy import networks
from rover_rl.algos.policy.expert import PrivilegedExpert
from rover_rl.algos.policy.grid_planner import Follower, follow
from rover_rl.algos.policy.recurrent import state_keys
from rover_rl.algos.train.progress import Stopwatch
from rover_rl.algos.train.run import Learner
from rover_rl.envs.config import SCAN_POSE
from rover_rl.envs.sensors.suite import ROUTE
from rover_rl.robots import get_robot
from rover_rl.worlds.pool import WorldPool

__all__ = ["PPOConfig", "PPOLearner"]


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
        self._advantage = GAE(gamma=settings.gamma, lmbda=settings.lmbda, value_network=self.critic, average_gae=True)
        self._driver = networks.driver_of(self.actor)
        driven = self.actor if self._driver is None else networks.with_driver(self.actor)
        self._loss = ClipPPOLoss(
            driven,
            self.critic,
            clip_epsilon=settings.clip,
            entropy_coeff=settings.entropy_coef,
            critic_coeff=0.5,
            loss_critic_type="l2",
        )
        self._optimizer = torch.optim.Adam(self._loss.parameters(), lr=settings.learning_rate)
        self._expert = _make_expert(config) if settings.imitation else None
        self._mirrors = networks.mirrors_of(encoder.sensors, config.env.action.kind)
        self._recurrent, self._mirror_memory = network.memory != "none", MirrorMemory(self.actor, self._mirrors)
        inputs = dict.fromkeys((*driven.in_keys, *self.critic.in_keys))
        self._training_keys = (*inputs, "action", "action_log_prob", "advantage", "value_target")

    def start_from(self, actor: Mapping[str, Tensor]) -> None:
        """Loads the weights of a trained policy. The critic, which is new, takes over frozen convolutions."""
        super().start_from(actor)
        if self._settings.freeze_encoder:
            for new, trained in zip(_image_networks(self.critic), _image_networks(self.actor), strict=True):
                new.load_state_dict(trained.state_dict())

    def update(self, batch: TensorDictBase, share: float, stopwatch: Stopwatch) -> dict[str, float]:
        self._set_learning_rate(share)
        batch["next", "reward"] *= self._settings.reward_scale
        with torch.no_grad():
            self._advantage(batch)
            if self._driver is not None:
                batch[networks.DRIVER] = self._driver(batch)
        decisions = batch.select(*self._training_keys)
        imitating = self._expert is not None and share < self._settings.imitation
        terms = ["loss_objective", "loss_critic", "loss_entropy"]
        if self._expert and imitating:
            # DAgger (Ross et al., 2011): the policy drives, and the expert labels the visited states with its actions.
            decisions["action"] = self._inside_bounds(self._expert(batch))
            terms.remove("loss_entropy")
        elif share < self._settings.critic_warmup:
            terms = ["loss_critic"]
        steps = []
        for part in self._minibatches(decisions):
            with stopwatch("gradient steps"):
                steps.append(self._gradient_step(part, terms, imitating))
        with stopwatch("gradient steps"):
            return self._means(steps)

    def _minibatches(self, decisions: TensorDictBase) -> Iterator[TensorDictBase]:
        """Yields the minibatches of all epochs, some of their decisions mirrored.

        A minibatch has decisions ``[M]``, or with a memory whole sequences of some rovers ``[M, T]``.
        """
        settings, device, size = self._settings, self.config.device, self._settings.minibatch
        starts = self._mirror_memory.starts(decisions) if settings.mirror_augmentation else {}
        if self._recurrent:
            size = max(1, size // settings.rollout_length)
        else:
            decisions = decisions.reshape(-1)
        for _ in range(settings.epochs):
            order = torch.randperm(len(decisions), device=device)
            shuffled = decisions[order]
            if settings.mirror_augmentation:
                rows = torch.rand(len(shuffled), device=device) < 0.5
                states = {key: state[order] for key, state in starts.items()}
                shuffled = mirrored_rows(shuffled, rows, states, self._mirrors)
            yield from shuffled.split(size)

    def _gradient_step(self, decisions: TensorDictBase, terms: list[str], imitating: bool) -> Tensor:
        """Takes a gradient step on the sum of some terms of PPO's loss and returns the logged values.

        For imitation, ``loss_objective`` is the negative log-likelihood of ``action``.
        """
        # Losses of TorchRL run memories on sequences.
        losses = self._loss(decisions)
        if imitating:
            with set_recurrent_mode(True):
                losses["loss_objective"] = -self.actor.get_dist(decisions).log_prob(decisions["action"]).mean()
        self._optimizer.zero_grad()
        torch.stack([losses[term] for term in terms]).sum().backward()
        torch.nn.utils.clip_grad_norm_(self._loss.parameters(), self._settings.max_grad_norm)
        self._optimizer.step()
        return self._logged(losses)

    def _inside_bounds(self, action: Tensor) -> Tensor:
        spec = networks.action_spec(self.config.env.bounded_action, self.config.device)
        middle, half = networks.middle_and_half(spec)
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

    def __init__(self, actor: ProbabilisticActor, mirrors: networks.Mirrors = networks.DEFAULT_MIRRORS) -> None:
        self._actor, self._keys, self._mirrors = actor, state_keys(actor), mirrors
        self._last: dict[str, Tensor] = {}

    @torch.no_grad()
    def starts(self, decisions: TensorDictBase) -> dict[str, Tensor]:
        """Returns the states ``[N, T, 1, units]`` of the mirror image of the next batch ``[N, T]``, by key.

        Only the states at the start of a sequence or an episode are those of the mirror image. Updates read no others.
        Without memory there are none.
        """
        if not self._keys:
            return {}
        states = {key: decisions[key].clone() for key in self._keys}
        is_init = decisions["is_init"][:, 0, :, None]
        for key, last in self._last.items():
            states[key][:, 0] = torch.where(is_init, 0.0, last)
        every = torch.ones(decisions.batch_size, dtype=torch.bool, device=decisions["is_init"].device)
        with set_recurrent_mode(True):
            image = self._actor[0](networks.mirrored(decisions, every, self._mirrors).update(states))
        self._last = {key: image["next", key][:, -1] for key in self._keys}
        return states


def mirrored_rows(
    decisions: TensorDictBase,
    rows: Tensor,
    starts: dict[str, Tensor],
    mirrors: networks.Mirrors = networks.DEFAULT_MIRRORS,
) -> TensorDictBase:
    """Returns decisions ``[N]`` or sequences ``[N, T]`` with the selected ``rows`` (bool ``[N]``) mirrored.

    ``starts`` are the states of their memory: see :class:`MirrorMemory`.
    """
    image = networks.mirrored(decisions, rows.reshape(-1, *[1] * (decisions.ndim - 1)), mirrors)
    for key, state in starts.items():
        image[key] = torch.where(rows[:, None, None, None], state, decisions[key])
    return image
