"""PathReward: a lead around obstacles, for training."""

from __future__ import annotations

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs.transforms import Transform

from rover_rl.algos.guide import Guides
from rover_rl.envs import RoverEnv
from rover_rl.envs.rows import in_rows


class PathReward(Transform):
    """Adds ``weight`` times the metres gained on the shortest free way to the goal to ``reward``.

    The contract pays for what is gained as the crow flies, which before a wall is nothing: a rover that learns from
    that alone waits there. This reward is a difference of potentials, so that the best policy stays the same (Ng,
    Harada, Russell: Policy invariance under reward transformations, ICML 1999; here without the discount). It knows
    the world's map, which the policy does not need to.

    It comes after :class:`~rover_rl.algos.action_repeat.ActionRepeat`. Decisions in which a goal is reached get
    nothing. Added is ``path_length``, the way that is left, float32 ``[N, 1]``, m: see
    :meth:`~rover_rl.algos.guide.Guide.path_length`.

    Args:
        env: whose rovers drive.
        weight: for each metre.
    """

    def __init__(self, env: RoverEnv, weight: float) -> None:
        super().__init__()
        self._guides = Guides(env.worlds, env.robot, env.device)
        self._weight = weight

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        now = self._path_length(next_tensordict)
        gained = (tensordict["path_length"] - now).masked_fill(next_tensordict["outcome", "goals"] > 0, 0.0)
        next_tensordict.set("reward", next_tensordict["reward"] + self._weight * gained)
        return next_tensordict.set("path_length", now)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset.set("path_length", self._path_length(tensordict_reset))

    def _path_length(self, observation: TensorDictBase) -> Tensor:
        return self._guides.path_length(in_rows(observation)).reshape(*observation.batch_size, 1)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Adds ``path_length``."""
        shape = (*observation_spec.shape, 1)
        observation_spec["path_length"] = Unbounded(shape=shape, device=observation_spec.device)
        return observation_spec
