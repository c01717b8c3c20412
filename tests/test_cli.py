from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import rover_rl
from rover_rl.algos.config import SACConfig, task_config, training_config, with_settings
from rover_rl.algos.config_files import read_config
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.names import NO_POLICY
from rover_rl.algos.policy.networks import ObservationEncoder, make_actor
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.algos.train import train, untrained
from rover_rl.algos.video.film import film
from rover_rl.cli import main
from rover_rl.cli.demo import Demo
from rover_rl.cli.train import train_defaults
from rover_rl.envs.config import EnvConfig, Randomization
from rover_rl.envs.imperfections import imperfect
from rover_rl.tasks import get_task
from rover_rl.worlds import WORLDS
from tests.full_disk import largest_file


def exits(capsys: pytest.CaptureFixture[str], line: str, code: int) -> str:
    """Parses a command line that ends the program; returns what is printed."""
    with pytest.raises(SystemExit) as stop:
        main(line.split())
    assert stop.value.code == code
    captured = capsys.readouterr()
    assert "" in captured
    return captured.out or captured.err


def test_the_program_has_a_version_and_help_with_a_line_for_each_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert exits(capsys, "--version", 0) == f"rover-rl {rover_rl.__version__}\n"
    text = exits(capsys, "--help", 0)
    assert [line.split()[0] for line in text.splitlines() if line.startswith("  ")] == COMMANDS


def test_the_help_of_a_command_has_its_options_with_defaults(capsys: pytest.CaptureFixture[str]) -> None:
    text = exits(capsys, "train --help", 0)
    for expected in ("--world", "--lidar.points", "(default: 512)", "Number of steps to train for"):
        assert expected in text
    assert text.index("--max-minutes") < text.index("--world") < text.index("--gamma")
    assert "--lmbda" in text
    text = exits(capsys, "train --algo sac --help", 0)
    assert "--tau" in text
    assert "--lmbda" not in text


COMMANDS = [
    *("train", "evaluate", "compare", "benchmark", "play", "view", "film", "tasks", "worlds", "robots", "demo"),
    *("robot", "drive", "calibrate", "dataset", "export"),
]
NAMES = f"use one of {COMMANDS}; see rover-rl --help"


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("", f"a command is missing; {NAMES}"),
        ("trian --seed 1", f"unknown command 'trian', perhaps 'train'; {NAMES}"),
        ("evaluate", NO_POLICY),
        # Numbers and worlds out of range.
        ("train --seed -1", "seed must be a whole number from 0 to "),
        ("evaluate scripted --world maze --count -3", "count must be between 1 and 256, got -3"),
        ("evaluate scripted --world maze --seconds nan", "seconds must be at least 0.05 and at most 1e+06, got nan"),
        ("film scripted --width 99999999 --out film.gif", "width must be positive and at most 8192, got 99999999"),
        ("train --world nowhere", f"unknown world 'nowhere'; use one of {sorted(WORLDS)}, 'name:seed'"),
        ("train --hidden 1000000000000", "not enough memory"),
        ("train --backend warp --world maze --physics fast", "unknown physics 'fast'"),
    ],
)
def test_a_wrong_command_line_is_refused_in_one_line(failed: Callable[..., str], line: str, expected: str) -> None:
    assert failed(*line.split()).startswith(f"rover-rl: {expected}")


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("worlds impor x", ("impor", "import, show", "rover-rl worlds --help")),
        ("benchmark", ("barn", "jaxnav")),
        ("benchmark barn scripted", ("--data", "Folder of the public repository")),
        ("train --sped 3", ("--sped", "--seed", "rover-rl train --help")),
        ("train --lidar.points x", ("--lidar.points INT", "'x'")),
        ("drive x --goal 1", ("--goal", "FLOAT FLOAT")),
        ("train --task.stuck-window 0", ("task", "stuck_window must be positive, got 0")),
        ("train --action.min-speed 2 --action.max-speed 1", ("action", "min_speed must be less than max_speed")),
    ],
)
def test_options_that_a_command_does_not_take_are_refused_with_what_it_takes(
    capsys: pytest.CaptureFixture[str], line: str, named: tuple[str, ...]
) -> None:
    told = exits(capsys, line, 2)
    assert [part for part in named if part not in told] == []


def test_a_run_without_a_checkpoint_says_what_to_do(failed: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("algo: ppo\n")
    expected = f"no checkpoint at {tmp_path}/checkpoint.pt: the run has written none yet; if it has ended, go on with"
    assert failed("evaluate", tmp_path) == f"rover-rl: {expected} rover-rl train --resume {tmp_path}\n"
    assert "is not the folder of a run" in failed("evaluate", tmp_path.parent)
    assert "is damaged, or no checkpoint" in failed("evaluate", tmp_path / "config.yaml")
    assert failed("evaluate", tmp_path / "no.pt").startswith("rover-rl: no checkpoint at")
    (tmp_path / "foreign.pt").write_text("not a checkpoint")
    assert "no checkpoint of rover_rl" in failed("evaluate", tmp_path / "foreign.pt")


def test_settings_that_cannot_be_read_are_refused_in_one_line(failed: Callable[..., str], tmp_path: Path) -> None:
    for text in ("algo: [\n", "[" * 5000, "algo: ppo\nday: 2001-99-99\n"):
        assert "given.yaml is no YAML" in failed("train", "--config", written(tmp_path, text))
    assert "must name an algo" in failed("train", "--config", written(tmp_path, "algo: [ppo]\n"))
    assert "is a folder, and settings are in a file" in failed("train", "--config", tmp_path)
    assert "is not the folder of a run" in failed("train", "--resume", tmp_path)
    for half in ("", "algo: ppo\nworld: mo"):
        (tmp_path / "config.yaml").write_text(half)
        assert "config.yaml is empty, or cut short" in failed("train", "--resume", tmp_path)


FILM = "film scripted --world maze --backend warp --seconds 0.1 --width 64 --height 48 --out"


def test_without_space_the_file_is_named_and_nothing_is_left(
    failed: Callable[..., str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    # Compiling kernels writes files.
    assert main([*FILM.split(), str(tmp_path / "before.gif")]) == 0
    (tmp_path / "before.gif").unlink()
    evaluate = "evaluate scripted --world maze --backend warp --count 1 --seconds 0.2 --out"
    capsys.readouterr()
    with largest_file(100):
        for line, file in (
            (f"{FILM} {tmp_path}/film.gif", "film.gif"),
            (f"train --runs {tmp_path} --name run", "run/config.yaml"),
        ):
            assert failed(*line.split()) == f"rover-rl: {tmp_path}/{file}: File too large\n"
        assert main([*evaluate.split(), str(tmp_path)]) == 2
    told = capsys.readouterr()
    assert told.err == f"rover-rl: {tmp_path}/evaluation.json: File too large\n"
    # Results are shown where they cannot be written.
    assert "scripted" in told.out
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


SIZE = ["--num-envs", "4", "--workers", "1", "--rollout-length", "4", "--total-steps", "16", "--hidden", "16"]


@pytest.mark.slow
def test_train_go_on_then_evaluate(
    failed: Callable[..., str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    given = ["train", "--algo", "ppo", "--world", "maze", "--randomize", "--epochs", "1", *SIZE]
    reward = "tests.envs.test_specs:CollisionHeat"
    with pytest.warns(UserWarning, match=f"no component of reward='{reward}' pays for a goal"):
        assert main([*given, "--reward", reward, "--runs", str(tmp_path), "--name", "run"]) == 0
    folder = tmp_path / "run"
    told = capsys.readouterr().out
    assert str(folder / "checkpoint.pt") in told
    assert "Time went into: simulator" in told
    assert (folder / "learning_curve.png").is_file()
    assert "already" in failed("train", "--runs", tmp_path, "--name", "run")

    with pytest.warns(UserWarning, match="pays for a goal"):
        assert main(["train", "--resume", str(folder), "--total-steps", "128"]) == 0
    assert "after 128 steps" in capsys.readouterr().out
    message = failed("train", "--resume", folder, "--world", "moon")
    assert f"{folder} is trained with world='maze'" in message
    assert f"use --from {folder}" in message

    out = tmp_path / "results"
    options = ["--count", "2", "--seconds", "0.2"]
    assert main(["evaluate", str(folder), "scripted", "--backend", "warp", *options, "--out", str(out)]) == 0
    names = {"evaluation.csv", "evaluation-summary.csv", "evaluation.json", "paths.png"}
    assert {file.name for file in out.iterdir()} == names
    assert "scripted" in capsys.readouterr().out


def test_settings_come_from_a_file_and_options_go_first(failed: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("algo: sac\nworld: maze\nhidden: [8]\nlearning_starts: 8\n")
    runs = ["--runs", str(tmp_path), "--name", "run"]
    size = ["--num-envs", "4", "--workers", "1", "--rollout-length", "4", "--total-steps", "32"]
    assert main(["train", "--config", str(tmp_path / "mine.yaml"), *runs, *size, "--gradient-steps", "1"]) == 0
    config = read_config(tmp_path / "run" / "config.yaml")
    assert isinstance(config.algorithm, SACConfig)
    assert config.algorithm.learning_starts == 8
    parts = (config.env.world, config.network.hidden, config.env.num_envs, config.algorithm.gradient_steps)
    assert parts == ("maze", (8,), 4, 1)
    assert "--algo is ppo" in failed("train", "--config", tmp_path / "mine.yaml", "--algo", "ppo")
    assert "give one of them" in failed("train", "--config", tmp_path / "mine.yaml", "--resume", tmp_path)
    assert "no settings at" in failed("train", "--resume", tmp_path / "nothing")
    assert "does not know: ['sped']" in failed("train", "--config", written(tmp_path, "algo: ppo\nsped: 3"))


def test_a_file_changes_settings_of_a_task(failed: Callable[..., str], tmp_path: Path) -> None:
    calibrated = written(tmp_path, "algo: ppo\nenv:\n  randomization: {latency: [2, 3]}\n")
    size = ["--num-envs", "4", "--rollout-length", "4", "--total-steps", "16", "--epochs", "1"]
    runs = ["--runs", str(tmp_path), "--name", "run"]
    assert main(["train", "late", "--learner", "ppo", "--config", str(calibrated), *size, *runs]) == 0
    config, task = read_config(tmp_path / "run" / "config.yaml"), get_task("late")
    assert config.env.randomization == Randomization(latency=(2, 3))
    assert (config.env.world, config.env.pose) == (task.env.world, task.env.pose)
    assert "the learner is sac" in failed("train", "late", "--learner", "sac", "--config", calibrated)
    assert "give one of them" in failed("train", "late", "--config", "pretrained:anywhere")


def test_a_policy_is_trained_further_in_another_world(failed: Callable[..., str], tmp_path: Path) -> None:
    given = ["--from", "pretrained:moon-ppo", "--world", "maze", "--total-steps", "16", "--num-envs", "4"]
    assert main(["train", *given, "--rollout-length", "4", "--runs", str(tmp_path), "--name", "run"]) == 0
    config, source = read_config(tmp_path / "run" / "config.yaml"), load_pretrained("moon-ppo").config
    chosen = (config.run.started_from, config.env.world, config.network)
    assert chosen == ("pretrained:moon-ppo", "maze", source.network)
    assert config.algorithm.learning_rate < source.algorithm.learning_rate
    assert (config.run.total_steps, config.run.max_minutes) == (16, None)
    given = ["train", "--from", tmp_path / "run", "--runs", tmp_path / "more"]
    assert "hidden=(128, 128) of the policy" in failed(*given, "--hidden", "8")
    assert "the policy was made for lidar points 32" in failed(*given, "--lidar.points", "16")
    assert "give one of them" in failed(*given, "--resume", tmp_path / "run")
    assert "no checkpoint at" in failed("train", "--from", tmp_path / "nothing")
    assert not (tmp_path / "more").exists()


def written(folder: Path, text: str) -> Path:
    path = folder / "given.yaml"
    path.write_text(text)
    return path


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Addresses that were opened in a viewer. There is no display."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    addresses: list[str] = []
    monkeypatch.setattr("webbrowser.open", addresses.append)
    return addresses


def test_play_films_a_policy_and_opens_the_film_on_a_display(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, opened: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    given = ["play", "scripted", "--world", "maze", "--seconds", "0.1"]
    assert main(given) == 0
    film = Path("runs/play/scripted-maze.gif")
    told = capsys.readouterr().out
    assert told.startswith("Filming scripted\n")
    assert "From none of 8 starts, a goal was reached within 0.1 s: this is the first" in told
    assert f"Film: {film}: time limit after 0.1 s\n" in told
    assert film.stat().st_size > 1000
    assert opened == []
    monkeypatch.setenv("DISPLAY", ":0")
    assert main(given) == 0
    assert opened == [film.resolve().as_uri()]


def test_play_films_a_trained_policy_in_its_world_and_folder(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, opened: list[str]
) -> None:
    config = training_config("ppo", world="maze:3", hidden=(8,))
    Checkpoint(config=config, steps=0, actor=make_actor(hidden=(8,)).state_dict()).save(tmp_path / "checkpoint.pt")
    assert main(["play", str(tmp_path), "--seconds", "0.1"]) == 0
    film = tmp_path / f"{tmp_path.name}-maze-3.gif"
    assert f"Film: {film}: " in capsys.readouterr().out
    assert film.is_file()
    assert main(["play", str(tmp_path / "nothing")]) == 2
    assert "no checkpoint at" in capsys.readouterr().err


@pytest.mark.slow
def test_the_demo_tests_a_policy_before_and_after_its_training_films_it_and_compares_a_pretrained_one(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rover_rl.cli.demo.FILMED", 0.2)
    monkeypatch.setattr("rover_rl.cli.demo.UNSEEN", {"field:50000-50001@1": "obstacles"})
    make_config = Demo._config
    small = {"num_envs": 4, "workers": 1, "rollout_length": 8, "epochs": 1, "minibatch": 16}
    monkeypatch.setattr(Demo, "_config", lambda demo: with_settings(make_config(demo), **small))
    filmed: list[Any] = []

    def recorded(policy: Any, *args: Any, **options: Any) -> Any:
        filmed.append(policy)
        return film(policy, *args, **options)

    monkeypatch.setattr("rover_rl.algos.video.film.film", recorded)
    short = ["--minutes", "1e-6", "--episodes", "2", "--seconds", "0.5", "--runs", str(tmp_path)]
    assert main(["demo", *short]) == 0
    folder = tmp_path / "demo-inspect"
    config = read_config(folder / "config.yaml")
    assert (config.env.backend, config.env.world, config.run.task_name) == ("warp", "inspect", "inspect")
    # A policy from nothing: neither a planner nor an expert helps.
    assert (config.network.prior, config.algorithm.imitation) == ("none", 0.0)
    rows = json.loads((folder / "evaluation.json").read_text())
    assert [row["policy"] for row in rows] == ["policy after 0 steps", "policy after 128 steps"]
    assert {(row["env"]["backend"], row["env"]["task"]["collision_from"]) for row in rows} == {("warp", "contact")}
    starts = [[episode["shortest"] for episode in row["episodes"]] for row in rows]
    assert len(starts[0]) == 2
    assert starts == [starts[0]] * 2
    (policy,) = filmed
    trained = Checkpoint.load(folder).make_actor().state_dict()
    assert all(torch.equal(value, trained[name]) for name, value in policy.state_dict().items())

    told = capsys.readouterr().out
    for picture in ("test_curve.png", "film.gif"):
        assert str(folder / picture) in told
        assert (folder / picture).stat().st_size > 1000
    # There is no terminal, so that each phase is told by lines, without a bar.
    lines = told.splitlines()
    assert lines[0] == "1. A policy that has learned nothing drives inspect (the first time, Warp compiles)"
    assert "It reaches 0% of 2 goals" in lines
    assert any(line.startswith("training 100% after") for line in lines)
    compared = r"obstacles \(field:50000-50001@1\): crowd \d+%, gridplanner-moving \d+%, scripted \d+%"
    assert any(re.fullmatch(compared, line) for line in lines)
    assert lines[-2] == f"More of the trained policy: rover-rl play {folder}"
    assert "\x1b" not in told
    assert "━━━━━━━━━━" not in told


def test_the_training_begins_with_the_untrained_policy_of_its_seed(tmp_path: Path) -> None:
    small = {"num_envs": 2, "workers": 1, "rollout_length": 4, "epochs": 1, "minibatch": 8, "total_steps": 32}
    config = task_config("inspect", seed=3, runs=str(tmp_path), learning_rate=1e-30, **small)
    before, after = untrained(config), Checkpoint.load(train(config).folder)
    assert before.steps == 0
    assert all(torch.allclose(value, after.actor[name], atol=1e-20) for name, value in before.actor.items())
    other = untrained(with_settings(config, seed=4))
    assert not all(torch.allclose(value, other.actor[name]) for name, value in before.actor.items())


def test_robot_and_drive_take_the_description_of_an_environment(failed: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "tank.yaml").write_text("robot: tank\n")
    assert "unknown robot 'tank'" in failed("robot", "--env", tmp_path / "tank.yaml")
    assert "unknown world 'mars'" in failed("robot", "--env", tmp_path / "tank.yaml", "--world", "mars")
    (tmp_path / "forward.yaml").write_text("action: {min_speed: 0.0}\n")
    driven = ["drive", "pretrained:moon-ppo", "--goal", "1", "1", "--dry-run", "--bag", tmp_path / "drive.mcap"]
    message = failed(*driven, "--env", tmp_path / "forward.yaml")
    assert "the policy was made for actions" in message
    assert "there is no setting sped" in failed("robot", "--env", written(tmp_path, "sped: 3"))


def test_drive_refuses_other_worlds_for_a_policy_that_knows_one_map_and_goals_outside_of_it(
    failed: Callable[..., str], tmp_path: Path
) -> None:
    for folder, north_up in (("knows", True), ("free", False)):
        config = training_config("ppo", world="maze:3", hidden=(8,), north_up=north_up, mirror_augmentation=False)
        actor = make_actor(ObservationEncoder(north_up=north_up), hidden=(8,)).state_dict()
        (tmp_path / folder).mkdir()
        Checkpoint(config=config, steps=0, actor=actor).save(tmp_path / folder / "checkpoint.pt")
    elsewhere = ["--world", "moon", "--goal", "1", "1", "--goal", "99", "0"]
    known, outside = "recognizes the places of maze:3, where it was trained, and --world is moon", "the goal 99 0 is"
    assert known in failed("drive", tmp_path / "knows", *elsewhere)
    assert outside in failed("drive", tmp_path / "knows", *elsewhere, "--allow-other-world")
    assert outside in failed("drive", tmp_path / "free", *elsewhere)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--backend my_parts:number", "backend must be one of ['bullet', 'mujoco', 'ros2', 'warp']"),
        ("--backend my_parts:needy", "backend 'my_parts:needy' is called with 0 arguments: missing a required"),
        ("--reward my_parts:needy", "reward 'my_parts:needy' is called with 0 arguments: missing a required"),
        ("--world my_parts:needier", "world 'my_parts:needier' is called with 1 arguments: missing a required"),
        ("--reward my_parts:number", "got 4"),
        ("--backend ray", "Ray is a collector: use collector='ray'"),
    ],
)
def test_parts_and_settings_that_do_not_work_are_one_sentence(
    failed: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: str, message: str
) -> None:
    (tmp_path / "my_parts.py").write_text(
        "number = 4\n\ndef needy(what):\n    return what\n\ndef needier(seed, what):\n    return what\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert message in failed("train", *options.split(), "--runs", tmp_path / "runs")
    assert not (tmp_path / "runs").exists()


def test_training_is_randomized_by_the_name_of_a_preset() -> None:
    def env(*given: str) -> EnvConfig:
        return train_defaults(["train", "--world", "maze", *given]).config.env

    assert env().randomization == Randomization()
    assert env("--randomize") == imperfect(env(), "typical")
    assert env("--randomize", "harsh").randomization.scan_latency == (0, 4)
    with pytest.raises(ValueError, match="--randomize takes one name, got late noise"):
        env("--randomize", "late", "noise")


@pytest.mark.parametrize(
    ("option", "command"),
    [
        ("--runs", ["train", "--world", "maze", "--runs", "OUT"]),
        ("--html", ["evaluate", "scripted", "--world", "maze", "--html", "OUT/page.html"]),
        ("--out", ["film", "scripted", "--out", "OUT/film.gif"]),
        ("--out", ["export", "pretrained:moon-sac", "--out", "OUT/sac.onnx"]),
        ("--bag", ["drive", "pretrained:moon-sac", "--goal", "1", "0", "--bag", "OUT/drive.mcap"]),
        ("--out", ["worlds", "show", "maze", "--out", "OUT/maze.png"]),
    ],
)
def test_a_place_that_cannot_be_written_to_is_told_with_the_option_that_names_another(
    option: str, command: list[str], failed: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A file in place of the folder, and a folder that is read-only, which root does not notice.
    file, folder = tmp_path / "file", tmp_path / "folder"
    file.touch()
    folder.mkdir()
    usual = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != folder and usual(path, mode))
    for place, reason in ((file, "is no folder"), (folder, "may not be written to")):
        told = failed(*(word.replace("OUT", str(place)) for word in command))
        assert f"cannot be written, since {place} {reason}: name another place with {option}\n" in told
