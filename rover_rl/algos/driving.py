"""The loop in which a policy drives an environment. Evaluation, suites, films, the viewer and live rovers watch it.

Example:
    >>> from itertools import islice
    >>> env = make_env(world_n="maze", num_envs=4)
    >>> for step in islice(drives(env, policy=None), 20):
    ...     for row, ending in step.endings().items():
    ...         print(f"rover {row}: {ending}")
    >>> env.close()
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.policy.baselines import RandomPolicy
from rover_rl.algos.policy.runner import Policy, PolicyRunner
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.task import StepEvent
from rover_rl.envs.terminations import TOLD

ENDINGS = {
    StepEvent.INVALID_ACTION: "invalid action",
    StepEvent.FLIP: "flipped",
    StepEvent.JAM: "jammed",
    StepEvent.OUT_OF_BOUNDS: "out of bounds",
    StepEvent.STUCK: "stuck",
    StepEvent.GOAL: "goal",
}
"""Endings of an episode before its time limit, by the event of its last step."""
TIME_LIMIT = "time limit"  #: Ending of an episode at its time limit.
TOO_NEAR = "obstacle too near"  #: Ending of a live drive: an obstacle is closer than the required clearance.
CONTACT = "contact"  #: Ending of a run of a benchmark: the body touches an obstacle.
STOPPED = "stopped"  #: Ending of a live drive: a person interrupted it, or the connection to the rover was lost.
RESTARTED = "robot restarted"  #: Ending of a live drive: the rover's clock went backwards, or its pose jumped.
REPLACED = "replaced"  #: Ending of a drive in a bag of others: another goal came before its own was reached.
_STEPS = "flipped", "jammed", "out of bounds", "stuck", "invalid action"
EARLY_ENDINGS = (*_STEPS, TOO_NEAR, RESTARTED, STOPPED, REPLACED)
"""Endings of an episode before its time limit, other than at its goal."""


class Step(NamedTuple):
    """Where rovers are after a step, or where their episodes begin: the ``observation`` of all, ``[N]``.

    ``rows`` are the rovers that have moved, or whose episodes begin, and ``ended`` those whose episode has ended in
    this step, bool ``[N]``, on the CPU. ``transition`` is what ``env.step()`` has returned; ``None`` where episodes
    begin.
    """

    observation: TensorDictBase
    rows: Tensor
    ended: Tensor
    transition: TensorDictBase | None = None

    def endings(self) -> dict[int, str]:
        rows = self.ended.nonzero().squeeze(-1).tolist()
        return {row: ending_of(self.observation[row]) for row in rows}


def ending_of(observation: TensorDictBase) -> str:
    """Ending of an episode by the observation of one rover, ``[]`` or ``[1]``, after its last step.

    Those of one's own are called as the termination, without ``_``.
    """
    if not observation["terminated"]:
        return TIME_LIMIT
    if (ending := ENDINGS.get(StepEvent(int(observation["outcome", "phase"])))) is not None:
        return ending
    return next(name.replace("_", " ") for name, ended in observation[TOLD].items() if ended)


def rovers_in(env: EnvBase) -> RoverEnv:
    """Returns the :class:`RoverEnv` inside of an environment. Raises ``ValueError`` if there is no batched one."""
    inner: Any = env
    while not isinstance(inner, RoverEnv):
        inner = getattr(inner, "base_env", None)
        if inner is None:
            raise ValueError(f"the environment must be a RoverEnv or make_env(...), got {type(env).__name__}")
    if not inner.batch_size:
        raise ValueError("the environment must be a batch: create it with num_envs=1, not None")
    return inner


class Drive:
    """A policy in an environment, step by step: :func:`drives` is its loop, and the viewer calls it by hand.

    ``env`` is a :class:`~rover_rl.RoverEnv` or :func:`~rover_rl.make_env`, with ``num_envs``. ``policy`` is a policy or
    its runner; ``None`` acts at random. For ``action_repeat`` and ``min_rows`` see
    :class:`~rover_rl.algos.policy.runner.PolicyRunner`. ``observation`` is the last one, ``[N]``.
    """

    observation: TensorDictBase

    def __init__(
        self, env: EnvBase, policy: Policy | PolicyRunner | None, action_repeat: int | None = None, min_rows: int = 1
    ) -> None:
        self.env, self.rovers = env, rovers_in(env)
        if not isinstance(policy, PolicyRunner):
            policy = PolicyRunner(policy or RandomPolicy(), action_repeat, min_rows, self.rovers)
        self.runner = policy

    @torch.no_grad()
    def begin(self, rows: Tensor | None = None, **places: Tensor) -> Step:
        """Begins episodes in ``rows``, bool ``[N]``, or in all, at a ``start`` and ``goal`` if they are given."""
        given = None if rows is None else self.observation.copy().set("_reset", rows[:, None])
        self.observation = self.env.reset(given, **places)
        self.runner.reset(rows)
        every = torch.ones(self.rovers.num_envs, dtype=torch.bool)
        return Step(self.observation, every if rows is None else rows, torch.zeros_like(every))

    @torch.no_grad()
    def decide(self, due: Tensor | None = None, exploring: bool = False, rows: Tensor | None = None) -> Tensor:
        """Returns the actions of the policy, ``[N, A]``: the best ones, or random ones for ``exploring``.

        ``due`` are the rows that decide, and ``rows`` those that drive: see
        :class:`~rover_rl.algos.policy.runner.PolicyRunner`.
        """
        way = ExplorationType.RANDOM if exploring else ExplorationType.DETERMINISTIC
        with set_exploration_type(way):
            return self.runner(self.observation, due, rows)

    @torch.no_grad()
    def step(self, action: Tensor, rows: Tensor | None = None) -> Step:
        """Takes a step in ``rows``, bool ``[N]``, or in all."""
        given = self.observation.set("action", action)
        transition = self.env.step(given if rows is None else given.set("_step", rows))
        self.observation = transition["next"]
        ended = self.observation["done"].squeeze(-1).to("cpu")
        moved = torch.ones_like(ended) if rows is None else rows.clone()
        return Step(self.observation, moved, moved & ended, transition)


class Schedule:
    """Which rovers drive, and where their episodes begin: all of them, again and again, as the environment draws.

    ``driving`` are the rovers that drive, bool ``[N]``; ``None``: all. ``episode`` is the number of the episode that
    each drives, int64 ``[N]``; ``None``: not counted.
    """

    driving: Tensor | None = None
    episode: Tensor | None = None

    def places(self) -> dict[str, Tensor]:
        """Arguments of ``env.reset()`` for all rovers."""
        return {}

    def restart(self, ended: Tensor) -> Tensor:
        """Takes note of rovers whose episode has ended, bool ``[N]``. Returns those that begin another one."""
        return ended


def drives(
    env: EnvBase,
    policy: Policy | PolicyRunner | None,
    schedule: Schedule | None = None,
    *,
    action_repeat: int | None = None,
    min_rows: int = 1,
) -> Iterator[Step]:
    """Lets a policy drive, and yields each step, and each beginning of episodes before it.

    A step is yielded before the episodes that ended in it are replaced by others. With a ``schedule``, the policy reads
    the number of the ``episode``; without, the environment draws episodes without end. See also :class:`Drive`.
    """
    drive, schedule = Drive(env, policy, action_repeat, min_rows), schedule or Schedule()
    yield drive.begin(**schedule.places())
    while schedule.driving is None or schedule.driving.any():
        if schedule.episode is not None:
            drive.observation.set("episode", schedule.episode[:, None])
        step = drive.step(drive.decide(rows=schedule.driving), schedule.driving)
        yield step
        restarting = schedule.restart(step.ended)
        if restarting.any():
            yield drive.begin(restarting, **schedule.places())
