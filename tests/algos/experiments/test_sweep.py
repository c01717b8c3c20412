from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from rover_rl.algos.config import TrainingConfig, with_settings
from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.metrics import Estimate
from rover_rl.algos.evaluation.parallel import GoalRequest
from rover_rl.algos.experiments import sweep as sweeps
from rover_rl.algos.experiments.space import read_space
from rover_rl.algos.experiments.sweep import Sweep, draw_trials, print_trials, validation_episodes, write_trials
from rover_rl.cli import main
from tests.algos.evaluation.drives import printed
from tests.algos.experiments.test_seeds import TINY
from tests.algos.train.runs import PPO

CONFIG = with_settings(PPO, world="inspect", backend="warp")
VARY = ["learning_rate=1e-4..3e-3", "gamma=0.9,0.95"]


class Fakes:
    """Stand-ins for training and evaluation, which take long: the result depends on the settings only."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.trained: list[TrainingConfig] = []
        self.interrupt_at = self.diverge_at = -1
        monkeypatch.setattr(sweeps, "train", self.train)
        monkeypatch.setattr(Sweep, "_evaluate", self.evaluate)

    def train(self, config: TrainingConfig, folder: Path | None) -> Any:
        number = len(self.trained)
        self.trained.append(config)
        if number == self.diverge_at:
            raise FloatingPointError("training diverged")

        return SimpleNamespace(interrupted=number == self.interrupt_at, minutes=0.5)

    def evaluate(self, *_: Any) -> Any:
        rate = self.trained[-1].algorithm.learning_rate * 100
        success, seconds = Estimate(rate, rate - 0.01, rate + 0.01), Estimate(9.0, 8.0, 10.0)
        return SimpleNamespace(metrics={"success_rate": success, "mean_time_to_traverse": seconds})


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> Fakes:
    pytest.importorskip("optuna")
    return Fakes(monkeypatch)


def begin(folder: Path, vary: list[str] = VARY, **settings: Any) -> Sweep:
    config = with_settings(CONFIG, **settings)
    return Sweep(config, read_space(vary, config), folder, episodes=4)


def test_a_sweep_that_runs_is_continued_nowhere_else(tmp_path: Path, fakes: Fakes) -> None:
    def meanwhile(text: str) -> None:
        with pytest.raises(BlockingIOError, match=f"{tmp_path} is being trained by process"):
            begin(tmp_path).run(2, print)

    assert begin(tmp_path).run(1, meanwhile)
    assert begin(tmp_path).run(2, print)
    assert len(fakes.trained) == 2


def test_a_sweep_trains_and_finds_the_best_settings(tmp_path: Path, fakes: Fakes) -> None:
    said: list[str] = []
    sweep = begin(tmp_path / "sweep")
    assert sweep.run(4, said.append)
    assert [config.run.name for config in fakes.trained] == ["trial-0", "trial-1", "trial-2", "trial-3"]
    rates = [config.algorithm.learning_rate for config in fakes.trained]
    assert len(set(rates)) == 4
    assert all(1e-4 <= rate <= 3e-3 for rate in rates)
    assert sweep.settings(sweep.finished[0])["learning_rate"] == max(rates)
    assert said[0] == f"Trial 1 of 4: learning_rate={rates[0]:g} gamma={fakes.trained[0].algorithm.gamma:g}"


def test_an_interrupted_sweep_goes_on_as_if_it_had_not_been(tmp_path: Path, fakes: Fakes) -> None:
    begin(tmp_path / "whole").run(4, print)
    whole, fakes.trained = [config.algorithm for config in fakes.trained], []
    fakes.interrupt_at = 1
    assert not begin(tmp_path / "parts").run(4, print)
    fakes.interrupt_at = -1
    sweep = begin(tmp_path / "parts")
    assert len(sweep.finished) == 1
    assert sweep.run(4, print)
    parts = [config.algorithm for config in fakes.trained]
    # The interrupted trial is trained on with its settings.
    assert parts == [*whole[:2], *whole[1:]]


def test_trials_that_fail_are_told_and_left_out(tmp_path: Path, fakes: Fakes) -> None:
    said: list[str] = []
    fakes.diverge_at = 0
    sweep = begin(tmp_path / "sweep")
    assert sweep.run(3, said.append)
    assert "Trial 1 failed: training diverged" in said
    assert len(sweep.finished) == 2


def test_choices_are_tried_once_each(tmp_path: Path, fakes: Fakes) -> None:
    sweep = begin(tmp_path / "sweep", ["gamma=0.9,0.95", "epochs=1,2"])
    assert sweep.run(9, print)
    tried = {(c.algorithm.gamma, c.algorithm.epochs) for c in fakes.trained}  # type: ignore[attr-defined]
    assert (len(fakes.trained), len(tried)) == (4, 4)


def test_a_folder_holds_one_sweep(tmp_path: Path, fakes: Fakes) -> None:
    begin(tmp_path / "sweep")
    begin(tmp_path / "sweep")
    with pytest.raises(FileExistsError, match="with other vary; choose another --name"):
        begin(tmp_path / "sweep", VARY[:1])
    with pytest.raises(FileExistsError, match="with other total_steps; choose another --name"):
        begin(tmp_path / "sweep", total_steps=7)


def test_trials_are_shown(tmp_path: Path, fakes: Fakes) -> None:
    sweep = begin(tmp_path / "sweep", [*VARY, "hidden=[8],[16,16]"])
    sweep.run(4, print)
    text = printed(print_trials, sweep, 80)
    assert max(map(len, text.splitlines())) <= 80
    best = sweep.settings(sweep.finished[0])
    assert f"{best['learning_rate']:g}" in text
    write_trials(sweep, tmp_path / "trials.csv")
    lines = (tmp_path / "trials.csv").read_text().splitlines()
    assert lines[0] == '"trial",learning_rate,gamma,hidden,success,high,low,minutes,seconds'
    assert len(lines) == 5
    draw_trials(sweep, tmp_path / "trials.svg")
    drawn = (tmp_path / "trials.svg").read_text()
    for name in ("learning_rate", "gamma", "hidden", f"best trial: {sweep.finished[0].number}"):
        assert f"<!-- {name} -->" in drawn


def test_trials_are_evaluated_in_episodes_of_their_own() -> None:
    episodes = validation_episodes(CONFIG, 4)
    assert len(episodes) == 4
    assert not (episodes.start == draw_episodes("inspect", 4).start).any()
    mazes = validation_episodes(replace(CONFIG, env=replace(CONFIG.env, world="maze:0-9@0-0.2")), 3)
    assert [world.split("@")[0] for world in map(mazes.world_name, range(3))] == ["maze:9984", "maze:9985", "maze:9986"]


@pytest.mark.slow
def test_one_command_sweeps_two_settings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("optuna")
    # Its policies have hardly been trained, and would drive until the time limit.
    monkeypatch.setattr(sweeps, "GoalRequest", lambda *args: GoalRequest(*args[:2], {**args[2], "seconds": 1.0}))
    line = ["sweep", "--vary", *VARY, "--trials", "2", "--episodes", "2", *TINY, "--total-steps", "64"]
    assert main([*line, "--runs", str(tmp_path), "--name", "mine"]) == 0
    output = capsys.readouterr().out
    assert "gamma: 0.9 or 0.95" in output
    assert f"rover-rl train --config {tmp_path}/mine/trial-" in output
    names = {path.name for path in (tmp_path / "mine").iterdir()}
    assert names == {"sweep.db", "trial-0", "trial-1", "trials.csv", "trials.png"}


def test_sweeps_take_no_seeds(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sweep", "--vary", "gamma=0.9,0.95", "--seeds", "0"]) == 2
    assert "sweep takes neither --seeds nor --resume" in capsys.readouterr().err
