"""What sensors can measure of the worlds around the rovers."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

from torch import Tensor

from rover_rl.sims.worlds import World
from rover_rl.sims.worlds.slot_table import TerrainTable
from rover_rl.sims.worlds.table import WorldTable

if TYPE_CHECKING:
    from rover_rl.sims.rays import RayCaster


class Surroundings:
    """Ground and obstacles of the world of each row. Nothing is built until a sensor asks for it.

    Args:
        worlds: world of each row.

    Attributes:
        is_live: whether the rover is a live one, around which nothing is known but the map of its world.
    """

    def __init__(self, worlds: WorldTable) -> None:
        self._worlds = worlds
        self.is_live = False

    def cast(self, origins: Tensor, directions: Tensor) -> Tensor:
        """Casts rays: see :meth:`rover_rl.sims.rays.RayCaster.cast`.

        Raises:
            ValueError: for a live rover.
        """
        if self.is_live:
            raise ValueError("a sensor casts rays, which needs a simulated world: a live rover has none")
        return self._caster.cast(origins, directions)

    def height_at(self, xy: Tensor) -> Tensor:
        """Returns the height of the ground (m) at points ``xy [N, ..., 2]`` (m) of each row's world: ``[N, ...]``."""
        table, entered = self._terrains
        for slot, world in entered().items():
            table[slot] = world.terrain
        return table.of(self._worlds.slots).height_at(xy.double()).to(xy.dtype)

    @cached_property
    def _caster(self) -> RayCaster:
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.sims.rays import RayCaster

        return RayCaster(self._worlds)

    @cached_property
    def _terrains(self) -> tuple[TerrainTable, Callable[[], dict[int, World]]]:
        return TerrainTable(self._worlds.slots.device), self._worlds.follow()
