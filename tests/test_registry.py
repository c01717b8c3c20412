"""Registry: parts by name, by entry point and by import path."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl.registry import Registry

PART = object()
NAMES = st.from_regex(r"[A-Za-z0-9_.-]+", fullmatch=True)
ModuleWriter = Callable[[str, str], None]


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleWriter:
    """Writes an importable module. Module names must be unique, because Python keeps imported modules."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(name: str, source: str) -> None:
        path = tmp_path.joinpath(*name.split(".")).with_suffix(".py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(source)

    return write


@pytest.fixture
def entry_point(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str, str], None]:
    """Adds an entry point, as an installed package does."""
    installed: list[importlib.metadata.EntryPoint] = []

    def entry_points(*, group: str) -> importlib.metadata.EntryPoints:
        return importlib.metadata.EntryPoints(installed).select(group=group)

    def add(group: str, name: str, value: str) -> None:
        installed.append(importlib.metadata.EntryPoint(name, value, group))

    monkeypatch.setattr("rover_rl.registry.entry_points", entry_points)
    return add


@settings(max_examples=25)
@given(NAMES, NAMES)
def test_registered_parts_are_found_by_name(first: str, second: str) -> None:
    built_in = {"built-in": PART}
    registry = Registry("part", built_in)
    parts = {first: object(), second: object(), "built-in": PART}
    for name, part in [*parts.items()] * 2:
        registry.register(name, part)
    assert built_in == {"built-in": PART}
    assert registry.names() == sorted(parts)
    assert all(registry.find(name) is part for name, part in parts.items())


@pytest.mark.parametrize("name", ["", "a b", "a:b", "name\n"])
def test_invalid_names_raise(name: str) -> None:
    registry = Registry("part", {})
    with pytest.raises(
        ValueError, match=r"^the name of a part must consist of letters, digits, '_', '-' and '\.', got"
    ):
        registry.register(name, PART)
    assert registry.names() == []


def test_a_taken_name_raises_and_keeps_the_first_part() -> None:
    registry = Registry("part", {"built-in": PART})
    registry.register("mine", PART)
    for name in ("built-in", "mine"):
        with pytest.raises(ValueError, match=f"^a part named '{name}' already exists; choose another name$"):
            registry.register(name, object())
        assert registry.find(name) is PART


def test_parts_are_found_by_import_path(module: ModuleWriter) -> None:
    module("registry_path_part", "class Outer:\n    inner = 'nested'\n\npart = ['part']\n")
    registry = Registry("part", {})
    part = registry.find("registry_path_part:part")
    assert part == ["part"]
    assert registry.find("registry_path_part:part") is part
    assert registry.find("registry_path_part:Outer.inner") == "nested"
    assert registry.names() == []
    module("registry_package.__init__", "")
    module("registry_package.parts", "part = 'in a package'\n")
    assert registry.find("registry_package.parts:part") == "in a package"
    with pytest.raises(ValueError, match="cannot be imported: No module named 'registry_package.others'"):
        registry.find("registry_package.others:part")


@pytest.mark.parametrize("name", ["registry_gone:part", "registry_gone.parts:part", "registry_gone.part"])
def test_a_missing_module_is_named(name: str) -> None:
    registry = Registry("part", {"a": PART})
    with pytest.raises(ValueError, match=f"^unknown part '{name}': there is no module 'registry_gone'; use one of"):
        registry.find(name)


@pytest.mark.parametrize(
    ("name", "suggestion"),
    [
        ("mooon", ", perhaps 'moon'"),
        ("mazes", ", perhaps 'maze'"),
        ("maze:abc", ", perhaps 'maze'"),
        ("rover_rl.registry.Registry", ", perhaps 'rover_rl.registry:Registry'"),
        ("x", ""),
    ],
)
def test_an_unknown_name_raises_with_the_known_names_and_the_most_similar_one(name: str, suggestion: str) -> None:
    registry = Registry("part", {"moon": PART, "maze": PART}, also=", or a Part")
    expected = rf"^unknown part '{name}'{suggestion}; use one of \['maze', 'moon'\], or a Part$"
    with pytest.raises(ValueError, match=expected):
        registry.find(name)


def test_a_missing_attribute_raises(module: ModuleWriter) -> None:
    module("registry_without_part", "class Outer:\n    pass\n")
    for attribute in ("part", "Outer.inner", "Outer.inner.part"):
        reason = f"'registry_without_part' has no '{attribute}'"
        with pytest.raises(ValueError, match=f"^part '.*:{attribute}' cannot be imported: {reason}$"):
            Registry("part", {}).find(f"registry_without_part:{attribute}")


@pytest.mark.parametrize(
    ("name", "source", "reason"),
    [
        (
            "registry_needs_module",
            "import registry_missing_dependency\n",
            "No module named 'registry_missing_dependency'",
        ),
        ("registry_needs_name", "from math import no_such_name\n", "cannot import name 'no_such_name' from 'math'"),
    ],
)
def test_an_import_error_inside_a_module_is_reported_with_its_reason(
    module: ModuleWriter, name: str, source: str, reason: str
) -> None:
    module(name, source)
    with pytest.raises(ValueError, match=f"^part '{name}:part' cannot be imported: {reason}") as error:
        Registry("part", {}).find(f"{name}:part")
    assert isinstance(error.value.__cause__, ImportError)


@pytest.mark.parametrize("name", ["os:abort", "builtins:exec"])
def test_import_paths_into_the_standard_library_raise(name: str) -> None:
    with pytest.raises(ValueError, match=f"^part '{name}' is in Python's standard library, which has no parts$"):
        Registry("part", {}).find(name)


def test_entry_points_of_installed_packages_are_found(
    entry_point: Callable[[str, str, str], None], module: ModuleWriter
) -> None:
    module("registry_installed_part", "part = 'installed'\n")
    entry_point("rover_rl.parts", "theirs", "registry_installed_part:part")
    entry_point("rover_rl.others", "other", "registry_installed_part:part")
    registry = Registry("part", {"built-in": PART})
    assert registry.names() == ["built-in", "theirs"]
    assert registry.find("theirs") == "installed"
    with pytest.raises(
        ValueError, match=r"^unknown part 'other', perhaps 'theirs'; use one of \['built-in', 'theirs'\]"
    ):
        registry.find("other")
