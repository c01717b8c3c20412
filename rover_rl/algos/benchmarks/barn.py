"""BARN, the Benchmark for Autonomous Robot Navigation: 300 fields of cylinders.

Perille et al., "Benchmarking Metric Ground Navigation", SSRR 2020; scores as in the BARN Challenge since 2024. The
worlds are in the folder ``jackal_helper/worlds/BARN`` of https://github.com/Daffan/the-barn-challenge (MIT).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from rover_rl.algos.benchmarks.suite import COLUMNS, Course, Suite, open_world, read_arrays
from rover_rl.algos.evaluation.trajectory import Trajectory
from rover_rl.envs.config import EnvConfig
from rover_rl.tiny_xml import numbers, read_xml
from rover_rl.worlds import cylinders

WORLDS = 300  # number of worlds
TEST_WORLDS = tuple(range(0, WORLDS, 6))  # Worlds of the benchmark's score. A policy may be trained in the others.
FOLDER = Path("jackal_helper/worlds/BARN")  # folder of the worlds in the public repository
START = (-2.25, 3.0, math.pi / 2)  # x, y (m) and yaw (rad) of all starts
GOAL = (-2.25, 13.0)  # x, y of all goals, m
GOAL_RADIUS = 1.0  # distance from the goal at which it is reached, m
SECONDS = 100.0  # time limit, s
SPEED = 2.0  # speed that the optimal time is computed with, m/s
FASTEST, SLOWEST = 2.0, 8.0  # range that the time is clipped to, in optimal times
RADIUS, HEIGHT = 0.075, 1.0  # radius and height of all cylinders, m
CELL = 2 * RADIUS  # side length of a cell of the reference paths, m
CELL_ORIGIN = (-RADIUS - 30 * CELL, 5.0 + RADIUS)  # center of cell (0, 0), m: path_coord_to_gazebo_coord in run.py


def read_barn(data: Path, worlds: Sequence[int] | None = None) -> list[Course]:
    """Reads worlds of BARN by their numbers; ``None``: all that there are.

    ``data`` is the folder of the public repository, or its folder with the worlds, or an ``.npz`` file with the arrays
    ``world [W]`` (numbers), ``cylinder_xy [C, 2]`` (m), ``offsets [W + 1]`` (first cylinder of each world) and
    ``path_length [W]`` (m). Raises ``ValueError`` if a world is missing or damaged.
    """
    return _read_file(data, worlds) if data.is_file() else _read_folder(data, worlds)


def _read_file(path: Path, worlds: Sequence[int] | None) -> list[Course]:
    shapes = {"world": (None,), "cylinder_xy": (None, 2), "offsets": (None,), "path_length": (None,)}
    arrays = read_arrays(path, shapes)
    found, ends, lengths = arrays["world"].tolist(), arrays["offsets"], arrays["path_length"].tolist()
    ordered = ends.dtype.kind in "iu" and (np.diff(ends.astype(np.int64)) >= 0).all()
    matching = len(ends) == len(found) + 1 == len(lengths) + 1
    if not (ordered and matching and ends[0] == 0 and ends[-1] == len(arrays["cylinder_xy"])):
        raise ValueError(f"the arrays of {path} do not match: offsets must be the first cylinder of each world")
    centers = np.split(arrays["cylinder_xy"], ends[1:-1])
    stored = {number: each for number, *each in zip(found, centers, lengths, strict=False)}
    return [_course(f"world {number} in {path}", number, *stored[number]) for number in _chosen(path, found, worlds)]


def _read_folder(folder: Path, worlds: Sequence[int] | None) -> list[Course]:
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder or file at {folder}")
    folder = folder / FOLDER if (folder / FOLDER).is_dir() else folder
    found = [number for number in range(WORLDS) if (folder / f"world_{number}.world").is_file()]
    if not found:
        raise ValueError(f"{folder} has no BARN worlds: there is no world_0.world to world_{WORLDS - 1}.world")
    return [_read_world(folder, number) for number in _chosen(folder, found, worlds)]


def _chosen(data: Path, found: Sequence[int], worlds: Sequence[int] | None) -> Sequence[int]:
    missing = [number for number in worlds or () if number not in found]
    if missing:
        known = f"it has {len(found)} worlds" + (f": {[*found]}" if len(found) <= 10 else "")
        raise ValueError(f"{data} lacks {len(missing)} of the BARN worlds, such as {missing[0]}; {known}")
    return found if worlds is None else worlds


def _read_world(folder: Path, number: int) -> Course:
    path = folder / f"world_{number}.world"
    centers = []
    for model in read_xml(path).iterfind("world/model"):
        shapes = list(model.iterfind("link/collision/geometry/cylinder"))
        for shape in shapes:
            (radius,) = numbers(shape.find("radius"), 1, None, f"the radius of a cylinder in {path}")
            if not math.isclose(radius, RADIUS, abs_tol=1e-6):
                raise ValueError(f"{path} is no BARN world: a cylinder has the radius {radius:g} m, not {RADIUS:g} m")
        if shapes:
            centers.append(numbers(model.find("pose"), 6, None, f"the pose of a model in {path}")[:2])
    cells = read_arrays(folder / "path_files" / f"path_{number}.npy", {"": (None, 2)})[""]
    if not np.isfinite(cells).all():
        raise ValueError(f"the reference path of {path} must have finite cells")
    points = np.vstack((START[:2], cells * CELL + CELL_ORIGIN, GOAL))
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    return _course(str(path), number, np.array(centers, dtype=np.float32).reshape(-1, 2), length)


def _course(what: str, number: int, centers: np.ndarray, length: float) -> Course:
    if not len(centers) or not np.isfinite(centers).all() or np.abs(centers).max() > 100:
        raise ValueError(f"{what} must have cylinders, all of them within 100 m of the origin")
    if not 0 < length < math.inf:
        raise ValueError(f"the reference path of {what} must have a positive length, got {length:g} m")
    # As float32, so that worlds from files of both kinds are the same.
    centers = np.asarray(centers, dtype=np.float32).astype(np.float64)
    obstacles = cylinders(np.column_stack((centers, np.full(len(centers), HEIGHT / 2))), RADIUS, HEIGHT)
    world = open_world(f"barn-{number}", obstacles, np.vstack((centers, START[:2], GOAL)))
    return Course(number, world, START, GOAL, length)


@dataclass(kw_only=True)
class Barn(Suite):
    """BARN: success, and a score of up to 0.5 for the time to the goal, in courses from :func:`read_barn`.

    The score of a run is 0 for a failure, else ``OT / clip(AT, 2 OT, 8 OT)``, with the time ``AT`` and the optimal time
    ``OT``: the length of the reference path divided by 2 m/s. The benchmark has 10 runs, which differ by noise. Here,
    all but the first start near the given start.
    """

    name = "BARN"
    score_name = "score"
    columns: ClassVar = {**COLUMNS, "score": ("score", "")}
    worlds = "BARN worlds in this simulator, no score of the public leaderboard."
    robot = " (BARN: Jackal, chassis 0.42 x 0.31 m, 2 m/s)"
    lidar = "720 beams in 270 degrees, up to 30 m"

    goal_radius: float = GOAL_RADIUS
    seconds: float = SECONDS

    def score(self, course: Course, run: Trajectory) -> float:
        optimal = course.length / SPEED
        clipped = min(max(run.seconds, FASTEST * optimal), SLOWEST * optimal)
        return (run.ending == "goal") * optimal / clipped

    def differences(self, env: EnvConfig) -> list[str]:
        time = "Time: from the start of the run (BARN: from the first 0.1 m)."
        which = f"Worlds: {len(self.courses)}, not the 50 test worlds of the benchmark's score."
        others = {course.number for course in self.courses} != {*TEST_WORLDS}
        return [*super().differences(env), time, *([which] if others else [])]
