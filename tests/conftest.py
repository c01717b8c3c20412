"""All tests of a run share a cache on disk, which is empty at first; those that register parts forget them.

Compiled kernels of Warp are kept from run to run: their names are hashes of what they are compiled from.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from rover_rl.envs import parts
from tests.extras import BACKENDS
from tests.pages import ROOT, blocks

# No test depends on how fast the machine is.
settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")

_FOLDER = pytest.StashKey[str]()
_REGISTRIES = ("sims.backends", "robots", "worlds", "envs.rewards")


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> str:
    """Name of a simulation backend."""
    return request.param


@pytest.fixture
def failed(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command that fails; returns its one line of complaint."""
    from rover_rl.cli import main

    def run(*args: object) -> str:
        capsys.readouterr()
        assert main([str(arg) for arg in args]) == 2
        captured = capsys.readouterr()
        assert (captured.out, captured.err.count("\n")) == ("", 1)
        return captured.err

    return run


@pytest.fixture
def own_registries(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forgets the parts that a test registers: other tests compare the lists of names."""
    for module in _REGISTRIES:
        registry = import_module(f"rover_rl.{module}")._REGISTRY
        monkeypatch.setattr(registry, "_parts", dict(registry._parts))
    for registry in (parts.ACTIONS, parts.TERMINATIONS, parts.EVENTS, parts.TASKS):
        monkeypatch.setattr(registry, "_parts", dict(registry._parts))


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of the package in a cache on disk that no other test uses."""
    folder = tmp_path / "cache"
    folder.mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    return folder / "rover_rl"


@pytest.fixture
def guide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own_registries: None) -> str:
    """Import path of the backend that ``docs/backends.md`` builds, in a module of its own."""
    page, *_ = blocks((ROOT / "docs" / "backends.md").read_text(), "python")
    (tmp_path / "guide_backend.py").write_text(page.code)
    monkeypatch.syspath_prepend(tmp_path)
    return "guide_backend:Kinematic"


def pytest_configure(config: pytest.Config) -> None:
    """Moves the cache to an empty folder. Processes of pytest-xdist inherit that of the first one."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        caches = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        os.environ.setdefault("WARP_CACHE_PATH", str(Path(caches, "warp")))
        config.stash[_FOLDER] = os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="rover_rl-tests-")


def pytest_collection_finish() -> None:
    """Lets one process compile a kernel that all others wait for. In an empty cache, each would compile it."""
    from rover_rl.native.warp import wp

    module = type(wp.get_module(__name__))
    compiled = module._compile

    def in_turn(self: Any, *args: Any, **options: Any) -> bool:
        with open(Path(os.environ["XDG_CACHE_HOME"], f"{self.name}.lock"), "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            return compiled(self, *args, **options)

    module._compile = in_turn


def pytest_unconfigure(config: pytest.Config) -> None:
    """Removes the folder."""
    folder = config.stash.get(_FOLDER, None)
    if folder:
        shutil.rmtree(folder, ignore_errors=True)
