"""The Python blocks of the README and of the pages in ``docs/`` run."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"
PAGES = (README, *(README.parent / "docs" / name for name in ("torchrl.md", "extending.md", "training.md")))
BLOCKS = [
    pytest.param(block, id=f"{page.stem}-{number}")
    for page in PAGES
    for number, block in enumerate(re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL))
]
INLINE_BLOCKS = [block for block in BLOCKS if "__main__" not in block.values[0]]
SCRIPT_BLOCKS = [block for block in BLOCKS if "__main__" in block.values[0]]


def test_the_pages_have_python_blocks():
    assert len(INLINE_BLOCKS) >= 10
    assert len(SCRIPT_BLOCKS) >= 2


@pytest.fixture
def own_registries(monkeypatch):
    """Forgets the parts that a test registers: other tests compare the lists of names."""
    for module in ("rover_rl.sims.backends", "rover_rl.sims.robots", "rover_rl.sims.worlds", "rover_rl.envs.rewards"):
        registry = import_module(module)._REGISTRY
        monkeypatch.setattr(registry, "_parts", dict(registry._parts))


@pytest.mark.parametrize("block", INLINE_BLOCKS)
@pytest.mark.usefixtures("own_registries")
def test_blocks_run(block, capsys):
    # Shortens or skips training, which has its own tests.
    code = re.sub(r"\.learn\([\d_]+\)", "", block)
    code = re.sub(r"\b1_000\b", "100", code)
    code = re.sub(r"total_frames=\d+_000", "total_frames=320", code)
    names = {"poses": None, "goals": None, "env": __import__("rover_rl").RoverEnv(world_n="maze")}
    exec(compile(code, "<page>", "exec"), names)


@pytest.mark.slow
@pytest.mark.parametrize("block", SCRIPT_BLOCKS)
def test_blocks_that_start_processes_run(block, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(block)
    environment = {**os.environ, "PYTHONPATH": str(README.parent)}
    done = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "(" in done.stdout


def test_linked_files_exist():
    for name in re.findall(r"\]\((docs/[^)]+)\)", README.read_text()):
        assert (README.parent / name).is_file(), name


def test_the_readme_names_make_demo_and_make_test():
    assert "make demo" in README.read_text()
    assert "make test" in README.read_text()
