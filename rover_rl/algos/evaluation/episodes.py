"""Evaluation episodes: fixed starts and goals with the lengths of their shortest paths.

Each of the three worlds of the original environment has a stored set: the first 256 draws whose shortest path is long
enough, without further selection.

Example:
    >>> stored_episodes("maze").shortest.min() >= 2
    tensor(True)
    >>> len(draw_episodes("maze:10000-10001", 4))
    8
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rover_rl.algos.evaluation.cores import over_cores
from rover_rl.checks import MAX_COUNT, check_at_least, check_seed
from rover_rl.envs.config import EnvConfig, RobotLike, TaskConfig
from rover_rl.envs.groups import GroupPlacement
from rover_rl.envs.placement import Placement
from rover_rl.names import Name
from rover_rl.native.threads import single_threaded
from rover_rl.rng import episode_keys, row_keys
from rover_rl.robots import Robot, get_robots
from rover_rl.robots.fleet import largest_of
from rover_rl.sims.free_space.fitting import fitting_worlds
from rover_rl.sims.free_space.paths import shortest_paths
from rover_rl.worlds import WORLDS, World, get_world
from rover_rl.worlds.pool import WorldPool, WorldSource
from rover_rl.worlds.table import WorldTable

DEFAULT_SEED = 20_000  # seed of the stored episodes
STORED_WORLDS = ("inspect", "moon", "maze")  # worlds with a stored set
STORED = 256  # number of episodes in a stored set
PER_WORLD = 4  # default number of episodes in each world of a range
MIN_PATH = 2.0  # smallest length of the shortest path of an episode, m
_FEW_WORLDS = 16  # number of worlds below which episodes are drawn in this process
_MAX_DRAWS = 100  # largest number of draws per requested episode
_SEEDS_OF_A_WORLD = 2**32  # distance of the first draws of two worlds with consecutive seeds


@dataclass(frozen=True)
class EpisodeSet:
    """A set of starts and goals for evaluation, in one world or in several."""

    name: str  #: Name of the world or of the range of worlds as requested, such as ``"maze:7"``.
    pool: WorldPool  #: Worlds of the episodes.
    seed: int  #: Seed of the first draw.
    start: Tensor  #: Start poses, float32 ``[count, 3]`` (x, y in m, yaw in rad).
    goal: Tensor  #: Goals, float32 ``[count, 2]``, m.
    shortest: Tensor  #: Lengths of the shortest paths to the edges of the goal discs, float32 ``[count]``, m.
    offset: int = 0  #: Index of the first episode in the set that this is a part of.
    world_index: Tensor = None  # type: ignore[assignment]  # Never None after __post_init__.
    """Index of each episode's world in the pool, int64 ``[count]``; 0 by default."""
    endless: bool = False
    """Whether a reached goal is followed by a new one. The environment draws starts and goals; here they are nan."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "pool", WorldPool.of(self.pool))
        if self.world_index is None:
            object.__setattr__(self, "world_index", torch.zeros(len(self.start), dtype=torch.int64))

    def __len__(self) -> int:
        return len(self.start)

    @property
    def several_worlds(self) -> bool:
        return len(self.pool) > 1

    @property
    def world(self) -> World:
        """World of the episodes. Raises ``ValueError`` if they are in several."""
        indices = self.world_index.unique().tolist()
        if len(indices) > 1:
            raise ValueError(f"the episodes are in {len(indices)} worlds; use the worlds of each episode")
        return self.pool[indices[0]]

    @property
    def worlds(self) -> list[World]:
        return [self.pool[index] for index in self.world_index.tolist()]

    def world_name(self, episode: int) -> str:
        return self.pool.name(int(self.world_index[episode])) if self.several_worlds else self.name

    def first(self, count: int) -> EpisodeSet:
        if not 1 <= count <= len(self):
            raise ValueError(f"count must be between 1 and {len(self)}, got {count}")
        return self.part(0, count)

    def part(self, begin: int, end: int) -> EpisodeSet:
        return replace(self.select(range(begin, min(end, len(self)))), offset=self.offset + begin)

    def select(self, indices: Sequence[int]) -> EpisodeSet:
        chosen = torch.tensor(indices, dtype=torch.int64)
        keys = ("start", "goal", "shortest", "world_index")
        return replace(self, **{key: getattr(self, key)[chosen] for key in keys})

    def with_used_worlds(self) -> EpisodeSet:
        used, index = self.world_index.unique(return_inverse=True)
        sources = (portable(self.pool.source(number)) for number in used.tolist())
        return replace(self, pool=WorldPool(*sources), world_index=index)


def draw_episodes(
    world: WorldSource,
    count: int = 64,
    seed: int = DEFAULT_SEED,
    min_path: float = MIN_PATH,
    *,
    robot: RobotLike = "rover_zero",
    workers: int | None = 1,
    agents: int = 1,
) -> EpisodeSet:
    """Draws starts and goals as the environment does, and keeps those whose shortest path is long enough.

    In the world with the seed ``w``, such as ``"maze:w"``, draw ``i`` is the start and goal of the first episode of an
    environment with the seed ``seed + 2**32 * w + i``; ``w`` is 0 for a world without a seed. The same seed always
    gives the same episodes in a world, whatever the other worlds, and a larger ``count`` appends to them.

    Args:
        world: world, range of worlds such as ``"maze:10000-10063"``, list of both, or pool, whose order the episodes
            have. Names without a scale get that of the robot, such as ``"maze:10000-10063*1.8"``.
        count: number of episodes in each world.
        seed: seed of the first draw.
        min_path: smallest length of the shortest path, m; draws with a shorter one are skipped.
        robot: robot for which the starts, goals and paths must be free. Of several, the one that needs the most space.
        workers: largest number of processes; ``None``: the number of cores. The episodes do not depend on it.
        agents: number of consecutive episodes that are driven at once, by rovers that share a world, with starts and
            goals apart. ``count`` must be a multiple.

    Raises:
        ValueError: for an unknown world or robot, a number out of range, or a world in which hardly any path is long
            enough.
    """
    check_at_least(1, MAX_COUNT, count=count, agents=agents)
    if count % agents:
        raise ValueError(f"count must be a multiple of agents={agents}, got {count}")
    robots = get_robots(robot)
    world = fitting_worlds(world, *robots)
    seed, pool = check_seed(seed, count), WorldPool.of(world)
    draw = partial(_draw_in, robot=largest_of(robots), count=count, min_path=min_path, agents=agents)
    places = []
    for source in map(pool.source, range(len(pool))):
        seed_of_world = Name.parse(source).settings.get("seed", 0) if isinstance(source, str) else 0
        places.append((portable(source), seed + _SEEDS_OF_A_WORLD * seed_of_world))
    # Processes take longer to start than the episodes of a few worlds take to draw.
    drawn = over_cores(draw, places, "drawing starts and goals", 1 if len(pool) < _FEW_WORLDS else workers)
    start, goal, shortest = (torch.cat(part) for part in zip(*drawn, strict=True))
    index = torch.arange(len(pool)).repeat_interleave(count)
    name = world if isinstance(world, str) else ", ".join(EnvConfig(world=world).world_names)
    return EpisodeSet(name, pool, seed, start, goal, shortest, world_index=index)


def endless_episodes(
    world: str | World, count: int = 32, seed: int = DEFAULT_SEED, *, robot: RobotLike = "rover_zero"
) -> EpisodeSet:
    """Episodes of up to 2,000 steps, with a new goal whenever one is reached, as in the original environment.

    Episode ``i`` is that of an environment seeded ``seed + i``.
    """
    check_at_least(1, MAX_COUNT, count=count)
    world = fitting_worlds(world, *get_robots(robot))
    name = world if isinstance(world, str) else get_world(world).name
    unknown = torch.full((count, 3), math.nan)
    return EpisodeSet(name, WorldPool.of(world), seed, unknown, unknown[:, :2], unknown[:, 0], endless=True)


def portable(world: str | World) -> str | World:
    """What gives the same world in another process: the name of a built-in one, else the world."""
    is_built_in = isinstance(world, str) and Name.parse(world).part in WORLDS
    return world if is_built_in else get_world(world)


@single_threaded()
def _draw_in(
    place: tuple[str | World, int], *, robot: Robot, count: int, min_path: float, agents: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Starts, goals and lengths of the shortest paths in the world of ``place``, drawn from its seed on."""
    world, seed, task, device = get_world(place[0]), place[1], TaskConfig(), torch.device("cpu")
    placing = (WorldTable([world] * count), robot, task.min_goal_distance)
    placement = Placement(*placing) if agents == 1 else GroupPlacement(*placing, agents)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    for first in range(seed, seed + _MAX_DRAWS * count, count):
        keys = episode_keys(row_keys(first, count, device), torch.ones(count, 1, dtype=torch.int64))
        start = placement.draw_start(keys)
        goal = placement.draw_goal(keys, torch.zeros_like(keys), start[:, :2])
        shortest = shortest_paths(world, robot, start, goal, task.success_distance)
        long_enough = (shortest >= min_path).reshape(-1, agents).all(1).repeat_interleave(agents)
        found.append((start[long_enough], goal[long_enough], shortest[long_enough]))
        start, goal, shortest = (torch.cat(part)[:count] for part in zip(*found, strict=True))
        if len(shortest) == count:
            return start, goal, shortest
    raise ValueError(f"world {world.name!r} has hardly any shortest path of {min_path:g} m or more")


def stored_episodes(world: str) -> EpisodeSet:
    if world not in STORED_WORLDS:
        raise ValueError(f"no episodes are stored for world {world!r}; draw them with draw_episodes()")
    data = json.loads((Path(__file__).parent / "episode_sets" / f"{world}.json").read_text())
    return read_episodes(world, data["seed"], data["episodes"])


def read_episodes(world: str, seed: int, rows: Sequence[Mapping[str, Any]]) -> EpisodeSet:
    """Episodes in a world or a range as files hold them, a row each."""
    start, goal, shortest = (torch.tensor([row[key] for row in rows]) for key in ("start", "goal", "shortest"))
    index = torch.tensor([row.get("world", 0) for row in rows])
    return EpisodeSet(world, WorldPool(world), seed, start, goal, shortest, world_index=index)


def choose_episodes(
    world: str,
    count: int | None = None,
    seed: int | None = None,
    *,
    robot: RobotLike = "rover_zero",
    workers: int | None = 1,
    agents: int = 1,
) -> EpisodeSet:
    """The first stored episodes of a world, or drawn ones if there are not enough.

    ``count`` is the number in each world, by default 256 in one world and 4 in each of a range. With a ``seed``, for
    several ``agents`` or for another robot than ``rover_zero``, all episodes are drawn: see :func:`draw_episodes`.
    """
    several = len(WorldPool(world)) > 1
    if count is None:
        count = PER_WORLD if several else STORED
        count = max(agents, count - count % agents)
    if world in STORED_WORLDS and seed is None and count <= STORED and robot == "rover_zero" and agents == 1:
        return stored_episodes(world).first(count)
    seed = DEFAULT_SEED if seed is None else seed
    return draw_episodes(world, count, seed, robot=robot, workers=workers, agents=agents)
