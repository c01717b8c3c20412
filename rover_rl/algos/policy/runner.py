"""Runner of a policy: carries its memory from decision to decision, and holds its actions in between.

Example:
    >>> runner = PolicyRunner(Checkpoint.load("runs/ppo-moon").make_actor())
    >>> env = make_env(world_n="maze", num_envs=4)
    >>> observation = env.reset()
    >>> for _ in range(20):
    ...     action = runner(observation)
    ...     observation = env.step(observation.set("action", action))["next"]
    ...     runner.reset(observation["done"].squeeze(-1))  # and reset the environment's rows
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.algos.policy.recurrent import state_keys
from rover_rl.envs.config import SCAN_POSE, EnvConfig, LidarConfig
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.seen_map.seen_map import NO_BOUNDS, SEEN_DISTANCES, SEEN_FRAME, SeenMap
from rover_rl.envs.sensors.lidar_mask import LidarViews
from rover_rl.envs.sensors.movers import SeenMovers
from rover_rl.envs.sensors.scan_pose import scan_pose_now
from rover_rl.envs.sensors.seen_tracks import SeenTracks
from rover_rl.envs.sensors.suite import LIDAR_MASK, MOVERS, ROUTE, WALLS
from rover_rl.envs.sensors.walls import SeenWalls
from rover_rl.robots import get_robot
from rover_rl.sims.settings import CONTROL_DT
from rover_rl.torch_defaults import with_torch_defaults

Policy: TypeAlias = Callable[[TensorDictBase], TensorDictBase]
"""Function or module that adds ``"action"``, ``[N, 2]``, to observations ``[N]``.

A policy with memory is a module with ``in_keys`` and ``out_keys``, as TorchRL's: it reads its state at some keys, and
``is_init``, and writes the next state at the same keys under ``"next"``. Without a state, it starts a new one.

A policy that needs to know the environment has a method ``enter(env)``. A policy with a true ``row_by_row`` is called
only with the rows that decide."""


_TRACKS: dict[str, type[SeenTracks]] = {MOVERS: SeenMovers, WALLS: SeenWalls}
"""What is followed in the scans for the policies that read it."""


def default_action_repeat(policy: Policy | None, given: int | None = None, dt: float = CONTROL_DT) -> int:
    """Returns the number of steps that each action of a policy is held for: the ``given`` one, or the default.

    A policy with a memory, a map or tracks, which change with each decision, decides as often as in training, others at
    each step. ``dt`` is the duration of a step, s, which may be another one than in training.
    """
    if given is not None:
        return given
    if not (state_keys(policy) or any(_reads(policy, key) for key in (*_TRACKS, ROUTE))):
        return 1
    trained_dt = getattr(getattr(policy, "made_for", None), "control_dt", CONTROL_DT)
    return max(1, round(getattr(policy, "trained_action_repeat", 1) * trained_dt / dt))


def reads_route(policy: object) -> bool:
    """Returns whether a policy reads the route on the map of what has been seen, ``"route"``."""
    return _reads(policy, ROUTE)


def _reads(policy: object, key: str) -> bool:
    return key in getattr(policy, "in_keys", ())


class PolicyRunner:
    """Runs a policy on a batch of rows.

    The runner calls the policy when a row is due for a decision, and holds its actions in between. It carries the
    memory of a policy from decision to decision, row by row. Policies without memory pass through.

    It adds to the observation what a policy reads and the environment does not have: of the sensors ``route``,
    ``movers`` and ``walls``, for which it keeps the maps of what the rovers have seen and the tracks of what moves;
    ``seen_distances`` and ``seen_frame``, the distances on these maps; ``scan_pose``, which tells that the scan is as
    new as the pose, if scans are never late; and ``lidar_mask``, that of the robot's lidar.

    Args:
        action_repeat: number of steps that each action is held for; ``None``: see :func:`default_action_repeat`.
        min_rows: smallest number of rows that the policy is called with. Copies of the last row fill them up. Matrix
            products of few rows round differently.
        env (rover_rl.RoverEnv | None): environment that the policy drives in, for the bounds that routes stay in;
            ``None``: none.
    """

    @with_torch_defaults
    def __init__(
        self, policy: Policy, action_repeat: int | None = None, min_rows: int = 1, env: RoverEnv | None = None
    ) -> None:
        self._env = env
        if env is not None and hasattr(policy, "enter"):
            policy.enter(env)
        self._dt = CONTROL_DT if env is None else env.control_dt
        self.action_repeat = default_action_repeat(policy, action_repeat, self._dt)
        self.policy, self._min_rows, self._keys = policy, min_rows, state_keys(policy)
        self._seen: SeenMap | None = None
        self._tracks: dict[str, SeenTracks] = {}
        self._views: LidarViews | None = None
        self._route: Tensor | None = None
        self._distribution: tuple[Tensor, Tensor] | None = None
        self._tracked: Tensor | None = None
        # Rows whose episode begins, and number of steps that each row's action has been held for.
        self._is_init, self._held = torch.ones(0, dtype=torch.bool), torch.zeros(0, dtype=torch.int64)
        self.reset()

    def reset(self, rows: Tensor | None = None) -> None:
        """Starts new episodes in ``rows``, bool ``[N]``, or in all, whose number may change. The next call decides."""
        if rows is None:
            self._state: dict[str, Tensor] = {}
            self._tracks = {}
            self._seen = self._views = self._route = self._distribution = self._tracked = None
            self._action: Tensor | None = None
        elif self._action is not None:
            self._is_init |= rows.to(self._is_init.device)

    @property
    def state(self) -> dict[str, Tensor]:
        """Memory of a policy that has one, each ``[N, ...]``, by key; empty before the first decision."""
        return dict(self._state)

    @property
    def distribution(self) -> tuple[Tensor, Tensor] | None:
        """Center and standard deviation, ``[N, k]`` each, of the normal distribution behind the last decision.

        It is before squashing. ``None`` before the first decision, and for a policy without a distribution.
        """
        return self._distribution

    @property
    def seen_map(self) -> tuple[SeenMap, Tensor] | None:
        """Maps that the runner keeps for the policy, and the last routes on them, ``[N, 5]``; ``None`` if none."""
        return None if self._seen is None or self._route is None else (self._seen, self._route)

    @property
    def tracked(self) -> Tensor | None:
        """Values of :class:`~rover_rl.envs.sensors.movers.Movers` that the policy has read last; ``None`` if none."""
        return self._tracked

    @with_torch_defaults
    def __call__(self, observation: TensorDictBase, due: Tensor | None = None) -> Tensor:
        """Returns the action of each row, ``[N, 2]``, for an observation ``[N]``, which is not changed.

        ``due`` are the rows that decide, bool ``[N]``; ``None``: those whose last action has been held for
        ``action_repeat`` steps. Rows whose episode begins always decide.
        """
        if self._action is None:
            return self._start(observation)
        due = self._is_init | (self._held >= self.action_repeat if due is None else due.to(self._held.device))
        # On the CPU, the check is cheap and saves the call. On an accelerator it would synchronize.
        if self.action_repeat == 1 or due.device.type != "cpu" or due.any():
            action, state = self._decide(observation, due)
            self._action = torch.where(due[:, None], action, self._action)
            self._state = {key: _where(due, value, self._state[key]) for key, value in state.items()}
        self._held = torch.where(due, 0, self._held) + 1
        self._is_init = self._is_init & ~due
        return self._action

    def _start(self, observation: TensorDictBase) -> Tensor:
        """Takes the first decision of all rows."""
        self._is_init = torch.ones(len(observation), dtype=torch.bool, device=observation.device)
        for key, seen in _TRACKS.items():
            if _reads(self.policy, key) and observation.get(key, None) is None:
                self._tracks[key] = seen(*self._rig(observation))
        reads_map = _reads(self.policy, SEEN_DISTANCES)
        if reads_map or (reads_route(self.policy) and observation.get(ROUTE, None) is None):
            rows, lidar, robot, device, interval = self._rig(observation)
            self._seen = SeenMap(rows, lidar, robot, device, interval=interval, keep_passed=reads_map)
        if _reads(self.policy, LIDAR_MASK) and observation.get(LIDAR_MASK, None) is None:
            self._views = LidarViews(*self._rig(observation)[:4])
        self._action, self._state = self._decide(observation, self._is_init)
        self._held = torch.ones(len(observation), dtype=torch.int64, device=self._action.device)
        self._is_init = torch.zeros_like(self._held, dtype=torch.bool)
        return self._action

    def _rig(self, observation: TensorDictBase) -> tuple[int, LidarConfig, Any, torch.device, float]:
        """Returns what maps and tracks are made for: rows, lidar, robot, device, and time between scans, s."""
        rows, points = observation["lidar"].shape
        config = self._env.config if self._env is not None else getattr(self.policy, "made_for", None)
        config = config or EnvConfig(lidar=LidarConfig(points=points))
        interval = self.action_repeat * self._dt
        several = self._env is not None and self._env.robots.are_several
        robot: Any = self._env.fleet if self._env is not None and several else get_robot(config.robot)
        return rows, config.lidar, robot, observation["lidar"].device, interval

    def _decide(self, observation: TensorDictBase, due: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """Calls the policy and returns the actions and the next state of all rows. Rows that are ``due`` matter."""
        rows, inputs = len(observation), observation.copy()
        if self._views is not None:
            inputs[LIDAR_MASK] = self._views()
        for key, seen in self._tracks.items():
            inputs[key] = seen(observation, due, self._is_init)
        if _reads(self.policy, MOVERS):
            self._tracked = inputs[MOVERS]
        if self._seen is not None:
            self._route = inputs[ROUTE] = self._seen(inputs, due, self._is_init, self._bounds(observation))
            if _reads(self.policy, SEEN_DISTANCES):
                inputs[SEEN_DISTANCES], inputs[SEEN_FRAME] = self._seen.distances(inputs, self._bounds(observation))
        if _reads(self.policy, SCAN_POSE) and observation.get(SCAN_POSE, None) is None:
            inputs[SCAN_POSE] = scan_pose_now(observation["imu"])
        if self._keys:
            inputs.update(self._state).set("is_init", self._is_init[:, None])
        if getattr(self.policy, "row_by_row", False):
            outputs = self.policy(inputs[due])
            state = {key: _scattered(outputs["next", key], due) for key in self._keys}
            return _scattered(outputs["action"], due), state
        if rows < self._min_rows:
            inputs = inputs[torch.arange(self._min_rows, device=observation.device).clamp(max=rows - 1)]
        outputs = self.policy(inputs)
        if "loc" in getattr(self.policy, "out_keys", ()):
            self._distribution = outputs["loc"][:rows], outputs["scale"][:rows]
        return outputs["action"][:rows], {key: outputs["next", key][:rows] for key in self._keys}

    def _bounds(self, observation: TensorDictBase) -> Tensor:
        """Returns the area that routes stay in, ``[N, 4]``, m."""
        if self._env is not None:
            return self._env.placement.bounds
        lidar = observation["lidar"]
        return lidar.new_tensor(NO_BOUNDS).expand(len(lidar), 4)


def _where(rows: Tensor, value: Tensor, other: Tensor) -> Tensor:
    return torch.where(rows.reshape(-1, *[1] * (value.ndim - 1)), value, other)


def _scattered(values: Tensor, rows: Tensor) -> Tensor:
    """Returns ``values`` in the selected rows, bool ``[N]``, and 0 in the others."""
    all_rows = values.new_zeros(len(rows), *values.shape[1:])
    all_rows[rows] = values
    return all_rows
