"""The sensor of the page "Your own sensor", in a package of the user's, used from the command line."""

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

SENSOR = "my_sensors.sensors:RangeFinder"
OBSERVATION = ["lidar", "imu", "target", "velocities", "range"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The current folder, with the package and a run that was trained with its sensor."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "my_sensors").mkdir()
    (folder / "my_sensors" / "__init__.py").touch()
    page = (ROOT / "docs" / "own_sensor.md").read_text(encoding="utf-8")
    (folder / "my_sensors" / "sensors.py").write_text(blocks(page, "python")[0].code)
    size = ["--total-steps", "128", "--num-envs", "4", "--workers", "1", "--rollout-length", "4", "--hidden", "8"]
    with pytest.MonkeyPatch.context() as patch, quick_workers():
        patch.chdir(folder)
        # The command finds the package in the current folder.
        patch.setattr(sys, "path", [*sys.path])
        own = ["--sensors", SENSOR, "--observation", *OBSERVATION]
        assert main(["train", "--world", "moon", *own, *size, "--name", "own"]) == 0
        yield folder
    for name in [name for name in sys.modules if name.startswith("my_sensors")]:
        del sys.modules[name]


@pytest.mark.slow
def test_the_run_and_the_checkpoint_name_the_sensor(folder: Path) -> None:
    config = yaml.safe_load((folder / "runs" / "own" / "config.yaml").read_text())
    assert config["env"]["sensors"] == [SENSOR]
    assert config["network"]["observation"] == OBSERVATION
    assert Checkpoint.load("runs/own").make_actor().in_keys == OBSERVATION


@pytest.mark.slow
def test_the_policy_is_evaluated_filmed_and_exported(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "runs/own", "--count", "2", "--seconds", "1", "--workers", "1"]) == 0
    (evaluation,) = json.loads((folder / "runs" / "own" / "evaluation.json").read_text())
    assert evaluation["env"]["sensors"] == [SENSOR]
    assert main(["film", "runs/own", "--out", "own.gif", "--seconds", "0.5"]) == 0
    assert (folder / "own.gif").stat().st_size > 1000
    assert main(["export", "runs/own", "--format", "torch", "--out", "own.pt2"]) == 0
    assert (folder / "own.pt2").stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--observation", "lidar", "range"], "observation must be some of ('lidar', "),
        (["--sensors", "my_sensors.sensors:Nothing"], "has no 'Nothing'"),
    ],
)
def test_a_mistake_is_one_sentence(
    folder: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    assert main(["train", "--world", "moon", *options]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.splitlines()) == 1
