"""Evaluation episodes: fixed starts and goals with the lengths of their shortest paths.

Each of the three worlds of the original environment has a stored set: the first 256 draws whose shortest path is long
enough, without further selection. ``python -m rover_rl.algos.evaluation.episodes`` regenerates the sets.

Example:
    >>> stored_episodes("maze").shortest.min() >= 2
    tensor(True)
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rover_rl.algos.policy.networks import single_threaded
from rover_rl.checks import MAX_COUNT, check_at_least, check_seed
from rover_rl.envs import TaskConfig
from rover_rl.envs.placement import Placement
from rover_rl.envs.rng import episode_keys, row_keys
from rover_rl.files import written_whole
from rover_rl.progress import ProgressDisplay
from rover_rl.sims.robots import Robot, get_robot
from rover_rl.sims.worlds import World, get_world
from rover_rl.sims.worlds.shortest_paths import shortest_paths

DEFAULT_SEED = 20_000
"""Seed of the stored episodes."""
STORED_WORLDS = ("inspect", "moon", "maze")
"""Worlds with a stored set."""
STORED = 256
"""Number of episodes in a stored set."""
MIN_PATH = 2.0
"""Smallest length of the shortest path of an episode, m."""
FOLDER = Path(__file__).with_name("episode_sets")
"""Folder of the stored sets."""
_MAX_DRAWS = 100
"""Largest number of draws per requested episode."""


@dataclass(frozen=True)
class EpisodeSet:
    """A set of starts and goals for evaluation.

    Attributes:
        name: name of the world as requested, such as ``"maze:7"``.
        world: world of the episodes.
        seed: seed of the first draw.
        start: start poses, float32 ``[count, 3]`` (x, y in m, yaw in rad).
        goal: goals, float32 ``[count, 2]``, m.
        shortest: lengths of the shortest paths from the starts to the edges of the goal discs, float32 ``[count]``, m;
            see :func:`~rover_rl.sims.worlds.shortest_paths.shortest_paths`.
        offset: index of the first episode in the set that this is a part of.
    """

    name: str
    world: World
    seed: int
    start: Tensor
    goal: Tensor
    shortest: Tensor
    offset: int = 0

    def __len__(self) -> int:
        return len(self.start)

    def first(self, count: int) -> EpisodeSet:
        """Returns the first ``count`` episodes.

        Raises:
            ValueError: if ``count`` is below 1 or above the number of episodes.
        """
        if not 1 <= count <= len(self):
            raise ValueError(f"count must be between 1 and {len(self)}, got {count}")
        return self.part(0, count)

    def part(self, begin: int, end: int) -> EpisodeSet:
        """Returns the episodes from index ``begin`` up to, but not including, ``end``."""
        start, goal, shortest = self.start[begin:end], self.goal[begin:end], self.shortest[begin:end]
        return replace(self, start=start, goal=goal, shortest=shortest, offset=self.offset + begin)


@single_threaded()
def draw_episodes(
    world: str | World,
    count: int = 64,
    seed: int = DEFAULT_SEED,
    min_path: float = MIN_PATH,
    *,
    robot: str | Robot = "rover_zero",
) -> EpisodeSet:
    """Draws starts and goals as the environment does, and keeps those whose shortest path is long enough.

    Draw ``i`` is the start and goal of the first episode of an environment with the seed ``seed + i``. The same seed
    always gives the same episodes, and a larger ``count`` appends to them.

    Args:
        world: name of a world, or a world.
        count: number of episodes.
        seed: seed of the first draw.
        min_path: smallest length of the shortest path, m; draws with a shorter one are skipped.
        robot: name of a robot, or a robot, for which the starts, goals and paths must be free.

    Raises:
        ValueError: for an unknown world or robot, a count or seed out of range, or a world in which hardly any path
            is long enough.
    """
    check_at_least(1, MAX_COUNT, count=count)
    seed = check_seed(seed, count)
    place, robot, goal_radius = get_world(world), get_robot(robot), TaskConfig().success_distance
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    taken = drawn = 0
    while taken < count:
        if drawn >= _MAX_DRAWS * count:
            raise ValueError(f"world {place.name!r} has hardly any shortest path of {min_path:g} m or more")
        start, goal = _draw(place, robot, count, seed + drawn)
        shortest = shortest_paths(place, robot, start, goal, goal_radius)
        long_enough = shortest >= min_path
        found.append((start[long_enough], goal[long_enough], shortest[long_enough]))
        drawn += count
        taken += int(long_enough.sum())
    start, goal, shortest = (torch.cat(part)[:count] for part in zip(*found, strict=True))
    return EpisodeSet(world if isinstance(world, str) else place.name, place, seed, start, goal, shortest)


def _draw(world: World, robot: Robot, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Starts ``[count, 3]`` and goals ``[count, 2]`` of the first episodes of environments seeded ``seed`` and up."""
    device = torch.device("cpu")
    placement = Placement([world] * count, robot, TaskConfig().min_goal_distance, device)
    keys = episode_keys(row_keys(seed, count, device), torch.ones(count, 1, dtype=torch.int64))
    start = placement.draw_start(keys)
    return start, placement.draw_goal(keys, torch.zeros_like(keys), start[:, :2])


def stored_episodes(world: str) -> EpisodeSet:
    """Returns the stored set of 256 episodes of a world.

    Raises:
        ValueError: for a world without a stored set.
    """
    if world not in STORED_WORLDS:
        raise ValueError(f"no episodes are stored for world {world!r}; draw them with draw_episodes()")
    data = json.loads((FOLDER / f"{world}.json").read_text())
    start, goal, shortest = (
        torch.tensor([row[key] for row in data["episodes"]]) for key in ("start", "goal", "shortest")
    )
    return EpisodeSet(world, get_world(world), data["seed"], start, goal, shortest)


def choose_episodes(
    world: str, count: int = STORED, seed: int | None = None, *, robot: str | Robot = "rover_zero"
) -> EpisodeSet:
    """Returns the first stored episodes of a world, or draws episodes if there are not enough stored ones.

    Args:
        world: name of a world.
        count: number of episodes.
        seed: seed of the first draw; ``None``: use the stored episodes if possible.
        robot: name of a robot, or a robot. The stored episodes are those of ``rover_zero``.

    Raises:
        ValueError: as for :func:`draw_episodes`.
    """
    if world in STORED_WORLDS and seed is None and count <= STORED and robot == "rover_zero":
        return stored_episodes(world).first(count)
    with ProgressDisplay("drawing starts and goals"):
        return draw_episodes(world, count, DEFAULT_SEED if seed is None else seed, robot=robot)


def write_episodes(episodes: EpisodeSet, path: Path) -> None:
    """Writes a set as JSON, one episode per line, with the shortest exact decimal form of each float32."""
    rows = zip(episodes.start.numpy(), episodes.goal.numpy(), episodes.shortest.numpy(), strict=True)
    lines = [
        json.dumps({"start": _shortest_text(start), "goal": _shortest_text(goal), "shortest": float(str(shortest))})
        for start, goal, shortest in rows
    ]
    head = json.dumps({"world": episodes.name, "seed": episodes.seed})[:-1]
    with written_whole(path) as temporary:
        temporary.write_text(f'{head}, "episodes": [\n' + ",\n".join(lines) + "\n]}\n")


def _shortest_text(numbers: np.ndarray) -> list[float]:
    return [float(str(number)) for number in numbers]


def main() -> None:
    """Regenerates the stored episodes of the package."""
    for world in STORED_WORLDS:
        write_episodes(draw_episodes(world, STORED), FOLDER / f"{world}.json")
        print(FOLDER / f"{world}.json")


if __name__ == "__main__":
    main()
