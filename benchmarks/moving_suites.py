"""DynaBARN and ros_jackal: 80 yards and fields with things that move, from JSON files; any contact fails.

Nair et al., "DynaBARN: Benchmarking Metric Ground Navigation in Dynamic Environments", SSRR 2022; Xu et al.,
"Benchmarking Reinforcement Learning Techniques for Autonomous Navigation", ICRA 2023. Their worlds are in
https://github.com/Daffan/the-barn-challenge and https://github.com/Daffan/ros_jackal (MIT). A file has ``motions`` by
name (``period``, s, and ``keys`` [t, x, y, yaw]) and ``worlds`` by number: for DynaBARN, the names of the motions of
its cylinders, and ``cylinder_radius`` (m); for ros_jackal, ``movers`` (a ``motion`` and the ``size`` of a box, m) and
``static_cylinders`` (x, y, radius, m)::

    python -m benchmarks.moving_suites dynabarn fields.json orca pretrained:crowd --runs 2
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch
import tyro

from rover_rl.algos.benchmarks import suite as suites
from rover_rl.algos.benchmarks.suite import Course, Result, Suite
from rover_rl.algos.driving import CONTACT
from rover_rl.algos.evaluation.metrics import Estimate
from rover_rl.algos.evaluation.results import Evaluation
from rover_rl.algos.evaluation.trajectory import Trajectory, is_touching
from rover_rl.algos.policy.names import resolve_policies
from rover_rl.cli.policies import EnvOptions
from rover_rl.envs.config import EnvConfig
from rover_rl.robots import get_robot
from rover_rl.worlds import boxes, cylinders
from rover_rl.worlds.movers import Box, Cylinder, Mover, Waypoints

HEIGHT = 1.0  # height of all obstacles, m
HALF, WALL = 10.0, 0.1  # half the side of a yard of DynaBARN and thickness of its three walls, m; the start's is open
GROUPS = {"easy": 14, "medium": 19, "hard": math.inf}  # largest number of cylinders of each difficulty
FIRST_WALLS = 400  # number of the first world of ros_jackal with sliding walls; those before have boxes
PUBLISHED = "Published: boxes 52 +- 1 % (transformer), 50 +- 5 % (MLP); walls 82 +- 4 % (GRU), at 2 m/s."


class MovingSuite(Suite):
    """Courses with movers. A run ends when the simulator tells the first contact, with a mover or with a wall."""

    score_name = "success"
    worlds = "Worlds of others in this simulator, no score of a public table."
    robot = " (there: Jackal, chassis 0.42 x 0.31 m, 2 m/s)"
    columns: ClassVar = {**suites.COLUMNS, "mover_rate": ("hits a mover", "%"), "wall_rate": ("hits a wall", "%")}

    def score(self, course: Course, run: Trajectory) -> float:
        return float(run.ending == "goal")

    def environment(self, env: EnvConfig) -> EnvConfig:
        env = super().environment(env)
        return replace(env, task=replace(env.task, collision_from="contact", collision_window=0))

    def ended(self, evaluation: Evaluation) -> Evaluation:
        # Contacts are the only jams.
        runs = [replace(run, ending=CONTACT) if run.ending == "jammed" else run for run in evaluation.trajectories]
        return replace(evaluation, trajectories=runs)

    def metrics(self, result: Result) -> dict[str, Estimate]:
        robot, runs = get_robot(result.evaluation.env.robot), result.evaluation.trajectories
        worlds = [course.world for course in self.courses for _ in range(self.runs)]
        walls = torch.tensor(
            [
                bool(is_touching(run.position[-1:], run.angles[-1:], world, robot)[0])
                for run, world in zip(runs, worlds, strict=True)
            ]
        )
        hits = torch.tensor([run.ending == CONTACT for run in runs])
        rates = {"mover_rate": hits & ~walls, "wall_rate": hits & walls}
        told = {name: suites.mean_rate(result.by_course(flags.double().tolist())) for name, flags in rates.items()}
        return {**result.common_metrics(), **told}

    def differences(self, env: EnvConfig) -> list[str]:
        lines = [line for line in super().differences(env) if not line.startswith("Contact")]
        felt = "Contact: as the simulator tells it at 20 Hz, with a mover or a wall. What was hit is told by the walls."
        return [*lines, felt, "Cylinders pass through walls." if self.name == "DynaBARN" else PUBLISHED]


class DynaBarn(MovingSuite):
    name = "DynaBARN"
    lidar = "as in BARN"
    start, goal = (11.0, 0.0, math.pi), (-9.0, 0.0)
    limits: ClassVar = {"goal_radius": 1.0, "seconds": 100.0}

    @classmethod
    def course(cls, data: Mapping[str, Any], number: int, motions: list[str]) -> tuple[str, Course]:
        shape = Cylinder(float(data["cylinder_radius"]), HEIGHT)
        movers = [Mover(motion(data, name), shape, f"cylinder {n}") for n, name in enumerate(motions)]
        away, length = HALF + WALL / 2, 2 * (HALF + WALL)
        centers = np.array([(-away, 0.0, HEIGHT / 2), (0.0, away, HEIGHT / 2), (0.0, -away, HEIGHT / 2)])
        walls = boxes(centers, np.array([(WALL, length, HEIGHT)] + [(2 * HALF, WALL, HEIGHT)] * 2))
        corners = np.array((cls.start[:2], cls.goal, (-HALF, HALF), (-HALF, -HALF)))
        world = suites.open_world(f"dynabarn-{number}", walls, corners, movers)
        group = next(name for name, most in GROUPS.items() if len(motions) <= most)
        return group, Course(number, world, cls.start, cls.goal, math.dist(cls.start[:2], cls.goal))


class RosJackal(MovingSuite):
    name = "ros_jackal"
    lidar = "720 beams, up to 5 m"
    start, goal = (-2.0, 3.0, 1.57), (-2.0, 13.0)
    limits: ClassVar = {"goal_radius": 0.4, "seconds": 80.0}

    @classmethod
    def course(cls, data: Mapping[str, Any], number: int, world: Mapping[str, Any]) -> tuple[str, Course]:
        movers = [
            Mover(motion(data, one["motion"]), Box(*one["size"]), f"box {k}") for k, one in enumerate(world["movers"])
        ]
        fixed = np.array(world.get("static_cylinders") or [], dtype=float).reshape(-1, 3)
        solids: list[Any] = []
        for radius in np.unique(fixed[:, 2]).tolist():
            centers = fixed[fixed[:, 2] == radius, :2]
            solids += cylinders(np.column_stack((centers, np.full(len(centers), HEIGHT / 2))), radius, HEIGHT)
        points = np.vstack((cls.start[:2], cls.goal, fixed[:, :2]))
        field = suites.open_world(f"ros-jackal-{number}", solids, points, movers)
        group = "boxes" if number < FIRST_WALLS else "walls"
        return group, Course(number, field, cls.start, cls.goal, math.dist(cls.start[:2], cls.goal))


def motion(data: Mapping[str, Any], name: Any) -> Waypoints:
    """Keyframes with constant speed between them, again and again, with a rest at the end of the period."""
    found = data["motions"][name] if isinstance(name, str) else name
    keys = [tuple(map(float, key)) for key in found["keys"]]
    # Of keyframes at the same time, the last one counts.
    keys = [key for n, key in enumerate(keys) if n + 1 == len(keys) or keys[n + 1][0] != key[0]]
    if found["period"] > keys[-1][0]:
        keys.append((float(found["period"]), *keys[-1][1:]))
    return Waypoints(keys, repeat="loop")  # type: ignore[arg-type]


def read(kind: type[DynaBarn] | type[RosJackal], path: Path) -> dict[str, list[Course]]:
    """Reads the courses of a file, by group."""
    data = json.loads(path.read_text())
    worlds = data["worlds"]
    named = dict(enumerate(worlds)) if isinstance(worlds, list) else worlds
    groups: dict[str, list[Course]] = {}
    for name, world in named.items():
        group, course = kind.course(data, int(re.findall(r"\d+", str(name))[-1]), world)
        groups.setdefault(group, []).append(course)
    return groups


@dataclass
class MovingSuites:
    """Run policies in worlds of DynaBARN or ros_jackal."""

    suite: tyro.conf.Positional[Literal["dynabarn", "ros-jackal"]]
    data: tyro.conf.Positional[Path]
    policies: tyro.conf.Positional[tuple[str, ...]]
    runs: int = 1
    seed: int = 0
    backend: str = "warp"
    environment: Annotated[EnvOptions, tyro.conf.arg(name="")] = EnvOptions()  # noqa: RUF009
    out: Path = Path("runs/benchmark-moving")

    def __call__(self) -> None:
        resolved = resolve_policies(self.policies, (self.suite,), self.environment.given_robot)
        envs = {one.name: (one.module, self.environment.description(one.module, self.backend)) for one in resolved}
        self.out.mkdir(parents=True, exist_ok=True)
        kind = DynaBarn if self.suite == "dynabarn" else RosJackal
        for group, courses in read(kind, self.data).items():
            suite = kind(courses, runs=self.runs, seed=self.seed, **kind.limits)
            results = suites.run_suite(suite, envs)
            print(group)
            suites.print_results(results)
            suites.write_results(self.out / f"{self.suite}-{group}.json", results)


if __name__ == "__main__":
    tyro.cli(MovingSuites)()
