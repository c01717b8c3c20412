"""``RoverParallelEnv``: a group of rovers as a ``ParallelEnv`` of PettingZoo."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from torchrl.envs import EnvBase

from rover_rl.envs.wrappers.numpy_batch import NumpyBatch, Observation, base_env, row_of

try:
    from pettingzoo import ParallelEnv
except ImportError as error:
    raise ImportError(
        "rover_rl.envs.wrappers.pettingzoo needs PettingZoo, an extra: pip install 'rover_rl[multiagent]'"
    ) from error


class RoverParallelEnv(ParallelEnv):
    """Wraps the rovers of one group, ``"rover_0"`` and so on, as a ``ParallelEnv`` of PettingZoo.

    Observations, actions, rewards and ``info`` of an agent are those of :class:`~rover_rl.GymWrapper`. A rover whose
    episode has ended leaves ``agents``, and stays where it is until the next reset, seen by the others.

    ``env`` is a ``RoverEnv`` with ``num_envs`` equal to ``agents``, or a ``TransformedEnv`` of one (``base_env``),
    and the options are those of :class:`~rover_rl.envs.wrappers.numpy_batch.NumpyBatch`. The default of ``time_limit``
    is ``"truncated"``.

    Example:
        >>> import rover_rl
        >>> env = RoverParallelEnv(rover_rl.RoverEnv(world_n="maze", backend="warp", num_envs=4, agents=4))
        >>> observations, infos = env.reset(seed=0)
        >>> observations, rewards, ended, cut, infos = env.step({agent: [1.0, 0.0] for agent in env.agents})
        >>> sorted(rewards)
        ['rover_0', 'rover_1', 'rover_2', 'rover_3']
    """

    def __init__(self, env: EnvBase, **options: Any) -> None:
        rovers, agents = base_env(env).num_envs, base_env(env).config.agents
        if rovers != agents:
            raise ValueError(f"RoverParallelEnv is for one group, got num_envs={rovers} and agents={agents}")
        options.setdefault("time_limit", "truncated")
        self._batch = NumpyBatch(env, **options)
        self.base_env, self.render_mode = self._batch.base_env, self._batch.render_mode
        self.metadata = {"name": "rover_rl", "render_modes": ["rgb_array"], "is_parallelizable": True}
        self.metadata["render_fps"] = self._batch.frames_per_second
        self.possible_agents = [f"rover_{number}" for number in range(agents)]
        self.agents: list[str] = []
        self._row_of = {agent: row for row, agent in enumerate(self.possible_agents)}

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        return self._batch.observation_space

    def action_space(self, agent: str) -> spaces.Space[Any]:
        return self._batch.action_space

    def reset(
        self, seed: int | None = None, options: Mapping[str, ArrayLike] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Begins the next episode, with a ``seed`` of the first rover, or ``None`` for the current one.

        Options are ``"start"`` ``[agents, 3]`` (x, y in m, yaw in rad) and ``"goal"`` ``[agents, 2]`` (m), both
        optional. Others have no effect.
        """
        places = {key: value for key, value in (options or {}).items() if key in ("start", "goal")}
        observation = self._batch.reset(seed=seed, options=places)
        self.agents = self.possible_agents[:]
        return self._of_agents(observation), {agent: {} for agent in self.agents}

    def step(
        self, actions: Mapping[str, ArrayLike]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        if missing := [agent for agent in self.agents if agent not in actions]:
            raise ValueError(f"each agent needs an action, {missing} have none")
        taken = np.zeros((len(self.possible_agents), *self._batch.action_space.shape), np.float32)
        drives = np.zeros(len(taken), np.bool_)
        for agent in self.agents:
            action = np.asarray(actions[agent], np.float32)
            if action.shape != taken.shape[1:]:
                raise ValueError(f"the action of {agent!r} must have shape {taken.shape[1:]}, got {action.shape}")
            taken[self._row_of[agent]], drives[self._row_of[agent]] = action, True
        if not self.agents:
            return {}, {}, {}, {}, {}
        step = self._batch.step(taken, drives)
        rows = {agent: self._row_of[agent] for agent in self.agents}
        infos = {agent: {key: value[row].item() for key, value in step.info.items()} for agent, row in rows.items()}
        rewards = {agent: float(step.reward[row]) for agent, row in rows.items()}
        terminated = {agent: bool(step.terminated[row]) for agent, row in rows.items()}
        truncated = {agent: bool(step.truncated[row]) for agent, row in rows.items()}
        result = self._of_agents(step.observation), rewards, terminated, truncated, infos
        self.agents = [agent for agent, row in rows.items() if not step.ended[row]]
        return result

    def render(self) -> NDArray[np.uint8] | None:
        """Returns an image of the first rover, uint8, if the render mode is ``"rgb_array"``, and ``None`` otherwise."""
        return self._batch.picture(0) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        self._batch.env.close()

    def _of_agents(self, observation: Observation) -> dict[str, Observation]:
        return {agent: row_of(observation, self._row_of[agent]) for agent in self.agents}
