"""Where decisions come from: the environment as it is trained in, and the collector that drives it."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import torch
from torchrl.collectors import BaseCollector, Collector
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase, RandomTruncationTransform, RewardSum, StepCounter, Transform
from torchrl.modules import ProbabilisticActor

from rover_rl.algos.action_repeat import ActionRepeat
from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.path_reward import PathReward
from rover_rl.algos.policy import FORWARD
from rover_rl.algos.step_clock import StepClock
from rover_rl.envs import make_env
from rover_rl.envs.specs import bounded_spec

LIDAR_POINTS = 32
"""Readings that the policy sees, as the contract has it."""
EPISODE_SUMS = {"reward": "episode_reward", ("reward_components", "goal"): "episode_goal_reward"}
"""Rewards that are summed over an episode, and where the sums go."""
_SESSION_SEEDS = 1_000_003
"""Between the seeds of a run and those of the same run resumed, which meets other starts and goals."""


def make_training_env(config: TrainingConfig, worker: int = 0, session: int = 0) -> EnvBase:
    """One worker's rovers, as the policy meets them: a step is a decision.

    The first episode of each row has a random length, so that the rows do not all start over together.

    Args:
        config: of the training.
        worker: which of ``config.workers`` this is.
        session: how often the run has been resumed.
    """
    rows = config.num_envs // config.workers
    env = make_env(
        world_n=config.world,
        length=config.episode_steps,
        lidar_points=LIDAR_POINTS,
        num_envs=rows,
        seed=config.seed + worker * rows + session * _SESSION_SEEDS,
    )
    if not config.reverse:
        env = env.append_transform(ForwardOnly())
    longest = -(-config.episode_steps // config.repeat)
    env = env.append_transform(ActionRepeat(config.repeat))
    if config.path_reward:
        env = env.append_transform(PathReward(env.base_env, config.path_reward))
    env = env.append_transform(RewardSum(list(EPISODE_SUMS), list(EPISODE_SUMS.values())))
    env = env.append_transform(StepCounter())
    env = env.append_transform(RandomTruncationTransform(min_horizon=1, max_horizon=longest))
    return env.append_transform(StepClock(env.base_env.simulator, worker))


class ForwardOnly(Transform):
    """Narrows the action spec to actions that do not drive backwards."""

    def transform_action_spec(self, action_spec: TensorSpec) -> TensorSpec:
        """Speeds from 0 on."""
        action_spec["action"] = bounded_spec(FORWARD, len(action_spec["action"].space.low), action_spec.device)
        return action_spec


@contextmanager
def collecting(
    config: TrainingConfig, actor: ProbabilisticActor, decisions: int, session: int = 0
) -> Iterator[BaseCollector]:
    """A collector of batches ``[num_envs, decisions]``, in this process or in several; closed in the end.

    Where the algorithm is ``asynchronous`` and there are several processes, each gives batches of its own rows
    alone, ``[num_envs / workers, decisions]``, and goes on while they are learned from.

    Args:
        config: of the training.
        actor: takes the actions; :meth:`BaseCollector.update_policy_weights_` tells other processes of its weights.
        decisions: of each rover in a batch.
        session: how often the run has been resumed.
    """
    frames = config.num_envs * decisions
    if config.workers == 1:
        collector = Collector(
            partial(make_training_env, config, session=session),
            actor,
            frames_per_batch=frames,
            track_traj_ids=False,
            auto_register_policy_transforms=False,
        )
    else:
        collector = Collector(
            [partial(_make_worker_env, config, worker, session) for worker in range(config.workers)],
            actor,
            num_collectors=config.workers,
            sync=not config.asynchronous,
            # An asynchronous collector's batch is one worker's, and there is nothing to put together.
            frames_per_batch=frames // config.workers if config.asynchronous else frames,
            cat_results=None if config.asynchronous else 0,
            use_buffers=True,
            num_threads=1,
            auto_register_policy_transforms=False,
        )
    try:
        yield collector
    finally:
        collector.shutdown()


def _make_worker_env(config: TrainingConfig, worker: int, session: int) -> EnvBase:
    """The same in a process of its own, which leaves Ctrl-C and SIGTERM to the process that trains."""
    if multiprocessing.parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        torch.manual_seed(config.seed + worker + session * _SESSION_SEEDS)
    return make_training_env(config, worker, session)
