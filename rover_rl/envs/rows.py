"""Episode, world and robot of each row of a batch."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial

import torch
from torch import Tensor

from rover_rl.envs.chosen_rows import ChosenRows
from rover_rl.envs.config import EnvConfig
from rover_rl.rng import episode_keys, random_bits, row_keys, to_index
from rover_rl.robots.fleet import Fleet
from rover_rl.sims.backends import begin_loading
from rover_rl.sims.free_space.fitting import RobotGroups
from rover_rl.worlds import World
from rover_rl.worlds.pool import WorldPool, WorldsAhead, WorldSource, draws_worlds
from rover_rl.worlds.table import WorldTable

_WORLD, _ROBOT = 16, 17
"""Streams of random numbers."""
_PARTS = 2**31 - 1
"""Number of equal parts that weighted draws divide the total weight into: the largest size of ``to_index``."""
SPARE_WORLDS = 64
"""Number of worlds that stay in their slots after the last row has left them."""


def first_keys(seed: int, num_envs: int, device: torch.device) -> Tensor:
    """Returns the random keys of the first episodes, int64 ``[N, 1]``. Row ``i`` has the seed ``seed + i``."""
    return episode_keys(row_keys(seed, num_envs, device), 1)


class Episodes:
    """Number of the episode of each row since it was seeded, and the random keys of rows and episodes.

    ``keys`` are those of the episodes, int64 ``[N, 1]``, ``world_keys`` those of what happens in the worlds, and
    ``world_steps`` the steps of each world's episode, int64 ``[N, 1]``; ``None``: those of its row.
    """

    world_keys: Tensor
    world_steps: Tensor | None = None

    def __init__(self, seed: int, num_envs: int, device: torch.device) -> None:
        self._rows = self.keys = self.world_keys = row_keys(seed, num_envs, device)
        self._number = torch.zeros_like(self._rows)

    def are_first(self) -> bool:
        return bool((self._number == 1).all())

    def begin(self, rows: ChosenRows) -> ChosenRows:
        """Begins episodes in rows, and returns those whose world begins one."""
        numbers = rows.of(self._number) + 1
        self._number = rows.into(self._number, numbers)
        self.keys = self.world_keys = rows.into(self.keys, episode_keys(rows.of(self._rows), numbers))
        return rows

    def next_world_keys(self, rows: ChosenRows) -> Tensor:
        return episode_keys(rows.of(self._rows), rows.of(self._number) + 1)

    def advance(self, active: Tensor | None) -> Tensor | None:
        """Counts a step of the ``active`` rows, and returns the rows in whose worlds time passes. ``None``: all."""
        return active


class RowWorlds:
    """The world of each row of a batch: one for life, or another one for each episode.

    Worlds without a range are assigned to equal blocks of rows. If there is a range of seeds, as in ``"maze:*"``, or a
    :class:`~rover_rl.worlds.pool.WorldPool`, each episode draws a world of the ``pool`` by the seed of the row, the
    number of the episode and the weights of the worlds only. The ``index`` of each row's world in the pool is int64
    ``[N, 1]``, and the ``table`` has its world and slot, for those who hold data of worlds.

    If the pool has no more worlds than rows, it is resident: all worlds are in slots of the table from :meth:`open` on,
    and rows change worlds on the device, without the host. Of a larger pool, the worlds that rows are in have slots.

    ``keys`` are those of the first episodes, ``[N, 1]``. Each ``agents`` consecutive rows share a world, and the keys
    that draw it. Raises ``ValueError`` if a world of the source is unknown, or there are more worlds than rows.
    """

    def __init__(self, source: WorldSource, keys: Tensor, agents: int = 1, is_drawn: bool | None = None) -> None:
        num_envs = len(keys)
        groups = num_envs // agents
        if source == [] or source == ():
            raise ValueError(f"world_n must give between 1 and num_envs={num_envs} worlds, got 0")
        self.pool = WorldPool.of(source)
        count = len(self.pool)
        self.is_drawn = draws_worlds(source) if is_drawn is None else is_drawn
        if not self.is_drawn and count > groups:
            shared = "" if agents == 1 else f" / agents={agents}"
            raise ValueError(f"world_n must give between 1 and num_envs={num_envs}{shared} worlds, got {count}")
        self._limits: Tensor | None = None
        # On the device once for all: a copy from the host waits for the device.
        self._sizes = torch.tensor(self.pool.sizes, device=keys.device)
        self._starts = self._sizes.cumsum(0) - self._sizes
        if len({*self.pool.shares}) > 1:
            self.set_weights(torch.tensor(self.pool.shares_of_worlds))
        rows = torch.arange(num_envs, device=keys.device)[:, None]
        self.index = self._drawn(keys) if self.is_drawn else rows // agents * count // groups
        indices = self.index.flatten().tolist()
        # A large pool may make another object when it is asked for a world again.
        worlds = {k: self.pool[k] for k in dict.fromkeys(indices)}
        self.table = WorldTable([worlds[k] for k in indices], keys.device, SPARE_WORLDS)
        # Slot of each world of a resident pool, int64 [len(pool)].
        self._resident: Tensor | None = None
        # The episodes of these keys have drawn their worlds.
        self._next_keys, self._next = keys, self.index
        self._ahead: WorldsAhead | None = None
        self.preparing: Callable[[], AbstractContextManager[None]] = nullcontext

    @property
    def index_if_several(self) -> Tensor | None:
        return self.index if len(self.pool) > 1 else None

    @property
    def entry(self) -> Tensor:
        """Index of the entry of the pool that each row's world belongs to, int64 ``[N]``."""
        return torch.searchsorted(self._starts, self.index.squeeze(-1), right=True) - 1

    @property
    def have_movers(self) -> bool:
        """Whether something moves in the worlds: in the first one of an entry of the pool."""
        known = self._known()
        return any((known.get(start) or self.pool[start]).movers for start in self._starts.tolist())

    def _known(self) -> dict[int, World]:
        return dict(zip(self.index.flatten().tolist(), self.table, strict=True))

    def open(self, prepare: Callable[[World], object]) -> None:
        """Gets ready for :meth:`draw`: makes the pool resident, or prepares worlds in a thread if it is too large.

        The thread prepares the worlds of the next episodes during :attr:`preparing`, each by calling ``prepare``.
        """
        if len(self.pool) > len(self.index):
            self._ahead = WorldsAhead(self.pool, prepare, limit=len(self.index))
            self._ahead.pause()
            self.preparing = partial(self._running, self._ahead)
        elif self._resident is None:
            worlds = self._known()
            self._resident = self.table.hold(worlds.get(k) or self.pool[k] for k in range(len(self.pool)))

    def draw(self, rows: ChosenRows, keys: Tensor, next_keys: Tensor) -> None:
        """Draws the worlds of episodes that begin with ``keys`` ``[N, 1]``, and of the rows' next, ``[M, 1]``."""
        keys = rows.of(keys)
        known, drawn = keys == rows.of(self._next_keys), rows.of(self._next)
        # Nearly always true. On an accelerator, this check would synchronize with it.
        if not (rows.are_selected and known.all()):
            drawn = torch.where(known, drawn, self._drawn(keys))
        before, self.index = self.index, rows.into(self.index, drawn)
        self._next_keys = rows.into(self._next_keys, next_keys)
        self._next = rows.into(self._next, self._drawn(next_keys))
        if self._resident is not None:
            self.table.enter(self._resident[self.index.squeeze(-1)])
            return
        # Worlds are Python objects that a simulator copies one by one, so that this loop is over changed rows alone.
        changed = (self.index != before).squeeze(-1).nonzero().squeeze(-1)
        source = self.pool if self._ahead is None else self._ahead
        self.table.assign(changed, [source[index] for index in self.index[changed, 0].tolist()])
        if self._ahead:
            self._ahead.request(self._next[rows.mask].tolist())

    def set_weights(self, weights: Tensor) -> None:
        """Sets the weights of the worlds, ``[len(pool)]``, in later draws. The next episodes have theirs already."""
        count = len(self.pool)
        if not self.is_drawn:
            drawn_from = "a range of worlds, as in 'maze:*', or a WorldPool, from which episodes draw"
            raise ValueError(f"weights are for {drawn_from}")
        if weights.shape != (count,):
            raise ValueError(f"weights must have the shape {(count,)}, one for each world, got {(*weights.shape,)}")
        # On the CPU, where sums are the same each time.
        limits = weights.to("cpu", torch.float64).cumsum(0)
        if not (weights >= 0).all() or not 0 < limits[-1] < torch.inf:
            raise ValueError("weights must be finite and not negative, and not all 0")
        self._limits = (limits / limits[-1] * _PARTS).round().long().to(self._sizes.device)

    @contextmanager
    def _running(self, ahead: WorldsAhead) -> Iterator[None]:
        ahead.resume()
        try:
            yield
        finally:
            ahead.pause()

    def close(self) -> None:
        if self._ahead:
            self._ahead.close()
            self._ahead, self.preparing = None, nullcontext

    def _drawn(self, keys: Tensor) -> Tensor:
        bits = random_bits(keys, _WORLD, 0, 2)
        if self._limits is not None:
            part = to_index(bits[:, :1], torch.full_like(keys, _PARTS))
            return torch.searchsorted(self._limits, part, right=True)
        entry = to_index(bits[:, :1], torch.full_like(keys, len(self._sizes)))
        return self._starts[entry] + to_index(bits[:, 1:], self._sizes[entry])


class RowRobots:
    """The robot of each row of a batch. Each episode draws one of the lots of those that drive in its world.

    The draw depends on the seed of the row, the number of the episode and its world only. ``choices`` are the first lot
    and number of lots of those that drive in the worlds of each entry of the pool, empty for one. The ``fleet`` is for
    those who hold data of robots, and ``robot_in`` returns the robot that needs the most space of those in a world.
    ``keys`` are those of the next episodes in place of those of the environment.
    """

    def __init__(
        self, groups: RobotGroups, choices: Sequence[tuple[int, int]], worlds: RowWorlds, keys: Tensor
    ) -> None:
        self._worlds, self._choices = worlds, torch.tensor(choices or [(0, 1)], device=keys.device)
        self._lots = torch.tensor(groups.lots, device=keys.device)
        self.robot_in, self.are_several = groups.largest_in, len(groups.robots) > 1
        self.fleet = Fleet(groups.robots, self._drawn(keys))
        self.keys: Tensor | None = None

    @classmethod
    def of(cls, config: EnvConfig, keys: Tensor) -> tuple[RowWorlds, RowRobots]:
        """Creates the worlds and the robots of an environment with their first episodes, while its simulator loads."""
        begin_loading(config.backend, config.preset, keys.device)
        groups = RobotGroups(config.robot)
        source, choices = groups.spread(config.world)
        is_drawn = (draws_worlds(config.world) or len(choices) > len(config.worlds)) if choices else None
        worlds = RowWorlds(source, first_of_group(keys, config.agents), config.agents, is_drawn)
        return worlds, cls(groups, choices, worlds, keys)

    def draw(self, mask: Tensor, keys: Tensor) -> None:
        drawn = self._drawn(keys if self.keys is None else self.keys)
        self.fleet.index = torch.where(mask.squeeze(-1), drawn, self.fleet.index)

    def _drawn(self, keys: Tensor) -> Tensor:
        one = len(self._choices) == 1
        choices = self._choices.expand(len(keys), 2) if one else self._choices[self._worlds.entry]
        return self._lots[drawn_lots(choices, keys)]


def drawn_lots(choices: Tensor, keys: Tensor) -> Tensor:
    """Returns the lot that each episode draws with its key, int64 ``[N]``: see ``RobotGroups``.

    ``choices`` are the first lot and number of lots that each row chooses from, int64 ``[N, 2]``.
    """
    return choices[:, 0] + to_index(random_bits(keys, _ROBOT, 0, 1), choices[:, 1:]).squeeze(-1)


def first_of_group(values: Tensor, agents: int) -> Tensor:
    """Returns the value of the first row of its group in every row, ``[N, ...]``."""
    return values if agents == 1 else values[::agents].repeat_interleave(agents, 0)
