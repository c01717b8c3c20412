"""Suites: fixed courses in the worlds of others, in which any contact of the body is a failure.

A run of a course ends at its goal, at the first contact of the body's outline, or at the time limit, and in no other
way. The observation of a policy is that of the environment it was made for. A new benchmark is a module with a
function that reads its courses, and a subclass of :class:`Suite`, as in ``barn.py``.
"""

from __future__ import annotations

import math
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from rich.console import Console
from rich.markup import escape
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.algos.driving import CONTACT, TIME_LIMIT
from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.evaluate import Policy, Request, evaluate_all
from rover_rl.algos.evaluation.metrics import Estimate, proportion, ratio
from rover_rl.algos.evaluation.plots import TRACE, draw_panels
from rover_rl.algos.evaluation.report import Column, cell, print_tables, write_rows
from rover_rl.algos.evaluation.results import Evaluation, plain_env_or_none, plain_estimates
from rover_rl.algos.evaluation.trajectory import Trajectory, is_touching
from rover_rl.checks import MAX_COUNT, MAX_SECONDS, check_at_least, check_seed
from rover_rl.envs.actions import action_bounds
from rover_rl.envs.config import EnvConfig
from rover_rl.files import MADE_BY, write_json
from rover_rl.robots import Robot, get_robot
from rover_rl.worlds import Solids, Terrain, World
from rover_rl.worlds.movers import Mover
from rover_rl.worlds.pool import WorldPool

COLUMNS = {
    "success_rate": ("success", "%"),
    "contact_rate": ("contacts", "%"),
    "time_limit_rate": ("time-outs", "%"),
    "mean_time": ("mean time", "s"),
}
"""Headings and units of the metrics that all suites share."""
JITTER = (0.05, 0.05, 0.1)  # largest change of x (m), y (m), yaw (rad) of a start in all runs but the first
MAX_RUNS = 1000  # largest number of runs of a course
WORST_RUNS = 6  # number of runs in a picture
_TRIES = 32  # number of changed starts of which the first without a contact is taken
_MARGIN = 5  # width of the open ground around a course, m
_BOUND = 1e4  # distance of the bounds of a course, which no run reaches, m


class Course(NamedTuple):
    """A world with a start (x, y in m, yaw in rad), a goal (x, y in m), and the length of the reference path, m."""

    number: int  #: That of the world in its benchmark.
    world: World
    start: tuple[float, float, float]
    goal: tuple[float, float]
    length: float


def open_world(name: str, obstacles: Sequence[Solids], points: np.ndarray, movers: Sequence[Mover] = ()) -> World:
    """A world on flat, open ground around ``points [P, 2]`` (m), whose bounds no run reaches."""
    low = np.floor(points.min(0)) - _MARGIN
    columns, rows = (np.ceil(points.max(0)) + _MARGIN - low).astype(int) + 1
    terrain = Terrain(torch.zeros(int(rows), int(columns)), cell=1.0, origin=(float(low[0]), float(low[1])))
    # The environment needs areas for starts and goals: free ground left of the course.
    (left, _), across = terrain.extent
    beside = (left, left + _MARGIN - 1.0), across
    bounds = (-_BOUND, _BOUND), (-_BOUND, _BOUND)
    return World(name, terrain, obstacles, spawn_range=beside, goal_range=beside, bounds=bounds, movers=movers)


@dataclass(kw_only=True)
class Suite(ABC):
    """Courses of a benchmark, and how runs of them are scored. Raises ``ValueError`` for a number out of range."""

    name: ClassVar[str]  #: Name of the benchmark.
    score_name: ClassVar[str]  #: Key of a run's score.
    columns: ClassVar[Mapping[str, tuple[str, str]]]  #: Headings and units of the metrics in a table, by key.
    places: ClassVar[str] = "worlds"  #: What a table calls the worlds.
    worlds: ClassVar[str]  #: How the worlds differ from those of the original benchmark.
    robot: ClassVar[str]  #: How the robot differs from that of the original benchmark.
    lidar: ClassVar[str]  #: How the lidar differs from that of the original benchmark.

    courses: Sequence[Course] = field(kw_only=False)
    runs: int = 1  #: Number of runs of each course. All but the first start near the given start.
    seed: int = 0  #: Seed of these starts.
    goal_radius: float  #: Distance from the goal at which it is reached, m.
    seconds: float  #: Time limit of a run, s.

    def __post_init__(self) -> None:
        check_at_least(1, MAX_RUNS, runs=self.runs)
        check_at_least(0.05, 100.0, goal_radius=self.goal_radius)
        check_at_least(0.05, MAX_SECONDS, seconds=self.seconds)
        check_seed(self.seed)
        if not self.courses:
            raise ValueError(f"{self.name} needs at least one world")

    @abstractmethod
    def score(self, course: Course, run: Trajectory) -> float:
        """Returns the score of a run."""

    def metrics(self, result: Result) -> dict[str, Estimate]:
        """Metrics that a table shows, by the keys of its columns."""
        return {**result.common_metrics(), self.score_name: ratio(result.scores.mean(1).tolist())}

    def differences(self, env: EnvConfig) -> list[str]:
        """How runs in an environment differ from the original benchmark: a sentence each."""
        mine, settings = get_robot(env.robot), env.lidar
        back, front, right, left = mine.footprint
        size = f"{front - back:.2f} x {left - right:.2f} m"
        seen = "" if mine.lidar_view == 2 * math.pi else f", of which {math.degrees(mine.lidar_view):.0f} are seen"
        beams = f"{settings.beams} beams in 360 degrees{seen}, up to {settings.max_range:g} m"
        away = f"{100 * JITTER[0]:g} cm in x and y and {JITTER[2]:g} rad away, drawn with seed {self.seed}"
        return [
            self.worlds,
            f"Robot: {mine.name}, {size}, up to {action_bounds(env.bounded_action).high[0]:g} m/s{self.robot}.",
            f"Lidar: {beams}, as {settings.points} readings ({self.name}: {self.lidar}).",
            f"Simulator: {env.backend}, 20 Hz, without noise.",
            "Contact: the footprint, a rectangle, comes within 1 cm of an obstacle, checked at 20 Hz.",
            *[f"Starts: all runs but the first of each start up to {away}."] * (self.runs > 1),
        ]

    @property
    def title(self) -> str:
        runs = "one run each" if self.runs == 1 else f"{self.runs} runs each"
        limits = f"goal within {self.goal_radius:g} m and {self.seconds:g} s, any contact fails"
        return f"{self.name}: {len(self.courses)} {self.places}, {runs}; {limits}"

    def episodes(self, robot: Robot) -> EpisodeSet:
        start = torch.cat([self._starts(course, robot) for course in self.courses])
        goal = torch.tensor([course.goal for course in self.courses]).repeat_interleave(self.runs, 0)
        length = torch.tensor([course.length for course in self.courses]).repeat_interleave(self.runs)
        index = torch.arange(len(self.courses)).repeat_interleave(self.runs)
        pool = WorldPool(*(course.world for course in self.courses))
        return EpisodeSet(self.name, pool, self.seed, start, goal, length, world_index=index)

    def _starts(self, course: Course, robot: Robot) -> Tensor:
        starts = [torch.tensor(course.start)]
        for run in range(1, self.runs):
            rng = np.random.default_rng((self.seed, course.number, run))
            near = starts[0] + torch.from_numpy(rng.uniform(-1, 1, (_TRIES, 3)) * JITTER).float()
            position, angles = pad(near[:, :2], (0, 1)), pad(near[:, 2:], (2, 0))
            free = ~is_touching(position, angles, course.world, robot)
            starts.append(near[int(free.to(torch.uint8).argmax())] if free.any() else starts[0])
        return torch.stack(starts)

    def environment(self, env: EnvConfig) -> EnvConfig:
        """An environment in which only the goal and the time limit end a run."""
        never = {"collision_window": MAX_COUNT, "stuck_threshold": 0.0, "flip_threshold": 2 * math.pi}
        return replace(env, task=replace(env.task, success_distance=self.goal_radius, **never))  # type: ignore[arg-type]

    def ended(self, evaluation: Evaluation) -> Evaluation:
        """Ends each run at its first contact, which is computed from the poses."""
        runs = [
            run.until(int(touched.to(torch.uint8).argmax()), CONTACT) if touched.any() else run
            for run, touched in zip(evaluation.trajectories, evaluation.contacts, strict=True)
        ]
        return replace(evaluation, trajectories=runs)


@dataclass(frozen=True)
class Result:
    """Results of a policy in a suite: its runs, course by course, each up to its first contact."""

    suite: Suite
    evaluation: Evaluation

    @property
    def name(self) -> str:
        return self.evaluation.name

    @cached_property
    def scores(self) -> Tensor:
        """Score of each run, float64 ``[courses, runs]``."""
        return self.by_course([self.suite.score(course, run) for course, run in self._pairs])

    @property
    def succeeded(self) -> Tensor:
        """1 for each run that reached its goal, else 0, float64 ``[courses, runs]``."""
        return self._ended("goal")

    @cached_property
    def metrics(self) -> dict[str, Estimate]:
        return self.suite.metrics(self)

    def common_metrics(self) -> dict[str, Estimate]:
        seconds, succeeded = self.by_course([run.seconds for _, run in self._pairs]), self.succeeded
        return {
            "success_rate": mean_rate(succeeded),
            "contact_rate": mean_rate(self._ended(CONTACT)),
            "time_limit_rate": mean_rate(self._ended(TIME_LIMIT)),
            "mean_time": ratio((succeeded * seconds).sum(1).tolist(), succeeded.sum(1).tolist()),
        }

    def rows(self) -> list[dict[str, Any]]:
        rows = []
        for number, ((course, run), score) in enumerate(zip(self._pairs, self.scores.flatten().tolist(), strict=True)):
            driven = {"seconds": round(run.seconds, 3), "length": run.length, "reference_length": course.length}
            head = {"world": course.number, "run": number % self.suite.runs, "ending": run.ending}
            rows.append(head | driven | {self.suite.score_name: score})
        return rows

    def worst(self, count: int) -> list[int]:
        """Indices of the runs with the lowest scores; among equals, those that end farthest from the goal."""
        goals, scores = self.evaluation.episodes.goal, self.scores.flatten().tolist()
        left = [torch.dist(run.path[-1], goal).item() for (_, run), goal in zip(self._pairs, goals, strict=True)]
        return sorted(range(len(left)), key=lambda run: (scores[run], -left[run]))[:count]

    def by_course(self, values: Sequence[float]) -> Tensor:
        """A value of each run as float64 ``[courses, runs]``."""
        return torch.tensor(values, dtype=torch.float64).reshape(len(self.suite.courses), self.suite.runs)

    @property
    def _pairs(self) -> list[tuple[Course, Trajectory]]:
        courses = [course for course in self.suite.courses for _ in range(self.suite.runs)]
        return [*zip(courses, self.evaluation.trajectories, strict=True)]

    def _ended(self, ending: str) -> Tensor:
        return self.by_course([float(run.ending == ending) for _, run in self._pairs])


def mean_rate(flags: Tensor) -> Estimate:
    """Mean of flags ``[courses, runs]``. Its interval is Wilson's for one run each or equal flags, else a bootstrap."""
    rates = flags.mean(1)
    if flags.shape[1] == 1 or flags.min() == flags.max():
        return proportion(round(rates.sum().item()), len(rates))
    return ratio(rates.tolist())


def run_suite(
    suite: Suite, policies: Mapping[str, tuple[Policy | None, EnvConfig]], workers: int | None = None
) -> list[Result]:
    """Runs policies (``None`` acts at random) in a suite. The results do not depend on the number of processes."""
    requests = []
    for name, (policy, env) in policies.items():
        options = {"name": name, "seconds": suite.seconds, "env": suite.environment(env), "track_movers": TRACE}
        requests.append(Request(policy, suite.episodes(get_robot(env.robot)), options))
    return [Result(suite, suite.ended(driven)) for driven in evaluate_all(requests, workers)]


def print_results(results: Sequence[Result], console: Console | None = None) -> None:
    """Prints a table of policies in the same suite, and what differs from the original benchmark."""
    console, suite = console or Console(), results[0].suite
    columns = [
        Column(heading, unit, [cell(result.metrics[key], unit, digits=3) for result in results])
        for key, (heading, unit) in suite.columns.items()
    ]
    print_tables(suite.title, [result.name for result in results], columns, console)
    console.print("What differs from the original benchmark:")
    for line in dict.fromkeys(line for result in results for line in suite.differences(result.evaluation.env)):
        console.print(f"- {escape(line)}", highlight=False, soft_wrap=True)
    console.print("Below a value: 95 % confidence interval.", style="dim")


def write_results(path: Path, results: Sequence[Result]) -> None:
    """Writes results in the same suite as JSON, with every run, and beside it as CSV, with a row per run."""
    suite, policies, rows = results[0].suite, [], []
    for result in results:
        head, env = {"policy": result.name, "backend": result.evaluation.backend}, result.evaluation.env
        rows += [head | row for row in result.rows()]
        described = {"differences": suite.differences(env), "env": plain_env_or_none(env)}
        policies.append({**head, **described, "metrics": plain_estimates(result.metrics), "runs": result.rows()})
    settings = {key: getattr(suite, key) for key in ("runs", "seed", "goal_radius", "seconds")}
    worlds, head = [course.number for course in suite.courses], {**MADE_BY, "benchmark": suite.name}
    write_json(path, {**head, "worlds": worlds, "jitter": JITTER, **settings, "policies": policies})
    write_rows(path.with_suffix(".csv"), rows)


def draw_worst_runs(result: Result, path: Path) -> None:
    rows, title = result.rows(), "world {world}, run {run}: {ending} after {seconds:.1f} s"
    panels = [(title.format(**rows[run]), result.evaluation.select([run])) for run in result.worst(WORST_RUNS)]
    draw_panels(panels, path, f"{result.name} in {result.suite.name}: the runs with the lowest scores")


def read_arrays(path: Path, shapes: Mapping[str, tuple[int | None, ...]]) -> dict[str, np.ndarray]:
    """Reads arrays of numbers by name, with the given shapes (``None`` is any length), from an ``.npz`` file.

    The name of the array in an ``.npy`` file is empty.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no file at {path}")
    try:
        loaded = np.load(path, allow_pickle=False)
        arrays = {"": loaded} if isinstance(loaded, np.ndarray) else dict(loaded)
    except (ValueError, EOFError, zipfile.BadZipFile, OSError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is damaged, no NumPy file, or has pickled objects, which are not read") from error
    if missing := [name for name in shapes if name not in arrays]:
        raise ValueError(f"{path} has no array {missing[0]!r}; it needs {', '.join(shapes)}")
    for name, shape in shapes.items():
        array = arrays[name]
        fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
        if not fits or array.dtype.kind not in "biuf":
            what = f"{name} in {path}" if name else str(path)
            expected = " x ".join("any" if n is None else str(n) for n in shape)
            raise ValueError(f"{what} must be numbers of the shape {expected}, got {array.dtype} {list(array.shape)}")
    return {name: arrays[name] for name in shapes}
