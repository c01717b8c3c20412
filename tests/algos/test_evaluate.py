from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from matplotlib.image import imread
from rich.console import Console
from tensordict import TensorDictBase

from rover_rl import World
from rover_rl.algos.evaluate import (
    Evaluation,
    draw_episodes,
    evaluate,
    print_table,
    wilson_interval,
    write_evaluation,
)
from rover_rl.algos.plots import draw_learning_curve, draw_paths
from rover_rl.algos.progress import ProgressLog
from rover_rl.sims.worlds import Terrain

FIELD = World("field", Terrain.flat((12.0, 12.0)))
EPISODES = draw_episodes(FIELD, count=3, seed=1)


def straight(td: TensorDictBase) -> TensorDictBase:
    """Drives at the goal, slowly while it is not ahead."""
    angle = td["target"][..., 1:]
    return td.set("action", torch.cat((angle.cos().clamp(min=0), angle), -1))


@pytest.fixture(scope="module")
def driven() -> Evaluation:
    return evaluate(straight, EPISODES, name="straight")


def test_a_seed_always_gives_the_same_episodes() -> None:
    again, other = draw_episodes(FIELD, 3, seed=1), draw_episodes(FIELD, 3, seed=5)
    assert torch.equal(again.start, EPISODES.start)
    assert torch.equal(again.goal, EPISODES.goal)
    assert not torch.equal(other.goal, EPISODES.goal)
    more = draw_episodes(FIELD, 5, seed=1)
    assert torch.equal(more.start[:3], EPISODES.start)


def test_driving_at_the_goal_reaches_it_on_open_ground(driven: Evaluation) -> None:
    assert driven.endings == ["goal"] * 3
    assert driven.success_rate == 1
    for path, start, goal, steps in zip(
        driven.paths, EPISODES.start, EPISODES.goal, driven.steps.tolist(), strict=True
    ):
        assert len(path) == steps + 1
        torch.testing.assert_close(path[0], start[:2], atol=0.02, rtol=0)
        assert torch.dist(path[-1], goal) < 0.5
    away = torch.linalg.vector_norm(EPISODES.goal - EPISODES.start[:, :2], dim=1) - 0.5
    assert driven.mean_time > away.mean()


def test_an_episode_does_not_depend_on_the_others(driven: Evaluation) -> None:
    alone = evaluate(straight, draw_episodes(FIELD, 1, seed=1))
    assert alone.steps[0] == driven.steps[0]
    assert torch.equal(alone.paths[0], driven.paths[0])


def test_the_random_policy_starts_at_the_same_places_and_repeats_itself(driven: Evaluation) -> None:
    torch.manual_seed(7)
    before = torch.random.get_rng_state()
    first, second = (evaluate(None, EPISODES, repeat=4, seconds=3) for _ in range(2))
    assert torch.equal(before, torch.random.get_rng_state())
    assert all(torch.equal(a, b) for a, b in zip(first.paths, second.paths, strict=True))
    for ours, theirs in zip(first.paths, driven.paths, strict=True):
        assert torch.equal(ours[0], theirs[0])
    assert len(first.paths[0]) == 3 * 20 / 4 + 1


def test_missed_goals_are_told_apart() -> None:
    standing = evaluate(lambda td: td.set("action", torch.zeros(3, 2)), EPISODES, seconds=1)
    assert standing.endings == ["time limit"] * 3
    assert standing.steps.tolist() == [20] * 3
    assert math.isnan(standing.mean_time)
    assert standing.to_json()["mean_time"] is None


def test_wilson_interval() -> None:
    assert wilson_interval(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-3)
    assert wilson_interval(5, 10) == pytest.approx((0.2366, 0.7634), abs=1e-3)
    assert wilson_interval(10, 10) == pytest.approx((0.7225, 1.0), abs=1e-3)


def test_results_and_pictures(driven: Evaluation, tmp_path: Path) -> None:
    random = evaluate(None, EPISODES, seconds=1)
    console = Console(record=True, width=120, quiet=True)
    print_table([driven, random], console)

    write_evaluation(tmp_path / "evaluation.json", [driven, random])
    written = json.loads((tmp_path / "evaluation.json").read_text())
    assert [entry["policy"] for entry in written] == ["straight", "random"]
    assert written[0]["endings"] == {"goal": 3}
    assert len(written[0]["episodes"]) == 3

    with ProgressLog(tmp_path / "progress.csv", Console(quiet=True)) as log:
        for step in range(1, 4):
            counts = {"episodes": 2 * step - 2, "episodes_reached": step - 1}
            log.add(0.3, {"steps": 100 * step, "goals_per_2000_steps": 1.0, "episode_return": math.nan, **counts})
    draw_learning_curve(tmp_path / "progress.csv", tmp_path / "curve.png", random)
    draw_paths([driven, random], tmp_path / "paths.png")
    for name in ("curve.png", "paths.png"):
        picture = imread(tmp_path / name)
        assert picture.ndim == 3
        assert picture[..., :3].std() > 0.05


def test_no_episodes_raise() -> None:
    with pytest.raises(ValueError, match="count must be at least 1"):
        draw_episodes(FIELD, 0)
    with pytest.raises(ValueError, match="unknown world 'mars'"):
        draw_episodes("mars")
