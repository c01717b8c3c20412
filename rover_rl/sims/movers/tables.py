"""Tables of the movers of the worlds in slots, and of the walls that they keep away from."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.worlds.clearance import clearance_on_grid
from rover_rl.worlds.movers.motion import Motion, WallDistances
from rover_rl.worlds.movers.mover import KINDS, Mover, Part
from rover_rl.worlds.table import SlotTable
from rover_rl.worlds.world import World

CELL, MAX_CELLS = 0.1, 512
"""Least spacing of the grid of distances, m, and largest number of its cells along a side."""
FAR = 3.0
"""Largest distance of interest, m."""


class MoverTables:
    """Movers of the worlds in slots: their motions, their settings and their parts.

    Attributes:
        motions: classes of the motions that occur.
        motion: index of the motion of each mover in :attr:`motions`, -1 for none.
        radius: radius of each mover, m.
        forms: parts of different kinds or sizes, by these.
        parts: what :class:`~rover_rl.worlds.movers.parts.Parts` are made of, by name.
        swing: whether any part swings.
    """

    def __init__(self, device: torch.device) -> None:
        self._device, self.swing = device, False
        self.motions: list[type[Motion]] = []
        self.forms: dict[tuple[str, tuple[float, float, float]], Part] = {}
        self.motion = SlotTable((), torch.int64, device, padding=-1)
        self.radius = SlotTable((), torch.float32, device)
        self.parts = {
            name: SlotTable(shape, dtype, device, padding=-1 if name in ("kind", "form") else 0)
            for dtype, shapes in (
                (torch.int32, {"kind": (), "form": ()}),
                (torch.int64, {"mover": ()}),
                (torch.float32, {"half": (3,), "center": (3,), "orientation": (4,), "swing": ()}),
            )
            for name, shape in shapes.items()
        }
        self._settings: dict[type[Motion], dict[str, SlotTable]] = {}

    def __setitem__(self, slot: int, movers: Sequence[Mover]) -> None:
        kinds = [type(mover.motion) for mover in movers]
        self.motions += [motion for motion in dict.fromkeys(kinds) if motion not in self.motions]
        self.motion[slot] = torch.tensor([self.motions.index(motion) for motion in kinds], dtype=torch.int64)
        self.radius[slot] = torch.tensor([mover.radius for mover in movers])
        parts = [(number, part) for number, mover in enumerate(movers) for part in mover.shape.parts()]
        self.swing = self.swing or any(part.swing for _, part in parts)
        values: dict[str, list] = {
            "kind": [KINDS.index(part.kind) for _, part in parts],
            "form": [self.form(part) for _, part in parts],
            "mover": [number for number, _ in parts],
            "half": [[side / 2 for side in part.size] for _, part in parts],
            **{name: [getattr(part, name) for _, part in parts] for name in ("center", "orientation", "swing")},
        }
        for name, table in self.parts.items():
            table[slot] = torch.tensor(values[name], dtype=table.values.dtype).reshape(-1, *table.values.shape[2:])
        for motion in set(kinds):
            self._set_settings(slot, motion, movers)

    def form(self, part: Part) -> int:
        """Returns the index of a part in :attr:`forms`."""
        self.forms.setdefault((part.kind, part.size), part)
        return [*self.forms].index((part.kind, part.size))

    def _set_settings(self, slot: int, motion: type[Motion], movers: Sequence[Mover]) -> None:
        """Sets the settings of the movers with a motion. Those of other movers of the slot are padding."""
        given = {number: mover.motion.tensors() for number, mover in enumerate(movers) if type(mover.motion) is motion}
        tables = self._settings.setdefault(motion, {})
        for name, first in next(iter(given.values())).items():
            table = tables.setdefault(name, SlotTable((0,) * first.ndim, first.dtype, self._device))
            values = {number: tensors[name] for number, tensors in given.items()}
            shape = [max(sizes) for sizes in zip(*(value.shape for value in values.values()), strict=True)]
            stacked = torch.zeros((len(movers), *shape), dtype=first.dtype)
            for number, value in values.items():
                stacked[number][tuple(map(slice, value.shape))] = value
            table[slot] = stacked

    def settings_of(self, motion: type[Motion], slots: Tensor) -> dict[str, Tensor]:
        """Returns the settings of a motion for rows in ``slots [N]``, by name, ``[N, M, ...]``."""
        movers = self.motion.values.shape[1]
        found = {}
        for name, table in self._settings[motion].items():
            used, length, *shape = table.values.shape
            # Slots without this motion may be missing at the end of the table.
            values = table.values[slots.clamp(max=used - 1)]
            found[name] = pad(values, (*[0] * 2 * len(shape), 0, movers - length))
        return found


class WallTable:
    """Distances to the obstacles and the bounds of the worlds in slots."""

    def __init__(self, device: torch.device) -> None:
        self._distances = SlotTable((), torch.float32, device)
        self._grids = SlotTable((5,), torch.float32, device)

    def __setitem__(self, slot: int, world: World) -> None:
        distances, x, y, cell = _measured(world)
        self._distances[slot] = distances.reshape(-1)
        self._grids[slot] = torch.tensor([(x, y, cell, *distances.shape)])

    def of(self, slots: Tensor) -> WallDistances:
        """Returns the distances for rows in ``slots [N]``. Those of slots that were not set mean nothing."""
        used = len(self._grids.values)
        return WallDistances(self._distances.values, self._grids.values[:, :1].flatten(0, 1), slots.clamp(max=used - 1))


@lru_cache(maxsize=256)
def _measured(world: World) -> tuple[Tensor, float, float, float]:
    """Returns distances ``[rows, columns]`` on a grid over the bounds, and x and y of its first point and spacing."""
    (x_low, x_high), (y_low, y_high) = world.bounds
    cell = max(CELL, max(x_high - x_low, y_high - y_low) / MAX_CELLS)
    xs = np.arange(x_low, x_high + cell, cell)
    ys = np.arange(y_low, y_high + cell, cell)
    distances = clearance_on_grid(world.terrain, world.obstacles, xs, ys, FAR).numpy()
    edge_x, edge_y = np.minimum(xs - x_low, x_high - xs), np.minimum(ys - y_low, y_high - ys)
    edges = np.minimum(edge_x[None, :], edge_y[:, None])
    return torch.from_numpy(np.minimum(distances, edges)).float(), x_low, y_low, cell
