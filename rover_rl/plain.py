"""Converts configuration dataclasses to plain data for YAML and JSON, and back, without PyTorch."""

from __future__ import annotations

import operator
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from cattrs import Converter, transform_error
from cattrs.errors import BaseValidationError, ForbiddenExtraKeysError

Settings = TypeVar("Settings")


def to_plain(settings: Any) -> dict[str, Any]:
    """Converts a dataclass to nested dictionaries, lists, numbers and strings."""
    return _converter().unstructure(settings)


def from_plain(data: Any, kind: type[Settings], source: str) -> Settings:
    """Creates a dataclass from its fields by name, those that are missing with their defaults.

    Raises ``ValueError`` if a field does not exist, or a value has the wrong type or is out of range: one sentence that
    names the field and ``source``, the origin of the data, such as the path of a file.
    """
    if not isinstance(data, dict):
        raise ValueError(f"{source} must hold settings by name, got {data!r}")
    try:
        return _converter().structure(data, kind)
    except BaseValidationError as error:
        problem, _, path = transform_error(error, path="", format_exception=_describe_error)[0].rpartition(" @ ")
        place = " in ".join(filter(None, (path.lstrip("."), source)))
        raise ValueError(f"{place}: {problem}") from error


def _describe_error(error: BaseException, kind: type | None) -> str:
    if isinstance(error, ForbiddenExtraKeysError):
        unknown, known = sorted(map(str, error.extra_fields)), sorted(item.name for item in fields(error.cl))
        return f"there is no setting {', '.join(unknown)}; use some of {known}"
    return str(error)


@cache
def _converter() -> Converter:
    # It converts tuples to lists and back, and does not convert between other types.
    converter = Converter(forbid_extra_keys=True, unstruct_collection_overrides={tuple: list})
    for kind in (bool, int, float, str):
        converter.register_structure_hook(kind, _structure_strictly)
    converter.register_structure_hook_func(_origin_in(Literal), _structure_literal)
    converter.register_structure_hook_func(_origin_in(Union, UnionType), _structure_union)
    return converter


def _origin_in(*origins: Any) -> Callable[[Any], bool]:
    return lambda hint: get_origin(hint) in origins


def _structure_strictly(value: Any, kind: type) -> Any:
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise ValueError(f"a value of type {kind.__name__} is needed, got {value!r}")
    return value


def _structure_literal(value: Any, hint: Any) -> Any:
    if value not in get_args(hint):
        raise ValueError(f"one of {list(get_args(hint))} is needed, got {value!r}")
    return value


def _structure_union(value: Any, hint: Any) -> Any:
    if value is None and NoneType in get_args(hint):
        return None
    for kind in get_args(hint):
        # Otherwise a string would be accepted as a tuple of characters.
        if kind is str or not (kind is NoneType or isinstance(value, str)):
            with suppress(ValueError, TypeError, BaseValidationError):
                return _converter().structure(value, kind)
    raise ValueError(f"a value of type {hint} is needed, got {value!r}")


def take_numbers(settings: Any) -> None:
    """Replaces numbers of NumPy and PyTorch in the fields of a frozen dataclass by Python's. Call it first.

    Raises ``ValueError`` if a field of numbers holds something else.
    """
    for item in fields(settings):
        given = getattr(settings, item.name)
        value, kinds = _of_python(given), str(item.type).split(" | ")
        if set(kinds) <= {*_NUMBERS}:
            taken = [kind for kind in kinds if _is_of(value, kind)]
            if not taken:
                raise ValueError(f"{item.name} must be {' or '.join(_NUMBERS[kind] for kind in kinds)}, got {given!r}")
            value = tuple(value) if taken[0].startswith("tuple") else value
        if value is not given:
            object.__setattr__(settings, item.name, value)


_NUMBERS = {
    "None": "None",
    "bool": "True or False",
    "int": "a whole number",
    "float": "a number",
    "tuple[int, int]": "two whole numbers",
    "tuple[float, float]": "two numbers",
}
"""Annotations of the fields whose numbers are checked, and what they are called."""


def _of_python(value: Any) -> Any:
    if type(value) in (list, tuple):
        parts = [_of_python(part) for part in value]
        return value if all(map(operator.is_, parts, value)) else type(value)(parts)
    return value.tolist() if hasattr(value, "tolist") else value


def _is_of(value: Any, kind: str) -> bool:
    if kind.startswith("tuple"):
        of = kind[6:].split(",")[0]
        return isinstance(value, list | tuple) and len(value) == 2 and all(_is_of(part, of) for part in value)
    if kind == "None":
        return value is None
    return type(value) in {"bool": (bool,), "int": (int,), "float": (int, float)}[kind]
