"""Attempts to reach a goal in training, counted so that their success rate is that of an evaluation."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.envs import Transform

from rover_rl.envs.task import StepEvent
from rover_rl.sims.settings import CONTROL_DT

TIME_LIMIT = 60.0  # time in which an attempt succeeds, as in an evaluation, s


class SpreadEnds(Transform):
    """Truncates the first episode of each row after a random number of decisions, and later ones after ``longest``.

    Equals TorchRL's ``RandomTruncationTransform``, to the last bit, without asking at resets whether a row is reset:
    the host would wait for a GPU. Append it after ``StepCounter``. ``lengths``, int64 ``[N, 1]``, are the numbers of
    decisions after which the current episodes are truncated.
    """

    lengths: Tensor

    def __init__(self, longest: int) -> None:
        super().__init__()
        self._longest, self._drawn = longest, False

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        over = next_tensordict["step_count"] >= self.lengths
        for key in ("truncated", "done"):
            next_tensordict.set(key, next_tensordict[key] | over)
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        done, mask = tensordict_reset["done"], tensordict.get("_reset", None)
        if not self._drawn:
            self.lengths = torch.randint(1, self._longest + 1, done.shape, device=done.device)
            self._drawn = True
        elif mask is not None:
            self.lengths = torch.where(mask, self._longest, self.lengths)
        return tensordict_reset


class AttemptEntries(Transform):
    """Base of transforms that add a nested entry of numbers, each int64 ``[N, 1]`` and 0 after a reset."""

    key: str
    entries: tuple[str, ...]

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        steps = tensordict_reset["outcome", "steps"]
        return self._with_entries(tensordict_reset, *(torch.zeros_like(steps) for _ in self.entries))

    def _with_entries(self, tensordict: TensorDictBase, *values: Tensor) -> TensorDictBase:
        for name, value in zip(self.entries, values, strict=True):
            tensordict.set((self.key, name), value)
        return tensordict

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        steps = observation_spec["outcome", "steps"]
        leaf = Unbounded(shape=steps.shape, dtype=torch.int64, device=steps.device)
        entries = {name: leaf.clone() for name in self.entries}
        observation_spec[self.key] = Composite(entries, shape=observation_spec.shape)
        return observation_spec


class AttemptCounter(AttemptEntries):
    """Counts the attempts to reach a goal that succeed and fail.

    An attempt lasts from the setting of a goal to its end: it succeeds if the goal is reached within 60 s, and fails if
    the episode ends before, as in an evaluation. Time limits of training would cut many off. So an attempt counts only
    if there is enough time when it begins: 60 s, or half of the longest episode if that is less. As this does not
    depend on how it ends, the rate is not biased, but a little too low where many goals take longer than the time that
    is left.

    It adds the nested entry ``attempts``, each int64 ``[N, 1]``: ``begun``, the number of steps of the episode before
    the current attempt, ``reached`` and ``failed``, the numbers of attempts that succeeded and failed in this step.

    Append it after :class:`~rover_rl.envs.transforms.action_repeat.ActionRepeat` and the transform that truncates.

    ``length`` is the number of steps of the longest episode, and ``dt`` the duration of a step, s.
    """

    key, entries = "attempts", ("begun", "reached", "failed")

    def __init__(self, ends: SpreadEnds, action_repeat: int, length: int, dt: float = CONTROL_DT) -> None:
        super().__init__()
        # In a list, because a module would register it as its own part.
        self._ends, self._action_repeat = [ends], action_repeat
        self._limit = round(TIME_LIMIT / dt)
        self._least = min(self._limit, length // 2)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        outcome, begun = next_tensordict["outcome"], tensordict[self.key, "begun"]
        steps, goals = outcome["steps"], outcome["goals"]
        in_time, counts = steps - begun <= self._limit, self._counts(begun)
        late = (goals > 0) & ~in_time & counts
        begun = torch.where(goals > 0, steps, begun)
        # With end_on_goal, a goal ends the episode, too.
        ended = next_tensordict["done"] & ~(next_tensordict["terminated"] & (outcome["phase"] >= StepEvent.GOAL))
        failed = late | (ended & self._counts(begun))
        return self._with_entries(next_tensordict, begun, goals * (in_time & counts), failed.long())

    def _counts(self, begun: Tensor) -> Tensor:
        """Returns which attempts that began after these numbers of steps of the episode count, bool ``[N, 1]``."""
        return self._ends[0].lengths * self._action_repeat - begun >= self._least
