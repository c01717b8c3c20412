"""Settings as plain data, for YAML and JSON, and back, by cattrs. Imports no PyTorch."""

from __future__ import annotations

from dataclasses import fields
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

from cattrs import Converter, transform_error
from cattrs.errors import BaseValidationError, ForbiddenExtraKeysError

Settings = TypeVar("Settings")


def to_plain(settings: Any) -> dict[str, Any]:
    """A dataclass as dictionaries, lists and numbers."""
    return _converter().unstructure(settings)


def from_plain(data: Any, kind: type[Settings], source: str) -> Settings:
    """A dataclass from plain data; fields that the data do not name have their defaults.

    Args:
        data: a dictionary.
        kind: the dataclass.
        source: where the data come from, for messages.

    Raises:
        ValueError: in one sentence, for a field that does not exist, or a value of the wrong type or out of range.
    """
    if not isinstance(data, dict):
        raise ValueError(f"{source} must hold settings by name, got {data!r}")
    try:
        return _converter().structure(data, kind)
    except BaseValidationError as error:
        problem, _, path = transform_error(error, path="", format_exception=_problem)[0].rpartition(" @ ")
        place = " in ".join(filter(None, (path.lstrip("."), source)))
        raise ValueError(f"{place}: {problem}") from error


def _problem(error: BaseException, kind: type | None) -> str:
    if isinstance(error, ForbiddenExtraKeysError):
        unknown, known = sorted(map(str, error.extra_fields)), sorted(item.name for item in fields(error.cl))
        return f"there is no setting {', '.join(unknown)}; use some of {known}"
    return str(error)


@cache
def _converter() -> Converter:
    """Converts tuples to lists and back, and takes no value of another type than a field's."""
    converter = Converter(forbid_extra_keys=True, unstruct_collection_overrides={tuple: list})
    for kind in (bool, int, float, str):
        converter.register_structure_hook(kind, _strict)
    converter.register_structure_hook_func(_is_choice, _choice)
    converter.register_structure_hook_func(_is_union, lambda value, hint: _one_of(converter, value, hint))
    return converter


def _strict(value: Any, kind: type) -> Any:
    if kind is float and type(value) is int:
        return float(value)
    if type(value) is not kind:
        raise ValueError(f"a value of type {kind.__name__} is needed, got {value!r}")
    return value


def _is_choice(hint: Any) -> bool:
    origin: Any = get_origin(hint)
    return origin is Literal


def _choice(value: Any, hint: Any) -> Any:
    if value not in get_args(hint):
        raise ValueError(f"one of {list(get_args(hint))} is needed, got {value!r}")
    return value


def _is_union(hint: Any) -> bool:
    return get_origin(hint) in (Union, UnionType)


def _one_of(converter: Converter, value: Any, hint: Any) -> Any:
    """``value`` as the first type of a union that it fits."""
    for kind in get_args(hint):
        if kind is NoneType:
            if value is None:
                return None
            continue
        if isinstance(value, str) and kind is not str:
            continue  # a text is no sequence of letters here
        try:
            return converter.structure(value, kind)
        except (ValueError, TypeError, BaseValidationError):
            continue
    raise ValueError(f"a value of type {hint} is needed, got {value!r}")
