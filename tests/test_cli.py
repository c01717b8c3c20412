from __future__ import annotations

from pathlib import Path

import pytest

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


def test_train_then_evaluate(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    size = ["--num-envs", "4", "--decisions", "8", "--total-steps", "128", "--epochs", "1"]
    assert main(["train", "--algo", "ppo", "--runs", str(tmp_path), "--name", "run", *size]) == 0
    checkpoint = tmp_path / "run" / "checkpoint.pt"
    assert str(checkpoint) in capsys.readouterr().out
    assert (tmp_path / "run" / "learning_curve.png").is_file()
    assert "already" in failed(capsys, "train", "--runs", tmp_path, "--name", "run")

    out = tmp_path / "results"
    assert main(["evaluate", str(checkpoint), "--count", "2", "--seconds", "1", "--out", str(out)]) == 0
    assert {file.name for file in out.iterdir()} == {"evaluation.json", "evaluation.csv", "paths.png"}
    assert "random" in capsys.readouterr().out


def test_worlds_are_listed_and_drawn(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["worlds", "--out", str(tmp_path)]) == 0
    assert {file.name for file in tmp_path.iterdir()} == {"inspect.png", "maze.png", "moon.png"}
    assert "moon" in capsys.readouterr().out
