"""The examples run, here with fewer steps than by default."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest
import torch

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture
def run(monkeypatch, capsys):
    """A function that runs an example with arguments and returns its standard output."""
    threads = torch.get_num_threads()

    def run_example(name: str, *arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    yield run_example
    torch.set_num_threads(threads)


def test_every_example_has_a_test():
    assert {path.name for path in EXAMPLES.iterdir()} - {"__pycache__"} == {
        "gymnasium_drive.py",
        "sb3_sac.py",
        "torchrl_ppo.py",
    }


def test_torchrl_ppo(run):
    output = run("torchrl_ppo.py", "--steps", "256", "--rovers", "2")
    assert len(output.splitlines()) == 2
    assert "256 steps" in output


def test_gymnasium_drive_reaches_its_goal(run):
    output = run("gymnasium_drive.py", "--steps", "150")
    assert "goal reached after" in output
    assert "no goal reached" not in output
    assert "16 rovers reached" in output


def test_sb3_sac(run):
    pytest.importorskip("stable_baselines3")
    output = run("sb3_sac.py", "--steps", "64", "--rovers", "2")
    assert "of 2 rovers reached a goal" in output
