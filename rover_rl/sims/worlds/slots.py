"""Slots: numbered places for the worlds that the rows of a batch are in."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence

from rover_rl.sims.worlds.world import World

SPARE_WORLDS = 64
"""Number of worlds that stay in their slots after the last row has left them."""


def max_slots(num_envs: int) -> int:
    """Returns the largest number of slots that the worlds of a batch take."""
    # Rows enter their new worlds one by one, so that one more slot than rows and spare worlds is in use at most.
    return num_envs + SPARE_WORLDS + 1


class Slots:
    """Assigns a slot to each world that a row of the batch is in.

    Those who hold data of worlds keep them by slot. A world stays in its slot after the last row has left it, until
    the slot is needed for another world: the one that was left first is replaced first.

    Args:
        worlds: world of each row.
        spare: number of worlds without rows that stay in their slots.

    Attributes:
        worlds: world in each slot.
        of_row: slot of each row, ``N`` entries.

    Example:
        >>> slots = Slots([maze, maze, moon])
        >>> slots.of_row
        [0, 0, 1]
        >>> slots.assign([2], [maze]), slots.of_row
        ([], [0, 0, 0])
        >>> slots.assign([1], [inspect]), slots.of_row
        ([1], [0, 1, 0])
    """

    def __init__(self, worlds: Sequence[World], spare: int = 0) -> None:
        self.worlds: list[World] = []
        self.of_row: list[int] = []
        self._spare = spare
        self._slot_of: dict[World, int] = {}
        self._rows: Counter[int] = Counter()
        # Slots without rows, in the order in which they were left.
        self._left: dict[int, None] = {}
        for world in worlds:
            self.of_row.append(self._enter(world, set()))

    def assign(self, rows: Iterable[int], worlds: Iterable[World]) -> list[int]:
        """Moves rows to worlds.

        Args:
            rows: indices of the rows.
            worlds: new world of each of these rows.

        Returns:
            The slots with other worlds than before, in ascending order.
        """
        filled: set[int] = set()
        for row, world in zip(rows, worlds, strict=True):
            if world is not self.worlds[self.of_row[row]]:
                self._leave(self.of_row[row])
                self.of_row[row] = self._enter(world, filled)
        return sorted(filled)

    def _enter(self, world: World, filled: set[int]) -> int:
        slot = self._slot_of.get(world)
        if slot is None:
            slot = self._free_slot()
            filled.add(slot)
            self._slot_of[world] = slot
            self.worlds[slot] = world
        self._left.pop(slot, None)
        self._rows[slot] += 1
        return slot

    def _free_slot(self) -> int:
        """Returns a new slot, or the one that was left first if more worlds than ``spare`` have no rows."""
        if len(self._left) > self._spare:
            slot = next(iter(self._left))
            del self._left[slot], self._slot_of[self.worlds[slot]]
            return slot
        self.worlds.append(None)  # type: ignore[arg-type]  # The caller sets it.
        return len(self.worlds) - 1

    def _leave(self, slot: int) -> None:
        self._rows[slot] -= 1
        if not self._rows[slot]:
            self._left[slot] = None
