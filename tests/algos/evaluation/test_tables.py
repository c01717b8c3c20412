"""Tables of evaluations fit into the terminal, and nothing in them is cut."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator

import pytest
import torch
from rich.console import Console

from rover_rl import World
from rover_rl.algos.driving import EARLY_ENDINGS, TIME_LIMIT
from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.metrics import METRICS
from rover_rl.algos.evaluation.report import check_columns, print_table
from rover_rl.algos.evaluation.results import Evaluation
from rover_rl.algos.evaluation.tables import folded
from rover_rl.worlds import Terrain
from rover_rl.worlds.pool import WorldPool
from tests.algos.evaluation.drives import line

FIELD = World("field", Terrain.flat((40.0, 40.0)))
NAMES = ["anywhere", "gridplanner", "my-long-run-name-with-seed-12", "averylongnamewithoutanyseparatorinit", "a", "b"]
ENDINGS = ["goal", "goal", TIME_LIMIT, *EARLY_ENDINGS]


def evaluation(name: str, endings: list[str]) -> Evaluation:
    """An evaluation with drives of 12 s straight ahead that end as given."""
    count = len(endings)
    drives = [line(ending, end=(10.25, 0.0), steps=240, reversals=12.0) for ending in endings]
    start, goal = torch.zeros(count, 3), torch.tensor([[10.0, 0.0]]).expand(count, 2)
    episodes = EpisodeSet("field", WorldPool(FIELD), 0, start, goal, torch.full((count,), 9.5))
    return Evaluation(name, episodes, 1, 60.0, drives)


@pytest.fixture(scope="module")
def evaluations() -> list[Evaluation]:
    return [evaluation(name, ENDINGS) for name in NAMES]


def lines(evaluations: list[Evaluation], width: int, terminal: bool, columns: list[str]) -> Iterator[str]:
    console = Console(file=io.StringIO(), width=width, force_terminal=terminal, no_color=True)
    print_table(evaluations, console, columns=columns)
    text = re.sub(r"\x1b\[[0-9;]*m", "", console.file.getvalue())  # type: ignore[attr-defined]
    yield from text.splitlines()


@pytest.mark.parametrize(("width", "terminal", "columns"), [(80, True, ["all"]), (120, False, [])])
def test_no_line_is_too_wide_and_no_name_or_number_is_cut(
    evaluations: list[Evaluation], width: int, terminal: bool, columns: list[str]
) -> None:
    printed = [*lines(evaluations, width, terminal, columns)]
    assert max(map(len, printed)) <= width
    assert "…" not in "".join(printed)
    words = " ".join(printed).split()
    for value in evaluations[0].metrics.values():
        if value.low < value.high:
            # Intervals are whole or left out.
            assert not any(word.endswith("–") or word.startswith("–") for word in words)
    success, time = ["18.2", "5–48"], "12.0"
    assert {*success, time, "0.17"} <= {*words}
    # The policies' first columns hold whole names, or the parts of a name between separators.
    for part in ("anywhere", "gridplanner"):
        assert part in words
    shown = "".join(line[1:31].split(" ")[0] for line in printed)
    assert "my-long-run-name-with-seed-12" in shown
    assert NAMES[3] in shown


def test_the_legend_explains_what_is_shown_and_nothing_else(evaluations: list[Evaluation]) -> None:
    text = " ".join(lines(evaluations[:1], 200, False, ["spl", "jerk"]))
    assert "SPL: success weighted by path length; jerk: root mean square" in text
    assert "clean" not in text
    alone = " ".join(lines([evaluation("one", ["goal"])], 200, False, ["ending_jammed"]))
    assert "confidence interval" not in alone
    default = " ".join(lines([evaluation("one", ["goal", "stuck"])], 200, False, []))
    assert "stuck: episodes that end so" in default
    assert "jammed" not in default


def test_columns_are_named_by_metric_or_heading() -> None:
    assert check_columns(["SPL", "jerk"]) == ["spl", "jerk"]
    assert check_columns(["all"]) == [*METRICS]
    with pytest.raises(ValueError, match="unknown column 'jerkk', perhaps 'jerk'; use all or some of"):
        check_columns(["jerkk"])


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        ("my-long-run-name", ["my-long-run-", "name"]),
        ("maze:10000-10063", ["maze:10000-", "10063"]),
        ("short", ["short"]),
        ("withoutseparators", ["withoutsepar", "ators"]),
    ],
)
def test_names_are_folded_after_separators(name: str, lines: list[str]) -> None:
    assert folded(name, 12) == lines
