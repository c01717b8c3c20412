from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from rover_rl.algos.config import training_config
from rover_rl.algos.experiments.curves import COMPARED, draw_learning_curve
from rover_rl.algos.experiments.runs import WINDOW, Run
from tests.algos.experiments.records import write_run


def test_a_learning_curve_does_not_depend_on_the_number_of_rows(tmp_path: Path) -> None:
    curves = []
    for parts in (1, 50):
        run = Run.read(write_run(tmp_path / str(parts), training_config("ppo", world="moon"), parts=parts))
        end = run.end("steps")
        curves.append(run.curve("success", "steps", np.linspace(0, end, 240), end * WINDOW))
    np.testing.assert_allclose(*curves, atol=0.02)


def test_runs_of_an_algorithm_in_a_world_are_one_curve(tmp_path: Path) -> None:
    runs = [
        write_run(tmp_path / f"{algo}-{world}-{seed}", training_config(algo, world=world, seed=seed), rows=20 + seed)
        for algo, world, seed in itertools.product(("ppo", "sac"), ("maze", "moon"), range(2))
    ]
    draw_learning_curve(runs[:5], tmp_path / "curve.svg", panels=COMPARED)
    # An SVG file contains each label as a comment.
    text = (tmp_path / "curve.svg").read_text()
    labels = {f"PPO in {world}: 2 runs of 83,968 steps in 2.0 min": 1 for world in ("maze", "moon")}
    labels |= {"sac-maze-0 (SAC in maze): 81,920 steps in 2.0 min": 1, "training time (min)": 2}
    labels |= {"lines: interquartile mean of the runs; areas: its 95 % interval": 1}
    assert {label: text.count(f"<!-- {label} -->") for label in labels} == labels
