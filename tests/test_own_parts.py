"""A package of the user's with parts of every kind, most of ``docs/extending.md``, used from the command line."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.cli import main
from rover_rl.robots import get_robot
from tests.fork_server import quick_workers
from tests.pages import ROOT, definitions

SLOW = """
from dataclasses import dataclass

from rover_rl.sims import make_simulator


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
DRIVE = """
from dataclasses import dataclass

import torch

from rover_rl.robots.drives import Drive


@dataclass(frozen=True, kw_only=True)
class Tracks(Drive):
    left: tuple[str, ...]
    right: tuple[str, ...]
    width: float = 0.5

    @property
    def motors(self):
        return self.left, self.right

    def matrix(self, wheels):
        return torch.tensor([[1.0, -self.width / 2], [1.0, self.width / 2]]) / wheels.radius
"""
ROBOT = """
from pathlib import Path

from my_package.drive import Tracks
from rover_rl import Robot

WHEELS = ("front_left_wheel", "rear_left_wheel"), ("front_right_wheel", "rear_right_wheel")


def scout():
    drive = Tracks(left=WHEELS[0], right=WHEELS[1], torque=5.0)
    urdf = Path(__file__).with_name("scout.urdf")
    return Robot.from_urdf(urdf, name="scout", drive=drive, sensors=("my_package.sensors:RangeFinder(name='drop')",))
"""
PARTS = [
    *("--world", "my_package.worlds:canyon:3", "--robot", "my_package.robot:scout"),
    *("--reward", "my_package.rewards:gentle", "--backend", "my_package.slow:Slow"),
]
SENSOR = "my_package.sensors:RangeFinder"
OBSERVATION = ["lidar", "imu", "target", "velocities", "drop", "range"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The current folder, with the package and a run that was trained with its parts, by two workers."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "my_package").mkdir()
    (folder / "my_package" / "__init__.py").touch()
    page = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
    files = {"slow": SLOW, "drive": DRIVE, "robot": ROBOT}
    files |= {"worlds": definitions(page, "canyon"), "rewards": definitions(page, "gentle")}
    files |= {"sensors": definitions(page, "RangeFinder")}
    for name, text in files.items():
        (folder / "my_package" / f"{name}.py").write_text(text)
    (folder / "my_package" / "scout.urdf").write_bytes(get_robot("rover_zero").urdf.read_bytes())
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
    assert main(["evaluate", run, "--count", "2", "--seconds", "0.2", "--backend", "my_package.slow:Slow"]) == 0
    (evaluation,) = json.loads((folder / "runs" / "own" / "evaluation.json").read_text())
    assert evaluation["env"]["robot"] == "my_package.robot:scout"
    assert evaluation["env"]["backend"] == "my_package.slow:Slow"
    assert evaluation["env"]["sensors"] == [SENSOR]
    small = ["--seconds", "0.5", "--width", "80", "--height", "60"]
    assert main(["film", run, "--out", "own.gif", *small, "--rewards", "rewards.png"]) == 0
    assert main(["export", run, "--format", "torch", "--out", "own.pt2"]) == 0
    assert min((folder / name).stat().st_size for name in ("own.gif", "rewards.png", "own.pt2")) > 1000
    capsys.readouterr()
    assert main(["train", "--resume", run, "--total-steps", "256"]) == 0
    assert "after 256 steps" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["mujoco", "warp"])
def test_the_robot_drives_in_every_simulator(folder: Path, backend: str) -> None:
    line = ["evaluate", "runs/own", "--backend", backend, "--count", "1", "--seconds", "0.2", "--out", backend]
    assert main(line) == 0
    assert (folder / backend / "evaluation.json").is_file()


@pytest.mark.slow
def test_a_mismatch_or_a_mistake_is_one_sentence(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "other.yaml").write_text(f"lidar: {{points: 32}}\nrobot: my_package.robot:scout\nsensors: [{SENSOR}]\n")
    (folder / "forward.yaml").write_text("action: {min_speed: 0.0}\n")
    scout = "--robot my_package.robot:scout"
    mistakes = {
        "evaluate runs/own --env other.yaml": "made for lidar points 16, and the environment has 32",
        f"evaluate pretrained:moon-ppo {scout}": "robot rover_zero, and the environment has my_package.robot:scout",
        "evaluate pretrained:moon-ppo --env forward.yaml": "and the environment has (0.0, 1.0,",
        "train --observation lidar range": "observation must be some of ('lidar', ",
        "train --sensors my_package.sensors:Nothing": "has no 'Nothing'",
    }
    for line, message in mistakes.items():
        assert main(line.split()) == 2
        error = capsys.readouterr().err
        assert message in error
        assert len(error.splitlines()) == 1
