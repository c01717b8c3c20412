"""The package's import graph has no cycle and follows the layers; its modules have specific names."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import lru_cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).parents[1] / "rover_rl"
VAGUE_NAMES = {"utils.py", "helpers.py", "common.py"}

LAYERS = (
    ("checks", "files", "option_names", "plain", "progress", "registry", "tensordicts"),
    (
        "sims.base",
        "sims.connection",
        "sims.drives",
        "sims.native",
        "sims.robots",
        "sims.rotations",
        "sims.timing",
        "sims.worlds",
    ),
    ("sims.free_space", "sims.ray_kernels", "sims.rays", "sims.rendering"),
    ("sims.bullet", "sims.mujoco", "sims.ros2", "sims.warp"),
    ("sims.backends",),
    ("sims.__init__",),
    ("envs",),
    ("algos.archives", "algos.config", "algos.config_files", "algos.workers"),
    ("algos.policy", "algos.pretrained"),
    ("algos.train",),
    ("algos.evaluation",),
    ("algos.benchmarks", "algos.deploy", "algos.experiments", "algos.video"),
    ("algos.__init__",),
    ("cli",),
    ("__init__",),
)
"""Layers of the package, bottom first. A module imports from its own layer and from layers below.

A name stands for a module or for a package with everything in it; ``sims.__init__`` stands for that file alone.
"""

SEPARATE = {
    "sims.bullet": ("sims.mujoco", "sims.ros2", "sims.warp"),
    "sims.mujoco": ("sims.bullet", "sims.ros2", "sims.warp"),
    "sims.ros2": ("sims.bullet", "sims.mujoco", "sims.warp"),
    "sims.warp": ("sims.bullet", "sims.mujoco", "sims.ros2"),
    "envs": ("sims.bullet", "sims.mujoco", "sims.ros2", "sims.warp"),
}
"""Packages, and other packages that they do not import although the layers would permit it."""


class Import(NamedTuple):
    """Module ``importer`` imports module ``imported`` in line ``line``. Names are relative to ``rover_rl``."""

    importer: str
    imported: str
    line: int

    def __str__(self) -> str:
        path = file_of(self.importer).relative_to(PACKAGE.parent)
        return f"{path}:{self.line} imports {PACKAGE.name}.{self.imported}"


# -----------------------------------------------------------------------------------------------------------
# The graph


def module_name(path: Path) -> str:
    """``sims/base.py`` is ``sims.base``, and ``sims/__init__.py`` is ``sims.__init__``."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


def file_of(module: str) -> Path:
    return PACKAGE.joinpath(*module.split(".")).with_suffix(".py")


@lru_cache
def modules() -> frozenset[str]:
    return frozenset(module_name(path) for path in PACKAGE.rglob("*.py"))


def resolve(name: str) -> str | None:
    """The module of a dotted name, or ``None`` outside of the package."""
    first, _, rest = name.partition(".")
    if first != PACKAGE.name:
        return None
    return next((module for module in (rest, f"{rest}.__init__".lstrip(".")) if module in modules()), None)


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")


def runtime_nodes(node: ast.AST, in_package: bool) -> Iterator[ast.AST]:
    """All nodes below ``node``, except for ``if TYPE_CHECKING:`` blocks and, in a package, its lazy ``__getattr__``."""
    for child in node.orelse if is_type_checking(node) else ast.iter_child_nodes(node):
        if in_package and isinstance(child, ast.FunctionDef) and child.name == "__getattr__":
            continue
        yield child
        yield from runtime_nodes(child, in_package)


def imported_names(node: ast.AST, package: list[str]) -> Iterator[str]:
    """Dotted names that a node imports. ``from a import b`` gives ``a.b`` if that is a module, otherwise ``a``.

    Args:
        node: node of a syntax tree.
        package: parts of the name of the enclosing package, for relative imports.
    """
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        relative = package[: len(package) - node.level + 1] if node.level else []
        source = ".".join([*relative, *filter(None, [node.module])])
        for alias in node.names:
            name = f"{source}.{alias.name}"
            yield name if resolve(name) else source
    elif isinstance(node, ast.Call) and ast.unparse(node.func) in ("import_module", "importlib.import_module"):
        yield from (str(value.value) for value in node.args if isinstance(value, ast.Constant))


def read_imports(module: str, source: str, types: bool = False) -> Iterator[Import]:
    """Imports of a module from the package, including those in functions, and with ``types`` those for types alone."""
    package, tree = [PACKAGE.name, *module.split(".")[:-1]], ast.parse(source)
    for node in ast.walk(tree) if types else runtime_nodes(tree, in_package=module.endswith("__init__")):
        for name in imported_names(node, package):
            imported = resolve(name)
            if imported is not None:
                yield Import(module, imported, node.lineno)


@lru_cache
def imports() -> tuple[Import, ...]:
    """All imports within the package, without duplicates."""
    edges = (edge for module in sorted(modules()) for edge in read_imports(module, file_of(module).read_text()))
    return tuple(dict.fromkeys(edges))


def contains(name: str, module: str) -> bool:
    return module == name or module.startswith(f"{name}.")


def layer_of(module: str) -> int | None:
    """Index of a module's layer, or ``None`` if the table does not list it."""
    return next((k for k, names in enumerate(LAYERS) if any(contains(name, module) for name in names)), None)


# -----------------------------------------------------------------------------------------------------------
# Cycles and layers


def test_the_import_graph_has_no_cycle():
    graph: dict[str, set[str]] = {module: set() for module in modules()}
    for edge in imports():
        graph[edge.importer].add(edge.imported)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        # The error lists the modules against the direction of the imports.
        pytest.fail("import cycle: " + " -> ".join(reversed(error.args[1])))


def test_every_module_has_a_layer():
    unlisted = [module for module in sorted(modules()) if layer_of(module) is None]
    assert not unlisted, f"add to LAYERS: {unlisted}"


def test_every_name_in_the_tables_exists():
    names = {name for layer in LAYERS for name in layer} | {*SEPARATE, *(n for many in SEPARATE.values() for n in many)}
    missing = {name for name in names if not any(contains(name, module) for module in modules())}
    assert not missing, f"no such module or package: {sorted(missing)}"


def test_no_module_imports_from_a_layer_above():
    layers = {module: layer_of(module) for module in modules()}
    listed = [edge for edge in imports() if None not in (layers[edge.importer], layers[edge.imported])]
    upward = [str(edge) for edge in listed if layers[edge.importer] < layers[edge.imported]]
    assert not upward, "\n".join(upward)


def test_separate_parts_do_not_import_each_other():
    forbidden = [
        str(edge)
        for edge in imports()
        for name, others in SEPARATE.items()
        if contains(name, edge.importer) and any(contains(other, edge.imported) for other in others)
    ]
    assert not forbidden, "\n".join(forbidden)


@pytest.mark.parametrize("part", ["sims.robots", "sims.worlds"])
def test_worlds_and_robots_know_neither_each_other_nor_free_space_for_types_either(part):
    others = {"sims.free_space", "sims.robots", "sims.worlds"} - {part}
    files = {module: file_of(module).read_text() for module in sorted(modules()) if contains(part, module)}
    edges = [edge for module, source in files.items() for edge in read_imports(module, source, types=True)]
    found = [str(edge) for edge in edges if any(contains(other, edge.imported) for other in others)]
    assert not found, "\n".join(found)


# -----------------------------------------------------------------------------------------------------------
# Names


def test_no_module_has_a_vague_name():
    vague = [module for module in sorted(modules()) if file_of(module).name in VAGUE_NAMES]
    assert not vague, f"name these modules for what they hold: {vague}"
