"""Stopped and killed runs continue where they were."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
import torch

from rover_rl.algos.config import TrainingConfig, with_settings
from rover_rl.algos.config_files import read_config, read_sessions
from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.train.run import TrainingSummary
from rover_rl.algos.train.run_folder import save_run
from rover_rl.cli import main
from tests.algos.train.runs import PPO, SAC, before_updates, progress_of, run, state_of
from tests.fork_server import fork_server

Trained = Callable[[str], TrainingSummary]
OwnRun = Callable[[TrainingConfig], Path]


@pytest.mark.parametrize(("config", "number"), [(PPO, signal.SIGINT), (SAC, signal.SIGTERM)])
def test_a_stopped_run_continues_where_it_was(
    config: TrainingConfig, number: signal.Signals, trained: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = trained(config.algo)
    handlers = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    before_updates(monkeypatch, config.algo, lambda update, *_: update == 2 and os.kill(os.getpid(), number))
    first = run(config, tmp_path, name="stopped")
    assert first.interrupted
    assert len(progress_of(first.folder)["updates"]) == 2
    assert Checkpoint.load(first.checkpoint).steps == first.steps
    second = run(config, tmp_path, first.folder, name="stopped")
    assert not second.interrupted
    counters = ("updates", "steps", "gradient_steps", "learning_rate")
    assert [progress_of(second.folder)[key] for key in counters] == [progress_of(whole.folder)[key] for key in counters]
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == handlers


def test_a_run_that_trains_is_continued_nowhere_else_and_evaluated_meanwhile(
    own_run: OwnRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = PPO
    folder, found = own_run(config), []

    def meanwhile(*_: object) -> None:
        for options in ({}, {"total_steps": 1024}, {"max_minutes": 9.0}):
            with pytest.raises(BlockingIOError, match=f"{folder} is being trained by process {os.getpid()} on "):
                run(config, tmp_path, folder, **options)
        with pytest.raises(FileExistsError, match="already"):
            run(config, tmp_path, name=folder.name)
        actor = Checkpoint.load(folder).make_actor()
        found.append(evaluate(actor, draw_episodes("maze", 1, 0), seconds=0.1))

    before_updates(monkeypatch, config.algo, meanwhile)
    more = 256 + config.num_envs * config.algorithm.rollout_length * config.collection.action_repeat
    assert run(config, tmp_path, folder, total_steps=more).steps == more
    assert len(found) == 1
    # It is free again, also after a session that fails.
    monkeypatch.undo()
    with pytest.raises(ValueError, match="is trained with"):
        run(config, tmp_path, folder, gamma=0.5)
    assert run(config, tmp_path, folder, total_steps=more).reached_before == ("total_steps",)
    assert not (folder / "training.lock").exists()


def test_a_run_that_has_reached_its_limit_says_so_and_what_continues_it(
    own_run: OwnRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = own_run(PPO)

    def told(*options: str) -> str:
        capsys.readouterr()
        assert main(["train", "--resume", str(folder), *options]) == 0
        return capsys.readouterr().out

    reached = f"{folder} had reached its limit before and was trained no further, after 256 steps in "
    longer = f"To train it longer: rover-rl train --resume {folder} "
    assert reached in (text := told())
    assert f"{longer}--total-steps T, with T above 256\n" in text
    assert f"{longer}--total-steps T, with T above 256\n" in told("--total-steps", "200")
    assert f"{longer}--max-minutes M, with M above 0." in told("--total-steps", "999", "--max-minutes", "1e-9")
    both = told("--max-minutes", "1e-9")
    assert f"{longer}--total-steps T --max-minutes M, with T above 256 and M above 0." in both
    assert "Finished" not in text + both
    assert "Finished after 320 steps" in told("--total-steps", "257")


def test_the_record_lists_sessions_with_other_settings_once_they_have_trained(
    own_run: OwnRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = own_run(PPO)
    path = folder / "config.yaml"
    written = path.read_text()
    # Its budget is used: nothing is trained with the new learning rate.
    run(PPO, tmp_path, folder, learning_rate=1e-5)
    assert path.read_text() == written
    longer = with_settings(PPO, runs=str(tmp_path), learning_rate=1e-5, total_steps=320)
    assert run(longer, tmp_path, folder).steps == 320
    assert read_config(path) == longer
    expected = [{"from_step": 256, "changed": {"learning_rate": 1e-5, "total_steps": 320}}]
    assert read_sessions(path) == expected
    assert "continues after 256 steps with" in capsys.readouterr().out
    run(longer, tmp_path, folder, total_steps=384)
    assert [session["from_step"] for session in read_sessions(path)] == [256, 320]


def test_what_cannot_be_gone_on_with_raises_and_is_not_overwritten(own_run: OwnRun, tmp_path: Path) -> None:
    folder = own_run(PPO)
    files = {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}
    with pytest.raises(ValueError, match=r"trained with world='maze', hidden=\[16\], and a run that"):
        run(PPO, tmp_path, folder, hidden=(8,), world="moon")
    state = state_of(folder)
    name = next(name for name in state["learner"]["loss"] if name.startswith("critic."))
    state["learner"]["loss"][name].fill_(torch.inf)
    save_run(folder, Checkpoint.load(folder), state)
    with pytest.raises(ValueError, match=rf"training_state\.pt holds NaN or infinity in the weights {name}: it cannot"):
        run(PPO, tmp_path, folder)
    (folder / "training_state.pt").unlink()
    with pytest.raises(ValueError, match=r"has a checkpoint, but no training_state\.pt to go on from; begin a new run"):
        run(PPO, tmp_path, folder)
    for kept in ("config.yaml", "progress.csv"):
        assert (folder / kept).read_bytes() == files[kept]
    assert Checkpoint.load(folder).steps == 256


@pytest.mark.slow
def test_a_killed_run_continues_without_gaps_or_duplicates(tmp_path: Path) -> None:
    folder = tmp_path / "sac-maze"
    begin = ["--algo", "sac", "--world", "maze", "--runs", str(tmp_path), "--num-envs", "4", "--workers", "1"]
    begin += ["--hidden", "16", "--learning-starts", "24", "--minibatch", "8", "--gradient-steps", "2"]
    begin += ["--snapshots", "10000000", "--total-steps", "1000000000", "--checkpoint-minutes", "0.002"]
    process = start(begin)
    wait_until(lambda: rows(folder) > 9 and (folder / "training_state.pt").is_file(), process)
    process.kill()
    process.join()
    reached = state_of(folder)["steps"]
    assert state_of(folder)["updates"] <= len(progress_of(folder)["updates"])
    assert Checkpoint.load(folder).steps <= reached
    run(read_config(folder / "config.yaml"), tmp_path, folder, total_steps=reached + 160)
    columns = progress_of(folder)
    assert columns["updates"] == list(range(1, len(columns["updates"]) + 1))
    assert columns["steps"] == [16 * update for update in columns["updates"]]
    assert columns["steps"][-1] == reached + 160
    assert columns["minutes"] == sorted(columns["minutes"])


def rows(folder: Path) -> int:
    return len(progress_of(folder).get("updates", ())) if (folder / "progress.csv").is_file() else 0


def start(options: list[str]) -> BaseProcess:
    process: BaseProcess = fork_server().Process(target=command, args=(["train", *options],))  # type: ignore[attr-defined]
    process.start()
    return process


def command(arguments: list[str]) -> None:
    """Runs the command line in a process of its own, without its output."""
    sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    sys.exit(main(arguments))


def wait_until(condition: Callable[[], bool], process: BaseProcess) -> None:
    latest = time.monotonic() + 120
    while not condition():
        assert process.is_alive()
        assert time.monotonic() < latest
        time.sleep(0.05)
