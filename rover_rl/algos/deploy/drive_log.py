"""Logs of drives with a live rover, with one line of JSON per step. A crash loses no earlier line."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, TextIO

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.evaluate import Evaluation
from rover_rl.algos.evaluation.trajectory import Trajectory, count_reversals
from rover_rl.envs.config import EnvConfig, TaskConfig
from rover_rl.files import check_writable
from rover_rl.robots import get_robot
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims import RoverState
from rover_rl.sims.free_space.paths import shortest_paths
from rover_rl.sims.settings import CONTROL_DT
from rover_rl.worlds import get_world
from rover_rl.worlds.pool import WorldPool

FORMAT = "rover_rl drive, version 1"  # name of the file format
BEAMS = 180  # largest number of lidar readings in each line of a log


class DriveLog:
    """Context manager that logs drives to a file for :func:`read_drives` and ``rover-rl evaluate``.

    Drives are appended to an existing file. ``seconds`` is the time limit of each.
    """

    def __init__(self, path: Path, world: str, policy: str, seconds: float, robot: str = "rover_zero") -> None:
        self._turns: list[float] = []
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file: TextIO = path.open("a", buffering=1)
        if path.stat().st_size:
            self._file.write("\n")  # the last line may be incomplete
        header = {"world": world, "policy": policy, "robot": robot, "seconds": seconds, "time": time.time()}
        self._write({"format": FORMAT, **header})

    def __enter__(self) -> DriveLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def begin(self, rover: RoverState, scan: Tensor, goal: tuple[float, float]) -> None:
        """Writes the start of a drive to ``goal`` (x, y, m), with the raw scan there, ``[1, beams]``, m."""
        self._turns = []
        self._write({"goal": goal, **_pose(rover, scan)})

    def add(
        self,
        rover: RoverState,
        scan: Tensor,
        outcome: TensorDictBase,
        command: tuple[float, float],
        latency: float,
        held: bool = False,
    ) -> None:
        """Writes a step: the state of the rover and the raw scan after it, ``[1, beams]``, m, and its ``"outcome"``.

        ``command``, ``latency`` and ``held`` are those of :class:`~rover_rl.algos.deploy.driving.Moment`.
        """
        self._turns.append(command[1])
        events = {"collision": bool(outcome["collision"]), "reached": bool(outcome["goal_reached"]), "held": held}
        measurements = {"dt": round(rover.dt.item(), 5), "command": command, "latency": round(latency, 5)}
        self._write({**_pose(rover, scan), **events, **measurements})

    def end(self, ending: str) -> None:
        """Writes the ending of the drive and the number of reversals of its turning direction."""
        self._write({"ending": ending, "reversals": count_reversals(self._turns)})

    def _write(self, entry: dict[str, Any]) -> None:
        self._file.write(json.dumps(entry) + "\n")


def _pose(rover: RoverState, scan: Tensor) -> dict[str, Any]:
    # Readings are kept to the centimeter; no return is null.
    step = -(-scan.shape[1] // BEAMS)
    ranges = [round(value, 2) if math.isfinite(value) else None for value in scan[0, ::step].tolist()]
    poses = {"position": rover.position[0], "angles": quaternion_to_euler(rover.orientation)[0]}
    return {name: [round(value, 5) for value in values.tolist()] for name, values in poses.items()} | {"ranges": ranges}


def check_log(path: Path) -> None:
    """Checks that drives can be appended: raises ``FileExistsError`` for another file than a log."""
    check_writable(path, "--log")
    head = json.dumps({"format": FORMAT})[:-1]
    if path.is_file() and path.read_bytes()[: len(head)] not in (b"", head.encode()):
        raise FileExistsError(f"{path} is no log of drives, so nothing is appended to it: name another --log")


def read_drives(path: Path) -> list[Evaluation]:
    """Reads a log as evaluations, one for each policy, world, robot and time limit.

    The shortest path of a drive is computed on the map of the world. If the start or the goal is not free on the map,
    the straight line is used. Raises ``ValueError`` if the file is no log of drives, or no drive in it has ended.
    """
    groups: dict[tuple[str, str, str, float], list[LoggedDrive]] = {}
    for drive in logged_drives(path):
        groups.setdefault((drive.world, drive.policy, drive.robot, drive.seconds), []).append(drive)
    evaluations = []
    for (world, policy, robot, seconds), drives in groups.items():
        made_for = EnvConfig(world=world, robot=robot, backend="ros2", end_on_goal=True)
        driven, episodes = [drive.trajectory() for drive in drives], _episodes(world, robot, drives)
        evaluations.append(Evaluation(policy, episodes, 1, seconds, driven, made_for))
    return evaluations


def _episodes(world_name: str, robot: str, drives: list[LoggedDrive]) -> EpisodeSet:
    world, first = get_world(world_name), [drive.entries[0] for drive in drives]
    start = torch.tensor([[*entry["position"][:2], entry["angles"][2]] for entry in first])
    goal = torch.tensor([entry["goal"] for entry in first])
    straight = ((goal - start[:, :2]).norm(dim=-1) - TaskConfig().success_distance).clamp(min=0.0)
    shortest = shortest_paths(world, get_robot(robot), start, goal)
    lengths = torch.where(shortest.isfinite(), shortest, straight)
    return EpisodeSet(world_name, WorldPool(world), 0, start, goal, lengths)


@dataclass
class LoggedDrive:
    """One drive of a log, with the entries of the log at the start and after each step."""

    world: str
    policy: str
    robot: str
    seconds: float
    goal: list[float]
    entries: list[dict[str, Any]]
    ending: str = ""

    def trajectory(self) -> Trajectory:
        """Resamples the drive to 20 Hz. Late and missing steps are filled with the nearest pose."""
        nearest, after = self._nearest(), self.entries[1:]
        steps = len(nearest) - 1
        step_of = (torch.tensor(self._times()[1:]) / CONTROL_DT).round().long().clamp(1, steps) - 1

        def in_steps(event: str) -> Tensor:
            happened = torch.zeros(steps, dtype=torch.bool)
            happened[step_of[torch.tensor([entry[event] for entry in after], dtype=torch.bool)]] = True
            return happened

        return Trajectory(
            position=torch.tensor([entry["position"] for entry in self.entries])[nearest],
            angles=torch.tensor([entry["angles"] for entry in self.entries])[nearest],
            collision=in_steps("collision"),
            goal=in_steps("reached"),
            ending=self.ending,
            reversals=count_reversals([entry["command"][1] for entry in after]),
        )

    def scans(self) -> Tensor:
        """Resamples the lidar readings like :meth:`trajectory`: ``[T + 1, beams]``, m, ``inf`` without a return."""
        scans = (self.entries[k]["ranges"] for k in self._nearest())
        return torch.tensor([[math.inf if reading is None else reading for reading in scan] for scan in scans])

    def _times(self) -> list[float]:
        return list(accumulate((entry["dt"] for entry in self.entries[1:]), initial=0.0))

    def _nearest(self) -> Tensor:
        """Index of the entry nearest to each step of 20 Hz, int64 ``[T + 1]``."""
        times = self._times()
        grid = CONTROL_DT * torch.arange(max(1, round(times[-1] / CONTROL_DT)) + 1)
        return (torch.tensor(times)[None] - grid[:, None]).abs().argmin(-1)


def logged_drives(path: Path) -> list[LoggedDrive]:
    """Reads the drives of a log that have ended."""
    entries = [*_entries(path)]
    if not entries or entries[0].get("format") != FORMAT:
        raise ValueError(f"{path} is no log of drives")
    header, drive, ended = {}, None, []
    for entry in entries:
        if entry.get("format") == FORMAT:
            header, drive = {key: entry[key] for key in ("world", "policy", "robot", "seconds")}, None
        elif "goal" in entry:
            drive = LoggedDrive(**header, goal=entry["goal"], entries=[entry])
        elif drive is not None and "ending" in entry:
            drive.ending = entry["ending"]
            ended.append(drive)
            drive = None
        elif drive is not None:
            drive.entries.append(entry)
    if not ended:
        raise ValueError(f"no drive in {path} has ended")
    return ended


def _entries(path: Path) -> Iterator[dict[str, Any]]:
    for line in path.read_text(errors="replace").splitlines():
        try:
            entry = json.loads(line)
        except ValueError:
            continue
        if isinstance(entry, dict):
            yield entry
