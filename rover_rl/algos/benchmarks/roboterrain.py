"""RoboTerrain: goals one after the other among people who walk back and forth.

Worlds with walkers are SDF files of https://github.com/jackvice/RoboTerrain (Apache-2.0). The rover drives for some
minutes, and contacts do not end a run. What counts is how long it is within 0.5 m of a person, and how long it
takes, per goal. Both have published logs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from rich.console import Console
from rich.markup import escape
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.benchmarks.suite import describe_robot
from rover_rl.algos.evaluation.cores import over_cores
from rover_rl.algos.evaluation.evaluate import Policy
from rover_rl.algos.evaluation.metrics import Estimate, count_runs, ratio
from rover_rl.algos.evaluation.results import plain_env_or_none, plain_estimates
from rover_rl.algos.evaluation.tables import Column, cell, print_tables, write_rows
from rover_rl.algos.policy.baselines import RandomPolicy
from rover_rl.algos.policy.networks import single_threaded
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.checks import MAX_COUNT, MAX_ROVERS, MAX_SECONDS, check_at_least, check_seed
from rover_rl.envs import EnvConfig, RoverEnv
from rover_rl.files import MADE_BY, write_json
from rover_rl.progress import ProgressDisplay
from rover_rl.worlds import World

GOAL_RADIUS = 0.3
"""Distance from a goal at which it is reached, m."""
TOO_CLOSE = 0.5
"""Distance of the centers of rover and person below which the rover is at risk, m."""
COLUMNS = {
    # Seconds with three digits.
    "risk": (f"s closer than {TOO_CLOSE:g} m, per goal", ""),
    "time": ("s per goal", ""),
    "goals": ("goals", ""),
    "contacts": ("contacts", ""),
    "goals_per_contact": ("goals per contact", ""),
}
"""Headings and units of the metrics in a table, by key."""
PUBLISHED = {
    "Nav2 (lidar, true pose)": {"inspect": (0.542, 27.0), "construct": (0.352, 17.1), "island": (0.417, 9.06)},
    "best learned (camera)": {"inspect": (0.097, 18.5), "construct": (0.020, 34.6), "island": (0.025, 10.2)},
}
"""Published seconds closer than 0.5 m and seconds, per goal, by policy and world."""
_MIN_ROWS = 32
"""Smallest number of rows that a policy is called with: matrix products of few rows round differently."""


def read_roboterrain(folder: Path) -> dict[str, World]:
    """Reads the worlds with movers of a folder, by the names of their files.

    Args:
        folder: folder with SDF files (``.sdf``, ``.world``). Those without an ``<actor>`` are left out.

    Raises:
        FileNotFoundError: if there is no such folder.
        ImportError: if a package of the extra ``worlds`` is missing.
        ValueError: if no file has movers, or one is damaged. The message is one sentence.
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder at {folder}")
    files = [path for path in sorted(folder.iterdir()) if path.suffix in (".sdf", ".world") and path.is_file()]
    moving = [path for path in files if "<actor" in path.read_text(encoding="utf-8", errors="replace")]
    worlds = {path.stem: World.from_file(path, missing="skip") for path in moving}
    worlds = {name: world for name, world in worlds.items() if world.movers}
    if not worlds:
        raise ValueError(f"{folder} has no SDF file of a world with an actor that moves")
    return worlds


@dataclass(frozen=True)
class RoboTerrain:
    """RoboTerrain: how long rovers are close to people, and how long they take, per goal.

    Args:
        worlds: worlds with movers, by name.
        rovers: number of rovers in each world, each with its own people.
        seconds: time that each drives, s.
        seed: seed of starts and goals.

    Raises:
        ValueError: if there are no worlds, or a number is out of range.
    """

    worlds: Mapping[str, World]
    rovers: int = 16
    seconds: float = 300.0
    seed: int = 0

    name: ClassVar[str] = "RoboTerrain"

    def __post_init__(self) -> None:
        check_at_least(1, MAX_ROVERS, rovers=self.rovers)
        check_at_least(1.0, MAX_SECONDS, seconds=self.seconds)
        check_seed(self.seed, self.rovers)
        if not self.worlds:
            raise ValueError(f"{self.name} needs at least one world")

    def environment(self, env: EnvConfig, world: World) -> EnvConfig:
        """Returns an environment in which nothing but leaving the world, or the time, ends an episode."""
        never = {"collision_window": MAX_COUNT, "stuck_threshold": 0.0, "flip_threshold": 2 * math.pi}
        task = replace(env.task, success_distance=GOAL_RADIUS, collision_from="contact", **never)  # type: ignore[arg-type]
        return replace(
            env, task=task, world=world, num_envs=self.rovers, end_on_goal=False, seed=self.seed, length=MAX_COUNT
        )

    def differences(self, env: EnvConfig) -> list[str]:
        """Returns how runs in an environment differ from the original benchmark: a sentence each."""
        body, lidar = describe_robot(env)
        return [
            "RoboTerrain worlds in this simulator; goals and starts are drawn from their free ground.",
            f"Robot: {body} (RoboTerrain: Leo Rover).",
            f"Lidar: {lidar} (RoboTerrain: lidar for Nav2, camera for learned policies).",
            f"Simulator: {env.backend}, 20 Hz, without noise.",
            f"Closer than {TOO_CLOSE:g} m: from the rover's center to the surface of a person.",
            "Contact: with anything, as the simulator tells it. It does not end a run.",
        ]


@dataclass(frozen=True)
class Run:
    """What happened to the rovers of a policy in a world.

    Attributes:
        policy: name of the policy.
        world: name of the world.
        goals: number of goals that each rover reached, ``[N]``.
        risk: time that it was too close to a person, ``[N]``, s.
        contacts: number of its contacts, ``[N]``.
        seconds: time that it drove, s.
        env: settings of the environment.
    """

    policy: str
    world: str
    goals: Tensor
    risk: Tensor
    contacts: Tensor
    seconds: float
    env: EnvConfig

    @property
    def metrics(self) -> dict[str, Estimate]:
        """Metrics by name. Intervals cover the variation between rovers."""
        goals, contacts = self.goals.double().tolist(), self.contacts.double().tolist()
        nothing = [math.nan, math.nan]
        return {
            "risk": ratio(self.risk.double().tolist(), goals),
            "time": ratio([self.seconds] * len(goals), goals),
            "goals": Estimate(sum(goals), *nothing),
            "contacts": Estimate(sum(contacts), *nothing),
            "goals_per_contact": ratio(goals, contacts),
        }


@dataclass(frozen=True)
class _Job:
    """Drives of a policy in a world."""

    policy: Policy | None
    name: str
    world: str
    env: EnvConfig
    seconds: float


def run_roboterrain(
    suite: RoboTerrain, policies: Mapping[str, tuple[Policy | None, EnvConfig]], workers: int | None = None
) -> list[Run]:
    """Drives policies in all worlds. The results do not depend on the number of processes.

    Args:
        suite: the benchmark.
        policies: policy (``None`` acts at random) and environment, by name.
        workers: largest number of processes; ``None``: the number of cores.
    """
    jobs = [
        _Job(policy, name, world_name, suite.environment(env, world), suite.seconds)
        for name, (policy, env) in policies.items()
        for world_name, world in suite.worlds.items()
    ]
    return over_cores(_drive, jobs, "driving", workers)


@torch.no_grad()
@single_threaded()
def _drive(job: _Job) -> Run:
    env = RoverEnv(job.env)
    runner = PolicyRunner(job.policy or RandomPolicy(job.env.seed or 0), None, _MIN_ROWS, env)
    steps = round(job.seconds / env.control_dt)
    touched, close, goals = torch.zeros(3, steps, env.num_envs, dtype=torch.bool)
    with closing(env), ProgressDisplay(job.name) as display, set_exploration_type(ExplorationType.DETERMINISTIC):
        tensordict = env.reset()
        for step in range(steps):
            tensordict = env.step(tensordict.set("action", runner(tensordict)))["next"]
            outcome = tensordict["outcome"]
            touched[step], goals[step] = env.rover_state.contact[:, 0], outcome["goal_reached"][:, 0]  # type: ignore[index]
            close[step] = env.movers.nearest_center(env.rover_state.position[:, :2])[:, 0] < TOO_CLOSE
            done = tensordict["done"][:, 0]
            if done.any():
                tensordict = env.reset(tensordict.set("_reset", done[:, None]))
                runner.reset(done)
            display.update(step / steps)
        dt = env.control_dt
    contacts = torch.tensor([count_runs(flags) for flags in touched.T])
    return Run(job.name, job.world, goals.sum(0), close.sum(0) * dt, contacts, steps * dt, job.env)


def print_roboterrain(suite: RoboTerrain, runs: Sequence[Run], console: Console | None = None) -> None:
    """Prints a table for each world, with published figures where there are any, and what differs."""
    console = console or Console()
    for world in suite.worlds:
        mine = [run for run in runs if run.world == world]
        rows = {run.policy: run.metrics for run in mine} | _published(world)
        columns = [
            Column(heading, unit, [cell(metrics[key], unit, digits=3) for metrics in rows.values()])
            for key, (heading, unit) in COLUMNS.items()
        ]
        title = f"{suite.name}, {world}: {suite.rovers} rovers, {suite.seconds:g} s each"
        print_tables(f"{title}; goals within {GOAL_RADIUS:g} m", list(rows), columns, console)
    console.print("What differs from the original benchmark:")
    for line in dict.fromkeys(line for run in runs for line in suite.differences(run.env)):
        console.print(f"- {escape(line)}", highlight=False, soft_wrap=True)
    console.print("Below a value: 95 % confidence interval.", style="dim")


def _published(world: str) -> dict[str, dict[str, Estimate]]:
    nothing = Estimate(math.nan, math.nan, math.nan)
    found = {}
    for policy, figures in PUBLISHED.items():
        for name, (risk, time) in figures.items():
            if name in world:
                known = {"risk": Estimate(risk, math.nan, math.nan), "time": Estimate(time, math.nan, math.nan)}
                found[f"{policy}, published"] = {key: known.get(key, nothing) for key in COLUMNS}
    return found


def write_roboterrain(path: Path, suite: RoboTerrain, runs: Sequence[Run]) -> None:
    """Writes results as a JSON file, and as a CSV file of the same name with a row for each rover.

    Args:
        path: path of the JSON file.
        suite: the benchmark.
        runs: results.
    """
    described: list[dict[str, Any]] = []
    for run in runs:
        head = {"policy": run.policy, "world": run.world, "differences": suite.differences(run.env)}
        env = plain_env_or_none(replace(run.env, world=run.world))
        described.append({**head, "env": env, "metrics": plain_estimates(run.metrics)})
    settings = {"rovers": suite.rovers, "seconds": suite.seconds, "seed": suite.seed, "goal_radius": GOAL_RADIUS}
    write_json(path, {**MADE_BY, "benchmark": suite.name, **settings, "results": described})
    rows = [
        {"policy": run.policy, "world": run.world, "rover": number, "goals": goals, "risk": risk, "contacts": contacts}
        for run in runs
        for number, (goals, risk, contacts) in enumerate(
            zip(run.goals.tolist(), run.risk.tolist(), run.contacts.tolist(), strict=True)
        )
    ]
    write_rows(path.with_suffix(".csv"), rows)
