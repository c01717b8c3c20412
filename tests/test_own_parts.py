"""A package of the user's with a world, a robot, a reward, a backend and a sensor, used from the command line."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.cli import main
from tests.fork_server import quick_workers
from tests.pages import ROOT, blocks

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
SENSOR = "my_package.sensors:RangeFinder"
"""The sensor of the page "Your own sensor"."""
OBSERVATION = ["lidar", "imu", "target", "velocities", "range"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The current folder, with the package and a run that was trained with its parts, by two workers."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "my_package").mkdir()
    (folder / "my_package" / "__init__.py").touch()
    (folder / "my_package" / "parts.py").write_text(PACKAGE)
    page = (ROOT / "docs" / "own_sensor.md").read_text(encoding="utf-8")
    (folder / "my_package" / "sensors.py").write_text(blocks(page, "python")[0].code)
    size = ["--total-steps", "128", "--num-envs", "4", "--workers", "2", "--rollout-length", "4", "--hidden", "8"]
    size += ["--lidar.points", "16", "--sensors", SENSOR, "--observation", *OBSERVATION, "--name", "own"]
    with pytest.MonkeyPatch.context() as patch, quick_workers():
        patch.chdir(folder)
        # The command finds the package in the current folder.
        patch.setattr(sys, "path", [*sys.path])
        assert main(["train", *PARTS, *size]) == 0
        yield folder
    for name in [name for name in sys.modules if name.startswith("my_package")]:
        del sys.modules[name]


@pytest.mark.slow
def test_the_run_and_the_checkpoint_name_the_parts(folder: Path) -> None:
    config = yaml.safe_load((folder / "runs" / "own" / "config.yaml").read_text())
    env = config["env"]
    assert [env[part] for part in ("world", "robot", "reward", "backend")] == PARTS[1::2]
    assert (env["lidar"]["points"], env["sensors"]) == (16, [SENSOR])
    assert config["network"]["observation"] == OBSERVATION
    assert Checkpoint.load("runs/own").make_actor().in_keys == OBSERVATION


@pytest.mark.slow
def test_the_policy_is_evaluated_filmed_exported_and_trained_on(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = "runs/own"
    assert main(["evaluate", run, "--count", "2", "--seconds", "1", "--backend", "my_package.parts:Slow"]) == 0
    (evaluation,) = json.loads((folder / "runs" / "own" / "evaluation.json").read_text())
    assert evaluation["env"]["robot"] == "my_package.parts:scout"
    assert evaluation["env"]["backend"] == "my_package.parts:Slow"
    assert evaluation["env"]["sensors"] == [SENSOR]
    assert main(["film", run, "--out", "own.gif", "--seconds", "0.5", "--rewards", "rewards.png"]) == 0
    assert main(["export", run, "--format", "torch", "--out", "own.pt2"]) == 0
    assert min((folder / name).stat().st_size for name in ("own.gif", "rewards.png", "own.pt2")) > 1000
    capsys.readouterr()
    assert main(["train", "--resume", run, "--total-steps", "256"]) == 0
    assert "after 256 steps" in capsys.readouterr().out


@pytest.mark.slow
def test_a_mismatch_or_a_mistake_is_one_sentence(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "other.yaml").write_text(
        "lidar: {points: 32}\nrobot: my_package.parts:scout\nsensors: [" + SENSOR + "]\n"
    )
    (folder / "forward.yaml").write_text("action: {min_speed: 0.0}\n")
    mistakes = {
        "evaluate runs/own --env other.yaml": "made for lidar points 16, and the environment has 32",
        "evaluate pretrained:moon-ppo --robot my_package.parts:scout": "made for the robot rover_zero, and the "
        "environment has my_package.parts:scout",
        "evaluate pretrained:moon-ppo --env forward.yaml": "and the environment has (0.0, 1.0,",
        "train --observation lidar range": "observation must be some of ('lidar', ",
        "train --sensors my_package.sensors:Nothing": "has no 'Nothing'",
    }
    for line, message in mistakes.items():
        assert main(line.split()) == 2
        error = capsys.readouterr().err
        assert message in error
        assert len(error.splitlines()) == 1
