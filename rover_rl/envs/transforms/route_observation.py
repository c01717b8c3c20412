"""``RouteObservation``: transform that adds the route to the goal on the map of what the lidar has seen."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs.transforms import Transform

from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.rows import in_rows
from rover_rl.envs.seen_map.seen_map import ROUTE, SeenMap
from rover_rl.envs.sensors.route import Route
from rover_rl.envs.specs import bounded_spec


class RouteObservation(Transform):
    """Adds ``route`` to the observation: float32 ``[N, 5]``, see :class:`~rover_rl.envs.seen_map.seen_map.SeenMap`.

    The route is the shortest one around the obstacles that the rover has seen in this episode, within the bounds of the
    world. Unlike :class:`~rover_rl.envs.transforms.path_reward.PathReward`, it uses the lidar, the pose and the IMU
    only, so that a policy may read it wherever it drives.

    Append it after :class:`~rover_rl.envs.transforms.action_repeat.ActionRepeat`, so that the map is updated with each
    decision.

    Args:
        env (rover_rl.RoverEnv): environment whose lidar and robot are used.
        threads: number of CPU threads. Results do not depend on it.
        action_repeat: number of steps from one decision to the next.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> env = RoverEnv(world_n="maze", num_envs=4, seed=0)
        >>> env = TransformedEnv(env, RouteObservation(env))
        >>> env.rollout(3)["route"].shape
        torch.Size([4, 3, 5])
    """

    def __init__(self, env: RoverEnv, threads: int = 1, action_repeat: int = 1) -> None:
        super().__init__()
        self._env = env
        interval = action_repeat * env.control_dt
        self._seen = SeenMap(env.num_envs, env.config.lidar, env.robot, env.device, threads, interval)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set(ROUTE, self._route(next_tensordict))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get("_reset", None)
        rows = torch.ones_like(tensordict_reset["done"]) if mask is None else mask
        return tensordict_reset.set(ROUTE, self._route(tensordict_reset, rows.reshape(-1)))

    def _route(self, observation: TensorDictBase, renewed: Tensor | None = None) -> Tensor:
        """Returns the routes. If ``renewed`` is given, only these rows have changed, and their episodes begin."""
        route = self._seen(in_rows(observation), renewed, renewed, self._env.placement.bounds)
        return route.reshape(*observation.batch_size, route.shape[-1])

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Adds ``route``."""
        observation_spec[ROUTE] = bounded_spec(Route().bounds, observation_spec.shape, observation_spec.device)
        return observation_spec
