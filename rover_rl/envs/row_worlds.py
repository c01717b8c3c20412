"""The world of each row of a batch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from rover_rl.rng import random_bits, to_index
from rover_rl.worlds import World
from rover_rl.worlds.pool import WorldPool, WorldsAhead, WorldSource, draws_worlds
from rover_rl.worlds.table import WorldTable

_WORLD = 16
"""Stream of random numbers."""
_PARTS = 2**31 - 1
"""Number of equal parts that weighted draws divide the total weight into: the largest size of ``to_index``."""
SPARE_WORLDS = 64
"""Number of worlds that stay in their slots after the last row has left them."""


class RowWorlds:
    """The world of each row of a batch: one for life, or another one for each episode.

    Worlds without a range are assigned to equal blocks of rows. If ``world_n`` has a range of seeds, as in
    ``"maze:*"``, or is a :class:`~rover_rl.worlds.pool.WorldPool`, each episode draws a world of the pool. The
    draw depends on the seed of the row, the number of the episode and the weights of the worlds only.

    If there are no more worlds than rows to draw from, the pool is resident: all of its worlds are in slots of the
    table from :meth:`open` on, and rows change worlds on the device, without the host. Of a larger pool, the worlds
    that rows are in have slots.

    Args:
        world_n: worlds.
        keys: random keys of the first episodes, ``[N, 1]``.
        agents: number of consecutive rows that share a world, and the keys that draw it.
        is_drawn: whether episodes draw their worlds. ``None``: as above.

    Attributes:
        pool: all worlds that rows can be in.
        is_drawn: whether episodes draw their worlds.
        index: index of each row's world in the pool, int64 ``[N, 1]``.
        table: world and slot of each row, for those who hold data of worlds.

    Raises:
        ValueError: if a world is unknown, or there are more worlds than rows.
    """

    def __init__(self, world_n: WorldSource, keys: Tensor, agents: int = 1, is_drawn: bool | None = None) -> None:
        num_envs = len(keys)
        groups = num_envs // agents
        if world_n == [] or world_n == ():
            raise ValueError(f"world_n must give between 1 and num_envs={num_envs} worlds, got 0")
        self.pool = WorldPool.of(world_n)
        count = len(self.pool)
        self.is_drawn = draws_worlds(world_n) if is_drawn is None else is_drawn
        if not self.is_drawn and count > groups:
            shared = "" if agents == 1 else f" / agents={agents}"
            raise ValueError(f"world_n must give between 1 and num_envs={num_envs}{shared} worlds, got {count}")
        self._limits: Tensor | None = None
        # On the device once for all: a copy from the host waits for the device.
        self._sizes = torch.tensor(self.pool.sizes, device=keys.device)
        self._starts = self._sizes.cumsum(0) - self._sizes
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

    @property
    def index_if_several(self) -> Tensor | None:
        """:attr:`index`, or ``None`` if the pool has only one world."""
        return self.index if len(self.pool) > 1 else None

    @property
    def entry(self) -> Tensor:
        """Index of the entry of the pool that each row's world belongs to, int64 ``[N]``."""
        return torch.searchsorted(self._starts, self.index.squeeze(-1), right=True) - 1

    @property
    def have_movers(self) -> bool:
        """Whether something moves in the worlds: in the first one of an entry of the pool."""
        starts = self._starts.tolist()
        known = dict(zip(self.index.flatten().tolist(), self.table, strict=True))
        return any((known.get(start) or self.pool[start]).movers for start in starts)

    def open(self, prepare: Callable[[World], object]) -> None:
        """Gets ready for :meth:`draw`: makes the pool resident, or prepares worlds in a thread if it is too large.

        The thread prepares the worlds of the next episodes during :meth:`preparing`. Use this only if :attr:`is_drawn`.

        Args:
            prepare: what to do with a world before it is needed, safe to call from another thread.
        """
        if len(self.pool) > len(self.index):
            self._ahead = WorldsAhead(self.pool, prepare, limit=len(self.index))
            self._ahead.pause()
        elif self._resident is None:
            worlds = dict(zip(self.index.flatten().tolist(), self.table, strict=True))
            self._resident = self.table.hold(worlds.get(k) or self.pool[k] for k in range(len(self.pool)))

    def draw(self, mask: Tensor, keys: Tensor, next_keys: Tensor) -> None:
        """Draws the worlds of new episodes, and those of the episodes after these.

        Use it only after :meth:`open`.

        Args:
            mask: rows that begin an episode, bool ``[N, 1]``.
            keys: random keys of the episodes, ``[N, 1]``.
            next_keys: random keys of the episodes after these, ``[N, 1]``.
        """
        drawn = torch.where(keys == self._next_keys, self._next, self._drawn(keys))
        before, self.index = self.index, torch.where(mask, drawn, self.index)
        self._next_keys = torch.where(mask, next_keys, self._next_keys)
        self._next = torch.where(mask, self._drawn(next_keys), self._next)
        if self._resident is not None:
            self.table.enter(self._resident[self.index.squeeze(-1)])
            return
        # Worlds are Python objects that a simulator copies one by one, so that this loop is over changed rows alone.
        changed = (self.index != before).squeeze(-1).nonzero().squeeze(-1)
        source = self.pool if self._ahead is None else self._ahead
        self.table.assign(changed, [source[index] for index in self.index[changed, 0].tolist()])
        if self._ahead:
            self._ahead.request(self._next[mask].tolist())

    def set_weights(self, weights: Tensor) -> None:
        """Sets the weights of the worlds in later draws. The next episode of each row has already drawn its world.

        Args:
            weights: weight of each world of the pool, ``[len(pool)]``.

        Raises:
            ValueError: if episodes do not draw worlds, or a weight is negative or not finite, or all are 0.
        """
        count = len(self.pool)
        if not self.is_drawn:
            raise ValueError(
                "weights are for a range of worlds, as in 'maze:*', or a WorldPool, from which episodes draw"
            )
        if weights.shape != (count,):
            raise ValueError(f"weights must have the shape {(count,)}, one for each world, got {(*weights.shape,)}")
        # On the CPU, where sums are the same each time.
        limits = weights.to("cpu", torch.float64).cumsum(0)
        if not (weights >= 0).all() or not 0 < limits[-1] < torch.inf:
            raise ValueError("weights must be finite and not negative, and not all 0")
        self._limits = (limits / limits[-1] * _PARTS).round().long().to(self.index.device)

    @contextmanager
    def preparing(self) -> Iterator[None]:
        """Lets the thread of :meth:`open` prepare worlds: use it around the simulator's kernels."""
        if self._ahead is None:
            yield
            return
        self._ahead.resume()
        try:
            yield
        finally:
            self._ahead.pause()

    def close(self) -> None:
        """Ends the preparation of worlds. Idempotent."""
        if self._ahead:
            self._ahead.close()
            self._ahead = None

    def _drawn(self, keys: Tensor) -> Tensor:
        """Returns the index of the world that each episode draws, int64 ``[N, 1]``."""
        bits = random_bits(keys, _WORLD, 0, 2)
        if self._limits is not None:
            part = to_index(bits[:, :1], torch.full_like(keys, _PARTS))
            return torch.searchsorted(self._limits, part, right=True)
        entry = to_index(bits[:, :1], torch.full_like(keys, len(self._sizes)))
        return self._starts[entry] + to_index(bits[:, 1:], self._sizes[entry])
