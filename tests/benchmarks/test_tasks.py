"""Cells of the table of tasks, their cards and the page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import task_page, tasks
from benchmarks.tasks import Options
from rover_rl import EnvConfig, Task
from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.algos.policy.names import ResolvedPolicy
from rover_rl.algos.workers import usable_cores
from rover_rl.envs import parts
from rover_rl.envs.config import ActionConfig

TINY = Task(
    name="tiny",
    reason="Small enough for a test.",
    observation=("lidar", "imu", "target", "velocities"),
    env=EnvConfig(world="maze:0-1", backend="warp", length=40),
    test_world="maze:50000-50001",
    episodes=1,
    seconds=0.5,
    references=("scripted",),
    learners={"ppo": {"num_envs": 4, "minibatch": 16, "epochs": 1, "rollout_length": 4, "hidden": (8,)}},
)
OWN = f"{__name__}:OwnPolicy"


class OwnPolicy(ScriptedPolicy):
    """Policy of someone else."""


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    monkeypatch.setitem(parts.TASKS._parts, "tiny", TINY)
    monkeypatch.setattr(tasks, "TABLE", ("ppo",))
    monkeypatch.setattr(tasks, "SEEDS", (1,))
    return {"out": tmp_path / "cards", "runs": tmp_path / "runs", "page": tmp_path / "docs" / "page.md"}


def test_one_command_makes_all_cards_of_a_task_and_goes_on(
    places: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tasks, "STEPS", 64)
    assert tasks.main(Options("tiny", missing=True, **places)) == 0
    cards = {path.name: json.loads(path.read_text()) for path in (places["out"] / "tiny").iterdir()}
    assert {*cards} == {"scripted.json", "ppo-seed1.json"}
    card = cards["ppo-seed1.json"]
    assert {key: card[key] for key in ("task", "entry", "kind", "seed", "steps")} == {
        "task": "tiny",
        "entry": "ppo",
        "kind": "learner",
        "seed": 1,
        "steps": 64,
    }
    assert card["episodes"] == sum(card["endings"].values()) == 2
    assert 0 <= card["success"] <= 1
    assert card["with_planner"] is False
    assert card["machine"]["cores"] >= usable_cores()
    assert card["command"] == "python -m benchmarks.tasks tiny ppo --seed 1"
    assert len(card["curve"]["success"]) == len(card["curve"]["steps"]) <= tasks.POINTS
    assert cards["scripted.json"]["seed"] is None
    assert cards["scripted.json"]["curve"] == {}
    assert places["page"].read_text() == task_page.page(task_page.read_cards(places["out"]))
    assert (places["page"].parent / task_page.PICTURE).stat().st_size < 150_000
    # There is nothing left to do.
    monkeypatch.setattr(tasks, "make_card", None)
    assert tasks.main(Options("tiny", missing=True, **places)) == 0


def test_a_policy_of_someone_else_has_a_name_of_its_own(places: dict[str, Any]) -> None:
    assert tasks.main(Options("tiny", OWN, name="own", seed=3, **places)) == 0
    card = json.loads((places["out"] / "tiny" / "own-seed3.json").read_text())
    assert (card["kind"], card["entry"], card["steps"]) == ("entry", "own", None)
    for name in (None, "ppo"):
        with pytest.raises(ValueError, match="needs a name of its own"):
            tasks.main(Options("tiny", OWN, name=name, **places))


def test_an_unknown_entry_is_told_what_there_is(places: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"one of \['ppo'\], a library, one of \['sb3', .*'gridplanner', .*got 'pp0'"):
        tasks.main(Options("tiny", "pp0", **places))
    with pytest.raises(ValueError, match="leave out --name"):
        tasks.main(Options("tiny", "ppo", name="mine", **places))
    with pytest.raises(ValueError, match="--program"):
        tasks.main(Options("tiny", "cleanrl", **places))
    with pytest.raises(ValueError, match="name a task and an entry"):
        tasks.main(Options("tiny", **places))


@pytest.mark.slow
def test_another_library_learns_and_is_judged(places: dict[str, Any]) -> None:
    pytest.importorskip("stable_baselines3")
    assert tasks.main(Options("tiny", "sb3", steps=8192, **places)) == 0
    card = json.loads((places["out"] / "tiny" / "sb3-0.008192M-seed1.json").read_text())
    assert card["entry"] == "sb3-0.008192M"
    assert 7000 < card["steps"] <= 8192
    assert 40 < len(card["curve"]["steps"]) <= tasks.POINTS


def test_a_planner_beside_a_policy_is_found() -> None:
    policy = OwnPolicy()
    assert not tasks.has_planner(ResolvedPolicy("own", policy))
    policy.made_for = EnvConfig(action=ActionConfig(kind="residual"))  # type: ignore[attr-defined]
    assert tasks.has_planner(ResolvedPolicy("own", policy))


def card(task: str, entry: str, seed: int | None, success: float, **others: Any) -> dict[str, Any]:
    command = f"python -m benchmarks.tasks {task} {entry}" + f" --seed {seed}" * (seed is not None)
    steps = None if seed is None else 1000
    curve = {} if seed is None else {"steps": [500, 1000], "minutes": [1, 2], "success": [None, success]}
    values = {"spl": success, "mean_time_to_traverse": None, "body_contact_share": 0.0, "minutes": 2.0, "steps": steps}
    kind = {"kind": "planner" if seed is None else "learner", "with_planner": False, "episodes": 100, "version": "1"}
    machine = {"machine": {"processor": "x86_64", "cores": 2}, "endings": {}}
    given = {"task": task, "entry": entry, "seed": seed, "success": success, "command": command, "curve": curve}
    return given | values | kind | machine | others


def test_the_page_has_a_row_for_each_entry_over_its_seeds(tmp_path: Path) -> None:
    cards = [card("tiny", "ppo", seed, value) for seed, value in ((1, 0.5), (2, 0.7), (3, 0.9))]
    cards += [card("tiny", "scripted", None, 0.4), card("tiny", "mixed", 1, 0.3, with_planner=True)]
    cards += [card("other", "ppo", seed, value) for seed, value in ((1, 0.2), (2, 0.2), (3, 0.2))]
    for number, one in enumerate(cards):
        task_page.write_card(tmp_path / "cards" / one["task"] / f"{number}.json", one)
    assert task_page.read_cards(tmp_path / "cards") == sorted(cards, key=lambda one: one["task"])
    tasks.main(Options(draw=True, out=tmp_path / "cards", page=tmp_path / "page.md"))
    lines = (tmp_path / "page.md").read_text().splitlines()
    assert "| task | mixed, with planner | ppo | *scripted* |" in lines
    assert "| [other](#other) |  | 20%, 0.001 M |  |" in lines
    assert any(line.startswith("| all |  | 40% (") for line in lines)
    rows = [line for line in lines[lines.index("## tiny") :] if line.startswith(("| ppo", "| mixed", "| *"))]
    assert [row.split(" | ")[0] for row in rows] == ["| ppo", "| *scripted*", "| mixed, with planner"]
    assert "| 70.0% | 50% to 90% | 1, 2, 3 | 0.70 |  | 0% | 1,000 | 2 | x86_64, 2 cores |" in rows[0]
    assert "`python -m benchmarks.tasks tiny ppo --seed 1`" in rows[0]
    assert (tmp_path / task_page.PICTURE).is_file()


def test_the_page_of_the_documentation_is_that_of_the_cards() -> None:
    assert task_page.PAGE.read_text() == task_page.page(task_page.read_cards(task_page.CARDS))
