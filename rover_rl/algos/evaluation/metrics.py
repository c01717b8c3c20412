"""Evaluation metrics: functions of recorded trajectories, with 95 % confidence intervals.

Names in brackets are those of the original environment, which has no formula for MTT and TR and never logs VORT.
Proportions of episodes have Wilson score intervals, all other metrics are ratios of sums over episodes with percentile
bootstrap intervals. They cover the variation between episodes, not between training runs: train with several seeds to
measure that.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from inspect import signature
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rover_rl.algos.driving import EARLY_ENDINGS, TIME_LIMIT
from rover_rl.algos.evaluation.body_contacts import is_touching
from rover_rl.envs.rewards import STANDSTILL as STANDSTILL
from rover_rl.robots import Robot
from rover_rl.rotations import wrap_angle
from rover_rl.sims.settings import CONTROL_DT
from rover_rl.worlds import World

ROUGH_TILT = math.radians(10)
"""Smallest tilt of the rover, in any direction, on rough ground, rad. Rough ground makes up most of inspect, a tenth of
moon, and nothing of maze. The original environment defines rough ground by an acceleration above 15 m/s^2, which a
wheeled rover does not reach at 1 m/s: the maximum in the 20 Hz positions of 192 episodes in the three worlds is
10 m/s^2."""
RISK = 0.5  #: Distance from the rover's origin to that of a mover below which the rover is at risk, m.
PERSONAL = 1.2  #: Distance between rover and mover below which the rover intrudes on the mover's space, m.
FREEZING = 2.0  #: Distance between rover and mover within which a rover that stands still counts as frozen, m.
RESAMPLES = 2000  #: Number of bootstrap resamples.


@dataclass(frozen=True)
class Estimate:
    """A value, nan if it is undefined, and the ends of its 95 % confidence interval, nan with too few episodes."""

    value: float
    low: float
    high: float


class Encounters(NamedTuple):
    """What happens between the rover and movers in an episode of T steps, at the start and after each step.

    Attributes:
        contact: whether the rover touched a mover in the step, bool ``[T + 1]``.
        gap: horizontal distance from the disc of the robot's radius around the rover to the surface of the nearest
            mover, 0 if they overlap, float32 ``[T + 1]``, m.
        center_distance: horizontal distance from the origin of the rover to that of the nearest mover, float32
            ``[T + 1]``, m.
    """

    contact: Tensor
    gap: Tensor
    center_distance: Tensor


class MoverTrack(NamedTuple):
    """Where the P solids of the movers are in an episode of T steps, at the start and after each step.

    A track of the last seconds of an episode begins later.

    Attributes:
        kind: index in ``rover_rl.worlds.movers.shapes.KINDS``, int32 ``[P]``.
        half: half of the length, width and height, float32 ``[P, 3]``, m.
        mover: index of the solid's mover in the world's ``movers``, int64 ``[P]``.
        position: centers, float32 ``[T + 1, P, 3]``, m.
        orientation: orientations, unit quaternions (x, y, z, w), float32 ``[T + 1, P, 4]``.
    """

    kind: Tensor
    half: Tensor
    mover: Tensor
    position: Tensor
    orientation: Tensor


@dataclass(frozen=True)
class Trajectory:
    """Record of one episode of T steps.

    Attributes:
        position: positions at the start and after each step, float32 ``[T + 1, 3]``, m.
        angles: roll, pitch and yaw at the start and after each step, float32 ``[T + 1, 3]``, rad.
        collision: whether each step ends in a collision, as the task defines it, bool ``[T]``.
        goal: whether each step reaches a goal, bool ``[T]``.
        ending: ``"goal"``, :data:`TIME_LIMIT`, or one of :data:`EARLY_ENDINGS`.
        reversals: number of changes of the commanded turning direction; nan if commands are not recorded.
        dt: duration of a step, s.
        encounters: what happens between the rover and movers; ``None`` if the world has none.
        movers: where the movers are; ``None`` if the world has none, or if this was not asked for.
    """

    position: Tensor
    angles: Tensor
    collision: Tensor
    goal: Tensor
    ending: str
    reversals: float = math.nan
    dt: float = CONTROL_DT
    encounters: Encounters | None = None
    movers: MoverTrack | None = None

    def __len__(self) -> int:
        return len(self.collision)

    def touching(self, walls: Tensor) -> Tensor:
        """Returns contacts with anything, bool ``[T + 1]``: those of :func:`find_body_contacts`, and with movers."""
        return walls if self.encounters is None else walls | self.encounters.contact

    def until(self, steps: int, ending: str) -> Trajectory:
        """Returns the first ``steps`` steps as an episode with the given ending."""
        states: dict[str, Any] = {key: getattr(self, key)[: steps + 1] for key in ("position", "angles")}
        events = {key: getattr(self, key)[:steps] for key in ("collision", "goal")}
        if self.encounters is not None:
            states["encounters"] = Encounters(*(values[: steps + 1] for values in self.encounters))
        if self.movers is not None:
            kept = max(0, len(self.movers.position) - (len(self) - steps))
            places = {key: getattr(self.movers, key)[:kept] for key in ("position", "orientation")}
            states["movers"] = self.movers._replace(**places)
        return replace(self, **states, **events, ending=ending)

    @property
    def seconds(self) -> float:
        """Duration of the episode, s."""
        return len(self) * self.dt

    @property
    def path(self) -> Tensor:
        """Positions seen from above, ``[T + 1, 2]``, m."""
        return self.position[:, :2]

    @property
    def length(self) -> float:
        """Length of the path seen from above, m."""
        return self.path.double().diff(dim=0).norm(dim=1).sum().item()

    @cached_property
    def speed(self) -> Tensor:
        """Mean speed of the body (not of the wheels) over ground in each step, ``[T]``, m/s."""
        return self.position.diff(dim=0).norm(dim=1) / self.dt

    @property
    def signed_speed(self) -> Tensor:
        """:attr:`speed`, negative in steps in which the rover moves backward, ``[T]``, m/s."""
        yaw = self.angles[:-1, 2]
        forward = (self.path.diff(dim=0) * torch.stack((yaw.cos(), yaw.sin()), -1)).sum(-1)
        return torch.copysign(self.speed, forward)

    @property
    def tilt(self) -> Tensor:
        """Angle between the vertical axes of the rover and the world after each step, ``[T]``, rad."""
        roll, pitch, _ = self.angles[1:].unbind(-1)
        return torch.arccos((roll.cos() * pitch.cos()).clamp(-1, 1))

    @property
    def turns(self) -> float:
        """Number of full turns: the sum of all absolute changes of heading, divided by 2 pi."""
        return wrap_angle(self.angles[:, 2].double().diff()).abs().sum().item() / (2 * math.pi)


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


def contact_free_success_rate(trajectories: Sequence[Trajectory], contacts: Sequence[Tensor]) -> Estimate:
    """Proportion of episodes that reach their goal without a contact: see :func:`find_body_contacts`.

    Contacts with movers, which the trajectories have, count too.
    """
    pairs = zip(trajectories, contacts, strict=True)
    clean = sum(t.ending == "goal" and not t.touching(touched).any() for t, touched in pairs)
    return proportion(clean, len(trajectories))


def ending_share(trajectories: Sequence[Trajectory], *endings: str) -> Estimate:
    """Proportion of episodes with one of the given endings."""
    return proportion(sum(t.ending in endings for t in trajectories), len(trajectories))


def spl(trajectories: Sequence[Trajectory], shortest: Tensor) -> Estimate:
    """Success weighted by path length: the mean of ``S l / max(p, l)``, between 0 and 1.

    ``S`` is 1 for a success and 0 otherwise, ``p`` is the length of the driven path and ``l`` that of the shortest
    path, both seen from above (Anderson et al., "On Evaluation of Embodied Navigation Agents", 2018, arXiv:1807.06757).
    ``shortest`` has the lengths of the shortest paths, ``[count]``, m.
    """
    pairs = zip(trajectories, shortest.tolist(), strict=True)
    return ratio([(t.ending == "goal") * least / max(t.length, least, 1e-9) for t, least in pairs])


def mean_time_to_traverse(trajectories: Sequence[Trajectory]) -> Estimate:
    """[MTT] Mean time to the goal of the episodes that reach it, s: short for a policy that reaches near goals only."""
    reached = [t.ending == "goal" for t in trajectories]
    return ratio([t.seconds * r for t, r in zip(trajectories, reached, strict=True)], reached)


def traverse_rate(trajectories: Sequence[Trajectory], shortest: Tensor) -> Estimate:
    """[TR] Shortest-path length to reached goals per second of driving: ``sum(S l) / sum(t)``, m/s.

    A failure contributes its time ``t`` and no length, since SPL does not credit partial progress either.
    ``shortest`` is that of :func:`spl`.
    """
    pairs = zip(trajectories, shortest.tolist(), strict=True)
    return ratio([(t.ending == "goal") * least for t, least in pairs], [t.seconds for t in trajectories])


def velocity_over_rough_terrain(trajectories: Sequence[Trajectory]) -> Estimate:
    """[VORT] Mean speed over ground in the steps with a tilt of 10 degrees or more, m/s.

    The value is nan if no ground is rough, as in the maze. The original defines rough ground by acceleration.
    """
    rough = [t.tilt >= ROUGH_TILT for t in trajectories]
    return ratio(
        [t.speed[r].sum().item() for t, r in zip(trajectories, rough, strict=True)], [r.sum().item() for r in rough]
    )


def count_reversals(yaw_rates: Sequence[float]) -> int:
    """Counts the changes of sign in successive yaw rates (rad/s), ignoring zeros.

    Example:
        >>> count_reversals([0.5, 0.0, -0.5, -0.1, 0.2])
        2
    """
    turning = [yaw_rate for yaw_rate in yaw_rates if yaw_rate]
    return sum(a * b < 0 for a, b in pairwise(turning))


def jerk(trajectories: Sequence[Trajectory]) -> Estimate:
    """Root mean square jerk of the driven speed, m/s^3: ``sqrt(mean(((v[k+1] - 2 v[k] + v[k-1]) / dt^2)^2))``.

    ``v[k]`` is the mean speed over ground in step k, negative if the rover moves backward. The mean is over all steps
    of all episodes that have a step before and a step after them. The speed of a wheel does not count.
    """
    squares = [(t.signed_speed.double().diff(n=2) / t.dt**2).square() for t in trajectories]
    mean = ratio([s.sum().item() for s in squares], [len(s) for s in squares])
    return Estimate(*(math.sqrt(end) for end in (mean.value, mean.low, mean.high)))


def count_runs(flags: Tensor) -> int:
    """Counts the runs of consecutive true values in ``flags``, bool ``[T]``."""
    flags = flags.to(torch.int8)
    return int(flags[:1].sum() + (flags.diff() > 0).sum())


def find_body_contacts(
    trajectories: Sequence[Trajectory], world: World | Sequence[World], robot: Robot | Sequence[Robot]
) -> list[Tensor]:
    """Finds the poses of each episode at which the rover's body touches an obstacle at rest, bool ``[T + 1]`` each.

    See :func:`~rover_rl.algos.evaluation.body_contacts.is_touching`. A contact need not be a lidar collision: at the
    sides and at the rear, the outline may be farther from the lidar. ``world`` and ``robot`` are those of all episodes,
    or of each.
    """
    worlds = [world] * len(trajectories) if isinstance(world, World) else world
    robots = [robot] * len(trajectories) if isinstance(robot, Robot) else robot
    together: dict[tuple[World, Robot], list[int]] = {}
    for episode, pair in enumerate(zip(worlds, robots, strict=True)):
        together.setdefault(pair, []).append(episode)
    contacts: dict[int, Tensor] = {}
    for (place, driven), episodes in together.items():
        members = [trajectories[episode] for episode in episodes]
        position, angles = (torch.cat([getattr(t, key) for t in members]) for key in ("position", "angles"))
        touched = is_touching(position, angles, place, driven)
        contacts |= zip(episodes, touched.split([len(t.position) for t in members]), strict=True)
    return [contacts[episode] for episode in range(len(trajectories))]


class EncounterFigures(NamedTuple):
    """Figures of one episode in a world with movers: see :func:`encounter_figures`."""

    mover_contacts: int
    run_into: int
    least_mover_distance: float
    risk_seconds: float
    intrusion_seconds: float
    frozen_seconds: float

    @property
    def at_fault(self) -> int:
        """Number of contacts that begin while the rover moves."""
        return self.mover_contacts - self.run_into


def encounter_figures(trajectory: Trajectory) -> EncounterFigures:
    """Computes the figures of one episode in a world with movers.

    - ``mover_contacts``: number of contacts with movers. Consecutive steps in contact are one.
    - ``run_into``: number of contacts that begin while the rover stands still: its speed in the step before the
      contact is below 0.05 m/s. The step of the contact itself does not tell, as the mover pushes the rover.
    - ``least_mover_distance``: least distance between the disc of the robot's radius and a mover, m.
    - ``risk_seconds``: time with the origins of rover and mover within 0.5 m, s. RoboTerrain's definition
      (https://github.com/jackvice/RoboTerrain).
    - ``intrusion_seconds``: time with a mover within 1.2 m of the disc, s. People keep others out of this personal
      space (Hall, "The Hidden Dimension", 1966).
    - ``frozen_seconds``: time for which the rover is slower than 0.05 m/s with a mover within 2 m of the disc, s
      (Trautman and Krause, "Unfreezing the robot", IROS 2010).

    Raises:
        ValueError: if the trajectory has no encounters.
    """
    if trajectory.encounters is None:
        raise ValueError("the trajectory has no encounters with movers")
    contact, gap, center_distance = trajectory.encounters
    standing = trajectory.speed < STANDSTILL
    # Rovers start at rest.
    stood = torch.cat((standing.new_ones(1), standing[:-1]))
    begins = contact[1:] & ~contact[:-1]

    def seconds(flags: Tensor) -> float:
        return int(flags.sum()) * trajectory.dt

    return EncounterFigures(
        mover_contacts=count_runs(contact),
        run_into=int((begins & stood).sum()) + int(contact[0]),
        least_mover_distance=gap.min().item(),
        risk_seconds=seconds(center_distance[1:] < RISK),
        intrusion_seconds=seconds(gap[1:] < PERSONAL),
        frozen_seconds=seconds(standing & (gap[1:] < FREEZING)),
    )


class Drives(list[Trajectory]):
    """Recorded episodes, with the flags of :func:`find_body_contacts` and the shortest lengths of :func:`spl`."""

    def __init__(
        self, trajectories: Sequence[Trajectory], contacts: Sequence[Tensor], shortest: Tensor | None = None
    ) -> None:
        super().__init__(trajectories)
        self.shortest = torch.zeros(0) if shortest is None else shortest
        self.walls = contacts
        self.contacts = [t.touching(walls) for t, walls in zip(self, contacts, strict=True)]
        self.touches = [count_runs(touched) for touched in self.contacts]
        self.goals = [t.goal.sum().item() for t in self]
        self.seconds = [t.seconds for t in self]

    @cached_property
    def meeting(self) -> Drives:
        """Episodes in worlds with movers."""
        met = [number for number, t in enumerate(self) if t.encounters is not None]
        return Drives([self[number] for number in met], [self.walls[number] for number in met])

    @cached_property
    def figures(self) -> list[EncounterFigures]:
        """Figures of each episode, if all are in worlds with movers."""
        return [encounter_figures(t) for t in self]


@dataclass(frozen=True)
class Metric:
    """A metric: its column in tables, and its formula.

    Attributes:
        heading: heading of the column.
        unit: ``"%"`` for proportions, which are stored as numbers up to 1, else that of the value.
        meaning: short description for the legend; empty for endings, whose heading describes them.
        of: computes the metric.
        default: whether tables have the column by default.
    """

    heading: str
    unit: str
    meaning: str
    of: Callable[[Drives], Estimate]
    default: bool = False


def _ended(*endings: str) -> Callable[[Drives], Estimate]:
    return lambda d: ending_share(d, *endings)


def _standstill(d: Drives) -> Estimate:
    return ratio([(t.speed < STANDSTILL).sum().item() for t in d], [len(t) for t in d])


def _body_contact_share(d: Drives) -> Estimate:
    return proportion(sum(count > 0 for count in d.touches), len(d))


def _wall_contact_share(d: Drives) -> Estimate:
    return proportion(sum(bool(touched.any()) for touched in d.walls), len(d))


def _mover_contact_share(d: Drives) -> Estimate:
    return proportion(sum(each.mover_contacts > 0 for each in d.figures), len(d))


def _figure(name: str, per: Callable[[Drives], Sequence[float]] | None = None) -> Callable[[Drives], Estimate]:
    return lambda d: ratio([getattr(each, name) for each in d.figures], None if per is None else per(d))


ENDING = "ending_"  #: First part of the names of metrics that are shares of endings.
_ON_GROUND = "mean speed on ground with a tilt of 10 degrees or more"
_CLEAN = "episodes that reach their goal without touching an obstacle"
_TOUCHED = "episodes in which the body touches an obstacle, other than rubble lower than the wheel hubs"
_RATE = "shortest-path length to reached goals per second of driving"
_REVERSALS = "changes of the commanded turning direction per second"
_ONE_GOAL = {
    "success_rate": Metric("success", "%", "episodes that reach their goal", _ended("goal"), True),
    "contact_free_success_rate": Metric("clean", "%", _CLEAN, lambda d: contact_free_success_rate(d, d.contacts), True),
    "spl": Metric("SPL", "", "success weighted by path length", lambda d: spl(d, d.shortest), True),
    "mean_time_to_traverse": Metric("time", "s", "mean time to a reached goal", mean_time_to_traverse, True),
    "traverse_rate": Metric("traverse rate", "m/s", _RATE, lambda d: traverse_rate(d, d.shortest)),
}
_ENDLESS = {
    "goals_per_episode": Metric("goals", "", "goals reached per episode", lambda d: ratio(d.goals), True),
    "seconds_per_goal": Metric(
        "per goal", "s", "driving time per goal reached", lambda d: ratio(d.seconds, d.goals), True
    ),
    "episode_seconds": Metric("duration", "s", "mean duration of an episode", lambda d: ratio(d.seconds)),
    "ended_early": Metric("early", "%", "episodes that end before the time limit", _ended(*EARLY_ENDINGS), True),
}
_BOTH = {
    "velocity_over_rough_terrain": Metric("speed on rough", "m/s", _ON_GROUND, velocity_over_rough_terrain),
    "collisions": Metric(
        "collisions",
        "",
        "collisions per episode, as the task defines them",
        lambda d: ratio([count_runs(t.collision) for t in d]),
    ),
    "body_contacts": Metric(
        "touches", "", "contacts of the body with obstacles per episode", lambda d: ratio(d.touches)
    ),
    "body_contact_share": Metric("touched", "%", _TOUCHED, _body_contact_share, True),
    # Circling is a common failure of policies for this task. Good policies have about 0.45 turns per goal.
    "turns_per_goal": Metric(
        "turns", "", "full turns per goal reached", lambda d: ratio([t.turns for t in d], d.goals)
    ),
    "standstill": Metric("still", "%", "time spent slower than 0.05 m/s", _standstill),
    # Steady heading control has about one per second. A controller that oscillates has up to 20 at 20 Hz.
    "command_reversals": Metric("reversals", "1/s", _REVERSALS, lambda d: ratio([t.reversals for t in d], d.seconds)),
    "jerk": Metric("jerk", "m/s^3", "root mean square jerk of the driven speed", jerk),
    **{
        ENDING + kind.replace(" ", "_"): Metric(kind, "%", "", _ended(kind), True)
        for kind in (TIME_LIMIT, *EARLY_ENDINGS)
    },
}
_WITH_MOVERS = {
    "mover_contact_share": Metric(
        "mover touched", "%", "episodes in which the body touches a mover", _mover_contact_share, True
    ),
    "run_into": Metric(
        "run into",
        "%",
        "contacts with movers that begin while the rover stands still",
        _figure("run_into", lambda d: [each.mover_contacts for each in d.figures]),
        True,
    ),
    "at_fault": Metric(
        "at fault",
        "1/goal",
        "contacts with movers that begin while the rover moves, per goal reached",
        _figure("at_fault", lambda d: d.goals),
    ),
    "least_mover_distance": Metric(
        "least distance", "m", "mean of the least distance to a mover", _figure("least_mover_distance"), True
    ),
    "wall_contact_share": Metric(
        "wall touched", "%", "episodes in which the body touches an obstacle at rest", _wall_contact_share
    ),
    "mover_contacts": Metric(
        "mover touches", "", "contacts of the body with movers per episode", _figure("mover_contacts")
    ),
    "risk_per_goal": Metric(
        "risk",
        "s/goal",
        "time with the centers of rover and mover within 0.5 m, per goal reached",
        _figure("risk_seconds", lambda d: d.goals),
    ),
    "intrusion": Metric(
        "intrusion", "%", "time within 1.2 m of a mover", _figure("intrusion_seconds", lambda d: d.seconds)
    ),
    "frozen": Metric(
        "frozen",
        "%",
        "time spent slower than 0.05 m/s within 2 m of a mover",
        _figure("frozen_seconds", lambda d: d.seconds),
    ),
}
"""Metrics of episodes in worlds with movers."""
METRICS = dict(
    sorted(
        (_ONE_GOAL | _ENDLESS | _BOTH | _WITH_MOVERS).items(),
        key=lambda item: (not item[1].default, item[0].startswith(ENDING)),
    )
)
"""All metrics by name, in the order in which tables show them. A new one is an entry in one of the tables above.

:meta hide-value:
"""


def goal_metrics(
    trajectories: Sequence[Trajectory], shortest: Tensor, contacts: Sequence[Tensor]
) -> dict[str, Estimate]:
    """Computes the metrics of episodes with one goal each, by name: see :class:`Drives`."""
    return _computed(_ONE_GOAL, Drives(trajectories, contacts, shortest))


def endless_metrics(trajectories: Sequence[Trajectory], contacts: Sequence[Tensor]) -> dict[str, Estimate]:
    """Computes the metrics of endless episodes, by name: see :class:`Drives`."""
    return _computed(_ENDLESS, Drives(trajectories, contacts))


def _computed(table: Mapping[str, Metric], drives: Drives) -> dict[str, Estimate]:
    found = {name: metric.of(drives) for name, metric in {**table, **_BOTH}.items()}
    if drives.meeting:
        found |= {name: metric.of(drives.meeting) for name, metric in _WITH_MOVERS.items()}
    return found
