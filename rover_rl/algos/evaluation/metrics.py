"""Evaluation metrics: columns of a table of episodes, and ratios of their sums with 95 % confidence intervals.

Names in brackets are those of the original environment, which has no formula for MTT and TR and never logs VORT.
Proportions of episodes have Wilson score intervals, all other metrics are ratios of sums over episodes with percentile
bootstrap intervals. They cover the variation between episodes, not between training runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from rover_rl.algos.driving import CONTACT, EARLY_ENDINGS, ENDINGS, TIME_LIMIT
from rover_rl.algos.evaluation.trajectory import Trajectory, count_runs
from rover_rl.envs.rewards import STANDSTILL

ROUGH_TILT = math.radians(10)
"""Smallest tilt of the rover on rough ground, rad: most of inspect is rough, a tenth of moon, nothing of maze.
The original environment asks for an acceleration above 15 m/s^2, which a wheeled rover does not reach at 1 m/s."""
RISK = 0.5  #: Distance from the rover's origin to that of a mover below which the rover is at risk, m.
PERSONAL = 1.2  #: Distance between rover and mover below which the rover intrudes on the mover's space, m.
FREEZING = 2.0  #: Distance between rover and mover within which a rover that stands still counts as frozen, m.
RESAMPLES = 2000  #: Number of bootstrap resamples.
ENDING = "ending_"  #: First part of the names of metrics that are shares of endings.
Row: TypeAlias = dict[str, Any]  # an episode in the table: see :func:`episode_row`


@dataclass(frozen=True)
class Estimate:
    """A value, nan if it is undefined, and the ends of its 95 % confidence interval, nan with too few episodes."""

    value: float
    low: float
    high: float


UNDEFINED = Estimate(math.nan, math.nan, math.nan)


def proportion(successes: int, count: int) -> Estimate:
    """A proportion with its Wilson score interval (J. Am. Stat. Assoc. 22, 1927); nan for a ``count`` of 0."""
    if not count:
        return UNDEFINED
    from scipy.stats import binomtest  # takes a second, and most programs compute no metrics

    interval = binomtest(successes, count).proportion_ci(confidence_level=0.95, method="wilson")
    return Estimate(successes / count, float(interval.low), float(interval.high))


def ratio(numerators: Sequence[float], denominators: Sequence[float] | None = None) -> Estimate:
    """``sum(numerators) / sum(denominators)`` over episodes, or the mean, with its bootstrap interval.

    The 2,000 paired resamples (percentiles; Efron, "Bootstrap methods", Ann. Stat. 7, 1979) are the same for the same
    number of episodes. Those with the ratio 0 / 0 are left out. The ends are nan if the value is nan, or if fewer than
    two episodes have a denominator above 0.
    """
    top = np.array(numerators, dtype=np.float64)
    bottom = np.ones_like(top) if denominators is None else np.array(denominators, dtype=np.float64)
    counted = (bottom > 0).sum()
    value = float(torch.from_numpy(top).sum() / torch.from_numpy(bottom).sum()) if counted else math.nan
    if counted < 2 or math.isnan(value):
        return Estimate(value, math.nan, math.nan)
    drawn = np.random.default_rng(0).integers(0, len(top), (RESAMPLES, len(top)))
    with np.errstate(divide="ignore", invalid="ignore"):
        resampled = top[drawn].sum(-1) / bottom[drawn].sum(-1)
    # This interval skips nan and does not interpolate between infinities, which would give nan.
    low, high = np.nanquantile(resampled, (0.025, 0.975), method="nearest").tolist()
    return Estimate(value, low, high)


def episode_row(trajectory: Trajectory, walls: Tensor, shortest: float = math.nan) -> Row:
    """Columns of an episode: those of evaluation.json, and the numerators and denominators of metrics.

    - ``spl``: ``S l / max(p, l)``, with 1 for a success as ``S``, the length of the driven path ``p`` and that of the
      shortest path ``l``, both seen from above (Anderson et al., "On Evaluation of Embodied Navigation Agents", 2018,
      arXiv:1807.06757).
    - ``jerk``: sum of ``((v[k+1] - 2 v[k] + v[k-1]) / dt^2)^2`` over the ``jerk_steps`` that have a step before and one
      after them. ``v[k]`` is the mean speed over ground in step k, negative backward.
    - ``reversals``: changes of the commanded turning direction. Steady control has about one per second.

    Contacts in consecutive steps are one. With movers, there are also

    - ``run_into``: contacts with movers that begin while the rover stands still, below 0.05 m/s in the step before: in
      the step of the contact, the mover pushes the rover. The others are ``at_fault``.
    - ``least_mover_distance``: least distance between the disc of the robot's radius and a mover, m.
    - ``risk_seconds``: time with the origins of rover and mover within 0.5 m, s, as RoboTerrain defines it
      (https://github.com/jackvice/RoboTerrain).
    - ``intrusion_seconds``: time with a mover within 1.2 m of the disc, s: the personal space that people keep others
      out of (Hall, "The Hidden Dimension", 1966).
    - ``frozen_seconds``: time in which the rover stands still with a mover within 2 m of the disc, s (Trautman and
      Krause, "Unfreezing the robot", IROS 2010).

    ``walls`` tells whether the body touches an obstacle at rest, bool ``[T + 1]``. ``shortest`` is the length of the
    shortest path, m.
    """
    t, touched, success = trajectory, trajectory.touching(walls), trajectory.ending == "goal"
    rough, standing = t.tilt >= ROUGH_TILT, t.speed < STANDSTILL
    jerk = (t.signed_speed.double().diff(n=2) / t.dt**2).square()
    row = {
        "shortest": shortest,
        "length": t.length,
        "goals": int(t.goal.sum()),
        "ending": t.ending,
        "steps": len(t),
        "seconds": t.seconds,
        "contacts": count_runs(touched),
        "collisions": count_runs(t.collision),
        "success": success,
        "clean": success and not bool(touched.any()),
        "spl": success * shortest / max(t.length, shortest, 1e-9),
        "success_seconds": t.seconds * success,
        "success_shortest": success * shortest,
        "rough_speed": t.speed[rough].sum().item(),
        "rough_steps": int(rough.sum()),
        "still_steps": int(standing.sum()),
        "turns": t.turns,
        "reversals": t.reversals,
        "jerk": jerk.sum().item(),
        "jerk_steps": len(jerk),
        "wall_contacts": count_runs(walls),
    }
    if t.encounters is None:
        return row
    contact, gap, center_distance = t.encounters
    stood = torch.cat((standing.new_ones(1), standing[:-1]))  # Rovers start at rest.
    contacts, run_into = count_runs(contact), int((contact[1:] & ~contact[:-1] & stood).sum()) + int(contact[0])
    return row | {
        "mover_contacts": contacts,
        "run_into": run_into,
        "at_fault": contacts - run_into,
        "least_mover_distance": gap.min().item(),
        "risk_seconds": int((center_distance[1:] < RISK).sum()) * t.dt,
        "intrusion_seconds": int((gap[1:] < PERSONAL).sum()) * t.dt,
        "frozen_seconds": int((standing & (gap[1:] < FREEZING)).sum()) * t.dt,
    }


@dataclass(frozen=True)
class Metric:
    """A metric: its column in tables, and the columns of episodes that it is the ratio of."""

    heading: str  #: Heading of the column.
    unit: str  #: ``"%"`` for proportions, which are numbers up to 1, else that of the value.
    meaning: str  #: Short description for the legend; empty for endings, whose heading describes them.
    top: str | Callable[[Row], float]
    """Numerator, a column of :func:`episode_row` or a function of the row. A flag makes a proportion."""
    bottom: str | None = None  #: Denominator, a column; with ``None``, the metric is the mean over episodes.
    of: Literal["goal", "endless", "movers", "all"] = "all"
    """Which episodes have it, of ``"goal"`` evaluations, ``"endless"`` ones, those with ``"movers"``, or ``"all"``."""
    default: bool = False  #: Whether tables have the column by default.
    root: bool = False  #: Whether it is the square root of the ratio.

    def estimate(self, rows: Sequence[Row]) -> Estimate:
        values = [row[self.top] if isinstance(self.top, str) else self.top(row) for row in rows]
        if all(isinstance(value, bool) for value in values) and self.bottom is None:
            return proportion(sum(map(int, values)), len(values))
        found = ratio(values, None if self.bottom is None else [row[self.bottom] for row in rows])
        return Estimate(*map(math.sqrt, (found.value, found.low, found.high))) if self.root else found


def _touching(contacts: str) -> Callable[[Row], bool]:
    return lambda row: row[contacts] > 0


def _ended(*endings: str, otherwise: bool = False) -> Callable[[Row], bool]:
    return lambda row: (row["ending"] in endings) != otherwise


_of_goals, _endless = (partial(Metric, of=of, default=True) for of in ("goal", "endless"))
_of_movers = partial(Metric, of="movers")
_LEAST = "mean of the least distance to a mover"
_CLEAN = "episodes that reach their goal without touching an obstacle"
_TOUCHED = "episodes in which the body touches an obstacle, other than rubble lower than the wheel hubs"
_TOUCHED_WALL = "episodes in which the body touches an obstacle at rest"
_TOUCHED_MOVER = "episodes in which the body touches a mover"
_FAULT = "contacts with movers that begin while the rover moves, per goal reached"
_RUN_INTO = "contacts with movers that begin while the rover stands still"
_RISK = "time with the centers of rover and mover within 0.5 m, per goal reached"
_TRAVERSE = "shortest-path length to reached goals per second of driving"
_ROUGH = "mean speed on ground with a tilt of 10 degrees or more"
_FROZEN = "time spent slower than 0.05 m/s within 2 m of a mover"
_OWN_END = "episodes that end by a termination of one's own"
_KNOWN_ENDINGS = (*ENDINGS.values(), *EARLY_ENDINGS, CONTACT, TIME_LIMIT)
_REVERSALS = "changes of the commanded turning direction per second"
METRICS = {
    "success_rate": _of_goals("success", "%", "episodes that reach their goal", "success"),
    "contact_free_success_rate": _of_goals("clean", "%", _CLEAN, "clean"),
    "spl": _of_goals("SPL", "", "success weighted by path length", "spl"),
    # [MTT] It is short for a policy that reaches near goals only.
    "mean_time_to_traverse": _of_goals("time", "s", "mean time to a reached goal", "success_seconds", "success"),
    "goals_per_episode": _endless("goals", "", "goals reached per episode", "goals"),
    "seconds_per_goal": _endless("per goal", "s", "driving time per goal reached", "seconds", "goals"),
    "ended_early": _endless("early", "%", "episodes that end before the time limit", _ended(*EARLY_ENDINGS)),
    "body_contact_share": Metric("touched", "%", _TOUCHED, _touching("contacts"), default=True),
    "mover_contact_share": _of_movers("mover touched", "%", _TOUCHED_MOVER, _touching("mover_contacts"), default=True),
    "run_into": _of_movers("run into", "%", _RUN_INTO, "run_into", "mover_contacts", default=True),
    "least_mover_distance": _of_movers("least distance", "m", _LEAST, "least_mover_distance", default=True),
    **{
        ENDING + kind.replace(" ", "_"): Metric(kind, "%", "", _ended(kind), default=True)
        for kind in (TIME_LIMIT, *EARLY_ENDINGS)
    },
    ENDING + "own": Metric("own end", "%", _OWN_END, _ended(*_KNOWN_ENDINGS, otherwise=True), default=True),
    # [TR] A failure contributes its time and no length, since SPL does not credit partial progress either.
    "traverse_rate": _of_goals("traverse rate", "m/s", _TRAVERSE, "success_shortest", "seconds", default=False),
    "episode_seconds": _endless("duration", "s", "mean duration of an episode", "seconds", default=False),
    # [VORT] nan if no ground is rough, as in the maze.
    "velocity_over_rough_terrain": Metric("speed on rough", "m/s", _ROUGH, "rough_speed", "rough_steps"),
    "collisions": Metric("collisions", "", "collisions per episode, as the task defines them", "collisions"),
    "body_contacts": Metric("touches", "", "contacts of the body with obstacles per episode", "contacts"),
    # Circling is a common failure of policies for this task. Good policies have about 0.45 turns per goal.
    "turns_per_goal": Metric("turns", "", "full turns per goal reached", "turns", "goals"),
    "standstill": Metric("still", "%", "time spent slower than 0.05 m/s", "still_steps", "steps"),
    "command_reversals": Metric("reversals", "1/s", _REVERSALS, "reversals", "seconds"),
    "jerk": Metric("jerk", "m/s^3", "root mean square jerk of the driven speed", "jerk", "jerk_steps", root=True),
    "at_fault": _of_movers("at fault", "1/goal", _FAULT, "at_fault", "goals"),
    "wall_contact_share": _of_movers("wall touched", "%", _TOUCHED_WALL, _touching("wall_contacts")),
    "mover_contacts": _of_movers("mover touches", "", "contacts of the body with movers per episode", "mover_contacts"),
    "risk_per_goal": _of_movers("risk", "s/goal", _RISK, "risk_seconds", "goals"),
    "intrusion": _of_movers("intrusion", "%", "time within 1.2 m of a mover", "intrusion_seconds", "seconds"),
    "frozen": _of_movers("frozen", "%", _FROZEN, "frozen_seconds", "seconds"),
}
"""All metrics by name, in the order in which tables show them. A new one is an entry here.

:meta hide-value:
"""


def compute_metrics(rows: Sequence[Row], endless: bool = False) -> dict[str, Estimate]:
    """Metrics of episodes with one goal each, or of ``endless`` ones. Those of movers need worlds with movers."""
    met = [row for row in rows if "mover_contacts" in row]
    kinds = {"all": rows, "endless" if endless else "goal": rows, **({"movers": met} if met else {})}
    return {name: metric.estimate(kinds[metric.of]) for name, metric in METRICS.items() if metric.of in kinds}


def finite_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """A row with ``None`` in place of nan and infinity, which JSON does not know."""
    return {key: None if isinstance(n, float) and not math.isfinite(n) else n for key, n in row.items()}
