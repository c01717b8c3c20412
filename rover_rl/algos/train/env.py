"""Training environment, in which one step is one decision of the policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import EnvBase, RewardSum, StepCounter, Transform

from rover_rl.algos.config import TrainingConfig, usable_cores
from rover_rl.algos.policy.recurrent import memory_transforms
from rover_rl.algos.train.curriculum import Curriculum
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.make import add_reward
from rover_rl.envs.rewards import reward_components
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.seen_map.seen_map import ROUTE
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from rover_rl.envs.transforms.path_reward import PathReward
from rover_rl.envs.transforms.route_observation import RouteObservation
from rover_rl.envs.transforms.route_reward import RouteReward
from rover_rl.envs.transforms.step_clock import StepClock
from rover_rl.sims.backends import find_settings

SESSION_SEEDS = 1_000_003
"""Offset of the seeds of each session of a run, so that a resumed run draws new starts and goals."""


def make_training_env(
    config: TrainingConfig,
    worker: int = 0,
    session: int = 0,
    estimates: Mapping[str, Tensor] | None = None,
    per_batch: bool = False,
) -> EnvBase:
    """Makes the environment of one worker, in which one step is one decision of the policy.

    The first episode of each row has a random length, so that the resets of the rows are spread over time.

    Args:
        config: settings of the training run.
        worker: index of the worker, from 0.
        session: number of times the run has been resumed.
        estimates: state of the :class:`~rover_rl.algos.train.learnability.Learnability` that a curriculum begins with.
        per_batch: whether transforms read values from the device once per batch, instead of once per step: see
            :class:`~rover_rl.algos.train.rollouts.PerBatch`.
    """
    env_config = _worker_env_config(config, worker, session)
    reward_components(env_config.reward, env_config.contract_reward)
    rovers = RoverEnv(**env_config.arguments())
    env = add_reward(rovers, env_config.reward, env_config)
    action_repeat = config.collection.action_repeat
    env = env.append_transform(ActionRepeat(action_repeat))
    if ROUTE in config.network.observation:
        env = env.append_transform(RouteObservation(rovers, _threads(config), action_repeat))
    if config.collection.route_reward:
        env = env.append_transform(RouteReward(config.collection.route_reward))
    if config.collection.path_reward:
        env = env.append_transform(PathReward(rovers, config.collection.path_reward))
    if config.collection.curriculum != "none":
        settings = config.collection
        share, temperature = settings.curriculum_share, settings.curriculum_temperature
        env = env.append_transform(Curriculum(rovers, share, temperature, estimates, per_batch))
    env = env.append_transform(RewardSum(["reward"], ["episode_reward"]))
    env = env.append_transform(GoalCounter())
    env = env.append_transform(StepCounter())
    longest = -(-env_config.length // action_repeat)
    env = env.append_transform(SpreadEnds(longest))
    for transform in memory_transforms(config.network.memory, config.network.memory_size):
        env = env.append_transform(transform)
    return env.append_transform(StepClock(rovers.simulator, worker, per_batch))


def _worker_env_config(config: TrainingConfig, worker: int, session: int) -> EnvConfig:
    """Returns the settings of one worker's environment."""
    env, rovers = config.env, config.rovers_per_worker
    backend = env.backend
    if backend in ("mujoco", "warp"):
        # The workers share the cores. Networks of this size need only one thread per worker.
        backend = find_settings(backend)(threads=_threads(config))
    return replace(
        env,
        num_envs=rovers,
        seed=config.seed + worker * rovers + session * SESSION_SEEDS,
        backend=backend,
        privileged=env.privileged or config.network.privileged_critic,
        # On the CPU, tensordicts without a device are faster.
        device=config.device if config.on_gpu else None,
    )


def _threads(config: TrainingConfig) -> int:
    """Returns the number of CPU threads of one worker."""
    return max(1, usable_cores() // config.workers)


class GoalCounter(Transform):
    """Adds ``episode_goals``: number of goals reached in the episode so far, int64 ``[N, 1]``.

    Append it after :class:`~rover_rl.envs.transforms.action_repeat.ActionRepeat`.
    """

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        goals = tensordict["episode_goals"] + next_tensordict["outcome", "goals"]
        return next_tensordict.set("episode_goals", goals)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset.set("episode_goals", torch.zeros_like(tensordict_reset["outcome", "goals"]))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Adds the spec of ``episode_goals``."""
        steps = observation_spec["outcome", "steps"]
        observation_spec["episode_goals"] = Unbounded(shape=steps.shape, dtype=torch.int64, device=steps.device)
        return observation_spec


class SpreadEnds(Transform):
    """Truncates the first episode of each row after a random number of decisions, and later ones after ``longest``.

    Equals TorchRL's ``RandomTruncationTransform``, to the last bit, without asking at resets whether a row is reset:
    the host would wait for a GPU. Append it after ``StepCounter``.

    Args:
        longest: largest number of decisions of an episode. The first lengths are drawn from 1 to ``longest``.
    """

    def __init__(self, longest: int) -> None:
        super().__init__()
        self._longest = longest
        self._lengths: Tensor | None = None

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        over = next_tensordict["step_count"] >= self._lengths
        for key in ("truncated", "done"):
            next_tensordict.set(key, next_tensordict[key] | over)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        done, mask = tensordict_reset["done"], tensordict.get("_reset", None)
        if self._lengths is None:
            self._lengths = torch.randint(1, self._longest + 1, done.shape, device=done.device)
        elif mask is not None:
            self._lengths = torch.where(mask, self._longest, self._lengths)
        return tensordict_reset
