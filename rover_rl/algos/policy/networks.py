"""The networks: what the policy sees, how it acts, and what it expects to earn."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

from rover_rl.envs.specs import ACTION, Bounds, bounded_spec

FORWARD = Bounds(low=(0.0, ACTION.low[1]), high=ACTION.high)
"""Actions that do not drive backwards."""
DEFAULT_KEYS = ("lidar", "imu", "target", "velocities")
"""What networks read. The pose is left out: a policy that knows where it is learns the map, not to drive."""
WAVELENGTHS = (64.0, 16.0, 4.0)
"""Lengths in metres over which the features of a position repeat: the largest world is 64 m wide."""


def action_spec(reverse: bool = True, device: torch.device | str | None = None) -> Bounded:
    """Actions of one rover, ``[2]``: the contract's, or those of them that do not drive backwards."""
    return bounded_spec(ACTION if reverse else FORWARD, (), device)


def middle_and_half(spec: Bounded) -> tuple[Tensor, Tensor]:
    """The middle between an action's bounds, and half of what lies between them."""
    low, high = spec.space.low, spec.space.high
    return (high + low) / 2, (high - low) / 2


class ObservationEncoder(nn.Module):
    """Scales observations for this task, to about [-1, 1] where it matters.

    Learning depends on it: scaled by the bounds of the observation space, distances of a few metres become so
    small that a policy hardly sees them. The scales are constants, so that a policy needs no running statistics
    to be used elsewhere. They are those of a driver: the logarithm of lidar ranges, since centimetres count
    when near and not when far, sine and cosine of angles, and tilts in units of some 20 degrees.

    Args:
        keys: entries of the observation to read, some of ``lidar``, ``imu``, ``target``, ``velocities``, ``pose``.
        lidar_points: readings in ``lidar``.
        north_up: whether lidar and target are also seen as on a map: turned by the yaw, so that they stay as they are
            when the rover turns on the spot. Needs ``lidar``, ``imu`` and ``target``.

    Attributes:
        features: how many numbers the encoding has.

    Raises:
        ValueError: for ``north_up`` without what it needs.

    Example:
        >>> encoder = ObservationEncoder(("lidar", "target"))
        >>> encoder(torch.full((1, 32), 12.0), torch.tensor([[5.0, 0.0]])).shape
        torch.Size([1, 37])
    """

    def __init__(self, keys: Sequence[str] = DEFAULT_KEYS, lidar_points: int = 32, north_up: bool = False) -> None:
        super().__init__()
        self.keys = tuple(keys)
        if north_up and not {"lidar", "imu", "target"} <= set(keys):
            raise ValueError(f"north_up needs lidar, imu and target, got {self.keys}")
        self._north_up, self._sees_yaw = north_up, north_up or "pose" in keys
        sizes = {"lidar": lidar_points, "imu": 4 if self._sees_yaw else 2, "target": 5, "velocities": 2}
        sizes["pose"] = 4 * len(WAVELENGTHS) + 1
        self.features = sum(sizes[key] for key in self.keys) + (lidar_points + 4 if north_up else 0)

    def forward(self, *observation: Tensor) -> Tensor:
        """Features ``[..., features]`` from the entries that ``keys`` names, in its order (m, rad, m/s, rad/s)."""
        entries = dict(zip(self.keys, observation, strict=True))
        parts = [getattr(self, f"_{key}")(value) for key, value in entries.items()]
        if self._north_up:
            parts.append(self._as_on_a_map(entries["lidar"], entries["imu"][..., 2:], entries["target"]))
        return torch.cat(parts, -1)

    def _as_on_a_map(self, ranges: Tensor, yaw: Tensor, target: Tensor) -> Tensor:
        points = ranges.shape[-1]
        turned = (torch.arange(points, device=yaw.device) - yaw * (points / (2 * math.pi))) % points
        before = turned.floor()
        index = before.long() % points
        near, far = ranges.gather(-1, index), ranges.gather(-1, (index + 1) % points)
        ranges = torch.lerp(near, far, turned - before)
        distance, angle = target.split(1, -1)
        direction = torch.cat(((angle + yaw).sin(), (angle + yaw).cos()), -1)
        return torch.cat((self._lidar(ranges), direction, direction * distance / 4), -1)

    def _lidar(self, ranges: Tensor) -> Tensor:
        return ranges.log1p() / 1.3 - 1

    def _imu(self, angles: Tensor) -> Tensor:
        """Pitch and roll; the yaw says something only to a policy that knows the map."""
        tilt, yaw = angles[..., :2] * 3, angles[..., 2:]
        return torch.cat((tilt, yaw.sin(), yaw.cos()), -1) if self._sees_yaw else tilt

    def _target(self, target: Tensor) -> Tensor:
        distance, angle = target.split(1, -1)
        return torch.cat((distance / 5 - 1, distance.log1p() - 1, angle.sin(), angle.cos(), angle / math.pi), -1)

    def _velocities(self, velocities: Tensor) -> Tensor:
        speed, yaw_rate = velocities.split(1, -1)
        return torch.cat((speed, yaw_rate / 3), -1)

    def _pose(self, position: Tensor) -> Tensor:
        wave_numbers = 2 * math.pi / position.new_tensor(WAVELENGTHS)
        phase = (position[..., :2, None] * wave_numbers).flatten(-2)
        return torch.cat((phase.sin(), phase.cos(), position[..., 2:]), -1)


class EncodedNetwork(nn.Module):
    """The encoder, then ``body``; what comes after the observation goes to ``body`` as it is.

    Args:
        encoder: of the observation.
        body: takes the encoding, and whatever else.
    """

    def __init__(self, encoder: ObservationEncoder, body: nn.Module) -> None:
        super().__init__()
        self.encoder = encoder
        self.body = body

    def forward(self, *entries: Tensor) -> Tensor | tuple[Tensor, ...]:
        """What ``body`` makes of the encoded observation and of the rest."""
        count = len(self.encoder.keys)
        encoded = self.encoder(*entries[:count])
        return self.body(torch.cat((encoded, *entries[count:]), -1))


def make_actor(
    encoder: ObservationEncoder | None = None,
    hidden: Sequence[int] = (128, 128),
    reverse: bool = True,
    spread: float = 2.0,
    device: torch.device | str | None = None,
) -> ProbabilisticActor:
    """A stochastic policy, the same for PPO and SAC: a normal distribution squashed to the action's bounds.

    Args:
        encoder: of the observation; ``None``: one of the default entries.
        hidden: units of each hidden layer.
        reverse: whether it may drive backwards.
        spread: largest standard deviation of the normal distribution.
        device: where the policy is; ``None``: the CPU.

    Returns:
        A module from observation to ``action [..., 2]`` and ``action_log_prob [...]``. It takes the middle of
        the distribution, unless ``set_exploration_type(ExplorationType.RANDOM)`` holds, as in collectors.

    Example:
        >>> env = RoverEnv(world_n="maze", num_envs=2, seed=0)
        >>> actor = make_actor()
        >>> actor(env.reset())["action"].shape
        torch.Size([2, 2])
    """
    encoder, spec = encoder or ObservationEncoder(), action_spec(reverse, device)
    # Small last weights: the first actions lie around the middle of their bounds, whatever is seen.
    body = _mlp(encoder.features, hidden, 2 * spec.shape[-1], gain=0.01)
    network = EncodedNetwork(encoder, nn.Sequential(body, NormalParameters(spread)))
    return _actor(network.to(device), encoder.keys, spec)


def on_features(actor: ProbabilisticActor) -> ProbabilisticActor:
    """The same actor, with the same weights, that reads ``features [..., n]``: the observation, encoded already."""
    return _actor(actor[0].module.body, ("features",), actor.spec["action"])


def _actor(network: nn.Module, keys: Sequence[str], spec: Bounded) -> ProbabilisticActor:
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=list(keys), out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=spec,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
        return_log_prob=True,
    )


class NormalParameters(nn.Module):
    """Splits its input into a normal distribution's mean, and its standard deviation between ``LEAST`` and ``most``.

    With no bound above, the standard deviation grows where the mean matters little, as before a wall, and the policy
    comes to rely on chance to get away from there: without exploration it stays.

    Args:
        most: largest standard deviation.
    """

    LEAST = 0.02

    def __init__(self, most: float) -> None:
        super().__init__()
        self.most = most

    def forward(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation ``[..., n]`` from ``[..., 2 n]``."""
        loc, scale = parameters.chunk(2, -1)
        return loc, self.LEAST + (self.most - self.LEAST) * scale.sigmoid()


def make_critic(
    encoder: ObservationEncoder | None = None,
    hidden: Sequence[int] = (128, 128),
    device: torch.device | str | None = None,
) -> ValueOperator:
    """A state-value function: from observation to ``state_value [..., 1]``. Arguments as :func:`make_actor`."""
    encoder = encoder or ObservationEncoder()
    network = EncodedNetwork(encoder, _mlp(encoder.features, hidden, 1, gain=1.0))
    return ValueOperator(network.to(device), in_keys=[*encoder.keys])


def make_action_critic(
    features: int,
    hidden: Sequence[int] = (128, 128),
    reverse: bool = True,
    device: torch.device | str | None = None,
) -> ValueOperator:
    """An action-value function: from ``features [..., n]`` and action to ``state_action_value [..., 1]``.

    Args:
        features: n, that an :class:`ObservationEncoder` makes of the observation.
        hidden: units of each hidden layer.
        reverse: whether actions may drive backwards.
        device: where the network is; ``None``: the CPU.
    """
    network = _ActionCritic(features, hidden, action_spec(reverse))
    return ValueOperator(network.to(device), in_keys=["features", "action"])


class _ActionCritic(nn.Module):
    """Scales the action to [-1, 1], and puts it beside the features."""

    _middle: Tensor
    _half: Tensor

    def __init__(self, features: int, hidden: Sequence[int], spec: Bounded) -> None:
        super().__init__()
        middle, half = middle_and_half(spec)
        self.register_buffer("_middle", middle, persistent=False)
        self.register_buffer("_half", half, persistent=False)
        self._mlp = _mlp(features + spec.shape[-1], hidden, 1, gain=1.0)

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        return self._mlp(torch.cat((features, (action - self._middle) / self._half), -1))


def _mlp(features: int, hidden: Sequence[int], outputs: int, gain: float) -> MLP:
    """Fully connected layers with ReLU between them and orthogonal weights, the last one's of ``gain``."""
    mlp = MLP(in_features=features, out_features=outputs, num_cells=list(hidden), activation_class=nn.ReLU)
    linear = [layer for layer in mlp if isinstance(layer, nn.Linear)]
    for layer in linear:
        nn.init.orthogonal_(layer.weight, gain if layer is linear[-1] else math.sqrt(2))
        nn.init.zeros_(layer.bias)
    return mlp


_MIRROR = {"imu": (1.0, -1.0, -1.0), "target": (1.0, -1.0), "velocities": (1.0, -1.0), "action": (1.0, -1.0)}
"""Signs of the mirror image: left and right swap, so that roll, yaw and angles turn round."""


@cache
def _mirror_signs(device: torch.device) -> dict[str, Tensor]:
    return {key: torch.tensor(signs, device=device) for key, signs in _MIRROR.items()}


def mirrored(decisions: TensorDictBase, rows: Tensor) -> TensorDictBase:
    """``decisions [N]`` with the ``rows`` (bool ``[N]``) seen in a mirror; the lidar's readings run the other way.

    The readings are minima over segments of which the first begins straight ahead, so that the mirror image is
    exact to one beam of the raw scan.
    """
    image = decisions.copy()
    rows = rows[:, None]
    for part in (image, image.get("next", None)):
        if part is None:
            continue
        for key, signs in _mirror_signs(rows.device).items():
            if (value := part.get(key, None)) is not None:
                part.set(key, torch.where(rows, value * signs, value))
        if (ranges := part.get("lidar", None)) is not None:
            part.set("lidar", torch.where(rows, ranges.flip(-1), ranges))
    return image


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
