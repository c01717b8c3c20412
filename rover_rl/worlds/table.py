"""Tables: the worlds that the rows of a batch are in, by slot, and data of worlds, for lookups by row."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import takewhile
from typing import Any

import torch
from torch import Tensor

from rover_rl.native.threads import kernel_threads, single_threaded
from rover_rl.worlds.terrain import Terrain, TerrainRows
from rover_rl.worlds.world import World

GROWTH = 1.25
"""Factor by which the longest possible list grows at least."""


def in_threads(function: Callable[[World], Any], worlds: Iterable[World]) -> list[Any]:
    """Calls a function for worlds: the first alone, which loads kernels, the others on all threads of kernels.

    Each of these has one thread of PyTorch's: with more, they wait for one another where cores are busy.
    """
    waiting = [*worlds]
    results = [function(world) for world in waiting[:1]]
    with ThreadPoolExecutor(kernel_threads()) as pool, single_threaded():
        return [*results, *pool.map(function, waiting[1:])]


class WorldTable(Sequence[World]):
    """Worlds of the rows of a batch, by row, and the slots that they are in.

    Worlds are in numbered slots, and a row is in the world of its slot. Those who hold data of worlds keep them by
    slot, and :meth:`follow` the table. A world stays in its slot after the last row has left it, until the slot is
    needed for another world: the one that was left first is replaced first.

    Args:
        worlds: world of each row.
        device: device of the slots. ``None`` is the CPU.
        spare: number of worlds without rows that stay in their slots.

    Attributes:
        slots: slot of each row, int64 ``[N]``. A change replaces the tensor.
        capacity: number that all slots are less than.

    Example:
        >>> maze, moon, inspect = map(get_world, ("maze", "moon", "inspect"))
        >>> table = WorldTable([maze, maze, moon])
        >>> table.slots, table[2] is moon
        (tensor([0, 0, 1]), True)
        >>> table.assign(torch.tensor([1]), [inspect])
        >>> table.slots, list(table) == [maze, inspect, moon]
        (tensor([0, 2, 1]), True)
    """

    def __init__(self, worlds: Sequence[World], device: torch.device | str | None = None, spare: int = 0) -> None:
        # Rows enter their new worlds one by one, so that one more slot than rows and spare worlds is in use at most.
        self.capacity = len(worlds) + spare + 1
        self._spare = spare
        self._worlds: list[World] = []
        self._slot_of: dict[World, int] = {}
        self._users: Counter[int] = Counter()
        # Slots without users, in the order in which they were left.
        self._left: dict[int, None] = {}
        # How many worlds had entered slots after the last one of each slot, in ascending order.
        self._entered: dict[int, int] = {}
        self._entries = 0
        self.slots = torch.tensor([self._enter(world) for world in worlds], dtype=torch.int64, device=device)

    @classmethod
    def of(cls, worlds: Sequence[World], device: torch.device | str | None = None) -> WorldTable:
        """Returns the table of a list of worlds. Returns a table unchanged."""
        return worlds if isinstance(worlds, WorldTable) else cls(worlds, device)

    def __len__(self) -> int:
        return len(self.slots)

    def __getitem__(self, row: Any) -> Any:
        return list(self)[row] if isinstance(row, slice) else self._worlds[int(self.slots[row])]

    def __iter__(self) -> Iterator[World]:
        return map(self._worlds.__getitem__, self.slots.tolist())

    def follow(self) -> Callable[[], dict[int, World]]:
        """Returns a function that returns the worlds, by slot, that entered since its last call; in the first, all."""
        seen = 0

        def entered() -> dict[int, World]:
            nonlocal seen
            new = takewhile(lambda slot: self._entered[slot] > seen, reversed(self._entered))
            worlds, seen = {slot: self._worlds[slot] for slot in new}, self._entries
            return worlds

        return entered

    def assign(self, rows: Tensor, worlds: Iterable[World]) -> None:
        """Moves rows, by their indices (int64 ``[M]``, which the host reads), each to one of ``worlds``."""
        slots = [self._move(*move) for move in zip(self.slots[rows].tolist(), worlds, strict=True)]
        self.slots = self.slots.index_copy(0, rows, self.slots.new_tensor(slots))

    def hold(self, worlds: Iterable[World]) -> Tensor:
        """Puts worlds in slots for good, whether rows are in them or not, and returns their slots, int64.

        Raises:
            ValueError: if there are more worlds than slots, ``capacity``.
        """
        return self.slots.new_tensor([self._enter(world) for world in worlds])

    def enter(self, slots: Tensor) -> None:
        """Sets the slots of all rows, int64 ``[N]``, on the device alone. All must be slots of :meth:`hold`."""
        self.slots = slots

    def _move(self, slot: int, world: World) -> int:
        if world is self._worlds[slot]:
            return slot
        self._users[slot] -= 1
        if not self._users[slot]:
            self._left[slot] = None
        return self._enter(world)

    def _enter(self, world: World) -> int:
        if (slot := self._slot_of.get(world)) is None:
            slot = self._slot_of[world] = self._free_slot()
            self._worlds[slot] = world
            self._entries += 1
            self._entered.pop(slot, None)
            self._entered[slot] = self._entries
        self._left.pop(slot, None)
        self._users[slot] += 1
        return slot

    def _free_slot(self) -> int:
        if len(self._left) > self._spare:
            slot = next(iter(self._left))
            del self._left[slot], self._slot_of[self._worlds[slot]]
            return slot
        if len(self._worlds) == self.capacity:
            raise ValueError(f"a table of {self.capacity} slots cannot hold more worlds")
        self._worlds.append(None)  # type: ignore[arg-type]  # The caller sets it.
        return len(self._worlds) - 1


class SlotTable:
    """A list of values for each slot, in one tensor. Values and lists of different sizes are padded.

    Attributes:
        values: values, ``[slots, capacity, *shape]``. All of these numbers grow as needed.
        lengths: number of values of each slot, int64 ``[slots]``.
    """

    def __init__(
        self, shape: tuple[int, ...], dtype: torch.dtype, device: torch.device | str, padding: float = 0
    ) -> None:
        self._padding = padding
        self.values = torch.zeros((0, 0, *shape), dtype=dtype, device=device)
        self.lengths = torch.zeros(0, dtype=torch.int64, device=device)

    def update(self, lists: Mapping[int, Tensor]) -> None:
        """Sets the values of slots, for which it grows once."""
        if lists:
            self._reserve(max(lists) + 1, *map(max, zip(*(values.shape for values in lists.values()), strict=True)))
        for slot, values in lists.items():
            self[slot] = values

    def __setitem__(self, slot: int, values: Tensor) -> None:
        self._reserve(slot + 1, *values.shape)
        padded = self.values[slot].fill_(self._padding)
        padded[tuple(slice(size) for size in values.shape)] = values.to(self.values)
        self.lengths[slot] = len(values)

    def _reserve(self, slots: int, capacity: int, *shape: int) -> None:
        old_slots, old_capacity, *old = self.values.shape
        shape = tuple(map(max, shape, old))
        if slots <= old_slots and capacity <= old_capacity and [*shape] == old:
            return
        # Growing by a share keeps the number of copies low when slots are added one by one, and lists get longer.
        slots = old_slots if slots <= old_slots else max(slots, 2 * old_slots)
        capacity = old_capacity if capacity <= old_capacity else max(capacity, int(GROWTH * old_capacity))
        grown = self.values.new_full((slots, capacity, *shape), self._padding)
        grown[tuple(slice(size) for size in self.values.shape)] = self.values
        self.values = grown
        self.lengths = torch.cat((self.lengths, self.lengths.new_zeros(slots - old_slots)))


class TerrainTable:
    """Terrains of the worlds in slots. The height at a point is that of :meth:`Terrain.height_at`, to the last bit."""

    def __init__(self, device: torch.device | str) -> None:
        self._heights = SlotTable((), torch.float32, device)
        self._grids = SlotTable((), torch.float64, device)

    def __setitem__(self, slot: int, terrain: Terrain) -> None:
        self._heights[slot], self._grids[slot] = terrain.heights.reshape(-1), terrain.grid

    def of(self, slots: Tensor) -> TerrainRows:
        return TerrainRows(self._heights.values, slots, self._grids.values[slots])
