"""``ActionRepeat``: transform that repeats each action for several steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import Compose, EnvBase, TransformedEnv
from torchrl.envs.transforms import Transform

from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.specs import UNOBSERVED
from rover_rl.envs.task import EVENTS
from rover_rl.envs.terminations import TOLD
from rover_rl.tensordicts import unchecked_tensordict

_GOALS, _GOAL = ("outcome", "goals"), EVENTS.index("goal_reached")


class ActionRepeat(Transform):
    """Repeats each action ``repeat`` times, so that the policy runs at 20 Hz divided by ``repeat``.

    A row whose episode ends during the repeat takes no further steps. (TorchRL's ``FrameSkipTransform`` continues to
    step ended rows, and returns only the ``done`` of the last step.) Rewards and their components are sums. A row is
    ``done`` if any step of the repeat ended its episode.

    ``outcome`` covers all steps of the repeat: the events of any step, the ``phase`` with the highest priority, and the
    sum of ``progress``. Its other entries are those of the last step. The transform adds ``("outcome", "goals")``, the
    number of goals reached, int64 ``[N, 1]``. Append transforms that count actions or sum rewards after this one.

    The observation, with its scan, is made after the last step alone, unless something reads it in between: a sensor
    with a memory or another period than actions have, delays, or a transform before this one that does not say
    ``reads_observation = False``.

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

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        env, transforms = self._before()
        is_read = any(getattr(transform, "reads_observation", True) for transform in transforms)
        if isinstance(env, RoverEnv) and not (is_read or env.reads_between(self.repeat)):
            tensordict.set(UNOBSERVED, torch.ones(tensordict.batch_size, dtype=torch.bool, device=tensordict.device))
        return tensordict

    def _before(self) -> tuple[EnvBase, list[Transform]]:
        """Returns the environment without transforms, and its transforms before this one."""
        env: Any = self.container
        transforms: list[Transform] = []
        while isinstance(env, TransformedEnv):
            env, transforms = env.base_env, [*_leaves(env.transform), *transforms]
        return env, transforms[: transforms.index(self)]

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        active = ones = torch.ones_like(next_tensordict.get("done"))
        if (given := tensordict.get("_step", None)) is not None:
            active = given.reshape(ones.shape)
        keys: list[NestedKey] = [*self.parent.reward_keys, ("outcome", "progress")]
        total, ends = _taken(next_tensordict, keys, active), _ends(next_tensordict)
        for _ in range(self.repeat - 1):
            active = active & ~next_tensordict.get("done")
            # On the CPU this check is cheap and may save steps. On an accelerator it would synchronize.
            if active.device.type == "cpu" and not active.any():
                break
            rows = active.reshape(tensordict.batch_size)
            # A component may compare its entries of two steps.
            current = {**dict(tensordict.items()), **dict(next_tensordict.items()), "_step": rows}
            current = unchecked_tensordict(current, tensordict.batch_size, tensordict.device)
            next_tensordict = self._step_before(current)
            step = _taken(next_tensordict, keys, active)
            total = [add(*values) for add, *values in zip(_ADDITIONS, total, step, strict=True)]
            # A termination of one's own tells nothing of rows that it has ended before.
            ends = {key: ended | (next_tensordict.get(key) & active) for key, ended in ends.items()}
        if UNOBSERVED in tensordict.keys():  # noqa: SIM118
            next_tensordict.update(self._before()[0].observe())
        sums, events, phase, goals = total
        *rewards, progress = sums.split(1, -1)
        # A copy, because the environment keeps a reference to the outcome that it returns.
        outcome = dict(next_tensordict.get("outcome").items()) | {"phase": phase, "progress": progress, "goals": goals}
        outcome |= dict(zip(EVENTS, events.split(1, -1), strict=True))
        entries = dict(zip(keys[:-1], rewards, strict=True)) | ends
        entries["outcome"] = unchecked_tensordict(outcome, tensordict.batch_size, tensordict.device)
        for key, value in entries.items():
            next_tensordict.set(key, value)
        return next_tensordict

    def _step_before(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Takes a step. TransformedEnv would read whether it is for all rows, and wait for the device."""
        env, transforms = self._before()
        preset = tensordict.get("next", None)
        for transform in reversed(transforms):
            tensordict = transform._inv_call(tensordict)
        following = env._step(tensordict)
        if preset is not None:
            # What a policy writes for the next step, such as its memory.
            following.update(preset.exclude(*following.keys(True, True)))
        for transform in transforms:
            following = transform._step(tensordict, following)
        return following

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        outcome = tensordict_reset.get("outcome").copy()
        return tensordict_reset.set("outcome", outcome.set("goals", torch.zeros_like(outcome.get("steps"))))

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        steps = observation_spec["outcome", "steps"]
        observation_spec[_GOALS] = Unbounded(shape=steps.shape, dtype=torch.int64, device=steps.device)
        return observation_spec


def _taken(step: TensorDictBase, keys: Sequence[NestedKey], active: Tensor) -> list[Tensor]:
    """Returns what a step adds in its ``active`` rows: to the ``keys``, to events, phase and goals."""
    sums = torch.cat([step.get(key) for key in keys], -1) * active
    outcome = step.get("outcome")
    events = torch.cat([outcome.get(event) for event in EVENTS], -1) & active
    return [sums, events, outcome.get("phase"), events[..., _GOAL : _GOAL + 1].long()]


def _ends(step: TensorDictBase) -> dict[NestedKey, Tensor]:
    """Returns the entries of a step that terminations of one's own have written.

    The environment itself keeps the ends of the contract's.
    """
    names = step.get(TOLD, {}).keys()
    keys = ("done", "terminated", "truncated", *((TOLD, name) for name in names)) if names else ()
    return {key: step.get(key) for key in keys}


def _leaves(transform: Transform) -> list[Transform]:
    return [leaf for one in transform for leaf in _leaves(one)] if isinstance(transform, Compose) else [transform]


_ADDITIONS: tuple[Callable[..., Tensor], ...] = (torch.add, torch.logical_or, torch.minimum, torch.add)
"""How what two steps add is added, in the order of :func:`_taken`."""
