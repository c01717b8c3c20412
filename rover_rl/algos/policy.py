"""The networks: what the policy sees, how it acts, and what it expects to earn."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

from rover_rl.envs.specs import ACTION, bounded_spec

ACTION_SPEC = bounded_spec(ACTION, 1, None)[0]
"""Of one rover, ``[2]``."""
OBSERVATION_KEYS = ("lidar", "imu", "target", "velocities")
"""What networks read. The pose is left out: a policy that knows where it is learns the map, not to drive."""


class ObservationEncoder(nn.Module):
    """Scales observations for this task, to about [-1, 1] where it matters: ``[..., lidar_points + 8]``.

    Learning depends on it: scaled by the bounds of the observation space, distances of a few metres become so
    small that a policy hardly sees them.
    """

    EXTRA = 8
    """Features beside the lidar's."""

    def forward(self, lidar: Tensor, imu: Tensor, target: Tensor, velocities: Tensor) -> Tensor:
        """Features ``[..., lidar_points + 8]``, from entries of the observation (in m, rad, m/s and rad/s).

        Args:
            lidar: ``[..., lidar_points]``.
            imu: pitch, roll and yaw, ``[..., 3]``; the yaw is left out, as the pose is.
            target: distance and angle, ``[..., 2]``.
            velocities: forward speed and yaw rate, ``[..., 2]``.
        """
        distance, angle = target.split(1, -1)
        speed, yaw_rate = velocities.split(1, -1)
        features = (
            lidar.log1p() / 1.3 - 1,
            distance / 5 - 1,
            distance.log1p() - 1,
            angle.sin(),
            angle.cos(),
            imu[..., :2],
            speed,
            yaw_rate / 3,
        )
        return torch.cat(features, -1)


class EncodedNetwork(nn.Module):
    """The encoder, then ``body``: called with the entries that :data:`OBSERVATION_KEYS` names."""

    def __init__(self, body: nn.Module) -> None:
        super().__init__()
        self.encoder = ObservationEncoder()
        self.body = body

    def forward(self, *observation: Tensor) -> Tensor | tuple[Tensor, ...]:
        """What ``body`` makes of the encoded observation."""
        return self.body(self.encoder(*observation))


def make_actor(
    lidar_points: int, hidden: tuple[int, ...] = (128, 128), action_spec: Bounded = ACTION_SPEC
) -> ProbabilisticActor:
    """A stochastic policy: a normal distribution squashed to the action's bounds, with a spread of its own.

    Args:
        lidar_points: readings in ``lidar``.
        hidden: units of each hidden layer.
        action_spec: of one rover, ``[2]``.

    Returns:
        A module from observation to ``action [..., 2]`` and ``action_log_prob [...]``. It takes the middle of
        the distribution, unless ``set_exploration_type(ExplorationType.RANDOM)`` holds, as in collectors.

    Example:
        >>> env = RoverEnv(world_n="maze", num_envs=2, seed=0)
        >>> actor = make_actor(env.lidar.points)
        >>> actor(env.reset())["action"].shape
        torch.Size([2, 2])
    """
    actions = action_spec.shape[-1]
    # Small last weights: the first actions lie around the middle of their bounds, whatever is seen.
    body = _mlp(lidar_points, hidden, actions, gain=0.01)
    network = EncodedNetwork(nn.Sequential(body, AddStateIndependentNormalScale(actions)))
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=list(OBSERVATION_KEYS), out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=action_spec,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": action_spec.space.low, "high": action_spec.space.high},
        return_log_prob=True,
    )


def make_critic(lidar_points: int, hidden: tuple[int, ...] = (128, 128)) -> ValueOperator:
    """A value function: a module from observation to ``state_value [..., 1]``.

    Args:
        lidar_points: readings in ``lidar``.
        hidden: units of each hidden layer.
    """
    network = EncodedNetwork(_mlp(lidar_points, hidden, 1, gain=1.0))
    return ValueOperator(network, in_keys=list(OBSERVATION_KEYS))


def _mlp(lidar_points: int, hidden: tuple[int, ...], outputs: int, gain: float) -> MLP:
    """Fully connected layers with tanh between them and orthogonal weights, the last one's of ``gain``."""
    features = lidar_points + ObservationEncoder.EXTRA
    mlp = MLP(in_features=features, out_features=outputs, num_cells=list(hidden), activation_class=nn.Tanh)
    linear = [layer for layer in mlp if isinstance(layer, nn.Linear)]
    for layer in linear:
        nn.init.orthogonal_(layer.weight, gain if layer is linear[-1] else math.sqrt(2))
        nn.init.zeros_(layer.bias)
    return mlp


@contextmanager
def single_threaded() -> Iterator[None]:
    """Lets torch use one thread: networks this small gain nothing from more.

    Where other programs use the same cores, two threads that wait for each other can be fifty times slower.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
