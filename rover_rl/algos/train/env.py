"""The environment as it is trained in: a step is a decision."""

from __future__ import annotations

from typing import Any

from torchrl.data import TensorSpec
from torchrl.envs import EnvBase, RandomTruncationTransform, RewardSum, StepCounter, Transform

from rover_rl.algos.config import TrainingConfig, usable_cores
from rover_rl.algos.policy.networks import FORWARD
from rover_rl.envs import make_env
from rover_rl.envs.randomization import Randomization
from rover_rl.envs.rover import assign_rows
from rover_rl.envs.specs import bounded_spec
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from rover_rl.envs.transforms.path_reward import PathReward
from rover_rl.envs.transforms.step_clock import StepClock
from rover_rl.sims.warp import WarpSettings
from rover_rl.sims.worlds import World

LIDAR_POINTS = 32
"""Readings that the policy sees, as the contract has it."""
EPISODE_SUMS = {"reward": "episode_reward", ("reward_components", "goal"): "episode_goal_reward"}
"""Rewards that are summed over an episode, and where the sums go."""
SESSION_SEEDS = 1_000_003
"""Between the seeds of a run and those of the same run resumed, which meets other starts and goals."""


def make_training_env(config: TrainingConfig, worker: int = 0, session: int = 0) -> EnvBase:
    """One worker's rovers, as the policy meets them: a step is a decision.

    The first episode of each row has a random length, so that the rows do not all start over together.

    Args:
        config: of the training.
        worker: which of ``config.processes`` this is.
        session: how often the run has been resumed.
    """
    env = make_env(
        world_n=config.worlds,
        length=config.episode_steps,
        lidar_points=LIDAR_POINTS,
        num_envs=config.rovers_each,
        randomization=Randomization.typical() if config.randomize else None,
        **_simulator(config),
        seed=config.seed + worker * config.rovers_each + session * SESSION_SEEDS,
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


def _simulator(config: TrainingConfig) -> dict[str, Any]:
    if config.backend == "warp":
        # The processes share the cores; torch has one thread in each, which is enough for small networks.
        settings = WarpSettings(threads=max(1, usable_cores() // config.processes))
        # Data on the CPU are quicker where no device is named.
        return {"backend": settings, "device": config.device if config.on_gpu else None}
    return {"physics": config.physics}


def rows_in_worlds(config: TrainingConfig) -> list[World]:
    """The world of each row of a batch: the rovers of every worker are in all worlds."""
    return assign_rows(config.worlds, config.rovers_each) * config.processes


class ForwardOnly(Transform):
    """Narrows the action spec to actions that do not drive backwards."""

    def transform_action_spec(self, action_spec: TensorSpec) -> TensorSpec:
        """Speeds from 0 on."""
        action_spec["action"] = bounded_spec(FORWARD, action_spec.shape, action_spec.device)
        return action_spec
