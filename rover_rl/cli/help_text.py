"""Help texts of the commands: what tyro makes of the dataclasses, as sentences that are not cut, without ``None``."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from typing import Annotated, Any

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

FLAT = tyro.conf.arg(name="")
"""Options have no prefix of their part: --world and --hidden, not --env.world and --network.hidden."""
_UNSET = ("None", "")  # defaults that say nothing


class ReadableHelp(ConstructorRegistry):
    """Reads options as tyro does, and changes what their help says.

    Of the dataclasses in ``shown``, only the fields of these names are options.
    """

    def __init__(self, shown: Mapping[Any, Collection[str]] | None = None) -> None:
        super().__init__()
        self._shown = shown or {}
        self._asking = False
        self.primitive_rule(self._value)
        self.struct_rule(self._options)

    def _value(self, info: PrimitiveTypeInfo) -> Any:
        found = self._others(self.get_primitive_spec, info)
        if not isinstance(found, PrimitiveConstructorSpec) or "None" not in found.metavar:
            return None
        metavar = re.sub(r"\{None\}\||\|\{None\}", "", found.metavar).replace("{None,", "{")
        # Braces around what is no choice held it together beside the other.
        return replace(found, metavar=re.sub(r"^\{([^{},|]*)\}$", r"\1", metavar))

    def _options(self, info: StructTypeInfo) -> StructConstructorSpec | None:
        found = self._others(self.get_struct_spec, info)
        if not isinstance(found, StructConstructorSpec):
            return found
        shown = self._shown.get(info.type)
        return replace(found, fields=tuple(_described(one) for one in found.fields if not shown or one.name in shown))

    def _others(self, ask: Callable[[Any], Any], info: Any) -> Any:
        if self._asking:
            return None
        self._asking = True
        try:
            return ask(info)
        finally:
            self._asking = False


def _described(field: StructFieldSpec) -> StructFieldSpec:
    """Joins the lines of a description, without its markup, and tells the default where the description does not."""

    def text() -> str | None:
        told = field.helptext() if callable(field.helptext) else field.helptext
        joined = told and re.sub(r"(?<!\n)\n\s*(?!\n)", " ", told)
        return joined and re.sub(r":[a-z:]+:`~?([^`]*)`|``([^`]*)``", lambda found: found[1] or found[2], joined)

    def hint(default: str) -> str:
        return "" if default in _UNSET or "Default: " in (text() or "") else f"(default: {default})"

    kind: Any = Annotated[field.type, tyro.conf.arg(help_behavior_hint=hint)]
    return replace(field, type=kind, helptext=text)
