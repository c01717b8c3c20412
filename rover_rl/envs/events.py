"""Events: what happens to rovers in an episode, beside the ranges of :class:`~rover_rl.Randomization`.

An event is a stage of one's own: it begins with the episode, may change each command before the simulator follows it,
and each reading after a step. Name it in ``make_env(events=...)`` or ``--events``.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any
from zlib import crc32

import torch
from torch import Tensor

from rover_rl.checks import MAX_NUMBER, check_at_least, check_positive
from rover_rl.envs.parts import EVENTS
from rover_rl.envs.stages import Stage, StepState
from rover_rl.rng import random_bits, to_unit


class Event(Stage):
    """Base class of events. Subclasses override methods of :class:`~rover_rl.envs.stages.Stage`: begin, command, read.

    Random numbers come from :meth:`uniform`, so that an episode is the same in any batch.

    Example:
        >>> class WeakLeftSide(Event):
        ...     '''The rover pulls to the left, by up to 0.3 rad/s, another amount in each episode.'''
        ...
        ...     def begin(self, mask, keys):
        ...         self.pull = 0.3 * self.uniform(keys)
        ...
        ...     def command(self, command, state):
        ...         return command + torch.cat((torch.zeros_like(self.pull), self.pull), -1)
    """

    number = 0
    """How many events of its class the environment has before it."""

    def uniform(self, keys: Tensor, steps: Tensor | int = 0, count: int = 1) -> Tensor:
        """Returns random numbers in [0, 1), ``[N, count]``, of episodes with these ``keys``, for a number of ``steps``.

        In a step, ``keys`` and ``steps`` are those of the state. Each class draws its own numbers, and so does each of
        several events of one class.
        """
        return to_unit(random_bits(keys, crc32(f"{type(self).__qualname__}{self.number or ''}".encode()), steps, count))


class PowerDips(Event):
    """The motors lose power for a moment: commands become 0 for ``seconds``, ``rate`` times a second on average."""

    def __init__(self, rate: float = 0.1, seconds: float = 0.3) -> None:
        check_at_least(0, MAX_NUMBER, rate=rate)
        check_positive(MAX_NUMBER, seconds=seconds)
        self._rate, self._seconds = rate, seconds
        self._until: Tensor | None = None

    def begin(self, mask: Tensor, keys: Tensor) -> None:
        self._until = torch.zeros_like(keys) if self._until is None else self._until.masked_fill(mask, 0)

    def command(self, command: Tensor, state: StepState) -> Tensor:
        dt = state.truth.rover.dt
        assert self._until is not None
        dips = self.uniform(state.keys, state.steps) < self._rate * dt
        until = torch.where(dips, state.steps + (self._seconds / dt).round().long(), self._until)
        self._until = until if state.active is None else torch.where(state.active, until, self._until)
        return command.masked_fill(state.steps < until, 0.0)


def events(given: Any) -> list[Event]:
    """Creates events from names, ``"module:attribute"`` and :class:`Event` objects and classes.

    A name may have settings, as in ``"power_dips(rate=0.2)"``. Raises ``ValueError`` for anything else.
    """
    several = given if isinstance(given, Sequence) and not isinstance(given, str) else (given,)
    # An object that is given may be for several environments.
    made = [copy(EVENTS.make(each, Event)) for each in several]
    for index, event in enumerate(made):
        event.number = sum(type(before) is type(event) for before in made[:index])
    return made


class Events(Stage):
    """Stage of all events of an environment, in their order: checks what they make of commands.

    Raises ``ValueError`` if an event returns something else than commands of the same shape, or on the CPU numbers that
    are not finite.
    """

    def __init__(self, given: Any) -> None:
        self._events = events(given)

    def begin(self, mask: Tensor, keys: Tensor) -> None:
        for event in self._events:
            event.begin(mask, keys)

    def command(self, command: Tensor, state: StepState) -> Tensor:
        for event in self._events:
            changed = event.command(command, state)
            shape = getattr(changed, "shape", None)
            if shape != command.shape or (changed.device.type == "cpu" and not changed.isfinite().all()):
                told = f"finite numbers of shape {tuple(command.shape)}"
                got = type(changed).__name__ if shape is None else f"shape {tuple(shape)}, or NaN or infinity"
                raise ValueError(f"{type(event).__name__}.command must return {told}, got {got}")
            command = changed
        return command

    def read(self, state: StepState) -> None:
        for event in self._events:
            event.read(state)
