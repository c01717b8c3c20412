"""Movers as plain data, for world files."""

from __future__ import annotations

from typing import Any

from rover_rl.plain import from_plain, to_plain
from rover_rl.worlds import movers
from rover_rl.worlds.movers import Mover

CLASSES = {name: kind for name, kind in vars(movers).items() if name in movers.__all__ and isinstance(kind, type)}
"""Motions and shapes of the package by name: a file names no others, so that reading one runs no other code."""


def mover_to_plain(mover: Mover) -> dict[str, Any]:
    """Returns a mover as nested dictionaries, lists, numbers and strings.

    Raises:
        ValueError: if its motion or its shape is not one of the package.
    """
    return {"name": mover.name, "motion": _to_plain(mover.motion), "shape": _to_plain(mover.shape)}


def mover_from_plain(data: Any) -> Mover:
    """Returns the mover that :func:`mover_to_plain` converted.

    Raises:
        ValueError: if the data are wrong.
    """
    if not isinstance(data, dict) or data.keys() != {"name", "motion", "shape"}:
        raise ValueError(f"a mover needs a name, a motion and a shape, got {data!r}")
    return Mover(_from_plain(data["motion"]), _from_plain(data["shape"]), str(data["name"]))


def _to_plain(part: Any) -> dict[str, Any]:
    name = type(part).__name__
    if CLASSES.get(name) is not type(part):
        raise ValueError(f"a world file can hold the motions and shapes of rover_rl alone, got {part!r}")
    return {"kind": name, **to_plain(part)}


def _from_plain(data: Any) -> Any:
    kind = CLASSES.get(str(data.get("kind"))) if isinstance(data, dict) else None
    if kind is None:
        raise ValueError(f"the kind of a motion or shape must be one of {sorted(CLASSES)}, got {data!r}")
    return from_plain({key: value for key, value in data.items() if key != "kind"}, kind, data["kind"])
