"""The package's import graph has no cycle and follows the layers; its modules have specific names."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "rover_rl"
VAGUE_NAMES = {"utils", "helpers", "common"}

LAYERS = [
    layer.split()
    for layer in """
    checks files names option_names plain progress registry rng tensordicts tiny_xml rotations native
    worlds robots
    sims.rover_state sims.sensor_report sims.settings
    sims.base sims.command_limiter sims.free_space sims.movers sims.rays sims.rendering sims.scenes sims.world_groups
    sims.bullet sims.mujoco sims.ros2 sims.warp
    sims.backends sims.effective_track
    sims.__init__
    envs
    tasks
    algos.archives algos.config algos.config_files algos.workers
    algos.policy algos.pretrained
    algos.driving
    algos.train
    algos.evaluation
    algos.benchmarks algos.calibration algos.deploy algos.experiments algos.video
    algos.__init__
    view
    cli
    __init__
    """.strip().splitlines()
]
"""Layers of the package, bottom first. A module imports from its own layer and from layers below.

A name stands for a module or for a package with everything in it; ``sims.__init__`` stands for that file alone.
"""

SIMULATORS = ("sims.bullet", "sims.mujoco", "sims.ros2", "sims.warp")
SEPARATE = {
    **{name: tuple({*SIMULATORS} - {name}) for name in SIMULATORS},
    "envs": SIMULATORS,
    "robots": ("sims", "worlds"),
    "worlds": ("sims", "robots"),
}
"""Packages, and other packages that they do not import, for types either, although the layers would permit it."""


def module_name(path: Path) -> str:
    """``sims/base.py`` is ``sims.base``, and ``sims/__init__.py`` is ``sims.__init__``."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


MODULES = {module_name(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def nodes(node: ast.AST, in_package: bool, types: bool) -> Iterator[ast.AST]:
    """All nodes below ``node``, except for imports for types and, in a package, its lazy ``__getattr__``."""
    skipped = not types and isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
    for child in node.orelse if skipped else ast.iter_child_nodes(node):  # type: ignore[attr-defined]
        if not types and in_package and isinstance(child, ast.FunctionDef) and child.name == "__getattr__":
            continue
        yield child
        yield from nodes(child, in_package, types)


def imported_names(node: ast.AST) -> Iterator[str]:
    """Dotted names that a node may import: ``from a import b`` gives ``a.b`` if that is a module, otherwise ``a``."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, "imports are absolute"
        for alias in node.names:
            name = f"{node.module}.{alias.name}"
            yield name if resolve(name) else str(node.module)
    elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
        yield from (str(value.value) for value in node.args if isinstance(value, ast.Constant))


def resolve(name: str) -> str | None:
    """The module of a dotted name, or ``None`` outside of the package."""
    first, _, rest = name.partition(".")
    if first != PACKAGE.name:
        return None
    return next((module for module in (rest, f"{rest}.__init__".lstrip(".")) if module in MODULES), None)


@cache
def imports(types: bool = False) -> list[tuple[str, str]]:
    """Pairs of a module and one that it imports, also in functions, and with ``types`` also for types alone."""
    found = [
        (module, resolve(name))
        for module, path in MODULES.items()
        for node in nodes(ast.parse(path.read_text(encoding="utf-8")), module.endswith("__init__"), types)
        for name in imported_names(node)
    ]
    return [(importer, imported) for importer, imported in dict.fromkeys(found) if imported is not None]


def contains(name: str, module: str) -> bool:
    return module == name or module.startswith(f"{name}.")


def layer_of(module: str) -> int:
    """Index of a module's layer, or -1 if the table does not list it."""
    return next((k for k, names in enumerate(LAYERS) if any(contains(name, module) for name in names)), -1)


def test_the_import_graph_has_no_cycle_not_even_for_types() -> None:
    graph: dict[str, set[str]] = {module: set() for module in MODULES}
    for importer, imported in imports(types=True):
        graph[importer].add(imported)
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        # The error lists the modules against the direction of the imports.
        pytest.fail("import cycle: " + " -> ".join(reversed(error.args[1])))


def test_every_module_has_a_layer_and_the_tables_name_what_exists() -> None:
    assert [module for module in MODULES if layer_of(module) < 0] == []
    names = {name for layer in LAYERS for name in layer} | {*SEPARATE, *(n for many in SEPARATE.values() for n in many)}
    assert {name for name in names if not any(contains(name, module) for module in MODULES)} == set()


def test_no_module_imports_from_a_layer_above() -> None:
    assert [pair for pair in imports(types=True) if layer_of(pair[0]) < layer_of(pair[1])] == []


def test_separate_parts_do_not_import_each_other() -> None:
    forbidden = [
        (importer, imported)
        for importer, imported in imports(types=True)
        for name, others in SEPARATE.items()
        if contains(name, importer) and any(contains(other, imported) for other in others)
    ]
    assert forbidden == []


def test_no_module_has_a_vague_name() -> None:
    """Modules are named for what they hold."""
    assert [module for module in MODULES if module.rpartition(".")[2] in VAGUE_NAMES] == []


def test_a_strangers_way_through_the_environment_is_short() -> None:
    way = ("envs/rover.py", "envs/task.py", "envs/rewards.py", "sims/warp/simulator.py")
    files = [
        PACKAGE.parent / "README.md",
        *(PACKAGE / name for name in way),
        PACKAGE.parent / "examples/torchrl_ppo.py",
    ]
    lines = [len(file.read_text(encoding="utf-8").splitlines()) for file in files]
    assert lines[1] <= 400
    assert sum(lines) <= 2000
    assert len({imported for importer, imported in imports(types=True) if importer == "envs.rover"}) <= 18
