from __future__ import annotations

import json
from pathlib import Path

import pytest

from rover_rl.algos.config import SACConfig, read_config
from rover_rl.cli import main


def failed(capsys: pytest.CaptureFixture[str], *args: object) -> str:
    """Runs a command that fails; returns its one line of complaint."""
    assert main([str(arg) for arg in args]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    return captured.err


def test_help_shows_units_and_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["train", "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for expected in ("--world", "--num-envs", "default: 64", "--max-minutes", "Steps to train for"):
        assert expected in text


def test_unknown_worlds_are_refused_in_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    expected = "rover-rl: unknown world 'mars'; use one of ['inspect', 'maze', 'moon']"
    assert failed(capsys, "train", "--world", "mars", "--runs", tmp_path).startswith(expected)
    assert failed(capsys, "demo", "--world", "mars", "--runs", tmp_path).startswith(expected)


def test_checkpoints_that_are_none_are_refused_in_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert failed(capsys, "evaluate", tmp_path / "no.pt").startswith("rover-rl: no checkpoint at")
    (tmp_path / "foreign.pt").write_text("not a checkpoint")
    assert "no checkpoint of rover_rl" in failed(capsys, "evaluate", tmp_path / "foreign.pt")


def test_settings_out_of_range_are_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert "num_envs must be at least 1" in failed(capsys, "train", "--num-envs", 0)


def test_unknown_options_exit_with_2(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["train", "--sped", "3"])
    assert stop.value.code == 2


SIZE = ["--num-envs", "4", "--workers", "1", "--decisions", "8", "--total-steps", "128"]


def test_train_go_on_then_evaluate(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["train", "--algo", "ppo", "--runs", str(tmp_path), "--name", "run", "--epochs", "1", *SIZE]) == 0
    folder = tmp_path / "run"
    told = capsys.readouterr().out
    assert str(folder / "checkpoint.pt") in told
    assert "Time went into: simulator" in told
    assert (folder / "learning_curve.png").is_file()
    assert "already" in failed(capsys, "train", "--runs", tmp_path, "--name", "run")

    assert main(["train", "--resume", str(folder), "--total-steps", "256"]) == 0
    assert "after 256 steps" in capsys.readouterr().out

    out = tmp_path / "results"
    options = ["--count", "2", "--seconds", "1"]
    assert main(["evaluate", str(folder), "scripted", *options, "--out", str(out)]) == 0
    assert {file.name for file in out.iterdir()} == {"evaluation.csv", "evaluation.json", "paths.png"}
    assert "scripted" in capsys.readouterr().out


def test_a_policy_is_trained_and_driven_in_warp(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    pytest.importorskip("warp", reason="needs rover_rl[warp]")
    folder = tmp_path / "run"
    given = ["train", "--backend", "warp", "--randomize", "--runs", str(tmp_path), "--name", "run", "--epochs", "1"]
    assert main([*given, *SIZE]) == 0
    driven = ["evaluate", str(folder), "--backend", "warp", "--count", "2", "--seconds", "1", "--out", str(tmp_path)]
    assert main(driven) == 0
    assert (tmp_path / "evaluation.json").is_file()
    capsys.readouterr()
    assert "presets of the physics are Bullet's" in failed(capsys, *given, "--physics", "fast")


def test_settings_come_from_a_file_and_options_go_first(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("algo: sac\nworld: moon\nhidden: [16]\nwarmup: 16\n")
    runs = ["--runs", str(tmp_path), "--name", "run"]
    assert main(["train", "--config", str(tmp_path / "mine.yaml"), *runs, *SIZE, "--gradient-steps", "1"]) == 0
    config = read_config(tmp_path / "run" / "config.yaml")
    assert isinstance(config, SACConfig)
    assert (config.world, config.hidden, config.num_envs, config.gradient_steps) == ("moon", (16,), 4, 1)
    capsys.readouterr()
    assert "--algo is ppo" in failed(capsys, "train", "--config", tmp_path / "mine.yaml", "--algo", "ppo")
    assert "give one of them" in failed(capsys, "train", "--config", tmp_path / "mine.yaml", "--resume", tmp_path)
    assert "no settings at" in failed(capsys, "train", "--resume", tmp_path / "nothing")
    assert "does not know: ['sped']" in failed(capsys, "train", "--config", written(tmp_path, "algo: ppo\nsped: 3"))


def test_settings_can_be_those_of_a_pretrained_policy(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    given = ["--config", "pretrained:maze-ppo", "--runs", str(tmp_path), *SIZE, "--max-minutes", "1e-6"]
    assert main(["train", *given]) == 0
    assert (read_config(tmp_path / "ppo-maze" / "config.yaml").world) == "maze"
    capsys.readouterr()
    assert "no pretrained policy 'mars-ppo'" in failed(capsys, "train", "--config", "pretrained:mars-ppo")


def written(folder: Path, text: str) -> Path:
    path = folder / "given.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(("algo", "own", "other"), [("ppo", "--lmbda", "--tau"), ("sac", "--tau", "--lmbda")])
def test_help_shows_the_settings_of_the_algorithm(
    capsys: pytest.CaptureFixture[str], algo: str, own: str, other: str
) -> None:
    with pytest.raises(SystemExit):
        main(["train", "--algo", algo, "--help"])
    text = capsys.readouterr().out
    assert own in text
    assert other not in text


def test_worlds_are_listed_and_drawn(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["worlds", "--out", str(tmp_path)]) == 0
    assert {file.name for file in tmp_path.iterdir()} == {"inspect.png", "maze.png", "moon.png"}
    assert "moon" in capsys.readouterr().out


@pytest.mark.slow
def test_the_demo_trains_and_shows_a_pretrained_policy(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rover_rl.cli.demo.FILMED", 1.0)
    short = ["--world", "inspect", "--minutes", "1e-6", "--count", "1", "--num-envs", "4", "--runs", str(tmp_path)]
    assert main(["demo", *short]) == 0
    folder = tmp_path / "ppo-inspect"
    told = capsys.readouterr().out
    for picture in ("learning_curve.png", "paths.png", "inspect-ppo.gif"):
        assert str(folder / picture) in told
        assert (folder / picture).stat().st_size > 1000
    policies = {row["policy"] for row in json.loads((folder / "evaluation.json").read_text())}
    assert policies == {"trained", "pretrained", "random"}
