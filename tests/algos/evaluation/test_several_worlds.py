"""Episodes in several worlds: drawing, driving, metrics by world, tables, files and pictures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from matplotlib.image import imread

from rover_rl import World
from rover_rl.algos.evaluation.episodes import EpisodeSet, draw_episodes
from rover_rl.algos.evaluation.evaluate import Evaluation, evaluate
from rover_rl.algos.evaluation.parallel import Request, evaluate_all
from rover_rl.algos.evaluation.plots import draw_paths
from rover_rl.algos.evaluation.report import write_evaluation
from rover_rl.algos.evaluation.results import worst_worlds
from rover_rl.algos.evaluation.trajectory import Trajectory
from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.cli import main
from rover_rl.envs.config import EnvConfig, Randomization
from rover_rl.robots import get_robot
from rover_rl.worlds import Terrain, box
from rover_rl.worlds.pool import WorldPool
from tests.algos.evaluation.drives import assert_same, csv_rows, line
from tests.fork_server import fork_server

ROBOT = get_robot("rover_zero")
FIELD = World("field", Terrain.flat((9.0, 9.0)))
WALL = World("wall", Terrain.flat((9.0, 9.0)), [box((0.0, 0.0, 0.5), (0.4, 4.0, 1.0))])
CRATES = World("crates", Terrain.flat((9.0, 9.0)), [box((2.0, y, 0.5), (0.5, 0.5, 1.0)) for y in (-2.0, 0.0, 2.0)])
POOL = WorldPool(FIELD, WALL, CRATES)
EPISODES = draw_episodes(POOL, 3, seed=1)


# --- episodes


def test_each_world_has_the_episodes_that_it_has_alone() -> None:
    assert EPISODES.name == "field, wall, crates"
    assert EPISODES.world_index.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    assert EPISODES.worlds[3:6] == [WALL] * 3
    assert [EPISODES.world_name(episode) for episode in (0, 3, 8)] == ["field", "wall", "crates"]
    for index, world in enumerate(POOL):
        alone, here = draw_episodes(world, 3, seed=1), EPISODES.part(3 * index, 3 * index + 3)
        for key in ("start", "goal", "shortest"):
            assert torch.equal(getattr(here, key), getattr(alone, key))
        assert here.world is world
    with pytest.raises(ValueError, match="the episodes are in 3 worlds"):
        _ = EPISODES.world


# --- driving


@pytest.mark.parametrize("backend", ["bullet", "warp"])
def test_results_are_those_of_each_world_alone_for_any_number_of_rows(backend: str) -> None:
    env, policy = EnvConfig(backend=backend), ScriptedPolicy()
    alone = [evaluate(policy, EPISODES.part(first, first + 3), seconds=0.4, env=env) for first in (0, 3, 6)]
    expected = [trajectory for part in alone for trajectory in part.trajectories]
    for rows in (2, 5):
        assert_same(evaluate(policy, EPISODES, seconds=0.4, env=env, rows=rows).trajectories, expected)


def test_results_do_not_depend_on_the_number_of_processes() -> None:
    fork_server()
    env = EnvConfig(backend="warp", randomization=Randomization.typical())
    worlds = WorldPool("maze:10000-10001", FIELD, WALL)
    episodes = draw_episodes(worlds, 9, seed=2, min_path=1.0)
    requests = [Request(policy, episodes, {"seconds": 0.5, "env": env}) for policy in (ScriptedPolicy(), None)]
    for ours, theirs in zip(evaluate_all(requests, 1), evaluate_all(requests, 2), strict=True):
        assert len(ours.trajectories) == 36
        assert_same(ours.trajectories, theirs.trajectories)
        assert ours.to_json() == theirs.to_json()


# --- metrics, tables, files and pictures


def drives(endings: list[str], x: float = -3.0) -> list[Trajectory]:
    """Straight drives of 1 m along y, at ``x``, with the given endings."""
    return [line(ending, (x, -0.5), (x, 0.5)) for ending in endings]


def evaluation(name: str, endings: list[str], episodes: EpisodeSet = EPISODES) -> Evaluation:
    return Evaluation(name, episodes, 1, 60.0, drives(endings))


# A third of the episodes in the field, two thirds at the wall, all among the crates.
ENDINGS = ["goal", "stuck", "stuck", "goal", "goal", "stuck", "goal", "goal", "goal"]


def test_results_by_world() -> None:
    driven = evaluation("mine", ENDINGS)
    assert [world["success_rate"] for world in driven.by_world] == pytest.approx([1 / 3, 2 / 3, 1])
    assert [world["name"] for world in driven.by_world] == ["field", "wall", "crates"]
    assert driven.by_world[0]["mean_time_to_traverse"] == 1.0
    assert driven.metrics["success_rate"].value == pytest.approx(6 / 9)
    assert worst_worlds([driven], 2) == [0, 1]
    other = evaluation("other", ENDINGS[::-1])
    assert worst_worlds([driven, other]) == [0, 1, 2]
    assert driven.title == "3 episodes in each of 3 worlds, field, wall, crates: one goal within 60 s"


def test_files_have_the_results_by_world(tmp_path: Path) -> None:
    write_evaluation(tmp_path / "evaluation.json", [evaluation("mine", ENDINGS)])
    (result,) = json.loads((tmp_path / "evaluation.json").read_text())
    assert [world["count"] for world in result["worlds"]] == [3, 3, 3]
    assert [episode["world"] for episode in result["episodes"]] == [0, 0, 0, 1, 1, 1, 2, 2, 2]
    rows = csv_rows(tmp_path / "evaluation-worlds.csv")
    assert [(row["world"], row["name"]) for row in rows] == [("0", "field"), ("1", "wall"), ("2", "crates")]
    assert float(rows[1]["success_rate"]) == pytest.approx(2 / 3)
    write_evaluation(tmp_path / "one.json", [evaluation("mine", ENDINGS[:3], EPISODES.first(3).with_used_worlds())])
    assert not (tmp_path / "one-worlds.csv").exists()


def test_the_worst_worlds_are_drawn(tmp_path: Path) -> None:
    draw_paths([evaluation("mine", ENDINGS), evaluation("other", ENDINGS)], tmp_path / "paths.svg")
    text = (tmp_path / "paths.svg").read_text()
    for name in ("mine", "other"):
        assert f"<!-- {name}, field: 33% -->" in text
        assert f"<!-- {name}, crates: 100% -->" in text


def test_the_command_takes_ranges(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    given = ["evaluate", "scripted", "--world", "maze:10000-10001", "maze:10002-10003@0.2", "--seconds", "0.5"]
    assert main([*given, "--episodes", "2", "--workers", "1", "--backend", "warp", "--out", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert text.count("2 episodes in each of 2 worlds") == 2
    assert "Lowest success rates of scripted in maze:10002-10003@0.2, warp: maze:10002@0.2 0%" in text
    results = json.loads((tmp_path / "evaluation.json").read_text())
    assert [(result["world"], result["count"]) for result in results] == [(given[3], 4), (given[4], 4)]
    assert results[1]["worlds"][1]["name"] == "maze:10003@0.2"
    for picture in ("paths-maze-10000-10001.png", "paths-maze-10002-10003@0.2.png"):
        assert imread(tmp_path / picture).std() > 0.05
