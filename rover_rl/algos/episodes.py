"""Episodes to evaluate on: fixed starts and goals, and how long the shortest path between them is.

The three worlds that come with the package have a stored set each, drawn once by ``python -m rover_rl.algos.episodes``
and never selected from: the first 256 draws whose shortest path is long enough.

Example:
    >>> stored_episodes("maze").shortest.min() >= 2
    tensor(True)
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from rover_rl.algos.files import written_whole
from rover_rl.algos.policy import single_threaded
from rover_rl.envs import TaskConfig
from rover_rl.envs.placement import Placement
from rover_rl.envs.rng import episode_keys, row_keys
from rover_rl.sims.robots import Robot, get_robot
from rover_rl.sims.worlds import WORLDS, World, free_space, get_world

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
            see :func:`shortest_paths`.
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
        ValueError: for an unknown world, a ``count`` below 1, or a world in which hardly any path is that long.
    """
    if count < 1:
        raise ValueError(f"count must be at least 1, got {count}")
    place, robot = get_world(world), get_robot("rover_zero")
    routes = _Routes(place, robot)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    taken = drawn = 0
    while taken < count:
        if drawn >= _MOST_DRAWS * count:
            raise ValueError(f"world {place.name!r} has hardly any shortest path of {min_path:g} m or more")
        start, goal = _draw(place, robot, count, seed + drawn)
        shortest = routes.lengths(start, goal)
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


def shortest_paths(world: World, robot: Robot, start: Tensor, goal: Tensor) -> Tensor:
    """Length of the shortest path for the rover's centre from each start to the edge of its goal's disc.

    The path leads over the passable cells of :func:`rover_rl.sims.worlds.free_space`, seen from above, and ends 0.5 m
    from the goal, where it is reached. Where the straight way is free the length is exact. Elsewhere Dijkstra's
    algorithm finds a path over steps in 32 directions, and the string is pulled tight: of the polylines over free
    ground through points of that path, the shortest is taken. It is a way that exists, and is longer than the very
    shortest by 0.6 % in the mean and 1.7 % at most (40 detours in the maze, beside the same cells cut into 25 each).

    A start in a cell that is not passable goes straight to the nearest one that is.

    Args:
        world: where.
        robot: that has to fit.
        start: ``[count, 2]`` or poses ``[count, 3]``, m.
        goal: ``[count, 2]``, m.

    Returns:
        float32 ``[count]``, m; ``inf`` where there is no way, 0 where the start is in the disc.
    """
    return _Routes(world, robot).lengths(start, goal)


def distance_fields(world: World, robot: Robot, goals: Tensor) -> Tensor:
    """Length of the shortest path for the rover's centre to each goal, from every cell of the world's free-space grid.

    Paths are those of :func:`shortest_paths` before their string is pulled, and end at the passable cell that is
    nearest to the goal. A cell that is not passable has the value of the nearest one that is.

    Args:
        world: where.
        robot: that has to fit.
        goals: ``[G, 2]``, m.

    Returns:
        float32 ``[G, rows, columns]``, m, as ``free_space(world, robot).passable``.
    """
    return _Routes(world, robot).fields(goals)


class _Routes:
    """Shortest paths over the passable cells of a world. Inside, lengths are in cells: centres are whole numbers."""

    def __init__(self, world: World, robot: Robot) -> None:
        space = free_space(world, robot)
        self._cell, self._origin = space.cell, np.array(space.origin)
        self._reach = TaskConfig().success_distance / space.cell
        self._passable = np.pad(space.passable.numpy(), 1)
        # Of every passable cell: x and y in cells.
        self._points = np.argwhere(space.passable.numpy())[:, ::-1].astype(float)
        self._number = np.full(space.passable.shape, -1)
        self._number[space.passable.numpy()] = np.arange(len(self._points))

    def lengths(self, start: Tensor, goal: Tensor) -> Tensor:
        """See :func:`shortest_paths`."""
        starts, goals = ((xy[:, :2].double().numpy() - self._origin) / self._cell for xy in (start, goal))
        entries = self._entries(starts, goals)
        lengths = np.linalg.norm(entries - starts, axis=1)
        for index in np.flatnonzero(~self._visible(starts, entries) & (lengths > 0)):
            lengths[index] = self._length_around(starts[index], goals[index])
        return torch.from_numpy(lengths * self._cell).float()

    def fields(self, goals: Tensor) -> Tensor:
        """See :func:`distance_fields`."""
        centres = (goals.double().numpy() - self._origin) / self._cell
        nearest = ((self._points - centres[:, None]) ** 2).sum(-1).argmin(-1)
        lengths = np.full((len(centres), *self._number.shape), math.inf, dtype=np.float32)
        lengths[:, self._number >= 0] = dijkstra(self._graph, indices=nearest) * self._cell
        # Cells that hang together with the goals; all others are given the value of the nearest of these.
        known = np.isfinite(lengths).all(0)
        rows, columns = distance_transform_edt(~known, return_distances=False, return_indices=True)
        return torch.from_numpy(lengths[:, rows, columns])

    def _entries(self, points: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """Where the straight line from each point to a goal meets its disc; the point itself where it is inside."""
        away = points - goals
        distance = np.linalg.norm(away, axis=-1, keepdims=True)
        return goals + away * np.minimum(self._reach / np.maximum(distance, 1e-12), 1.0)

    def _visible(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Whether the straight lines from ``a [M, 2]`` to ``b [M, 2]`` cross passable cells only: bool ``[M]``."""
        span = b - a
        lines = np.arange(int(np.abs(span).max(initial=0.0)) + 2)
        first = np.floor(np.minimum(a, b) + 0.5) + 0.5
        with np.errstate(divide="ignore", invalid="ignore"):
            crossings = (first[:, :, None] + lines - a[:, :, None]) / span[:, :, None]
        # Along a line of the grid there is no crossing: 0 / 0, or a division by zero.
        crossings = np.nan_to_num(crossings, nan=1.0, posinf=1.0, neginf=1.0).clip(0, 1).reshape(len(a), -1)
        edges = np.sort(np.pad(crossings, ((0, 0), (1, 1)), constant_values=(0, 1)), axis=1)
        middle = (edges[:, 1:] + edges[:, :-1]) / 2
        free = self._is_passable(a[:, None] + middle[:, :, None] * span[:, None])
        return np.all(free | (np.diff(edges, axis=1) < 1e-9), axis=1)

    def _is_passable(self, points: np.ndarray) -> np.ndarray:
        """Whether points ``[..., 2]`` lie in passable cells; outside of the grid none is."""
        index = np.floor(points + 1.5).astype(int).clip(0, np.array(self._passable.shape[::-1]) - 1)
        return self._passable[index[..., 1], index[..., 0]]

    @cached_property
    def _graph(self) -> csr_array:
        """Steps between passable cells in 32 directions, and their lengths: sparse ``[P, P]``."""
        rows, columns, lengths = [], [], []
        for offset in _STEPS:
            ends = self._points + offset
            free = self._is_passable(ends)
            free[free] = self._visible(self._points[free], ends[free])
            rows.append(np.flatnonzero(free))
            columns.append(self._numbers(ends[free]))
            lengths.append(np.full(len(rows[-1]), math.hypot(*offset)))
        entries = (np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns)))
        return csr_array(entries, shape=(len(self._points),) * 2)

    def _numbers(self, points: np.ndarray) -> np.ndarray:
        x, y = points.astype(int).T
        return self._number[y, x]

    def _length_around(self, start: np.ndarray, goal: np.ndarray) -> float:
        """Length of the way around what stands between a start and a goal ``[2]``."""
        first = int(((self._points - start) ** 2).sum(1).argmin())
        distance, before = dijkstra(self._graph, indices=first, return_predecessors=True)
        near = np.flatnonzero(((self._points - goal) ** 2).sum(1) < (self._reach + 2) ** 2)
        entries = self._entries(self._points[near], goal)
        total = distance[near] + np.linalg.norm(entries - self._points[near], axis=1)
        total[~self._visible(self._points[near], entries)] = math.inf
        if not np.isfinite(total).any():
            return math.inf
        last = int(total.argmin())
        cells = [int(near[last])]
        while cells[-1] != first:
            cells.append(int(before[cells[-1]]))
        points = np.vstack((start, self._points[cells[::-1]], entries[last]))
        return self._pulled_tight(points, goal)

    def _pulled_tight(self, points: np.ndarray, goal: np.ndarray) -> float:
        """Length of the shortest free polyline from the first of ``points [P, 2]`` through others to the disc."""
        count = len(points)
        ends = np.vstack((points, self._entries(points, goal)))
        i, j = np.indices((count, 2 * count)).reshape(2, -1)
        # To a later point of the path, or from a point straight to the disc.
        wanted = ((j > i) & (j < count)) | (j == i + count)
        i, j = i[wanted], j[wanted]
        free = self._visible(points[i], ends[j]) | (j == i + 1)
        length = np.full((count, 2 * count), math.inf)
        length[i[free], j[free]] = np.linalg.norm(ends[j[free]] - points[i[free]], axis=1)
        best = np.full(count, math.inf)
        best[0] = 0.0
        for k in range(1, count):
            best[k] = (best[:k] + length[:k, k]).min()
        return float(min(best[-1], (best + np.diagonal(length, count)).min()))


_STEPS = [(x, y) for x in range(-3, 4) for y in range(-3, 4) if math.gcd(x, y) == 1]
"""Steps to other cells, in 32 directions: ``(x, y)`` in cells."""


def main() -> None:
    """Draws the stored episodes anew and writes them into the package."""
    for world in WORLDS:
        write_episodes(draw_episodes(world, STORED), FOLDER / f"{world}.json")
        print(FOLDER / f"{world}.json")


if __name__ == "__main__":
    main()
