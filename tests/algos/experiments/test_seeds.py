from __future__ import annotations

from pathlib import Path

import pytest

from rover_rl.algos.config import training_config, with_settings
from rover_rl.algos.experiments.runs import seed_runs
from rover_rl.cli import main
from tests.algos.experiments.records import write_run
from tests.algos.train.runs import FIELD

TINY = [
    *("--world", FIELD, "--backend", "warp", "--num-envs", "4", "--hidden", "8"),
    *("--rollout-length", "4", "--minibatch", "8", "--epochs", "1"),
]
"""Options of a training that takes no time."""


def test_each_seed_has_a_folder(tmp_path: Path) -> None:
    config = training_config("ppo", world="maze:0-9", runs=str(tmp_path))
    runs = seed_runs(config, (0, 7))
    assert [(run.run.name, run.seed, folder) for run, folder in runs] == [
        ("ppo-maze-0-9-seed0", 0, None),
        ("ppo-maze-0-9-seed7", 7, None),
    ]
    assert seed_runs(with_settings(config, name="mine"), [3])[0][0].run.name == "mine-seed3"


def test_runs_that_exist_are_continued_with_their_own_backend_if_all_else_is_the_same(tmp_path: Path) -> None:
    config = training_config("ppo", runs=str(tmp_path), name="mine")
    write_run(tmp_path / "mine-seed1", with_settings(config, seed=1, backend="warp", workers=1))
    (_, new), (run, folder) = seed_runs(config, (0, 1))
    assert (new, folder, run.env.backend) == (None, tmp_path / "mine-seed1", "warp")
    with pytest.raises(FileExistsError, match="other settings of gamma, total_steps; choose another --name"):
        seed_runs(with_settings(config, gamma=0.5, total_steps=7), [1])
    with pytest.raises(FileExistsError, match="other settings of algo"):
        seed_runs(training_config("sac", runs=str(tmp_path), name="mine"), [1])


@pytest.mark.slow
def test_one_command_trains_all_seeds_and_one_compares_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["train", *TINY, "--total-steps", "64", "--logger", "csv", "--runs", str(tmp_path), "--name", "mine"]
    assert main([*line, "--seeds", "0"]) == 0
    rows = (tmp_path / "mine-seed0" / "progress.csv").read_bytes()
    assert "To compare them with others: rover-rl compare " + str(tmp_path / "mine\n") in capsys.readouterr().out
    # The same command with one more seed does not train the others again.
    assert main([*line, "--seeds", "0", "1"]) == 0
    assert (tmp_path / "mine-seed0" / "progress.csv").read_bytes() == rows
    assert (tmp_path / "mine-seed1" / "csv" / "scalars" / "loss_critic.csv").is_file()
    capsys.readouterr()
    assert main(["compare", str(tmp_path / "mine"), "--out", str(tmp_path / "compared")]) == 0
    assert "mine" in capsys.readouterr().out
    assert {file.suffix for file in (tmp_path / "compared").iterdir()} == {".png", ".csv", ".json"}


def test_a_run_that_diverges_does_not_keep_the_others_from_training(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    trained: list[int] = []

    def one(config: object, folder: object, **options: object) -> int:
        seed = config.seed  # type: ignore[attr-defined]
        trained.append(seed)
        if seed == 0:
            raise FloatingPointError("training diverged")
        return 130 if seed == 2 else 0

    monkeypatch.setattr("rover_rl.cli.train.train_one", one)
    line = ["train", *TINY, "--runs", str(tmp_path), "--seeds"]
    assert main([*line, "0", "1"]) == 2
    assert "rover-rl: training diverged" in capsys.readouterr().err
    assert main([*line, "2", "3"]) == 130
    assert "The same command continues it" in capsys.readouterr().out
    assert trained == [0, 1, 2]
