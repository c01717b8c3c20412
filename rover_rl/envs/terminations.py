"""Terminations as TorchRL transforms: what ends an episode, beside the events of the contract.

The contract's endings (flipped, jammed, out of bounds, stuck) are those of :class:`~rover_rl.RoverEnv`, with the
thresholds of :class:`~rover_rl.TaskConfig`. Name others in ``make_env(terminate=...)`` or ``--terminate``.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec
from torchrl.envs.transforms import Transform

from rover_rl.checks import MAX_NUMBER, check_positive
from rover_rl.envs.parts import TERMINATIONS
from rover_rl.envs.task import StepEvent
from rover_rl.tensordicts import in_rows, unchecked_tensordict

TOLD = "terminations"
"""Entry of a step with a bool for each termination, by its name."""


class Termination(Transform):
    """Base class of terminations. Subclasses define ``name`` and :meth:`ends`.

    A step in which it holds is ``terminated``, and ``("terminations", name)``, bool ``[N, 1]``, tells so to rewards and
    tables. It is judged in each step of the simulator, before the rewards.

    Example:
        >>> class Tilted(Termination):
        ...     name = "tilted"
        ...
        ...     def ends(self, outcome, observation):
        ...         return observation["imu"][:, :2].abs().amax(-1, keepdim=True) > 0.3
    """

    name: str

    @abstractmethod
    def ends(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor:
        """Returns which rows end, bool ``[N, 1]``.

        It gets the ``outcome`` of the step (see :mod:`rover_rl.envs.task`) and, as ``observation``, the whole result of
        the step. Rows that took no step do not end, whatever it returns.
        """

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        rows = in_rows(next_tensordict)
        outcome = rows.get("outcome")
        ended, phase = self.ends(outcome, rows), outcome.get("phase")
        if not isinstance(ended, Tensor) or ended.dtype != torch.bool or ended.shape != phase.shape:
            got = f"{ended.dtype} {tuple(ended.shape)}" if isinstance(ended, Tensor) else type(ended).__name__
            raise ValueError(f"{type(self).__name__}.ends must return bool {tuple(phase.shape)}, got {got}")
        ended = ended & (phase != StepEvent.NONE)
        ended = ended if next_tensordict.batch_dims else ended[0]
        self._told(next_tensordict).set(self.name, ended)
        next_tensordict.set("truncated", next_tensordict.get("truncated") & ~ended)
        for key in ("terminated", "done"):
            next_tensordict.set(key, next_tensordict.get(key) | ended)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self._told(tensordict_reset).set(self.name, torch.zeros_like(tensordict_reset.get("done")))
        return tensordict_reset

    def _told(self, tensordict: TensorDictBase) -> TensorDictBase:
        told = tensordict.get(TOLD, None)
        if told is None:
            told = unchecked_tensordict({}, tensordict.batch_size, tensordict.device)
            tensordict.set(TOLD, told)
        return told

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        shape, device = observation_spec.shape, observation_spec.device
        told = observation_spec.get(TOLD, None)
        told = Composite(shape=shape, device=device) if told is None else told
        told[self.name] = Binary(n=1, shape=(*shape, 1), dtype=torch.bool, device=device)
        observation_spec[TOLD] = told
        return observation_spec


class NoProgress(Termination):
    """Ends an episode in which the rover has come no ``distance`` (m) nearer to its goal for ``seconds``.

    It ends episodes that stand in a corner or drive in circles, which a learner would otherwise sit out. The way around
    a wall may lead away from the goal for as long.
    """

    name, reads_observation = "no_progress", False

    def __init__(self, seconds: float = 20.0, distance: float = 0.2) -> None:
        super().__init__()
        check_positive(MAX_NUMBER, seconds=seconds, distance=distance)
        self._seconds, self._distance = seconds, distance
        # Way to the goal gained since the goal was set, the most of it that counted, m, and steps since then.
        self._gained: Tensor | None = None

    def ends(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor:
        progress, steps, phase = outcome.get("progress"), outcome.get("steps"), outcome.get("phase")
        if self._gained is None:
            self._gained = self._best = torch.zeros_like(progress)
            self._since = torch.zeros_like(steps)
            self._steps = round(self._seconds / self.parent.control_dt)
        moved, begins = phase != StepEvent.NONE, (steps <= 1) | outcome.get("goal_reached")
        gained = torch.where(moved, self._gained + progress, self._gained)
        nearer = gained > self._best + self._distance
        since = torch.where(moved, self._since + 1, self._since)
        self._gained = gained.masked_fill(begins, 0.0)
        self._best = torch.where(nearer, gained, self._best).masked_fill(begins, 0.0)
        self._since = since.masked_fill(begins | nearer, 0)
        return self._since >= self._steps


def terminations(given: Any) -> list[Transform]:
    """Creates terminations from names, ``"module:attribute"`` and :class:`Termination` objects and classes.

    A name may have settings, as in ``"no_progress(seconds=10)"``. Raises ``ValueError`` for anything else.

    Example:
        >>> [each.name for each in terminations("no_progress(seconds=10)")]
        ['no_progress']
    """
    several = given if isinstance(given, Sequence) and not isinstance(given, str) else (given,)
    made = [TERMINATIONS.make(each, Termination) for each in several]
    names = [getattr(part, "name", None) for part in made]
    if None in names or len({*names}) < len(names):
        raise ValueError(f"terminations must have names of their own, got {names}")
    # A transform belongs to one environment, and what was given may be for several.
    return [part.clone() for part in made]
