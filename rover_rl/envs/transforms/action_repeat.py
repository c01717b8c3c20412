"""ActionRepeat: one decision for several steps of the simulator."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from rover_rl.envs.task import EVENTS

_GOALS = ("outcome", "goals")


class ActionRepeat(Transform):
    """Takes each action ``repeat`` times, so that a policy decides at 20 Hz divided by ``repeat``.

    A row whose episode ends within the repeat is held for the rest of it: its reward, and every reward
    component, is the sum over the steps that it took. (TorchRL's ``FrameSkipTransform`` steps ended rows on,
    and tells only of the last step's ``done``.)

    ``outcome`` tells of the decision as a whole: the events that happened in any of its steps, the ``phase``
    that comes first in the order of :class:`~rover_rl.envs.StepEvent`, and the sum of ``progress``; the rest is
    as after the last step. Added is ``goals``, the number of goals reached (int64 ``[N, 1]``).

    Transforms that count decisions or sum rewards over an episode come after this one.

    Args:
        repeat: steps of the simulator a decision.

    Raises:
        ValueError: for a ``repeat`` below 1.

    Example:
        >>> env = make_env(world_n="maze", num_envs=4, seed=0).append_transform(ActionRepeat(4))
        >>> env.rollout(3)["next", "outcome", "steps"][0].squeeze(-1)
        tensor([ 4,  8, 12])
    """

    def __init__(self, repeat: int) -> None:
        super().__init__()
        if repeat < 1:
            raise ValueError(f"repeat must be at least 1 step, got {repeat}")
        self.repeat = repeat

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        active = ones = torch.ones_like(next_tensordict.get("done"))
        if (given := tensordict.get("_step", None)) is not None:
            active = given.reshape(ones.shape)
        total = self._tally(next_tensordict, active)
        for _ in range(self.repeat - 1):
            active = active & ~next_tensordict.get("done")
            # On the host a look is cheap and may spare the rest; on an accelerator it would wait for the device.
            if active.device.type == "cpu" and not active.any():
                break
            rows = active.reshape(tensordict.batch_size)
            next_tensordict = self.parent._step(tensordict.copy().set("_step", rows))
            step = self._tally(next_tensordict, active)
            total = {key: _COMBINE.get(key, torch.add)(value, step[key]) for key, value in total.items()}
        # A copy, because the environment keeps the outcome that it hands out.
        next_tensordict.set("outcome", next_tensordict.get("outcome").copy())
        for key, value in total.items():
            next_tensordict.set(key, value)
        return next_tensordict

    def _tally(self, step: TensorDictBase, active: Tensor) -> dict[NestedKey, Tensor]:
        """What a step adds to the decision: nothing on rows that were not ``active`` (bool ``[N, 1]``)."""
        tally = {key: step.get(key) * active for key in (*self.parent.reward_keys, ("outcome", "progress"))}
        tally |= {("outcome", event): step.get(("outcome", event)) & active for event in EVENTS}
        tally["outcome", "phase"] = step.get(("outcome", "phase"))
        tally[_GOALS] = tally["outcome", "goal_reached"].long()
        return tally

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        outcome = tensordict_reset.get("outcome").copy()
        return tensordict_reset.set("outcome", outcome.set("goals", torch.zeros_like(outcome.get("steps"))))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Adds the number of goals to ``outcome``."""
        steps = observation_spec["outcome", "steps"]
        observation_spec[_GOALS] = Unbounded(shape=steps.shape, dtype=torch.int64, device=steps.device)
        return observation_spec


_COMBINE = {
    ("outcome", "phase"): torch.minimum,
    **{("outcome", event): torch.logical_or for event in EVENTS},
}
"""How the entries of a step join those of the steps before it; the others are summed."""
