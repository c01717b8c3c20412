"""Arguments of environments: the contract's and the names of :class:`EnvConfig`, as one description."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypedDict

from rover_rl.envs.config import EnvConfig
from rover_rl.registry import perhaps

if TYPE_CHECKING:
    import torch

    from rover_rl.envs.config import (
        ActionConfig,
        BackendLike,
        GuardConfig,
        HeadingGains,
        LidarConfig,
        LimitsConfig,
        OutcomeSource,
        PoseConfig,
        Randomization,
        RewardConfig,
        RewardLike,
        RobotLike,
        SensorLike,
        TaskConfig,
        WorldLike,
    )
    from rover_rl.robots.options import RobotOptions
    from rover_rl.sims.settings import Connection


class EnvSettings(TypedDict, total=False):
    """Keyword arguments of :class:`RoverEnv`: the contract's, then the fields of :class:`EnvConfig`."""

    size: tuple[int, int]
    length: int
    scan_topic: str
    imu_topic: str
    cmd_vel_topic: str
    camera_topic: str
    world_n: WorldLike
    connection_check_timeout: float
    lidar_points: int
    max_lidar_range: float
    num_envs: int | None
    agents: int
    backend: BackendLike
    physics: str | None
    robot: RobotLike
    robot_options: RobotOptions | None
    lidar_beams: int
    lidar_period: int
    seed: int | None
    device: torch.device | str | None
    end_on_goal: bool
    task: TaskConfig | None
    heading_gains: HeadingGains | None
    limits: LimitsConfig | None
    guard: GuardConfig | None
    randomization: Randomization | None
    action: ActionConfig | None
    compensate_delay: bool
    outcome_from: OutcomeSource
    privileged: bool
    world: WorldLike | None
    lidar: LidarConfig | None
    pose: PoseConfig | None
    connection: Connection | None
    sensors: Sequence[SensorLike]
    control_rate: float | None


PLACES = {
    "world_n": ("world", ""),
    "lidar_points": ("lidar", "points"),
    "lidar_beams": ("lidar", "beams"),
    "lidar_period": ("lidar", "period"),
    "max_lidar_range": ("lidar", "max_range"),
    "scan_topic": ("connection", "scan_topic"),
    "imu_topic": ("connection", "imu_topic"),
    "cmd_vel_topic": ("connection", "cmd_vel_topic"),
    "camera_topic": ("connection", "camera_topic"),
    "connection_check_timeout": ("connection", "timeout"),
}
"""Field of :class:`EnvConfig` that an argument belongs to, and the field of that part, by the argument's name."""
CONTRACT = 10
"""Number of positional arguments: the contract's."""


def env_signature() -> inspect.Signature:
    """Returns the signature of the arguments, with their defaults. ``None`` for a part is the contract's."""
    hints, defaults = EnvSettings.__annotations__, EnvConfig()
    parameters = []
    for number, (name, hint) in enumerate(hints.items()):
        kind = inspect.Parameter.POSITIONAL_OR_KEYWORD if number < CONTRACT else inspect.Parameter.KEYWORD_ONLY
        field, part = PLACES.get(name, (name, ""))
        default = getattr(defaults, field)
        default = getattr(default, part) if part else default
        if "None" in _text(hint) and name != "num_envs":
            default = None
        parameters.append(inspect.Parameter(name, kind, default=default, annotation=_text(hint)))
    return inspect.Signature(parameters)


def _text(hint: Any) -> str:
    # The annotations of a TypedDict are forward references.
    return getattr(hint, "__forward_arg__", str(hint))


SIGNATURE = env_signature()


def config_from(
    what: str,
    args: Sequence[Any],
    settings: Mapping[str, Any],
    reward: RewardLike = "contract",
    contract_reward: RewardConfig | None = None,
) -> EnvConfig:
    """Returns the description of an environment, which is the only argument, or given by the contract's arguments.

    Args:
        what: name of the function or class, for messages.
        args: positional arguments: an :class:`EnvConfig`, or the contract's.
        settings: keyword arguments, see :class:`EnvSettings`.
        reward, contract_reward: reward and its parameters.

    Raises:
        TypeError: if there are arguments besides an ``EnvConfig``, or an argument is unknown, given twice, or given by
            both of its names, as ``world`` and ``world_n``.
        ValueError: if a value is out of range, or a part has the wrong type.
    """
    if args and isinstance(args[0], EnvConfig):
        if len(args) > 1 or settings or reward != "contract" or contract_reward is not None:
            raise TypeError(f"{what} takes an EnvConfig alone; use dataclasses.replace(config, ...) to change it")
        return args[0]
    try:
        given = SIGNATURE.bind(*args, **settings).arguments
    except TypeError as error:
        unknown = next((name for name in settings if name not in SIGNATURE.parameters), "")
        raise TypeError(f"{what}: {error}{perhaps(unknown, SIGNATURE.parameters)}") from None
    nested: dict[str, dict[str, Any]] = {}
    own = {name: value for name, value in given.items() if name not in PLACES}
    for name in given.keys() & PLACES.keys():
        field, part = PLACES[name]
        if own.get(field) is not None:
            advice = f"; {name} is the contract's name for a part of it" if part else ""
            raise TypeError(f"{what}: {field} and {name} set the same: give one of them{advice}")
        nested.setdefault(field, {})[part] = given[name]
    default = EnvConfig()
    changes = {name: value for name, value in own.items() if value is not None or name not in _NONE_IS_THE_DEFAULT}
    changes |= {
        field: parts[""] if "" in parts else replace(getattr(default, field), **parts)
        for field, parts in nested.items()
    }
    if changes.get("device") is not None:
        changes["device"] = str(changes["device"])
    return EnvConfig(**changes, reward=reward, contract_reward=contract_reward or default.contract_reward)


_NONE_IS_THE_DEFAULT = {name for name, hint in EnvSettings.__annotations__.items() if "None" in _text(hint)} - {
    "num_envs",
    "seed",
    "device",
}
"""Arguments for which ``None`` is the contract's value."""
