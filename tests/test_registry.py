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


def test_invalid_and_taken_names_raise_and_change_nothing() -> None:
    registry = Registry("part", {"built-in": PART})
    registry.register("mine", PART)
    for name in ("", "a b", "a:b", "name\n"):
        with pytest.raises(ValueError, match=r"^the name of a part must consist of letters, digits, '_', '-' and"):
            registry.register(name, PART)
    for name in ("built-in", "mine"):
        with pytest.raises(ValueError, match=f"^a part named '{name}' already exists; choose another name$"):
            registry.register(name, object())
        assert registry.find(name) is PART
    assert registry.names() == ["built-in", "mine"]


def test_parts_are_found_by_import_path(module: ModuleWriter) -> None:
    module("registry_path_part", "class Outer:\n    inner = 'nested'\n\npart = ['part']\n")
    module("registry_package.__init__", "")
    module("registry_package.parts", "part = 'in a package'\n")
    registry = Registry("part", {})
    part = registry.find("registry_path_part:part")
    assert part == ["part"]
    assert registry.find("registry_path_part:part") is part
    assert registry.find("registry_path_part:Outer.inner") == "nested"
    assert registry.find("registry_package.parts:part") == "in a package"
    assert registry.names() == []


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        *((name, ": there is no module 'gone'") for name in ("gone:part", "gone.parts:part", "gone.part")),
        ("mooon", ", perhaps 'moon'"),
        ("maze:abc", ", perhaps 'maze'"),
        ("rover_rl.registry.Registry", ", perhaps 'rover_rl.registry:Registry'"),
        ("x", ""),
    ],
)
def test_an_unknown_name_raises_with_the_known_names_and_the_most_similar_one(name: str, reason: str) -> None:
    registry = Registry("part", {"moon": PART, "maze": PART}, also=", or a Part")
    expected = rf"^unknown part '{name}'{reason}; use one of \['maze', 'moon'\], or a Part$"
    with pytest.raises(ValueError, match=expected):
        registry.find(name)


@pytest.mark.parametrize(
    ("source", "path", "reason"),
    [
        ("class Outer: ...", "part", "'{module}' has no 'part'"),
        ("class Outer: ...", "Outer.inner.part", "'{module}' has no 'Outer.inner.part'"),
        ("import not_installed", "part", "No module named 'not_installed'"),
        ("from math import no_such_name", "part", "cannot import name 'no_such_name' from 'math'"),
    ],
)
def test_a_part_that_cannot_be_imported_is_reported_with_the_reason(
    module: ModuleWriter, request: pytest.FixtureRequest, source: str, path: str, reason: str
) -> None:
    name = f"registry_part_{abs(hash(request.node.name))}"
    module(name, source)
    with pytest.raises(ValueError, match=f"^part '{name}:{path}' cannot be imported: {reason.format(module=name)}"):
        Registry("part", {}).find(f"{name}:{path}")


@pytest.mark.parametrize("name", ["os:abort", "builtins:exec"])
def test_import_paths_into_the_standard_library_raise(name: str) -> None:
    with pytest.raises(ValueError, match=f"^part '{name}' is in Python's standard library, which has no parts$"):
        Registry("part", {}).find(name)


def test_entry_points_of_installed_packages_are_found(module: ModuleWriter, monkeypatch: pytest.MonkeyPatch) -> None:
    module("registry_installed_part", "part = 'installed'\n")
    installed = importlib.metadata.EntryPoints(
        importlib.metadata.EntryPoint(name, "registry_installed_part:part", group)
        for group, name in (("rover_rl.parts", "theirs"), ("rover_rl.others", "other"))
    )
    monkeypatch.setattr("rover_rl.registry.entry_points", lambda *, group: installed.select(group=group))
    registry = Registry("part", {"built-in": PART})
    assert registry.names() == ["built-in", "theirs"]
    assert registry.find("theirs") == "installed"
    with pytest.raises(ValueError, match="^unknown part 'other', perhaps 'theirs'"):
        registry.find("other")
