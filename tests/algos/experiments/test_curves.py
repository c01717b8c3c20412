from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import torch
from matplotlib.image import imread

from rover_rl.algos.config import training_config
from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.evaluate import Evaluation
from rover_rl.algos.experiments.curves import COMPARED, draw_learning_curve
from tests.algos.evaluation.drives import FIELD, line
from tests.algos.experiments.records import write_run


def texts(path: Path) -> str:
    """The text of an SVG file, which contains each label as a comment."""
    assert path.suffix == ".svg"
    return path.read_text()


def scripted() -> Evaluation:
    """An evaluation of one episode."""
    episodes = EpisodeSet("field", FIELD, 0, torch.zeros(1, 3), torch.ones(1, 2), torch.ones(1))
    return Evaluation("scripted", episodes, 1, 60.0, [line("goal")])


def test_a_learning_curve_does_not_depend_on_the_number_of_rows(tmp_path: Path) -> None:
    pictures = []
    for parts in (1, 50):
        run = write_run(tmp_path / str(parts), training_config("ppo", world="moon"), parts=parts)
        draw_learning_curve([run], run / "curve.png")
        pictures.append(imread(run / "curve.png"))
    assert pictures[0][..., :3].std() > 0.05
    np.testing.assert_allclose(*pictures, atol=0.01)


def test_runs_of_an_algorithm_in_a_world_are_one_curve(tmp_path: Path) -> None:
    runs = [
        write_run(tmp_path / f"{algo}-{world}-{seed}", training_config(algo, world=world, seed=seed), rows=20 + seed)
        for algo, world, seed in itertools.product(("ppo", "sac"), ("maze", "moon"), range(2))
    ]
    draw_learning_curve([*runs[:4], runs[4]], tmp_path / "curve.svg", panels=COMPARED)
    text = texts(tmp_path / "curve.svg")
    labels = {f"PPO in {world}: 2 runs of 83,968 steps in 2.0 min": 1 for world in ("maze", "moon")}
    labels |= {"sac-maze-0 (SAC in maze): 81,920 steps in 2.0 min": 1, "training time (min)": 2}
    labels |= {"lines: interquartile mean of the runs; areas: its 95 % interval": 1}
    assert {label: text.count(f"<!-- {label} -->") for label in labels} == labels
