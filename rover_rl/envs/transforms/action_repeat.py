"""``ActionRepeat``: transform that repeats each action for several steps."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import Transform

from rover_rl.envs.task import EVENTS
from rover_rl.envs.terminations import TOLD

_GOALS = ("outcome", "goals")


class ActionRepeat(Transform):
    """Repeats each action ``repeat`` times, so that the policy runs at 20 Hz divided by ``repeat``.

    A row whose episode ends during the repeat takes no further steps. (TorchRL's ``FrameSkipTransform`` continues to
    step ended rows, and returns only the ``done`` of the last step.) Rewards and their components are sums. A row is
    ``done`` if any step of the repeat ended its episode.

    ``outcome`` covers all steps of the repeat: the events of any step, the ``phase`` with the highest priority, and the
    sum of ``progress``. Its other entries are those of the last step. The transform adds ``("outcome", "goals")``, the
    number of goals reached, int64 ``[N, 1]``. Append transforms that count actions or sum rewards after this one.

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
        total, ends = self._step_entries(next_tensordict, active), _ends(next_tensordict)
        for _ in range(self.repeat - 1):
            active = active & ~next_tensordict.get("done")
            # On the CPU this check is cheap and may save steps. On an accelerator it would synchronize.
            if active.device.type == "cpu" and not active.any():
                break
            rows = active.reshape(tensordict.batch_size)
            # A component may compare its entries of two steps.
            current = tensordict.copy().update(next_tensordict)
            next_tensordict = _step_rows(self.parent, current.set("_step", rows))
            step = self._step_entries(next_tensordict, active)
            total = {key: _REDUCTIONS.get(key, torch.add)(value, step[key]) for key, value in total.items()}
            # A termination of one's own tells nothing of rows that it has ended before.
            ends = {key: ended | (next_tensordict.get(key) & active) for key, ended in ends.items()}
        # A copy, because the environment keeps a reference to the outcome that it returns.
        next_tensordict.set("outcome", next_tensordict.get("outcome").copy())
        for key, value in (total | ends).items():
            next_tensordict.set(key, value)
        return next_tensordict

    def _step_entries(self, step: TensorDictBase, active: Tensor) -> dict[NestedKey, Tensor]:
        """Returns the accumulated entries of a step. Rows that are not ``active`` (bool ``[N, 1]``) add nothing."""
        entries = {key: step.get(key) * active for key in (*self.parent.reward_keys, ("outcome", "progress"))}
        entries |= {("outcome", event): step.get(("outcome", event)) & active for event in EVENTS}
        entries["outcome", "phase"] = step.get(("outcome", "phase"))
        entries[_GOALS] = entries["outcome", "goal_reached"].long()
        return entries

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        outcome = tensordict_reset.get("outcome").copy()
        return tensordict_reset.set("outcome", outcome.set("goals", torch.zeros_like(outcome.get("steps"))))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        steps = observation_spec["outcome", "steps"]
        observation_spec[_GOALS] = Unbounded(shape=steps.shape, dtype=torch.int64, device=steps.device)
        return observation_spec


def _ends(step: TensorDictBase) -> dict[NestedKey, Tensor]:
    """Returns the entries of a step that terminations of one's own have written.

    The environment itself keeps the ends of the contract's.
    """
    told = step.get(TOLD, None)
    if told is None:
        return {}
    return {key: step.get(key) for key in ("done", "terminated", "truncated", *((TOLD, name) for name in told.keys()))}  # noqa: SIM118


def _step_rows(env: EnvBase, tensordict: TensorDictBase) -> TensorDictBase:
    """Steps the rows of ``_step``. A transform may return anything for the others."""
    if tensordict.get("_step").device.type == "cpu" or not isinstance(env, TransformedEnv):
        return env._step(tensordict)
    # TransformedEnv._step would read whether the step is for all rows, and make the host wait for the device.
    preset = tensordict.get("next", None)
    tensordict = env.transform.inv(tensordict)
    following = _step_rows(env.base_env, tensordict)
    if preset is not None:
        following.update(preset.exclude(*following.keys(True, True)))
    return env.transform._step(tensordict, following)


_REDUCTIONS = {("outcome", "phase"): torch.minimum, **{("outcome", event): torch.logical_or for event in EVENTS}}
"""Reductions of the accumulated entries over the steps of a repeat. All other entries are summed."""
