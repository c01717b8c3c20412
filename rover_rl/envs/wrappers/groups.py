"""``GroupedRovers``: groups of rovers as a multi-agent environment of TorchRL."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Composite, TensorSpec
from torchrl.envs import EnvBase

from rover_rl.envs.specs import done_spec
from rover_rl.envs.wrappers.numpy_batch import base_env

_ENDS = ("done", "terminated", "truncated")


class GroupedRovers(EnvBase):
    """Shows groups of rovers as TorchRL's multi-agent environments do, such as ``VmasEnv`` and ``PettingZooEnv``.

    The batch size is ``[G]``, the number of groups. What belongs to rovers is under ``"rovers"``, ``[G, agents, ...]``:
    the entries of the observation, ``action``, ``reward``, ``outcome``, the ends of its episode, and ``mask``: whether
    it drives in the step to come. A rover whose episode has ended stays where it is, with a reward of 0, until the
    group's has ended, and the group begins one together. ``done``, ``terminated`` and ``truncated`` of a group
    ``[G, 1]`` are true once all of its rovers are done, all terminated, or some truncated, or with ``done_on_any``,
    once one is. ``group_map`` is that of TorchRL: ``{"rovers": ["rover_0", ...]}``.

    ``env`` is a ``RoverEnv`` with a batch, or a ``TransformedEnv`` of one (``base_env``). ``reset(start=...,
    goal=...)`` sets start poses ``[G, agents, 3]`` and goals ``[G, agents, 2]``.

    Example:
        >>> import rover_rl
        >>> env = GroupedRovers(rover_rl.make_env(world="maze", backend="warp", num_envs=8, agents=4, seed=0))
        >>> env.rollout(3)["rovers", "lidar"].shape
        torch.Size([2, 3, 4, 32])
    """

    batch_locked = True

    def __init__(self, env: EnvBase, done_on_any: bool = False) -> None:
        rovers = base_env(env)
        if not env.batch_size:
            raise ValueError("GroupedRovers needs a batch of rovers, got num_envs=None; give num_envs")
        self.agents = rovers.config.agents
        groups = rovers.num_envs // self.agents
        super().__init__(device=env.device, batch_size=(groups,))
        self.env, self.base_env = env, rovers
        self.group_map = {"rovers": [f"rover_{number}" for number in range(self.agents)]}
        self._done_on_any = done_on_any
        self._root: TensorDictBase | None = None
        self._ended = torch.zeros(groups, self.agents, dtype=torch.bool, device=rovers.goal.device)
        self._make_specs()

    def _make_specs(self) -> None:
        shape, device = (*self.batch_size, self.agents), self.device
        observation = self._grouped_spec(self.env.observation_spec)
        observation["mask"] = Binary(n=self.agents, shape=shape, dtype=torch.bool, device=device)
        self.observation_spec = self._under_rovers(observation)
        self.action_spec = self._under_rovers(self._grouped_spec(self.env.full_action_spec))
        self.reward_spec = self._under_rovers(self._grouped_spec(self.env.full_reward_spec))
        ends = done_spec(self.batch_size, device)
        ends["rovers"] = self._grouped_spec(self.env.full_done_spec)
        self.full_done_spec = ends

    def _grouped_spec(self, spec: TensorSpec) -> Any:
        return spec.unflatten(0, (*self.batch_size, self.agents))

    def _under_rovers(self, spec: TensorSpec) -> Composite:
        return Composite(rovers=spec, shape=self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        self.env.set_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **places: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        begins = torch.ones_like(self._ended[:, :1]) if mask is None else mask.reshape(-1, 1)
        given = {key: places[key].flatten(0, 1) for key in ("start", "goal") if places.get(key) is not None}
        root = None if self._root is None else self._root.set("_reset", begins.expand_as(self._ended).reshape(-1, 1))
        self._root = self.env.reset(root, **given)
        self._ended = self._ended & ~begins
        return self._pack(self._root)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self._root is None:
            raise RuntimeError("step() needs a running episode; call reset() first")
        drives = ~self._ended
        if (active := tensordict.get("_step", None)) is not None:
            drives = drives & active.reshape(-1, 1)
        self._root.set("action", tensordict.get(("rovers", "action")).flatten(0, 1))
        self._root.set("_step", drives.reshape(-1, 1))
        result = self.env.step(self._root)
        result.pop("_step", None)
        self._root = self.env.step_mdp(result)
        after = result.get("next")
        self._ended = self._ended | (after.get("done").reshape_as(drives) & drives)
        return self._pack(after)

    def _pack(self, rows: TensorDictBase) -> TensorDictBase:
        keys = {*self.env.observation_spec.keys(), *self.env.full_reward_spec.keys(), *_ENDS} & {*rows.keys()}
        rovers = rows.select(*keys).unflatten(0, (*self.batch_size, self.agents))
        rovers.set("mask", ~self._ended)
        whole = torch.any if self._done_on_any else torch.all
        done, terminated = whole(rovers.get("done"), 1), whole(rovers.get("terminated"), 1)
        ends = {"done": done, "terminated": terminated, "truncated": done & ~terminated}
        return TensorDict({"rovers": rovers, **ends}, self.batch_size, device=self.device)

    def close(self, *, raise_if_closed: bool = False) -> None:
        self.env.close(raise_if_closed=raise_if_closed)
        super().close(raise_if_closed=raise_if_closed)
