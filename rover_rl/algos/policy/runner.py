"""How a policy is run: the sensors that it reads, its memory, and the actions that it holds.

Example:
    >>> policy = Checkpoint.load("runs/ppo-moon").make_actor()
    >>> env = make_env(sensors_for(policy, EnvConfig(world="maze", num_envs=4)))
    >>> runner, observation = PolicyRunner(policy), env.reset()
    >>> for _ in range(20):
    ...     action = runner(observation)
    ...     observation = env.step(observation.set("action", action))["next"]
    ...     runner.reset(observation["done"].squeeze(-1))  # and reset the environment's rows
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.algos.policy.recurrent import state_keys
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.sensors.suite import MOVERS, OPTIONAL, ROUTE, SEEN_DISTANCES, with_sensors
from rover_rl.sims.settings import CONTROL_DT
from rover_rl.tensordicts import with_torch_defaults

Policy: TypeAlias = Callable[[TensorDictBase], TensorDictBase]
"""Function or module that adds ``"action"``, ``[N, 2]``, to observations ``[N]``.

Its ``in_keys``, as TorchRL's modules have them, state the sensors that it reads: see :func:`sensors_for`. A policy with
memory reads its state at some of them, and ``is_init``, and writes the next state at the same keys under ``"next"``.
Without a state, it starts a new one.

A policy that needs to know the environment has a method ``enter(env)``. A policy with a true ``row_by_row`` is called
only with the rows that decide."""

_REMEMBERED = (ROUTE, MOVERS, SEEN_DISTANCES)
"""Entries that change with each reading, as they are remembered: maps and tracks."""


def default_action_repeat(policy: Policy | None, given: int | None = None, dt: float = CONTROL_DT) -> int:
    """Returns the number of steps that each action of a policy is held for: the ``given`` one, or the default.

    A policy with a memory, a map or tracks, which change with each decision, decides as often as in training, others at
    each step. ``dt`` is the duration of a step, s.
    """
    if given is not None:
        return given
    if not (state_keys(policy) or {*_REMEMBERED} & {*_entries(policy)}):
        return 1
    trained_dt = getattr(getattr(policy, "made_for", None), "control_dt", CONTROL_DT)
    return max(1, round(getattr(policy, "trained_action_repeat", 1) * trained_dt / dt))


def sensors_for(policy: Policy | None, env: EnvConfig, action_repeat: int | None = None) -> EnvConfig:
    """Returns a description of an environment with the sensors that a policy reads.

    Those that it does not have are added to its ``sensors``. Maps and tracks change once for a decision, which
    ``action_repeat`` tells as in :func:`default_action_repeat`.

    Example:
        >>> sensors_for(make_baseline("gridplanner"), EnvConfig(world="maze")).sensors
        ('route(period=4)',)
    """
    return with_sensors(env, _entries(policy), default_action_repeat(policy, action_repeat, env.control_dt))


def _entries(policy: Policy | None) -> list[str]:
    return [key for key in getattr(policy, "in_keys", ()) if isinstance(key, str)]


class PolicyRunner:
    """Calls a policy when rows are due for a decision, and holds its actions and its memory in between.

    Args:
        action_repeat: number of steps that each action is held for; ``None``: see :func:`default_action_repeat`.
        min_rows: smallest number of rows that the policy is called with. Copies of the last row fill them up. Matrix
            products of few rows round differently.
        env (rover_rl.RoverEnv | None): environment that the policy drives in, which it enters if it needs to know it.

    Attributes:
        state: memory of a policy that has one, each ``[N, ...]``, by key; empty before the first decision.
        distribution: center and standard deviation, ``[N, k]`` each, of the normal distribution behind the last
            decision, before squashing. ``None`` before the first one, and for a policy without such a distribution.

    Raises:
        ValueError: at the first call, if the observation lacks sensors that the policy reads.
    """

    @with_torch_defaults
    def __init__(
        self, policy: Policy, action_repeat: int | None = None, min_rows: int = 1, env: RoverEnv | None = None
    ) -> None:
        if env is not None and hasattr(policy, "enter"):
            policy.enter(env)
        self.action_repeat = default_action_repeat(policy, action_repeat, CONTROL_DT if env is None else env.control_dt)
        self.policy, self._min_rows, self._keys = policy, min_rows, state_keys(policy)
        self.reset()

    def reset(self, rows: Tensor | None = None) -> None:
        """Starts new episodes in ``rows``, bool ``[N]``, or in all, whose number may change. The next call decides."""
        if rows is None:
            self.state: dict[str, Tensor] = {}
            self.distribution: tuple[Tensor, Tensor] | None = None
            self._action: Tensor | None = None
        elif self._action is not None:
            self._is_init |= rows.to(self._is_init.device)

    @with_torch_defaults
    def __call__(self, observation: TensorDictBase, due: Tensor | None = None, rows: Tensor | None = None) -> Tensor:
        """Returns the action of each row, ``[N, 2]``, for an observation ``[N]``, which is not changed.

        ``due`` are the rows that decide, bool ``[N]``; ``None``: those whose action has been held for ``action_repeat``
        steps. Rows whose episode begins always decide. Of these, only ``rows``, bool ``[N]``, need an action.
        """
        if self._action is None:
            lacking = [key for key in _entries(self.policy) if key in OPTIONAL and observation.get(key, None) is None]
            if lacking:
                raise ValueError(f"the policy reads {lacking}: make the environment with sensors_for(policy, config)")
            # Rows whose episode begins, and number of steps that each row's action has been held for.
            self._is_init = torch.ones(len(observation), dtype=torch.bool, device=observation.device)
            self._held = torch.zeros_like(self._is_init, dtype=torch.int64)
        due = self._is_init | (self._held >= self.action_repeat if due is None else due.to(self._held.device))
        due = due if rows is None else due & rows.to(due.device)
        # On the CPU, the check is cheap and saves the call. On an accelerator it would synchronize.
        if self._action is None or self.action_repeat == 1 or due.device.type != "cpu" or due.any():
            action, state = self._decide(observation, due)
            self._action = action if self._action is None else _where(due, action, self._action)
            self.state = {key: _where(due, value, self.state.get(key, value)) for key, value in state.items()}
        self._held = torch.where(due, 0, self._held) + 1
        self._is_init = self._is_init & ~due
        return self._action

    def _decide(self, observation: TensorDictBase, due: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Calls the policy and returns the actions and the next state of all rows. Rows that are ``due`` matter."""
        rows, inputs = len(observation), observation.copy()
        if self._keys:
            inputs.update(self.state).set("is_init", self._is_init[:, None])
        if getattr(self.policy, "row_by_row", False):
            outputs = self.policy(inputs[due])
            state = {key: _scattered(outputs["next", key], due) for key in self._keys}
            return _scattered(outputs["action"], due), state
        if rows < self._min_rows:
            inputs = inputs[torch.arange(self._min_rows, device=observation.device).clamp(max=rows - 1)]
        outputs = self.policy(inputs)
        if "loc" in getattr(self.policy, "out_keys", ()) and outputs["scale"].shape[-1]:
            self.distribution = outputs["loc"][:rows], outputs["scale"][:rows]
        return outputs["action"][:rows], {key: outputs["next", key][:rows] for key in self._keys}


def _where(rows: Tensor, value: Tensor, other: Tensor) -> Tensor:
    return torch.where(rows.reshape(-1, *[1] * (value.ndim - 1)), value, other)


def _scattered(values: Tensor, rows: Tensor) -> Tensor:
    all_rows = values.new_zeros(len(rows), *values.shape[1:])
    all_rows[rows] = values
    return all_rows
