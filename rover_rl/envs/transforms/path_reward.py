"""Shaping rewards, for training: for progress to the goal, and against going where the rover has been.

Those for progress, along the shortest free path or along the route on the seen map, are differences of potentials, so
that the optimal policy does not change (A. Y. Ng, D. Harada, S. Russell, "Policy invariance under reward
transformations", ICML 1999; here without the discount). Steps in which a goal is reached get no such reward. Append
them all after :class:`~rover_rl.envs.transforms.action_repeat.ActionRepeat`.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.sensors.suite import ROUTE, VISITS
from rover_rl.sims.free_space.goal_fields import GoalFields
from rover_rl.tensordicts import in_rows

PASSING, LONG = 1.0, 10.0
"""Time that passing a place takes, and the longest time beyond it that counts, s."""


class PathReward(Transform):
    """Adds ``weight`` per meter of progress along the shortest free path to ``reward``.

    The contract rewards progress in a straight line, which is zero in front of a wall, so that a rover learns to stop
    there. The reward uses the map of the world, the policy does not. The transform adds ``path_length``, the length of
    the remaining path for worlds and robot of ``env``, float32 ``[N, 1]``, m: the ``path_distance`` of the
    privileged observation, where there is one.
    """

    def __init__(self, env: RoverEnv, weight: float) -> None:
        super().__init__()
        self._fields = GoalFields(env.pool, env.robot_in)
        self._weight = weight

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        path_length = self._path_length(next_tensordict)
        progress = (tensordict["path_length"] - path_length).masked_fill(next_tensordict["outcome", "goals"] > 0, 0.0)
        next_tensordict.set("reward", next_tensordict["reward"] + self._weight * progress)
        return next_tensordict.set("path_length", path_length)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset.set("path_length", self._path_length(tensordict_reset))

    def _path_length(self, observation: TensorDictBase) -> Tensor:
        if (known := observation.get(("privileged", "path_distance"), None)) is not None:
            return known
        rows = in_rows(observation)
        self._fields.aim(world_of(rows).flatten(), goal_of(rows))
        return self._fields.along(rows["pose"][..., :2])[0].reshape(*observation.batch_size, 1)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        shape = (*observation_spec.shape, 1)
        observation_spec["path_length"] = Unbounded(shape=shape, device=observation_spec.device)
        return observation_spec


class RouteReward(Transform):
    """Adds ``weight`` per meter by which the route to the goal gets shorter to ``reward``.

    A rover that sees the end of a dead end loses at once what the way around costs. Unlike :class:`PathReward`, it
    needs no map of the world. The environment needs the sensor ``route``. Steps without a route get no reward.
    """

    def __init__(self, weight: float) -> None:
        super().__init__()
        self._weight = weight

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before, after = tensordict[ROUTE][..., 4:], next_tensordict[ROUTE][..., 4:]
        without = (next_tensordict["outcome", "goals"] > 0) | (torch.minimum(before, after) < 0)
        progress = (before - after).masked_fill(without, 0.0)
        return next_tensordict.set("reward", next_tensordict["reward"] + self._weight * progress)


class RevisitPenalty(Transform):
    """Takes ``weight`` per second from ``reward``, times the seconds that the rover has been here before.

    These are the times of the sensor :class:`~rover_rl.envs.sensors.visits.Visits`, which the environment needs, beyond
    the first second, and at most 10 s. Where a way to the goal may begin on either side of the rover, a policy learns
    to try both, and not to oscillate (novelty within an episode: A. P. Badia et al., "Never give up: learning directed
    exploration strategies", ICLR 2020).

    Args:
        weight: penalty, 1/s^2.
        seconds: duration of a step of the policy, s.
    """

    def __init__(self, weight: float, seconds: float) -> None:
        super().__init__()
        self._penalty = weight * seconds

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before = (next_tensordict[VISITS][..., :1] - PASSING).clamp(0.0, LONG)
        return next_tensordict.set("reward", next_tensordict["reward"] - self._penalty * before)


def world_of(observation: TensorDictBase) -> Tensor:
    """Returns the index of the world, int64 ``[..., 1]``: ``outcome["world"]``, or 0 if there is only one world."""
    world = observation.get(("outcome", "world"), None)
    return torch.zeros_like(observation["outcome", "steps"]) if world is None else world


def goal_of(observation: TensorDictBase) -> Tensor:
    """Computes the position of the goal in the world frame, ``[..., 2]``, m, from ``pose``, ``imu`` and ``target``."""
    distance, bearing = observation["target"].split(1, -1)
    direction = bearing + observation["imu"][..., 2:]
    return observation["pose"][..., :2] + distance * torch.cat((direction.cos(), direction.sin()), -1)
