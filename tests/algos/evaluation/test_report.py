"""Tables, files and pictures of evaluations."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from matplotlib.image import imread
from tensordict import TensorDict

from rover_rl.algos.driving import EARLY_ENDINGS, ENDINGS, TIME_LIMIT
from rover_rl.algos.evaluation.episodes import EpisodeSet, draw_episodes, endless_episodes
from rover_rl.algos.evaluation.evaluate import Evaluation, evaluate
from rover_rl.algos.evaluation.metrics import METRICS
from rover_rl.algos.evaluation.plots import draw_paths, draw_reward_components
from rover_rl.algos.evaluation.report import change, check_columns, print_table, write_evaluation
from rover_rl.algos.evaluation.results import worst_worlds
from rover_rl.worlds import Terrain, World
from rover_rl.worlds.movers import Cylinder, Mover, Person, Waypoints
from rover_rl.worlds.pool import WorldPool
from tests.algos.drivers import standing, straight
from tests.algos.evaluation.drives import EPISODES, FIELD, WARP, csv_rows, evaluation, line, printed

NAMES = ["anywhere", "gridplanner", "my-long-run-name-with-seed-12", "averylongnamewithoutanyseparatorinit", "a", "b"]
# A third of the episodes in the field, two thirds at the wall, all among the crates.
IN_WORLDS = ["goal", "stuck", "stuck", "goal", "goal", "stuck", "goal", "goal", "goal"]


def table(*evaluations: Evaluation, width: int = 160, **options) -> str:
    return printed(print_table, evaluations, width, **options)


def long_drives(name: str) -> Evaluation:
    """Drives of 12 s straight ahead that end in all ways."""
    drives = [
        line(kind, end=(10.25, 0.0), steps=240, reversals=12.0) for kind in ("goal", "goal", TIME_LIMIT, *EARLY_ENDINGS)
    ]
    count, field = len(drives), World("field", Terrain.flat((40.0, 40.0)))
    start, goal = torch.zeros(count, 3), torch.tensor([[10.0, 0.0]]).expand(count, 2)
    episodes = EpisodeSet("field", WorldPool(field), 0, start, goal, torch.full((count,), 9.5))
    return Evaluation(name, episodes, 1, 60.0, drives)


# --- tables


@pytest.mark.parametrize(("width", "columns"), [(80, ["all"]), (120, [])])
def test_no_line_is_too_wide_and_no_name_or_number_is_cut(width: int, columns: list[str]) -> None:
    lines = table(*map(long_drives, NAMES), width=width, columns=columns).splitlines()
    assert max(map(len, lines)) <= width
    assert "…" not in "".join(lines)
    words = " ".join(lines).split()
    # Intervals are whole or left out.
    assert not any(word.endswith("–") or word.startswith("–") for word in words)
    assert {"16.7", "5–45", "12.0", "0.15", "anywhere", "gridplanner"} <= {*words}
    shown = "".join(line[1:31].split(" ")[0] for line in lines)
    assert NAMES[2] in shown
    assert NAMES[3] in shown


def test_the_legend_explains_what_is_shown_and_nothing_else() -> None:
    text = re.sub(r"\s+", " ", table(long_drives("one"), width=200, columns=["spl", "jerk"]))
    assert "SPL: success weighted by path length; jerk: root mean square" in text
    assert "clean" not in text
    assert "confidence interval" not in table(evaluation("one", ["goal"]), columns=["ending_jammed"])
    default = table(evaluation("one", ["goal", "stuck"]))
    assert "stuck: episodes that end so" in default
    assert "jammed" not in default


def test_columns_are_named_by_metric_or_heading() -> None:
    assert check_columns(["SPL", "jerk"]) == ["spl", "jerk"]
    assert check_columns(["all"]) == [*METRICS]
    with pytest.raises(ValueError, match="unknown column 'jerkk', perhaps 'jerk'; use all or some of"):
        check_columns(["jerkk"])


def test_the_table_has_a_row_a_policy_and_one_for_all_seeds() -> None:
    one, again = (evaluation(name, ["goal"] * 3) for name in ("straight", "again"))
    text = table(one, again, width=80, groups={"straight": "both of them", "again": "both of them"})
    assert text.count("3 episodes in field, wall, crates: one goal within 60 s") == 1
    row = next(line for line in text.splitlines() if line.startswith(" straight"))
    assert "100.0" in row
    assert f"{one.metrics['spl'].value:.2f}" in row
    assert all(shown in text for shown in ("44–100", "both of them", "± 0.0"))
    assert not any(hidden in text for hidden in ("nan", "jammed", "turns:"))


def test_episodes_with_a_goal_in_some_backends_only_are_told() -> None:
    firm = evaluation("straight", ["goal"] * 3)

    def copied(endings: Sequence[str], backend: str = "warp") -> Evaluation:
        return replace(evaluation("straight", endings), episodes=firm.episodes, env=replace(firm.env, backend=backend))

    text = table(firm, copied(["goal", "time limit", "goal"]))
    assert "in one backend and not in another: episodes 1 (bullet goal, warp time limit)\n" in text
    assert "straight: the backends agree on which episodes" in table(firm, copied(["goal"] * 3))
    missed = copied(["time limit"] * 3)
    moved = replace(firm.episodes, start=firm.episodes.start + 0.1)
    changes = ({"name": "another"}, {"seconds": 30.0}, {"action_repeat": 2}, {"episodes": moved})
    for other in (*(replace(missed, **changed) for changed in changes), copied(["stuck"] * 3, "bullet")):
        assert "in one backend and not in another" not in table(firm, other)


def test_imperfections_are_compared_with_exact_sensors() -> None:
    firm = evaluation("straight", ["goal"] * 3)
    exact = replace(firm, imperfection="exact")
    late = replace(evaluation("straight", ["stuck", "stuck", "goal"]), imperfection="late")
    shown = table(exact, late)
    assert "Success, and its change against exact" in shown
    assert "-66.7" in shown
    assert change(late, exact).value == pytest.approx(-2 / 3)
    assert change(exact, exact).value == 0
    assert late.summary()["imperfection"] == late.episode_rows()[0]["imperfection"] == "late"
    # Results of one kind of sensors are shown as always.
    assert "exact" not in table(firm)
    assert "imperfection" not in firm.summary()


# --- files


def test_files_have_all_results(tmp_path: Path) -> None:
    episodes = draw_episodes(FIELD, 3, seed=1)
    driven = evaluate(straight, episodes, name="straight", env=WARP)
    endless = evaluate(straight, endless_episodes(FIELD, 2, 1), seconds=1, env=WARP)
    random = evaluate(None, episodes, seconds=1, env=WARP)
    write_evaluation(tmp_path / "evaluation.json", [driven, random, endless])
    written = json.loads((tmp_path / "evaluation.json").read_text())
    modes = [("straight", "one goal"), ("random", "one goal"), ("policy", "endless")]
    assert [(entry["policy"], entry["mode"]) for entry in written] == modes
    assert written[0]["endings"] == {"goal": 3}
    assert [episode["ending"] for episode in written[0]["episodes"]] == ["goal"] * 3
    assert all(episode["length"] >= episode["shortest"] - 0.1 for episode in written[0]["episodes"])

    rows = csv_rows(tmp_path / "evaluation.csv")
    first = [("straight", "0"), ("straight", "1"), ("straight", "2"), ("random", "0")]
    assert [(row["policy"], row["episode"]) for row in rows[:4]] == first
    for row, episode in zip(rows, written[0]["episodes"], strict=False):
        assert [float(row[key]) for key in ("start_x", "start_y", "start_yaw")] == episode["start"]
        assert (row["ending"], row["contacts"]) == ("goal", "0")
        assert float(row["seconds"]) == episode["seconds"]
    assert len(rows) == sum(entry["count"] for entry in written)
    assert rows[-1]["goals"] == str(written[-1]["episodes"][-1]["goals"])

    rows = csv_rows(tmp_path / "evaluation-summary.csv")
    assert [row["policy"] for row in rows] == ["straight", "random", "policy"]
    for row, entry in zip(rows, written, strict=True):
        for key, estimate in entry["metrics"].items():
            for column, field in ((key, "value"), (f"{key}_low", "low"), (f"{key}_high", "high")):
                number = float(row[column])
                assert estimate[field] == (pytest.approx(number) if math.isfinite(number) else None)
    draw_paths([driven, random], tmp_path / "paths.png")
    assert imread(tmp_path / "paths.png")[..., :3].std() > 0.05


def test_results_by_world(tmp_path: Path) -> None:
    driven, other = evaluation("mine", IN_WORLDS), evaluation("other", IN_WORLDS[::-1])
    assert [world["success_rate"] for world in driven.by_world] == pytest.approx([1 / 3, 2 / 3, 1])
    assert driven.by_world[0]["mean_time_to_traverse"] == 1.0
    assert driven.metrics["success_rate"].value == pytest.approx(6 / 9)
    assert worst_worlds([driven], 2) == [0, 1]
    assert worst_worlds([driven, other]) == [0, 1, 2]
    assert driven.title == "3 episodes in each of 3 worlds, field, wall, crates: one goal within 60 s"
    write_evaluation(tmp_path / "evaluation.json", [driven])
    (result,) = json.loads((tmp_path / "evaluation.json").read_text())
    assert [world["count"] for world in result["worlds"]] == [3, 3, 3]
    assert [episode["world"] for episode in result["episodes"]] == EPISODES.world_index.tolist()
    rows = csv_rows(tmp_path / "evaluation-worlds.csv")
    assert [(row["world"], row["name"]) for row in rows] == [("0", "field"), ("1", "wall"), ("2", "crates")]
    assert float(rows[1]["success_rate"]) == pytest.approx(2 / 3)
    write_evaluation(tmp_path / "one.json", [evaluation("mine", IN_WORLDS[:3])])
    assert not (tmp_path / "one-worlds.csv").exists()
    draw_paths([driven, driven], tmp_path / "paths.svg")
    text = (tmp_path / "paths.svg").read_text()
    assert text.count("<!-- mine, field: 33% -->") == text.count("<!-- mine, crates: 100% -->") == 2


# --- pictures: an SVG file contains each label as a comment


def test_each_policy_has_a_panel_and_every_ending_a_marker(tmp_path: Path) -> None:
    path, endings = tmp_path / "paths.svg", [*ENDINGS.values(), TIME_LIMIT]
    episodes = draw_episodes(FIELD, len(endings), seed=1)
    draw_paths([evaluation("mine", endings, episodes)], path)
    assert [f"<!-- end: {ending} -->" in path.read_text() for ending in endings] == [True] * 7
    draw_paths(
        [evaluation(f"policy {number}", ["goal", "stuck"], episodes) for number in range(4)], path, max_episodes=1
    )
    text = path.read_text()
    assert all(f"<!-- policy {number}: success rate 50% -->" in text for number in range(4))
    assert "<!-- first 1 shown -->" in text
    assert text.count("<!-- end: ") == 1


LINE = Waypoints([(0.0, 2.0, -3.0, 1.57), (6.0, 2.0, 3.0, 1.57)], repeat="back_and_forth")
CROSSING = World("crossing", Terrain.flat((12.0, 12.0)), movers=[Mover(LINE, Person()), Mover(LINE, Cylinder(0.4))])


@cache
def crossed(track_movers: bool | float) -> Evaluation:
    """A rover that stands still while movers pass by."""
    return evaluate(standing, draw_episodes(CROSSING, 1), track_movers=track_movers, seconds=4.0, env=WARP)


def test_a_picture_names_movers_if_their_track_is_kept(tmp_path: Path) -> None:
    for track in (True, False):
        draw_paths([crossed(track)], tmp_path / "paths.svg")
        named = "<!-- mover at the end, its last 3 s -->" in (tmp_path / "paths.svg").read_text()
        assert named == track
    # The first steps of an episode have the first part of its track.
    whole, part = (crossed(track).trajectories[0] for track in (True, 3.0))
    assert torch.equal(whole.until(40, "contact").movers.position, whole.movers.position[:41])
    assert torch.equal(part.until(40, "contact").movers.position, whole.movers.position[20:41])
    assert len(part.until(10, "contact").movers.position) == 0


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
    text = (tmp_path / "rewards.svg").read_text()
    for expected in ("goal (1)", "collision", "end: jammed", "tilt penalty", "sum +100.00", "sum -5.00"):
        assert f"<!-- {expected} -->" in text
    assert "stuck" not in text
    assert "final +94.60" in text
    two, without = torch.stack([rollout(), rollout()]), rollout().exclude(("next", "reward_components"))
    for invalid, message in ((two, "one rover"), (without, "no reward components")):
        with pytest.raises(ValueError, match=message):
            draw_reward_components(invalid, tmp_path / "rewards.png")
