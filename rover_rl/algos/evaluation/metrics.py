"""Evaluation metrics: columns of a table of episodes, and ratios of their sums with 95 % confidence intervals.

Names in brackets are those of the original environment, which has no formula for MTT and TR and never logs VORT.
Proportions of episodes have Wilson score intervals, all other metrics are ratios of sums over episodes with percentile
bootstrap intervals. They cover the variation between episodes, not between training runs: train with several seeds to
measure that.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from inspect import signature
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from rover_rl.algos.driving import EARLY_ENDINGS, TIME_LIMIT
from rover_rl.algos.evaluation.trajectory import Trajectory, count_runs
from rover_rl.envs.rewards import STANDSTILL

ROUGH_TILT = math.radians(10)
"""Smallest tilt of the rover, in any direction, on rough ground, rad. Rough ground makes up most of inspect, a tenth of
moon, and nothing of maze. The original environment defines rough ground by an acceleration above 15 m/s^2, which a
wheeled rover does not reach at 1 m/s: the maximum in the 20 Hz positions of 192 episodes in the three worlds is
10 m/s^2."""
RISK = 0.5  #: Distance from the rover's origin to that of a mover below which the rover is at risk, m.
PERSONAL = 1.2  #: Distance between rover and mover below which the rover intrudes on the mover's space, m.
FREEZING = 2.0  #: Distance between rover and mover within which a rover that stands still counts as frozen, m.
RESAMPLES = 2000  #: Number of bootstrap resamples.
ENDING = "ending_"  #: First part of the names of metrics that are shares of endings.
Row: TypeAlias = dict[str, Any]
"""An episode in the table: see :func:`episode_row`."""


@dataclass(frozen=True)
class Estimate:
    """A value, nan if it is undefined, and the ends of its 95 % confidence interval, nan with too few episodes."""

    value: float
    low: float
    high: float


def proportion(successes: int, count: int) -> Estimate:
    """Computes a proportion with its Wilson score interval; nan for a ``count`` of 0.

    Wilson, "Probable inference", J. Am. Stat. Assoc. 22, 1927.

    Example:
        >>> proportion(5, 10)
        Estimate(value=0.5, low=0.2365..., high=0.7634...)
    """
    if not count:
        return Estimate(math.nan, math.nan, math.nan)
    # Importing scipy.stats takes about a second, and most programs that import this module compute no metrics.
    from scipy.stats import binomtest

    interval = binomtest(successes, count).proportion_ci(confidence_level=0.95, method="wilson")
    return Estimate(successes / count, float(interval.low), float(interval.high))


def ratio(numerators: Sequence[float], denominators: Sequence[float] | None = None) -> Estimate:
    """Computes ``sum(numerators) / sum(denominators)`` over episodes, or the mean, with its bootstrap interval.

    The 2,000 paired resamples (percentiles) of :func:`scipy.stats.bootstrap` are the same in every call with the same
    number of episodes (Efron, "Bootstrap methods", Ann. Stat. 7, 1979). Resamples with the ratio 0 / 0 are left out.
    The interval has no width if all episodes are equal. Its ends are nan if the value is nan, or if fewer than two
    episodes have a denominator above 0.

    Example:
        >>> ratio([1.0, 3.0], [1.0, 1.0])
        Estimate(value=2.0, low=1.0, high=3.0)
    """
    top = torch.tensor(numerators, dtype=torch.float64)
    bottom = torch.ones_like(top) if denominators is None else torch.tensor(denominators, dtype=torch.float64)
    counted = int((bottom > 0).sum())
    value = (top.sum() / bottom.sum()).item() if counted else math.nan
    if counted < 2 or math.isnan(value):
        return Estimate(value, math.nan, math.nan)
    from scipy.stats import DegenerateDataWarning, bootstrap

    # SciPy 1.15 renames the argument.
    rng = "rng" if "rng" in signature(bootstrap).parameters else "random_state"
    with np.errstate(divide="ignore", invalid="ignore"), warnings.catch_warnings():
        # SciPy warns when its own interval is nan because of 0 / 0.
        warnings.simplefilter("ignore", DegenerateDataWarning)
        resampled = bootstrap(
            (top.numpy(), bottom.numpy()),
            lambda numerators, denominators, axis: numerators.sum(axis) / denominators.sum(axis),
            n_resamples=RESAMPLES,
            vectorized=True,
            paired=True,
            method="percentile",
            **{rng: np.random.default_rng(0)},
        ).bootstrap_distribution
    # Unlike SciPy's interval, this one skips nan and does not interpolate between infinities, which would give nan.
    low, high = np.nanquantile(resampled, (0.025, 0.975), method="nearest").tolist()
    return Estimate(value, low, high)


def episode_row(trajectory: Trajectory, walls: Tensor, shortest: float = math.nan) -> Row:
    """Computes the columns of an episode: those of evaluation.json, and the numerators and denominators of metrics.

    - ``spl``: ``S l / max(p, l)``, with 1 for a success as ``S``, the length of the driven path ``p`` and that of the
      shortest path ``l``, both seen from above (Anderson et al., "On Evaluation of Embodied Navigation Agents", 2018,
      arXiv:1807.06757).
    - ``jerk``: sum of ``((v[k+1] - 2 v[k] + v[k-1]) / dt^2)^2`` over the ``jerk_steps`` that have a step before and one
      after them. ``v[k]`` is the mean speed over ground in step k, negative backward. The speed of a wheel does not
      count.
    - ``reversals``: changes of the commanded turning direction. Steady control has about one per second, a controller
      that oscillates up to 20 at 20 Hz.

    Args:
        walls: whether the body touches an obstacle at rest, bool ``[T + 1]``: see
            :func:`~rover_rl.algos.evaluation.trajectory.find_body_contacts`.
        shortest: length of the shortest path, m.
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
    return row if t.encounters is None else row | _encounter_columns(t, standing)


def _encounter_columns(trajectory: Trajectory, standing: Tensor) -> Row:
    """Columns of an episode in a world with movers.

    - ``mover_contacts``: number of contacts with movers. Consecutive steps in contact are one.
    - ``run_into``: number of contacts that begin while the rover stands still: its speed in the step before the
      contact is below 0.05 m/s. The step of the contact itself does not tell, as the mover pushes the rover. The others
      are ``at_fault``.
    - ``least_mover_distance``: least distance between the disc of the robot's radius and a mover, m.
    - ``risk_seconds``: time with the origins of rover and mover within 0.5 m, s. RoboTerrain's definition
      (https://github.com/jackvice/RoboTerrain).
    - ``intrusion_seconds``: time with a mover within 1.2 m of the disc, s. People keep others out of this personal
      space (Hall, "The Hidden Dimension", 1966).
    - ``frozen_seconds``: time for which the rover is slower than 0.05 m/s with a mover within 2 m of the disc, s
      (Trautman and Krause, "Unfreezing the robot", IROS 2010).
    """
    assert trajectory.encounters is not None
    contact, gap, center_distance = trajectory.encounters
    # Rovers start at rest.
    stood = torch.cat((standing.new_ones(1), standing[:-1]))
    run_into = int((contact[1:] & ~contact[:-1] & stood).sum()) + int(contact[0])
    contacts = count_runs(contact)
    return {
        "mover_contacts": contacts,
        "run_into": run_into,
        "at_fault": contacts - run_into,
        "least_mover_distance": gap.min().item(),
        "risk_seconds": int((center_distance[1:] < RISK).sum()) * trajectory.dt,
        "intrusion_seconds": int((gap[1:] < PERSONAL).sum()) * trajectory.dt,
        "frozen_seconds": int((standing & (gap[1:] < FREEZING)).sum()) * trajectory.dt,
    }


@dataclass(frozen=True)
class Metric:
    """A metric: its column in tables, and the columns of episodes that it is the ratio of.

    Attributes:
        heading: heading of the column.
        unit: ``"%"`` for proportions, which are stored as numbers up to 1, else that of the value.
        meaning: short description for the legend; empty for endings, whose heading describes them.
        top: numerator: a column of :func:`episode_row`, or a function of the row. A flag makes a proportion.
        bottom: denominator, a column; ``None``: the metric is the mean over episodes.
        of: episodes that have it: of ``"goal"`` evaluations, ``"endless"`` ones, those with ``"movers"``, or ``"all"``.
        default: whether tables have the column by default.
        root: whether it is the square root of the ratio.
    """

    heading: str
    unit: str
    meaning: str
    top: str | Callable[[Row], float]
    bottom: str | None = None
    of: Literal["goal", "endless", "movers", "all"] = "all"
    default: bool = False
    root: bool = False

    def estimate(self, rows: Sequence[Row]) -> Estimate:
        values = [row[self.top] if isinstance(self.top, str) else self.top(row) for row in rows]
        if all(isinstance(value, bool) for value in values) and self.bottom is None:
            return proportion(sum(map(int, values)), len(values))
        found = ratio(values, None if self.bottom is None else [row[self.bottom] for row in rows])
        return Estimate(*map(math.sqrt, (found.value, found.low, found.high))) if self.root else found


def _ended(*endings: str) -> Callable[[Row], bool]:
    return lambda row: row["ending"] in endings


_CLEAN = "episodes that reach their goal without touching an obstacle"
_TOUCHED = "episodes in which the body touches an obstacle, other than rubble lower than the wheel hubs"
_FAULT = "contacts with movers that begin while the rover moves, per goal reached"
_RUN_INTO = "contacts with movers that begin while the rover stands still"
_RISK = "time with the centers of rover and mover within 0.5 m, per goal reached"
METRICS = {
    "success_rate": Metric("success", "%", "episodes that reach their goal", "success", of="goal", default=True),
    "contact_free_success_rate": Metric("clean", "%", _CLEAN, "clean", of="goal", default=True),
    "spl": Metric("SPL", "", "success weighted by path length", "spl", of="goal", default=True),
    # [MTT] It is short for a policy that reaches near goals only.
    "mean_time_to_traverse": Metric(
        "time", "s", "mean time to a reached goal", "success_seconds", "success", of="goal", default=True
    ),
    "goals_per_episode": Metric("goals", "", "goals reached per episode", "goals", of="endless", default=True),
    "seconds_per_goal": Metric(
        "per goal", "s", "driving time per goal reached", "seconds", "goals", of="endless", default=True
    ),
    "ended_early": Metric(
        "early", "%", "episodes that end before the time limit", _ended(*EARLY_ENDINGS), of="endless", default=True
    ),
    "body_contact_share": Metric("touched", "%", _TOUCHED, lambda row: row["contacts"] > 0, default=True),
    "mover_contact_share": Metric(
        *("mover touched", "%", "episodes in which the body touches a mover"),
        lambda row: row["mover_contacts"] > 0,
        of="movers",
        default=True,
    ),
    "run_into": Metric("run into", "%", _RUN_INTO, "run_into", "mover_contacts", of="movers", default=True),
    "least_mover_distance": Metric(
        *("least distance", "m", "mean of the least distance to a mover", "least_mover_distance"),
        of="movers",
        default=True,
    ),
    **{
        ENDING + kind.replace(" ", "_"): Metric(kind, "%", "", _ended(kind), default=True)
        for kind in (TIME_LIMIT, *EARLY_ENDINGS)
    },
    # [TR] A failure contributes its time and no length, since SPL does not credit partial progress either.
    "traverse_rate": Metric(
        *("traverse rate", "m/s", "shortest-path length to reached goals per second of driving"),
        *("success_shortest", "seconds", "goal"),
    ),
    "episode_seconds": Metric("duration", "s", "mean duration of an episode", "seconds", of="endless"),
    # [VORT] nan if no ground is rough, as in the maze.
    "velocity_over_rough_terrain": Metric(
        *("speed on rough", "m/s", "mean speed on ground with a tilt of 10 degrees or more"),
        *("rough_speed", "rough_steps"),
    ),
    "collisions": Metric("collisions", "", "collisions per episode, as the task defines them", "collisions"),
    "body_contacts": Metric("touches", "", "contacts of the body with obstacles per episode", "contacts"),
    # Circling is a common failure of policies for this task. Good policies have about 0.45 turns per goal.
    "turns_per_goal": Metric("turns", "", "full turns per goal reached", "turns", "goals"),
    "standstill": Metric("still", "%", "time spent slower than 0.05 m/s", "still_steps", "steps"),
    "command_reversals": Metric(
        "reversals", "1/s", "changes of the commanded turning direction per second", "reversals", "seconds"
    ),
    "jerk": Metric("jerk", "m/s^3", "root mean square jerk of the driven speed", "jerk", "jerk_steps", root=True),
    "at_fault": Metric("at fault", "1/goal", _FAULT, "at_fault", "goals", of="movers"),
    "wall_contact_share": Metric(
        *("wall touched", "%", "episodes in which the body touches an obstacle at rest"),
        lambda row: row["wall_contacts"] > 0,
        of="movers",
    ),
    "mover_contacts": Metric(
        "mover touches", "", "contacts of the body with movers per episode", "mover_contacts", of="movers"
    ),
    "risk_per_goal": Metric("risk", "s/goal", _RISK, "risk_seconds", "goals", of="movers"),
    "intrusion": Metric("intrusion", "%", "time within 1.2 m of a mover", "intrusion_seconds", "seconds", of="movers"),
    "frozen": Metric(
        "frozen", "%", "time spent slower than 0.05 m/s within 2 m of a mover", "frozen_seconds", "seconds", of="movers"
    ),
}
"""All metrics by name, in the order in which tables show them. A new one is an entry here.

:meta hide-value:
"""


def compute_metrics(rows: Sequence[Row], endless: bool = False) -> dict[str, Estimate]:
    """Computes the metrics of episodes with one goal each, or of ``endless`` ones, by name.

    Those of movers are of the episodes in worlds with movers, if there are any.
    """
    met = [row for row in rows if "mover_contacts" in row]
    kinds = {"all": rows, "endless" if endless else "goal": rows, **({"movers": met} if met else {})}
    return {name: metric.estimate(kinds[metric.of]) for name, metric in METRICS.items() if metric.of in kinds}
