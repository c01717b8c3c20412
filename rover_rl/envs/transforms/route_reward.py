"""``RouteReward``: shaping reward for progress along the route on the map of what the lidar has seen, for training."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.envs.transforms import Transform

from rover_rl.envs.seen_map.seen_map import ROUTE


class RouteReward(Transform):
    """Adds ``weight`` per meter by which the route to the goal gets shorter to ``reward``.

    The reward is a difference of potentials of what the rover has seen, so that the optimal policy does not change
    (A. Y. Ng, D. Harada, S. Russell, "Policy invariance under reward transformations", ICML 1999; here without the
    discount). A rover that sees the end of a dead end loses at once what the way around costs. Unlike
    :class:`~rover_rl.envs.transforms.path_reward.PathReward`, it needs no map of the world and no shortest paths on it,
    which take longer to compute than the physics if episodes are in many worlds.

    Append it after :class:`~rover_rl.envs.transforms.route_observation.RouteObservation`. Steps in which a goal is
    reached, and those without a route, get no reward.

    Args:
        weight: reward per meter.
    """

    def __init__(self, weight: float) -> None:
        super().__init__()
        self._weight = weight

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before, after = tensordict[ROUTE][..., 4:], next_tensordict[ROUTE][..., 4:]
        without = (next_tensordict["outcome", "goals"] > 0) | (torch.minimum(before, after) < 0)
        progress = (before - after).masked_fill(without, 0.0)
        return next_tensordict.set("reward", next_tensordict["reward"] + self._weight * progress)
