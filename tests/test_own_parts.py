"""A package of the user's with a world, a robot, a reward and a backend, used from the command line."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

PACKAGE = """
from dataclasses import dataclass, replace

import torch

from rover_rl import RewardComponent, Terrain, World, box, contract_reward
from rover_rl.sims import make_simulator
from rover_rl.sims.robots import get_robot


def canyon(seed):
    generator = torch.Generator().manual_seed(seed)
    places = torch.rand(5, 2, generator=generator) * 8 - 4
    boxes = [box((x, y, 0.5), (0.6, 0.6, 1.0)) for x, y in places.tolist()]
    return World(f"canyon-{seed}", Terrain.flat((12, 12)), boxes)


def scout():
    return replace(get_robot("rover_zero"), name="scout", max_linear_acceleration=2.0)


class TiltPenalty(RewardComponent):
    name = "tilt"

    def value(self, outcome, observation):
        return -0.1 * observation["imu"][:, :2].abs().sum(-1, keepdim=True)


def gentle():
    return [*contract_reward(), TiltPenalty()]


@dataclass(frozen=True)
class Slow:
    factor: float = 0.5

    def make(self, **arguments):
        return SlowSimulator(make_simulator("bullet", **arguments), self.factor)


class SlowSimulator:
    def __init__(self, simulator, factor):
        self.simulator, self.factor = simulator, factor

    def __getattr__(self, name):
        return getattr(self.simulator, name)

    def step(self, commands, active=None):
        return self.simulator.step(self.factor * commands, active)
"""
PARTS = [
    *("--world", "my_package.parts:canyon:3", "--robot", "my_package.parts:scout"),
    *("--reward", "my_package.parts:gentle", "--backend", "my_package.parts:Slow"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package and a run that was trained with its parts, by two workers."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "my_package").mkdir()
    (folder / "my_package" / "__init__.py").touch()
    (folder / "my_package" / "parts.py").write_text(PACKAGE)
    size = ["--total-steps", "256", "--num-envs", "4", "--workers", "2", "--rollout-length", "4", "--hidden", "8"]
    rover_rl(folder, "train", *PARTS, *size, "--lidar.points", "16", "--name", "own")
    return folder


def rover_rl(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    result = run(folder, *arguments)
    assert result.returncode == 0, result.stderr
    return result


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    code = "import sys; from rover_rl.cli import main; sys.exit(main())"
    paths = os.pathsep.join(filter(None, (str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH"))))
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
def test_the_run_names_the_parts(folder: Path) -> None:
    env = yaml.safe_load((folder / "runs" / "own" / "config.yaml").read_text())["env"]
    assert [env[part] for part in ("world", "robot", "reward", "backend")] == PARTS[1::2]
    assert env["lidar"]["points"] == 16


@pytest.mark.slow
def test_the_policy_is_evaluated_and_filmed_and_trained_on(folder: Path) -> None:
    rover_rl(folder, "evaluate", "runs/own", "--count", "2", "--seconds", "1", "--backend", "my_package.parts:Slow")
    (evaluation,) = json.loads((folder / "runs" / "own" / "evaluation.json").read_text())
    assert evaluation["env"]["robot"] == "my_package.parts:scout"
    assert evaluation["env"]["backend"] == "my_package.parts:Slow"
    rover_rl(folder, "film", "runs/own", "--out", "own.gif", "--seconds", "0.5", "--rewards", "rewards.png")
    assert (folder / "own.gif").stat().st_size > 1000
    assert "after 512 steps" in rover_rl(folder, "train", "--resume", "runs/own", "--total-steps", "512").stdout


@pytest.mark.slow
def test_a_mismatch_is_one_sentence(folder: Path) -> None:
    (folder / "other.yaml").write_text("lidar: {points: 32}\nrobot: my_package.parts:scout\n")
    (folder / "forward.yaml").write_text("action: {min_speed: 0.0}\n")
    mismatches = {
        ("runs/own", "--env", "other.yaml"): "made for lidar points 16, and the environment has 32",
        ("pretrained:moon-ppo", "--robot", "my_package.parts:scout"): "made for the robot rover_zero, and the "
        "environment has my_package.parts:scout",
        ("pretrained:moon-ppo", "--env", "forward.yaml"): "and the environment has (0.0, 1.0,",
    }
    for arguments, message in mismatches.items():
        result = run(folder, "evaluate", *arguments, "--count", "1")
        assert result.returncode == 2
        assert message in result.stderr
        assert len(result.stderr.splitlines()) == 1
