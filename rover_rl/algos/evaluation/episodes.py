"""Episodes to evaluate on: fixed starts and goals, and how long the shortest path between them is.

Each of the package's three worlds has a stored set: the first 256 draws whose shortest path is long enough, without
selection. ``python -m rover_rl.algos.evaluation.episodes`` draws them again.

Example:
    >>> stored_episodes("maze").shortest.min() >= 2
    tensor(True)
"""

from __future__ import annotations

import json
from dataclasses import dataclass
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
from rover_rl.sims.robots import Robot, get_robot
from rover_rl.sims.worlds import WORLDS, World, get_world
from rover_rl.sims.worlds.shortest_paths import shortest_paths

DEFAULT_SEED = 20_000
"""Of the stored episodes."""
STORED = 256
"""Episodes in a stored set."""
MIN_PATH = 2.0
"""Metres of shortest path that an episode has at least."""
FOLDER = Path(__file__).with_name("episode_sets")
_MOST_DRAWS = 100
"""Draws for each episode wanted, before the world counts as too small."""


@dataclass(frozen=True)
class EpisodeSet:
    """Starts and goals to evaluate on.

    Attributes:
        name: of the world as it was asked for, such as ``"maze:7"``.
        world: where they lie.
        seed: they were drawn from.
        start: poses, float32 ``[count, 3]`` (x, y in m, yaw in rad).
        goal: float32 ``[count, 2]``, m.
        shortest: length of the shortest path from each start to the edge of the goal's disc, float32 ``[count]``, m:
            see :func:`~rover_rl.sims.worlds.shortest_paths.shortest_paths`.
    """

    name: str
    world: World
    seed: int
    start: Tensor
    goal: Tensor
    shortest: Tensor

    def __len__(self) -> int:
        return len(self.start)

    def first(self, count: int) -> EpisodeSet:
        """The first ``count`` of them.

        Raises:
            ValueError: for a ``count`` below 1 or above what there is.
        """
        if not 1 <= count <= len(self):
            raise ValueError(f"count must be between 1 and {len(self)}, got {count}")
        parts = (self.start[:count], self.goal[:count], self.shortest[:count])
        return EpisodeSet(self.name, self.world, self.seed, *parts)


@single_threaded()
def draw_episodes(
    world: str | World, count: int = 64, seed: int = DEFAULT_SEED, min_path: float = MIN_PATH
) -> EpisodeSet:
    """Draws starts and goals as the environment does, and takes the first whose shortest path is long enough.

    Draw ``i`` is where the first episode of an environment seeded ``seed + i`` begins. The same seed gives the same
    episodes, and more of them begin with the same ones.

    Args:
        world: a name or a world.
        count: how many.
        seed: of the first draw.
        min_path: shortest path at least, m; what is shorter is passed over.

    Raises:
        ValueError: for an unknown world, a count or seed out of range, or a world in which hardly any path
            is that long.
    """
    check_at_least(1, MAX_COUNT, count=count)
    seed = check_seed(seed, count)
    place, robot = get_world(world), get_robot("rover_zero")
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    taken = drawn = 0
    while taken < count:
        if drawn >= _MOST_DRAWS * count:
            raise ValueError(f"world {place.name!r} has hardly any shortest path of {min_path:g} m or more")
        start, goal = _draw(place, robot, count, seed + drawn)
        shortest = shortest_paths(place, robot, start, goal)
        long_enough = shortest >= min_path
        found.append((start[long_enough], goal[long_enough], shortest[long_enough]))
        drawn += count
        taken += int(long_enough.sum())
    parts = (torch.cat(part)[:count] for part in zip(*found, strict=True))
    return EpisodeSet(world if isinstance(world, str) else place.name, place, seed, *parts)


def _draw(world: World, robot: Robot, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """Starts ``[count, 3]`` and goals ``[count, 2]`` of the first episodes of environments seeded from ``seed`` on."""
    device = torch.device("cpu")
    placement = Placement([world] * count, robot, TaskConfig().min_goal_distance, device)
    keys = episode_keys(row_keys(seed, count, device), torch.ones(count, 1, dtype=torch.int64))
    start = placement.draw_start(keys)
    return start, placement.draw_goal(keys, torch.zeros_like(keys), start[:, :2])


def stored_episodes(world: str) -> EpisodeSet:
    """The set of 256 episodes that the package holds for a world.

    Raises:
        ValueError: for a world without one.
    """
    if world not in WORLDS:
        raise ValueError(f"no episodes are stored for world {world!r}; draw_episodes() draws some")
    data = json.loads((FOLDER / f"{world}.json").read_text())
    columns = (torch.tensor([row[key] for row in data["episodes"]]) for key in ("start", "goal", "shortest"))
    return EpisodeSet(world, get_world(world), data["seed"], *columns)


def write_episodes(episodes: EpisodeSet, path: Path) -> None:
    """Writes a set as JSON, an episode a line; every number is the shortest text of its float32."""
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
    """Draws the stored episodes anew and writes them into the package."""
    for world in WORLDS:
        write_episodes(draw_episodes(world, STORED), FOLDER / f"{world}.json")
        print(FOLDER / f"{world}.json")


if __name__ == "__main__":
    main()
