"""Suites in worlds with movers, and the JSON files that their courses are read from."""

from __future__ import annotations

import json
import math
import re
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch

from rover_rl.algos.benchmarks.suite import Course, Result, Suite, describe_robot, mean_rate
from rover_rl.algos.driving import CONTACT
from rover_rl.algos.evaluation.body_contacts import is_touching
from rover_rl.algos.evaluation.metrics import Estimate, Trajectory
from rover_rl.algos.evaluation.results import Evaluation
from rover_rl.envs import EnvConfig
from rover_rl.robots import get_robot
from rover_rl.worlds.movers import Waypoints


@dataclass(frozen=True)
class MotionFile:
    """Contents of a JSON file of worlds with movers.

    Attributes:
        path: path of the file.
        content: content of the file.
        worlds: description of each world, by its number.
    """

    path: Path
    content: Mapping[str, Any]
    worlds: Mapping[int, Any]

    @classmethod
    def read(cls, path: Path) -> MotionFile:
        """Reads a file with ``worlds`` (a list, or by names that end in numbers) and ``motions`` (by name).

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is no JSON, or lacks worlds or motions. The message is one sentence.
        """
        if not path.is_file():
            raise FileNotFoundError(f"no file at {path}")
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path} is no JSON file") from error
        if not isinstance(content, dict) or not content.get("worlds") or not isinstance(content.get("motions"), dict):
            raise ValueError(f"{path} must have worlds, and motions by name")
        worlds = content["worlds"]
        named = dict(enumerate(worlds)) if isinstance(worlds, list) else worlds
        ends = [re.search(r"[0-9]{1,6}\Z", str(name)) for name in named] if isinstance(named, dict) else []
        numbered = {int(end[0]): world for end, world in zip(ends, named.values(), strict=True) if end} if ends else {}
        if not numbered or len(numbered) < len(named):
            raise ValueError(f"the worlds of {path} must be a list, or named by different numbers")
        return cls(path, content, numbered)

    def chosen(self, numbers: Sequence[int] | None) -> list[int]:
        """Returns the numbers of worlds, all by default, in ascending order.

        Raises:
            ValueError: if the file lacks one of them.
        """
        for number in numbers or ():
            if number not in self.worlds:
                raise ValueError(f"{self.path} lacks world {number}: it has {min(self.worlds)} to {max(self.worlds)}")
        return sorted(self.worlds) if numbers is None else [*numbers]

    def motion(self, name: Any) -> Waypoints:
        """Returns a motion, by its name or as it is: keyframes with constant speed between them, again and again.

        Raises:
            ValueError: if there is no such motion, or it is wrong. The message is one sentence.
        """
        found = self.content["motions"].get(name) if isinstance(name, str) else name
        if not isinstance(found, dict):
            raise ValueError(f"{self.path} has no motion {name!r}")
        try:
            keys = [tuple(float(number) for number in key) for key in found["keys"]]
            # Of keyframes at the same time, the last one counts.
            keys = [key for n, key in enumerate(keys) if n + 1 == len(keys) or keys[n + 1][0] != key[0]]
            period = float(found["period"])
            if math.isfinite(period) and period > keys[-1][0]:
                # At rest until the path begins again.
                keys.append((period, *keys[-1][1:]))
            return Waypoints(keys, repeat="loop")  # type: ignore[arg-type]
        except (KeyError, TypeError, IndexError) as error:
            raise ValueError(f"motion {name!r} of {self.path} must have a period and keys [t, x, y, yaw]") from error
        except ValueError as error:
            raise ValueError(f"motion {name!r} of {self.path} is wrong: {error}") from error

    def numbers(self, value: Any, count: int, what: str) -> tuple[float, ...]:
        """Returns finite numbers.

        Raises:
            ValueError: if they are not, or not ``count``. The message is one sentence.
        """
        try:
            given = tuple(float(number) for number in value)
        except (TypeError, ValueError):
            given = ()
        if len(given) != count or not all(map(math.isfinite, given)):
            raise ValueError(f"{what} in {self.path} must be {count} finite numbers, got {value!r}")
        return given


class MovingSuite(Suite):
    """Courses with movers. A run ends when the simulator tells the first contact, with a mover or with a wall.

    Args:
        courses: courses.
        runs: number of runs of each course. All but the first start near the given start.
        seed: seed of these starts, and of movers that move at random.

    Attributes:
        radius: distance from the goal at which it is reached, m.
        limit: time limit of a run, s.
    """

    radius: ClassVar[float]
    limit: ClassVar[float]
    score_name = "success"
    places = "worlds"
    columns: ClassVar = {
        "success_rate": ("success", "%"),
        "mover_rate": ("hits a mover", "%"),
        "wall_rate": ("hits a wall", "%"),
        "time_limit_rate": ("time-outs", "%"),
        "mean_time": ("mean time", "s"),
    }

    def __init__(self, courses: Sequence[Course], *, runs: int = 1, seed: int = 0) -> None:
        super().__init__(courses, runs=runs, seed=seed, goal_radius=self.radius, seconds=self.limit)

    def score(self, course: Course, run: Trajectory) -> float:
        """Returns 1 for a run that reached its goal, else 0."""
        return float(run.ending == "goal")

    def environment(self, env: EnvConfig) -> EnvConfig:
        """Returns an environment in which the goal, the time limit and the first contact end a run."""
        env = super().environment(env)
        return replace(env, task=replace(env.task, collision_from="contact", collision_window=0))

    def ended(self, evaluation: Evaluation) -> Evaluation:
        """Names the endings by a contact: they are the only jams."""
        runs = [replace(run, ending=CONTACT) if run.ending == "jammed" else run for run in evaluation.trajectories]
        return replace(evaluation, trajectories=runs)

    def metrics(self, result: Result) -> dict[str, Estimate]:
        """Returns the metrics of the table."""
        runs = result.evaluation.trajectories
        hits = [
            touching_a_wall(run, course, result.evaluation.env) if run.ending == CONTACT else None
            for run, course in zip(runs, self._course_of(runs), strict=True)
        ]
        flags = torch.tensor([(hit is False, hit is True) for hit in hits], dtype=torch.float64)
        by_mover, by_wall = flags.reshape(len(self.courses), -1, 2).unbind(-1)
        return {**result.common_metrics(), "mover_rate": mean_rate(by_mover), "wall_rate": mean_rate(by_wall)}

    def _course_of(self, runs: Sequence[Trajectory]) -> list[Course]:
        return [course for course in self.courses for _ in range(len(runs) // len(self.courses))]

    @abstractmethod
    def original(self) -> tuple[str, str, str]:
        """Returns the name of the original, its robot and its lidar."""

    def differences(self, env: EnvConfig) -> list[str]:
        """Returns how runs in an environment differ from the original benchmark."""
        body, lidar = describe_robot(env)
        name, robot, scanner = self.original()
        told = [
            f"{name} worlds in this simulator, no score of a public table.",
            f"Robot: {body} ({name}: {robot}).",
            f"Lidar: {lidar} ({name}: {scanner}).",
            *self.common_differences(env),
        ]
        by_pose = "Contact: the footprint"
        felt = "Contact: as the simulator tells it at 20 Hz, with a mover or a wall. What was hit is told by the walls."
        return [felt if line.startswith(by_pose) else line for line in told]


def touching_a_wall(run: Trajectory, course: Course, env: EnvConfig) -> bool:
    """Returns whether the body touches something that does not move at the end of a run."""
    return bool(is_touching(run.position[-1:], run.angles[-1:], course.world, get_robot(env.robot))[0])
