"""Neural networks: actors, critics, and mirror images of what they read."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, TypeAlias

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import AffineTransform, ComposeTransform, Distribution
from torchrl.data import Bounded
from torchrl.modules import MLP, ConvNet, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.modules.distributions.continuous import SafeTanhTransform

from rover_rl.algos.config import DistributionKind, MemoryKind, TrainingConfig
from rover_rl.algos.policy.grid_actions import ACTIONS, LABELS, TURN, GridDistribution, GridLogits, mirrored_labels
from rover_rl.algos.policy.recurrent import recurrent_network
from rover_rl.algos.policy.route_prior import RoutePrior, RowBounds
from rover_rl.envs.actions import Heading, action_bounds, find_action
from rover_rl.envs.config import ActionConfig, HeadingGains, LidarConfig
from rover_rl.envs.encoding import ObservationEncoder
from rover_rl.envs.parts import HEADING
from rover_rl.envs.privileged import FEATURES, MAP_BEARINGS, MAP_DISTANCES
from rover_rl.envs.sensors.base import Sensor, mirrored_signs
from rover_rl.envs.sensors.movers import NEAREST, NUMBERS, encoded
from rover_rl.envs.sensors.standard import Target, WheelOdometry
from rover_rl.envs.sensors.suite import ROBOT, policy_sensors
from rover_rl.envs.specs import bounded_spec
from rover_rl.robots import get_robot
from rover_rl.tensordicts import with_torch_defaults

DRIVER = "driver"
"""Entry of a batch of decisions: mean that the prior of a policy adds, before squashing, ``[..., 2]``."""
# Channels and kernel sizes of convolutions over an image, each of which halves rows and columns, and the number of
# features after them.
CHANNELS, KERNELS, UNITS = (16, 32, 32), (5, 3, 3), 64
PATCH, PATCH_UNITS = 4, 24  # largest number of rows and columns of a patch, and number of features of one


def action_spec(action: ActionConfig | None = None, device: torch.device | str | None = None) -> Bounded:
    """Returns the action spec of one rover, ``[2]``, with given bounds, by default the contract's."""
    return bounded_spec(action_bounds(action or ActionConfig()), (), device)


def middle_and_half(spec: Bounded) -> tuple[Tensor, Tensor]:
    low, high = spec.space.low, spec.space.high
    return (high + low) / 2, (high - low) / 2


class BoundedTanhNormal(TanhNormal):
    """TorchRL's ``TanhNormal`` within bounds ``[n]``, without its checks of them, which would wait for a GPU."""

    def __init__(self, loc: Tensor, scale: Tensor, low: Tensor, high: Tensor) -> None:
        # The module that holds the bounds may have been moved to another device since it was made.
        low, high = low.to(loc.device), high.to(loc.device)
        # Does what the constructor of TanhNormal does after its checks.
        self.tanh_loc, self.upscale, self._event_dims = False, 5.0, min(1, loc.ndim)
        self.device, self.low, self.high = loc.device, low, high
        self._t = ComposeTransform([SafeTanhTransform(), AffineTransform((high + low) / 2, (high - low) / 2)])
        self.update(loc, scale)


class InRowBounds:
    """Distributions of a kind within bounds by robot: a function of their parameters and of the sensor ``robot``."""

    def __init__(self, kind: Callable[..., Distribution], bounds: RowBounds) -> None:
        self._kind, self._bounds = kind, bounds

    def __call__(self, loc: Tensor, scale: Tensor, robot: Tensor) -> Distribution:
        return self._kind(loc, scale, *self._bounds.to(robot.device)(robot))


class EncodedNetwork(nn.Module):
    """Applies an encoder to the observation and a network, ``body``, to its features.

    The features of a ``privileged`` encoder follow those of the observation.
    """

    def __init__(self, encoder: ObservationEncoder, body: nn.Module, privileged: nn.Module | None = None) -> None:
        super().__init__()
        self.encoder, self.body, self.privileged = encoder, body, privileged

    def forward(self, *entries: Tensor) -> Tensor | tuple[Tensor, ...]:
        return self.body(self.features(*entries))

    def features(self, *entries: Tensor) -> Tensor:
        """Returns what ``body`` reads, which depends on no weights."""
        count = len(self.encoder.keys)
        features = self.encoder(*entries[:count])
        return features if self.privileged is None else torch.cat((features, self.privileged(*entries[count:])), -1)


class ActorNetwork(EncodedNetwork):
    """Mean and standard deviation of an action, ``[..., 2]`` each. A ``prior`` is added to the mean.

    ``bounds`` are those of the robots that the observation tells; ``None``: those of the action spec.
    """

    def __init__(
        self,
        encoder: ObservationEncoder,
        body: nn.Module,
        spec: Bounded,
        prior: RoutePrior | None,
        bounds: RowBounds | None,
    ) -> None:
        super().__init__(encoder, body)
        self.prior, self._bounds, self._by_robot = prior, bounds or RowBounds(spec), bounds is not None

    def forward(self, *entries: Tensor) -> tuple[Tensor, ...]:
        driver = None if self.prior is None else self.driver(dict(zip(self.encoder.keys, entries, strict=True)))
        return self.distribution(self.features(*entries), driver)

    def distribution(self, features: Tensor, driver: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Returns mean and standard deviation for the features of an observation, and the mean of the prior."""
        loc, scale = self.body(features)
        if self.prior is not None and driver is not None:
            loc = self.prior.reach * torch.tanh(loc / self.prior.reach) + driver
        return loc, scale

    def driver(self, entry: Mapping[str, Tensor]) -> Tensor:
        assert self.prior is not None
        return self.prior(entry, *self._bounds(entry[ROBOT] if self._by_robot else None))


class PrivilegedEncoder(nn.Module):
    """Encodes the privileged observation as ``features [..., features]`` of about [-1, 1], for critics.

    Without position and heading, by which a critic would know one map by heart, and which mirror images contradict.
    """

    keys: tuple[NestedKey, ...] = tuple(("privileged", key) for key in FEATURES if key != "position")
    features = 2 + 2 + 5 + 2 + len(MAP_DISTANCES) * MAP_BEARINGS + 7 * NEAREST + 4
    _reach: Tensor

    def __init__(self) -> None:
        super().__init__()
        reach = torch.tensor(MAP_DISTANCES).repeat_interleave(MAP_BEARINGS)
        self.register_buffer("_reach", reach, persistent=False)

    def forward(self, *entries: Tensor) -> Tensor:
        entry = {key[-1]: value for key, value in zip(self.keys, entries, strict=True)}
        path = entry["path_distance"]
        factors = [2 * (entry[key] - 1) for key in ("friction", "chassis_mass", "motor_torque")]
        parts = [3 * entry["attitude"][..., :2], WheelOdometry().encode(entry["velocities"])]
        parts += [Target().encode(entry["target"])]
        movers = encoded(entry["movers"].unflatten(-1, (NEAREST, NUMBERS))).flatten(-2)
        parts += [path / 5 - 1, path.log1p() - 1, entry["local_map"] / self._reach, movers]
        parts += [*factors, entry["latency"] / 3]
        return torch.cat(parts, -1)


def encoder_of(config: TrainingConfig) -> ObservationEncoder:
    network, env = config.network, config.env
    reading = network.observation, env.lidar.points, network.north_up, env.own_sensors
    return ObservationEncoder(*reading, image_network=network.image_network)


def actor_of(
    config: TrainingConfig, encoder: ObservationEncoder | None = None, device: str | None = None
) -> ProbabilisticActor:
    """Creates a policy with these settings: see :func:`make_actor`."""
    network, env = config.network, config.env
    bounds, prior = bounds_by_robot(config), None
    if network.prior != "none":
        prior = RoutePrior(get_robot(env.robot), network.observation, network.prior_reach, network.prior_share)
    encoder, memory = encoder or encoder_of(config), (network.memory, network.memory_size)
    settings = network.hidden, env.bounded_action, network.max_std, device, *memory, prior, bounds
    return make_actor(encoder, *settings, network.distribution)


def bounds_by_robot(config: TrainingConfig) -> RowBounds | None:
    """Returns the bounds of the actions of different robots, where a policy of PPO reads which one it drives."""
    action, network = config.env.bounded_action, config.network
    speed_and_turn = action.kind in (HEADING, "twist") and not action.max_sideways
    if config.algo != "ppo" or ROBOT not in network.observation or not speed_and_turn:
        return None
    gain, share = HeadingGains.kp if action.kind == HEADING else 1.0, TURN if network.distribution == "grid" else 1.0
    return RowBounds(action_spec(action), gain, share)


@with_torch_defaults
def make_actor(
    encoder: ObservationEncoder | None = None,
    hidden: Sequence[int] = (128, 128),
    action: ActionConfig | None = None,
    max_std: float = 2.0,
    device: torch.device | str | None = None,
    memory: MemoryKind = "none",
    memory_size: int = 128,
    prior: RoutePrior | None = None,
    bounds: RowBounds | None = None,
    distribution: DistributionKind = "normal",
) -> ProbabilisticActor:
    """Creates a stochastic policy: by default a tanh-squashed normal distribution within the action's bounds.

    It reads an observation and writes ``action [..., 2]`` and ``action_log_prob [...]``. The action is the center of
    the distribution, or the most likely one of a grid, except under
    ``set_exploration_type(ExplorationType.RANDOM)``, as in collectors.

    Args:
        encoder: encoder of the observation; ``None``: an encoder of the default entries.
        hidden: number of units of each hidden layer.
        action: bounds of the action; ``None``: the contract's.
        max_std: largest standard deviation of the normal distribution, before squashing.
        device: device of the policy; ``None``: the CPU.
        memory, memory_size: ``"gru"``, and its number of units, for a memory between the hidden layers and the last
            one. With it, the policy reads and writes a state: see ``rover_rl.algos.policy.recurrent``.
        prior: driver to whose action the policy adds, if it has no memory. ``None``: the policy starts from nothing.
        bounds: bounds of the action by robot, which the observation tells: see
            :func:`~rover_rl.algos.policy.networks.bounds_by_robot`. ``None``: those of ``action``.
        distribution: ``"normal"``, or ``"grid"``: see :class:`~rover_rl.algos.policy.grid_actions.GridDistribution`.

    Example:
        >>> env = RoverEnv(world_n="maze", num_envs=2, seed=0)
        >>> make_actor()(env.reset())["action"].shape
        torch.Size([2, 2])
    """
    encoder, spec = encoder or ObservationEncoder(), action_spec(action, device)
    on_grid = distribution == "grid"
    last, outputs = (GridLogits(), ACTIONS) if on_grid else (NormalParameters(max_std), 2 * spec.shape[-1])
    # With small weights in the last layer, the first actions are near the center of their bounds for any observation.
    if memory == "none":
        body = _body(encoder, encoder.features, hidden, outputs, gain=0.01)
        network = ActorNetwork(encoder, nn.Sequential(body, last), spec, prior, bounds)
        return _actor(TensorDictModule(network, [*encoder.keys], ["loc", "scale"]).to(device), spec, on_grid, bounds)
    *layers, units = hidden
    body = nn.Sequential(_body(encoder, encoder.features, layers, units, gain=math.sqrt(2)), nn.ReLU())
    embedding = TensorDictModule(EncodedNetwork(encoder, body), [*encoder.keys], ["embedding"])
    head = nn.Sequential(_mlp(units + memory_size, (), outputs, gain=0.01), last)
    return _actor(recurrent_network(embedding, units, head, memory_size).to(device), spec, on_grid, bounds)


def on_features(actor: ProbabilisticActor) -> ProbabilisticActor:
    """Returns an actor with the same weights that reads encoded observations, ``features [..., n]``."""
    return _actor(TensorDictModule(actor[0].module.body, ["features"], ["loc", "scale"]), actor.spec["action"])


def _actor(
    network: TensorDictModuleBase, spec: Bounded, on_grid: bool = False, bounds: RowBounds | None = None
) -> ProbabilisticActor:
    kind = GridDistribution if on_grid else BoundedTanhNormal
    keys = {"loc": "loc", "scale": "scale"}
    if bounds is None:
        fixed = {"low": spec.space.low, "high": spec.space.high}
        distribution: dict[str, Any] = {"distribution_class": kind, "distribution_kwargs": fixed}
    else:
        keys, distribution = keys | {"robot": ROBOT}, {"distribution_class": InRowBounds(kind, bounds)}
    return ProbabilisticActor(network, keys, spec=spec, **distribution, return_log_prob=True)


class NormalParameters(nn.Module):
    """Splits ``[..., 2 n]`` into mean and standard deviation, ``MIN_STD`` to ``max_std``, of a normal distribution.

    Without an upper bound it grows where the mean matters little, such as in front of a wall, and the policy relies on
    random actions to escape: without exploration, it gets stuck.
    """

    MIN_STD = 0.02  # smallest standard deviation
    max_std: Tensor

    def __init__(self, max_std: float) -> None:
        super().__init__()
        # A buffer, which collectors send to their workers with the weights, because training changes it.
        self.register_buffer("max_std", torch.tensor(max_std), persistent=False)

    def forward(self, parameters: Tensor) -> tuple[Tensor, Tensor]:
        loc, scale = parameters.chunk(2, -1)
        return loc, self.MIN_STD + (self.max_std - self.MIN_STD) * scale.sigmoid()


def make_critic(
    encoder: ObservationEncoder | None = None,
    hidden: Sequence[int] = (128, 128),
    device: torch.device | str | None = None,
    privileged: bool = False,
) -> ValueOperator:
    """Creates a state-value function from observation, or also the privileged one, to ``state_value [..., 1]``."""
    encoder = encoder or ObservationEncoder()
    beside = PrivilegedEncoder() if privileged else None
    features = encoder.features + (beside.features if beside else 0)
    network = EncodedNetwork(encoder, _body(encoder, features, hidden, 1, gain=1.0), beside)
    return ValueOperator(network.to(device), in_keys=[*encoder.keys, *(beside.keys if beside else ())])


def make_action_critic(
    encoder: ObservationEncoder,
    hidden: Sequence[int] = (128, 128),
    action: ActionConfig | None = None,
    device: torch.device | str | None = None,
) -> ValueOperator:
    """Creates an action-value function from encoded ``features`` and action to ``state_action_value [..., 1]``."""
    network = _ActionCritic(encoder, hidden, action_spec(action))
    return ValueOperator(network.to(device), in_keys=["features", "action"])


class _ActionCritic(nn.Module):
    _middle: Tensor
    _half: Tensor

    def __init__(self, encoder: ObservationEncoder, hidden: Sequence[int], spec: Bounded) -> None:
        super().__init__()
        middle, half = middle_and_half(spec)
        self.register_buffer("_middle", middle, persistent=False)
        self.register_buffer("_half", half, persistent=False)
        self._mlp = _body(encoder, encoder.features + spec.shape[-1], hidden, 1, gain=1.0)

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        return self._mlp(torch.cat((features, (action - self._middle) / self._half), -1))


class ImageFeatures(nn.Module):
    """Replaces each image among encoded features by :data:`UNITS` features: see :attr:`rover_rl.Sensor.image`.

    Features ``[..., n]`` become ``[..., n + added]``. Those after the encoder's stay. At least one of the encoder's
    sensors has images.

    Example:
        >>> encoder = ObservationEncoder(("target", "heights"))
        >>> ImageFeatures(encoder)(torch.zeros(1, encoder.features)).shape
        torch.Size([1, 69])
    """

    def __init__(self, encoder: ObservationEncoder) -> None:
        super().__init__()
        self._sizes, images = {key: encoder.sensors[key].features for key in encoder.keys}, encoder.images
        read = Patches if encoder.image_network == "patches" else _convolutions
        self.networks = nn.ModuleDict({key: read(self._sizes[key], shape) for key, shape in images.items()})
        self.added = sum(UNITS - self._sizes[key] for key in images)

    def forward(self, features: Tensor) -> Tensor:
        sizes = [*self._sizes.values()]
        *parts, rest = features.split([*sizes, features.shape[-1] - sum(sizes)], -1)
        entries = zip(self._sizes, parts, strict=True)
        read = [self.networks[key](part) if key in self.networks else part for key, part in entries]
        return torch.cat((*read, rest), -1)


def _convolutions(features: int, shape: tuple[int, int]) -> nn.Module:
    channels, paddings = features // (shape[0] * shape[1]), [kernel // 2 for kernel in KERNELS]
    sizes: dict[str, Any] = {
        "num_cells": list(CHANNELS),
        "kernel_sizes": list(KERNELS),
        "strides": 2,
        "paddings": paddings,
    }
    convolutions = ConvNet(in_features=channels, **sizes, activation_class=nn.ReLU)
    count = convolutions(torch.zeros(1, channels, *shape)).shape[-1]
    return nn.Sequential(nn.Unflatten(-1, (channels, *shape)), convolutions, nn.Linear(count, UNITS), nn.ReLU())


class Patches(nn.Module):
    """Reads images ``[..., features]`` by one layer over their patches, with the same weights for each.

    It returns :data:`UNITS` features. Patches have :data:`PATCH` rows and columns, or the largest numbers below that
    divide those of the image. They do not overlap: on a CPU, this takes an eighth of the time of three convolutions.
    """

    def __init__(self, features: int, shape: tuple[int, int]) -> None:
        super().__init__()
        self._channels = channels = features // (shape[0] * shape[1])
        self._sizes = [next(size for size in range(PATCH, 0, -1) if count % size == 0) for count in shape]
        self._counts = [count // size for count, size in zip(shape, self._sizes, strict=True)]
        count, pixels = math.prod(self._counts), math.prod(self._sizes)
        self.patch, self.image = nn.Linear(channels * pixels, PATCH_UNITS), nn.Linear(count * PATCH_UNITS, UNITS)

    def forward(self, image: Tensor) -> Tensor:
        (rows, columns), (height, width) = self._counts, self._sizes
        pixels = image.reshape(-1, self._channels, rows, height, columns, width)
        patches = pixels.permute(0, 2, 4, 1, 3, 5).flatten(3).flatten(1, 2)
        read = self.image(self.patch(patches).relu().flatten(1)).relu()
        return read.reshape(*image.shape[:-1], UNITS)


def _body(encoder: ObservationEncoder, features: int, hidden: Sequence[int], outputs: int, gain: float) -> nn.Module:
    # The features of the encoder may be followed by others.
    if not encoder.images:
        return _mlp(features, hidden, outputs, gain)
    images = ImageFeatures(encoder)
    return nn.Sequential(images, _mlp(features + images.added, hidden, outputs, gain))


def _mlp(features: int, hidden: Sequence[int], outputs: int, gain: float) -> MLP:
    """Creates an MLP with ReLU and orthogonal weights; ``gain`` is that of the last layer."""
    mlp = MLP(features, outputs, num_cells=list(hidden), activation_class=nn.ReLU, activation_kwargs={"inplace": True})
    linear = [layer for layer in mlp if isinstance(layer, nn.Linear)]
    for layer in linear:
        nn.init.orthogonal_(layer.weight, gain if layer is linear[-1] else math.sqrt(2))
        nn.init.zeros_(layer.bias)
    return mlp


def mirrored_map(local_map: Tensor) -> Tensor:
    """Returns the mirror image of the local map ``[..., distances * bearings]``: bearing b becomes -b."""
    return local_map.unflatten(-1, (len(MAP_DISTANCES), MAP_BEARINGS)).flip(-1).roll(1, -1).flatten(-2)


Mirrors: TypeAlias = Mapping[NestedKey, Callable[[Tensor], Tensor]]
"""Functions that return mirror images, by entry. The mirror of the world is the x axis."""
_MIRROR: Mirrors = {
    "action": Heading.mirror,
    ("privileged", "position"): partial(mirrored_signs, (1.0, -1.0, 1.0)),
    ("privileged", "attitude"): partial(mirrored_signs, (-1.0, 1.0, -1.0)),
    ("privileged", "velocities"): WheelOdometry().mirror,
    ("privileged", "target"): Target().mirror,
    ("privileged", "local_map"): mirrored_map,
    ("privileged", "movers"): partial(mirrored_signs, (1.0, -1.0, 1.0, -1.0, 1.0) * NEAREST),
}
"""Mirror images of what is no entry of a policy's observation."""


def mirrors_of(sensors: Mapping[str, Sensor], action: str = HEADING) -> Mirrors:
    """Returns the mirror images of an observation by its ``sensors``, and of a kind of ``action``."""
    mirror = find_action(action).mirror
    return {
        **_MIRROR,
        "action": mirror,
        DRIVER: mirror,
        LABELS: mirrored_labels,
        **{key: sensor.mirror for key, sensor in sensors.items()},
    }


DEFAULT_MIRRORS = mirrors_of(policy_sensors(LidarConfig()))
"""Mirror images of what the sensors of every rover tell, and of the contract's action."""


def mirrored(transitions: TensorDictBase, rows: Tensor, mirrors: Mirrors = DEFAULT_MIRRORS) -> TensorDictBase:
    """Returns ``transitions [...]`` with the selected ``rows`` (bool ``[...]``) mirrored left to right.

    ``mirrors`` are those of :func:`mirrors_of`. See also :class:`~rover_rl.algos.train.ppo.MirrorMemory`.
    """
    image = transitions.copy()
    rows = rows[..., None]
    for part in [image, image["next"]] if "next" in image.keys() else [image]:  # noqa: SIM118
        for key, mirror in mirrors.items():
            if (value := part.get(key, None)) is not None:
                part.set(key, torch.where(rows, mirror(value), value))
    return image
