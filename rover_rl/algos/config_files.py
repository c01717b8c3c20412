"""Settings of training as plain data and YAML files. Imports no PyTorch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from rover_rl.algos.config import ALGORITHMS, PARTS, TrainingConfig, default_config, part_of, with_settings
from rover_rl.envs.config import env_from_plain, plain_env
from rover_rl.files import write_through, written_whole
from rover_rl.plain import from_plain, to_plain


def plain(config: TrainingConfig) -> dict[str, Any]:
    """Settings as plain data: the algorithm's name, then the parts."""
    parts = {part: to_plain(getattr(config, part)) for part in PARTS if part != "env"}
    return {"algo": config.algo, "env": plain_env(config.env), **parts}


def config_from(data: Any, source: str, default: TrainingConfig | None = None) -> TrainingConfig:
    """Settings from plain data; what it does not name is as in ``default``, or has its default.

    Settings may stand in their parts, as ``plain`` gives them, or without parts. The sessions of a run are no settings.
    ``source`` is the name of the file, for messages. Raises a ``ValueError`` for an algorithm or a setting that does
    not exist, or a value of the wrong type.
    """
    if not isinstance(data, dict) or data.get("algo") not in list(ALGORITHMS):
        raise ValueError(f"{source} must name an algo, one of {sorted(ALGORITHMS)}")
    algo = data["algo"]
    if default is not None and algo != default.algo:
        raise ValueError(f"{source} has settings of {algo}, and the learner is {default.algo}")
    parts = {key: value for key, value in data.items() if key not in ("algo", _SESSIONS)}
    if not set(parts) & set(PARTS):
        homes = part_of(algo)
        if unknown := sorted(map(str, parts.keys() - homes.keys())):
            raise ValueError(f"{source} has settings that {algo} does not know: {unknown}; use some of {sorted(homes)}")
        named = {homes[name] for name in parts}
        parts = {part: {name: value for name, value in parts.items() if homes[name] == part} for part in named}
    if unknown := sorted(set(parts) - set(PARTS), key=str):
        raise ValueError(f"{source} has parts that do not exist: {unknown}; use some of {[*PARTS]}")
    default = default or default_config(algo, _backend_name(parts.get("env")))
    read: dict[str, Any] = {}
    for part, given in parts.items():
        place = f"{part} in {source}"
        if not isinstance(given, dict):
            raise ValueError(f"{place} must hold settings by name, got {given!r}")
        if part == "env":
            read[part] = env_from_plain(plain_env(default.env) | given, place)
        else:
            read[part] = from_plain(to_plain(getattr(default, part)) | given, type(getattr(default, part)), place)
    return replace(default, **read)


def _backend_name(env: Any) -> str:
    named = env.get("backend") if isinstance(env, dict) else None
    named = next(iter(named), None) if isinstance(named, dict) else named
    return named if isinstance(named, str) else default_config("ppo").env.backend


_SESSIONS = "sessions"  # name of the list of sessions in a run's settings


def write_config(path: Path, config: TrainingConfig, sessions: Sequence[dict[str, Any]] = ()) -> None:
    """Writes settings as YAML, with the sessions of a run that changed some, if there are any."""
    data = plain(config) | ({_SESSIONS: [*sessions]} if sessions else {})
    with written_whole(path) as temporary:
        write_through(temporary, yaml.safe_dump(data, sort_keys=False).encode())


def read_sessions(path: Path) -> list[dict[str, Any]]:
    return read_yaml(path).get(_SESSIONS, [])


def read_yaml(path: str | Path) -> Any:
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder, and settings are in a file, such as a run's config.yaml")
    if not path.is_file():
        raise FileNotFoundError(f"no settings at {path}")
    try:
        return yaml.safe_load(path.read_bytes().decode())
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no YAML: {' '.join(str(error).split())}") from error


def read_config(path: str | Path, default: TrainingConfig | None = None) -> TrainingConfig:
    """Reads settings from YAML. Raises a ``FileNotFoundError``, or a ``ValueError`` as :func:`config_from`."""
    return config_from(read_yaml(path), str(path), default)


def run_config(folder: str | Path) -> TrainingConfig:
    folder = Path(folder)
    path = folder / "config.yaml"
    if not path.is_file():
        raise FileNotFoundError(f"no settings at {path}: {folder} is not the folder of a run")
    if not path.read_bytes().endswith(b"\n"):
        raise ValueError(f"{path} is empty, or cut short: the run's settings are lost; begin a new run")
    return with_settings(read_config(path), runs=str(folder.parent), name=folder.name)


def experiments(configs: Sequence[TrainingConfig]) -> list[str]:
    """Names of the experiments that runs belong to: the same for runs that differ in their seed only.

    A name has the algorithm, the world, and the settings that differ from those of other runs of both.

    Example:
        >>> experiments([training_config("sac", gamma=0.9), training_config("sac", gamma=0.96, seed=1)])
        ['SAC in moon, gamma=0.9', 'SAC in moon, gamma=0.96']
    """
    every = [_flat(config) for config in configs]
    names = []
    for config, own in zip(configs, every, strict=True):
        kind = config.algo, own["world"]
        others = [flat for other, flat in zip(configs, every, strict=True) if (other.algo, flat["world"]) == kind]
        special = [f"{key}={value}" for key, value in own.items() if any(other[key] != value for other in others)]
        names.append(", ".join((f"{config.algo.upper()} in {', '.join(config.env.world_names)}", *special)))
    return names


SEED_SUFFIX = "-seed"  # text between the name of an experiment and the seed in the name of a run's folder
_OF_A_RUN = (
    *("seed", "name", "runs", "backend", "device", "collector", "workers"),
    *("checkpoint_minutes", "snapshots", "logger"),
)
"""Settings that do not change what is learned."""


def plain_settings(config: TrainingConfig) -> dict[str, Any]:
    parts = plain(config)
    return {"algo": parts["algo"]} | {name: value for part in PARTS for name, value in parts[part].items()}


def differing_settings(one: TrainingConfig, other: TrainingConfig) -> list[str]:
    """Names of the settings that differ among those that change what is learned, and the seed."""
    if one.algo != other.algo:
        return ["algo"]
    flat, others = plain_settings(one), plain_settings(other)
    return [name for name in flat if flat[name] != others[name] and (name == "seed" or name not in _OF_A_RUN)]


def _flat(config: TrainingConfig) -> dict[str, Any]:
    parts = [(name, value) for part in PARTS for name, value in vars(getattr(config, part)).items()]
    return {name: value for name, value in parts if name not in _OF_A_RUN}
