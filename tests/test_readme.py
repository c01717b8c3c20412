"""What the README shows, runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"
BLOCKS = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)


def test_the_readme_has_programs():
    assert len(BLOCKS) >= 5


@pytest.mark.parametrize("block", BLOCKS, ids=range(len(BLOCKS)))
def test_programs_run(block, capsys):
    # Training is tested elsewhere, in less time.
    code = re.sub(r"\.learn\([\d_]+\)", "", block)
    names = {"poses": None, "goals": None, "env": __import__("rover_rl").RoverEnv(world_n="maze")}
    exec(compile(code, str(README), "exec"), names)


def test_files_that_it_shows_exist():
    for name in re.findall(r"\]\((docs/[^)]+)\)", README.read_text()):
        assert (README.parent / name).is_file(), name


def test_it_names_the_two_commands():
    assert "make demo" in README.read_text()
    assert "make test" in README.read_text()
