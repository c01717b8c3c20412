"""Fine-tuning: training that starts from a trained policy, in another world, with another reward, or for longer.

Example:
    >>> config = fine_tuning_config("pretrained:moon-ppo", world="maze", max_minutes=5)
    >>> config.run.started_from, config.algorithm.minibatch, config.env.world
    ('pretrained:moon-ppo', 256, 'maze')
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from rover_rl.algos.config import UNLIMITED_STEPS, PPOConfig, RunConfig, TrainingConfig, with_settings
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.names import PRETRAINED, load_policy
from rover_rl.envs.config import require_match
from rover_rl.worlds.pool import draws_worlds

MINUTES = 2.0  # default duration of fine-tuning, minutes
_RATE = 0.5  # default learning rate, as a fraction of that of the policy's training
# Default fraction of the training in which only the critic learns. Checkpoints hold no critic: a new one begins.
_WARMUP = 0.15
_ROVERS = 128  # default for the largest number of rovers: few of them give many updates in a short time
_ALPHA = 0.01  # default weight of the entropy in SAC at the start, about that at the end of a training


def fine_tuning_config(source: str | Path, **settings: Any) -> TrainingConfig:
    """Settings of a training that starts from a policy: those of the policy's training, and defaults for a short one.

    The learning rate is lower, the time limit is two minutes unless ``total_steps`` is given, nothing is imitated
    again, and only worlds that are drawn from a range have a curriculum. In the first part of the training, only the
    critic learns.

    ``source`` is ``pretrained:NAME``, the folder of a run, or a checkpoint file. Settings are fields of the parts of
    :class:`~rover_rl.algos.config.TrainingConfig`, for example ``world``, ``reward`` or ``max_minutes``; robot, lidar,
    bounds of the action and networks must stay those of the policy. Raises a ``FileNotFoundError`` if there is no such
    policy, and a ``ValueError`` if the file holds none, or for an unknown setting.
    """
    source = str(source)
    config = load_policy(source).config
    run = RunConfig(
        total_steps=UNLIMITED_STEPS,
        max_minutes=None if "total_steps" in settings else MINUTES,
        started_from=source if source.startswith(PRETRAINED) else str(Path(source).resolve()),
    )
    rovers = min(config.num_envs, max(config.env.agents, _ROVERS - _ROVERS % config.env.agents))
    # Collector, workers and device are those of the machine that the policy was trained on.
    defaults: dict[str, Any] = {"num_envs": rovers, "collector": "auto", "workers": None, "device": None}
    defaults |= {"learning_rate": _RATE * config.algorithm.learning_rate, "critic_warmup": _WARMUP}
    if isinstance(config.algorithm, PPOConfig):
        # As many gradient steps in an update as with all rovers.
        defaults["minibatch"] = max(1, config.algorithm.minibatch * rovers // config.num_envs)
        defaults["imitation"] = 0.0
    else:
        defaults["alpha"] = _ALPHA
    if not draws_worlds(settings.get("world", config.env.world)):
        defaults["curriculum"] = "none"
    return with_settings(replace(config, run=run), **defaults | settings)


def load_source(config: TrainingConfig) -> Checkpoint | None:
    if config.run.started_from is None:
        return None
    source = load_policy(config.run.started_from)
    require_match(source.env, config.env)
    for name, had in vars(source.config.network).items():
        # Checkpoints hold no critic.
        if name != "privileged_critic" and had != (given := getattr(config.network, name)):
            raise ValueError(
                f"{name}={had!r} of the policy {config.run.started_from} cannot change in fine-tuning, got {given!r}"
            )
    return source
