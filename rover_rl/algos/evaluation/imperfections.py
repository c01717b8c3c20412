"""Table of policies under imperfections of their sensors, beside exact ones."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Console

from rover_rl.algos.evaluation.metrics import Estimate, ratio
from rover_rl.algos.evaluation.results import EndlessEvaluation, Evaluation
from rover_rl.algos.evaluation.tables import Column, cell, print_tables


def print_imperfections(
    title: str, evaluations: Sequence[Evaluation | EndlessEvaluation], console: Console | None = None
) -> None:
    """Prints the success rate of each policy under each imperfection, and its change against the first one.

    Nothing is printed if there are no several imperfections. The evaluations are on the same episodes.
    """
    driven = [one for one in evaluations if isinstance(one, Evaluation)]
    columns = [*dict.fromkeys(one.imperfection for one in driven)]
    if len(columns) < 2:
        return
    rows: dict[tuple[str, str], dict[str, Evaluation]] = {}
    for one in driven:
        rows.setdefault((one.name, one.backend), {})[one.imperfection] = one
    backends = {backend for _, backend in rows}
    names = [f"{name}, {backend}" if len(backends) > 1 else name for name, backend in rows]
    cells = [Column(column, "%", _cells(column, columns[0], [*rows.values()])) for column in columns]
    heading = f"Success, and its change against {columns[0]}"
    print_tables(
        f"{title}. {heading}", [line for name in names for line in (name, "change")], cells, console or Console()
    )


def change(one: Evaluation, other: Evaluation) -> Estimate:
    """Computes how much larger the success rate of ``one`` is, on the same episodes, with its bootstrap interval."""
    return ratio((one.reached.double() - other.reached.double()).tolist())


def _cells(column: str, first: str, rows: Sequence[dict[str, Evaluation]]) -> list[str]:
    cells = []
    for row in rows:
        undefined = Estimate(math.nan, math.nan, math.nan)
        one, exact = row.get(column), row.get(first)
        rate = undefined if one is None else one.metrics["success_rate"]
        compared = one is not None and exact is not None and one is not exact
        cells += [cell(rate, "%"), cell(change(one, exact) if compared else undefined, "%")]  # type: ignore[arg-type]
    return cells
