"""Docstrings in the API reference.

The reference documents an object once, under the name by which users import it, such as ``rover_rl.World``. Docstrings
and annotations may name it by the module that defines it, by a package that imports it, or without a module.
"""

from __future__ import annotations

import re
from functools import reduce
from importlib import import_module
from typing import Any

from docutils.nodes import Element
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.nodes import make_refnode


def setup(app: Sphinx) -> dict[str, Any]:
    """Connects the extension to a build."""
    app.connect("missing-reference", resolve)
    app.connect("html-page-context", unlink_source)
    app.connect("autodoc-process-signature", shorten_factories)
    # Before napoleon, whose priority is 500.
    app.connect("autodoc-process-docstring", keep_colon, priority=400)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}


def shorten_factories(
    app: Sphinx, what: str, name: str, thing: object, options: object, signature: str | None, returned: str | None
) -> tuple[str | None, str | None]:
    """Writes defaults that a dataclass computes as ``...``, which Sphinx can parse."""
    return signature and signature.replace("<factory>", "..."), returned


def keep_colon(app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Keeps napoleon from reading the words before a colon in the docstring of an attribute as its type.

    An empty comment in front of the docstring has no colon.
    """
    if what in ("attribute", "data", "property") and lines:
        lines[:0] = ["..", ""]


def unlink_source(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: object) -> None:
    """Removes the links from source code to the reference: viewcode does not know the documented names."""
    if page.startswith("_modules/"):
        context["body"] = re.sub(r'<a class="viewcode-back".*?</a>', "", context["body"])


def resolve(app: Sphinx, env: BuildEnvironment, node: pending_xref, content: Element) -> Element | None:
    """Returns a link to the documented name of an object, or ``None`` if there is none."""
    if node.get("refdomain") != "py":
        return None
    objects = env.domains["py"].data["objects"]
    target, module = node["reftarget"], node.get("py:module")
    names = (name for name in (target, f"{module}.{target}") if name.startswith("rover_rl."))
    found = next(filter(None, (_documented(name, objects) for name in names)), None) or _only(target, objects)
    if found is None:
        return None
    entry = objects[found]
    return make_refnode(app.builder, node["refdoc"], entry.docname, entry.node_id, content, found)


def _documented(name: str, objects: dict[str, Any]) -> str | None:
    """Returns the name under which the object of a dotted name is documented, or ``None``."""
    owner, _, attribute = name.rpartition(".")
    paths = (_path(_find(name)), f"{_path(_find(owner))}.{attribute}")
    return next((path for path in paths if path in objects), None)


def _only(name: str, objects: dict[str, Any]) -> str | None:
    """Returns the documented name that ends in ``name`` if there is one alone, or ``None``."""
    ending = {(entry.docname, entry.node_id): path for path, entry in objects.items() if path.endswith(f".{name}")}
    return next(iter(ending.values())) if len(ending) == 1 else None


def _path(thing: Any) -> str:
    return f"{getattr(thing, '__module__', None)}.{getattr(thing, '__qualname__', None)}"


def _find(name: str) -> Any:
    """Returns the object of a dotted name, or ``None``."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            module = import_module(".".join(parts[:count]))
        except ImportError:
            continue
        try:
            return reduce(getattr, parts[count:], module)
        except AttributeError:
            return None
    return None
