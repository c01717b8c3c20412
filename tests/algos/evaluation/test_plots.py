from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from rover_rl import World
from rover_rl.algos.driving import ENDINGS, TIME_LIMIT
from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.evaluate import Evaluation
from rover_rl.algos.evaluation.plots import draw_paths, draw_reward_components
from rover_rl.worlds import Terrain, box
from tests.algos.evaluation.drives import line

FIELD = World("field", Terrain.flat((12.0, 12.0)), [box((2.0, 2.0, 0.5), (1.0, 1.0, 1.0))])


def texts(path: Path) -> str:
    """The text of an SVG file, which contains each label as a comment."""
    assert path.suffix == ".svg"
    return path.read_text()


def driven(name: str, endings: list[str], speed: float = 1.0) -> Evaluation:
    """An evaluation of parallel straight drives with the same speed (m/s)."""
    start = torch.tensor([[-4.0, 0.3 * row, 0.0] for row in range(len(endings))])
    ends = [(-4.0 + 21 * 0.05 * speed, y) for y in start[:, 1].tolist()]
    drives = [line(kind, (-4.0, end[1]), end, steps=21) for kind, end in zip(endings, ends, strict=True)]
    episodes = EpisodeSet("field", FIELD, 0, start, start[:, :2] + torch.tensor((1.5, 0.0)), torch.ones(len(endings)))
    return Evaluation(name, episodes, 1, 60.0, drives)


def test_every_ending_has_a_marker(tmp_path: Path) -> None:
    endings = [*ENDINGS.values(), TIME_LIMIT]
    draw_paths([driven("mine", endings)], tmp_path / "paths.svg")
    text = texts(tmp_path / "paths.svg")
    assert [f"<!-- end: {ending} -->" in text for ending in endings] == [True] * 7
    draw_paths([driven("mine", ["goal"])], tmp_path / "paths.svg")
    assert texts(tmp_path / "paths.svg").count("<!-- end: ") == 1


@pytest.mark.parametrize("count", [1, 4, 5])
def test_each_policy_has_a_panel(count: int, tmp_path: Path) -> None:
    evaluations = [driven(f"policy {number}", ["goal", "stuck"]) for number in range(count)]
    draw_paths(evaluations, tmp_path / "paths.svg", max_episodes=1)
    text = texts(tmp_path / "paths.svg")
    assert all(f"<!-- policy {number}: success rate 50% -->" in text for number in range(count))
    assert "<!-- first 1 shown -->" in text


def rollout(steps: int = 30) -> TensorDict:
    """A rollout in which the rover reaches a goal at step 10 and jams at the end of a collision."""
    rewards = {name: torch.zeros(steps, 1) for name in ("goal", "progress", "collision", "stuck", "tilt_penalty")}
    rewards["goal"][9], rewards["progress"][:] = 100.0, 0.02
    rewards["tilt_penalty"][5], rewards["collision"][20:] = -1.0, -0.5
    events = {key: rewards[name] != 0 for key, name in (("goal_reached", "goal"), ("collision", "collision"))}
    done = torch.arange(steps)[:, None] == steps - 1
    count = torch.arange(1, steps + 1)[:, None]
    outcome = {**events, "phase": torch.full((steps, 1), 2), "steps": count, "total_steps": count + 500}
    after = {"reward_components": TensorDict(rewards, [steps]), "outcome": TensorDict(outcome, [steps]), "done": done}
    return TensorDict({"next": TensorDict(after, [steps])}, [steps])


def test_reward_components_are_drawn_with_events(tmp_path: Path) -> None:
    draw_reward_components(rollout(), tmp_path / "rewards.svg")
    text = texts(tmp_path / "rewards.svg")
    for expected in ("goal (1)", "collision", "end: jammed", "tilt penalty", "sum +100.00", "sum -5.00"):
        assert f"<!-- {expected} -->" in text
    assert "stuck" not in text
    assert "final +94.60" in text


def test_invalid_rollouts_raise(tmp_path: Path) -> None:
    two, without = torch.stack([rollout(), rollout()]), rollout().exclude(("next", "reward_components"))
    for invalid, message in ((two, "one rover"), (without, "no reward components")):
        with pytest.raises(ValueError, match=message):
            draw_reward_components(invalid, tmp_path / "rewards.png")
