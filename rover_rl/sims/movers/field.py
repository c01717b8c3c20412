"""``MoverField``: the movers of every row of a batch, from step to step, and tables of those of each world."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.rng import random_bits
from rover_rl.sims.movers.other_rovers import OtherRovers, RoverSolids
from rover_rl.sims.rover_state import RoverState
from rover_rl.worlds.clearance import clearance_on_grid
from rover_rl.worlds.movers.motion import Motion, MotionInput, MoverState, Rovers, WallDistances
from rover_rl.worlds.movers.mover import KINDS, Mover, Part
from rover_rl.worlds.movers.parts import Parts
from rover_rl.worlds.region import union
from rover_rl.worlds.table import SlotTable, TerrainTable, WorldTable
from rover_rl.worlds.world import World

STRIDE = 1.3
"""Length of a stride of a walking mover, in which each leg swings forward and back, m: two steps of 0.65 m."""
FULL_SWING = 1.2
"""Speed from which on legs swing with their whole amplitude, m/s."""
_MOVERS, _DRAWS = 32, 33
"""Streams of random numbers."""
CELL, MAX_CELLS = 0.1, 512
"""Least spacing of the grid of distances to walls, m, and largest number of its cells along a side."""
FAR = 3.0
"""Largest distance to walls of interest, m."""


class MoverField:
    """Movers of every row of a batch, and where they are.

    The movers of a row are those of its world. They depend on the random key of its episode alone, and reactive ones
    on the rover of the row, too.

    Args:
        worlds: world of each row.
        dt: duration of a step, s.
        rover_radius: radius of a rover, m.
        is_live: whether the movers are those around a live rover, of which nothing is known.
        others: the other rovers of each row's group, which are movers, too. ``None`` if each rover is on its own.

    Attributes:
        parts: solids of the movers. ``None`` as long as no row has had movers: nothing else takes time then.
        state: state of the movers, ``[N, M]``.
        radius: radius of each mover, ``[N, M]``, m.
        present: which movers exist, bool ``[N, M]``.
        keys: random keys of the next episodes in place of those of the environment, int64 ``[N, 1]``. ``None``: those
            of the environment.
    """

    def __init__(
        self,
        worlds: WorldTable,
        dt: float,
        rover_radius: float,
        is_live: bool = False,
        others: OtherRovers | None = None,
    ) -> None:
        self._worlds, self._entered, self._dt, self._rover_radius = worlds, worlds.follow(), dt, rover_radius
        self._is_live, self._others = is_live, others
        count, device = len(worlds), worlds.slots.device
        self._tables, self._terrains, self._walls = MoverTables(device), TerrainTable(device), WallTable(device)
        self._areas = SlotTable((8,), torch.float32, device)
        self._slots: Tensor | None = None
        self._steps = torch.zeros(count, 1, dtype=torch.int64, device=device)
        self._keys, self._every = torch.zeros_like(self._steps), torch.ones_like(self._steps, dtype=torch.bool)
        self.state = MoverState.at_rest(count, 0, device)
        # Way that each mover has gone, from which its legs swing, [N, M], m.
        self._walked = self.radius = torch.zeros(count, 0, device=device)
        self.present = torch.zeros(count, 0, dtype=torch.bool, device=device)
        self.parts: Parts | None = None
        self.keys: Tensor | None = None
        # Those of the movers of the worlds, without the other rovers.
        self._own: Parts | None = None
        # Heading of each part's mover after the last step, [N, P], rad.
        self._yaw = torch.zeros(count, 0, device=device)
        self.enter_worlds()

    @property
    def forms(self) -> list[Part]:
        """Parts of different kinds or sizes that have occurred, in this order."""
        return [*self._tables.forms.values()]

    def parts_of(self, world: World) -> list[Part]:
        """Returns the parts of rows in a world, by their index in ``parts``: other rovers, then its movers."""
        rovers = [] if self._others is None else [*self._others.parts] * (self._others.agents - 1)
        return rovers + [part for mover in world.movers for part in mover.shape.parts()]

    def enter_worlds(self) -> None:
        """Moves rows to their worlds in the table, after these have changed. The caller resets these rows next."""
        for slot, world in self._entered().items():
            self._tables[slot] = () if self._is_live else world.movers
            self._terrains[slot] = world.terrain
            areas = torch.tensor([world.bounds, union(world.spawn_range, world.goal_range)])
            self._areas[slot] = areas.mT.reshape(1, 8)
            if any(mover.motion.has_walls for mover in world.movers):
                self._walls[slot] = world
        if self._slots is not self._worlds.slots:
            self._slots = self._worlds.slots
            if self._tables.motions or self._others is not None:
                self._select(self._slots)

    def _select(self, slots: Tensor) -> None:
        """Copies what the tables hold of each row's world."""
        tables = self._tables
        self._motion, self.radius = tables.motion.values[slots], tables.radius.values[slots]
        self.present = self._motion >= 0
        self._settings = {motion: tables.settings_of(motion, slots) for motion in tables.motions}
        self._corners, self._wall_distances = self._areas.values[slots, 0], self._walls.of(slots)
        added = self.radius.shape[1] - self._walked.shape[1]
        self.state, self._walked = self.state.padded(added), pad(self._walked, (0, added))
        self._local = {name: table.values[slots] for name, table in tables.parts.items()}
        shape, last = self._local["kind"].shape, self._own
        if last is None or last.kind.shape != shape:
            self._own = self._reserve(*shape)
            self._yaw = pad(self._yaw, (0, shape[1] - self._yaw.shape[1]))
            if last is not None:
                # Rows that go on in their worlds have their parts where they were.
                for name in ("position", "orientation", "velocity", "turn"):
                    values = getattr(last, name)
                    getattr(self._own, name)[:, : values.shape[1]] = values
        # In place: simulators keep the tensors.
        for name in ("kind", "form", "half", "mover"):
            getattr(self._own, name).copy_(self._local[name])

    def _reserve(self, rows: int, own: int) -> Parts:
        """Makes new ``parts``, and returns those of the movers of the worlds, ``own`` in each row."""
        others, device = self._others, self._worlds.slots.device
        count = 0 if others is None else others.count
        self.parts = Parts.zeros((rows, own + count), device)
        if others is not None:
            solids, rovers = others.parts, others.agents - 1
            # First, so that parts of movers have the same indices in all worlds: see parts_of.
            self._theirs = theirs = self.parts.columns(0, count)
            theirs.kind.copy_(torch.tensor([KINDS.index(part.kind) for part in solids] * rovers))
            theirs.form.copy_(torch.tensor([self._tables.form(part) for part in solids] * rovers))
            theirs.half.copy_(torch.tensor([part.size for part in solids] * rovers) / 2)
            theirs.mover.copy_(torch.arange(rovers).repeat_interleave(len(solids)) + self.radius.shape[1])
            self._show_rovers(others.seen())
        return self.parts.columns(count, count + own)

    def follow(self, rover: RoverState, moved: Tensor | None, begins: Tensor) -> None:
        """Puts the rovers of groups where they are, for the others of their groups."""
        if self._others is not None:
            self._others.follow(rover, moved, begins)
            self._show_rovers(self._others.seen())

    def _show_rovers(self, solids: RoverSolids) -> None:
        for name, values in solids._asdict().items():
            getattr(self._theirs, name).copy_(values)

    def reset(self, mask: Tensor, keys: Tensor, rovers: Tensor) -> None:
        """Begins the episodes of the rows of ``mask`` (bool ``[N, 1]``).

        They have random ``keys`` (int64 ``[N, 1]``), and their ``rovers`` start at points ``[N, 2]``, m.
        """
        keys = keys if self.keys is None else self.keys
        self._keys, self._steps = torch.where(mask, keys, self._keys), self._steps.masked_fill(mask, 0)
        if not self._tables.motions:
            return
        count, movers = self.radius.shape
        self._mover_keys = random_bits(self._keys, _MOVERS, 0, movers)
        blank = MoverState.at_rest(count, movers, mask.device)
        self.state = blank.where(mask.expand_as(self.present), self.state)
        still = Rovers(rovers[:, None], torch.zeros_like(rovers)[:, None], self._rover_radius)
        self._change("begin", mask, self._together(still))
        self._walked = self._walked.masked_fill(mask, 0.0)
        self._place(mask, begins=True)

    def advance(self, active: Tensor | None, rovers: Rovers, driving: Tensor | None = None) -> None:
        """Moves the movers of the rows of ``active`` (bool ``[N, 1]``; ``None``: all) by one step.

        They may react to ``rovers``, as these are before the step. Of groups, those of ``driving`` drive on.
        """
        if self._others is not None:
            self._show_rovers(self._others.advance(driving))
        if not self._tables.motions:
            return
        rows = self._every if active is None else active
        self._steps = self._steps + rows
        before = self.state.position
        self._change("advance", rows, self._together(rovers))
        if self._tables.swing:
            self._walked = self._walked + _length(self.state.position - before)
        self._place(rows)

    def nearest(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the horizontal distance from points ``[N, 2]`` to the nearest mover, and its speed, m and m/s.

        Distances ``[N, 1]`` are those to its surface: 0 inside, and ``inf`` without movers.
        """
        least, speed = self._nearest_mover(points)
        if self._others is None:
            return least, speed
        to_rover, of_rover = self._others.nearest(points)
        return torch.minimum(least, to_rover), torch.where(to_rover < least, of_rover, speed)

    def _nearest_mover(self, points: Tensor) -> tuple[Tensor, Tensor]:
        if self._own is None or not self._tables.motions:
            return torch.full_like(points[:, :1], math.inf), torch.zeros_like(points[:, :1])
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.worlds.movers.part_kernels import nearest_mover

        least, mover = nearest_mover(self._own, points)
        return least, _length(self.state.velocity).gather(1, mover)

    def nearest_center(self, points: Tensor) -> Tensor:
        """Returns the horizontal distance from points ``[N, 2]`` to the origin of the nearest mover, ``[N, 1]``, m."""
        distance = (points[:, None] - self.state.position).norm(dim=-1).masked_fill(~self.present, math.inf)
        if self._others is not None:
            distance = torch.cat((distance, self._others.center_distances(points)), -1)
        return pad(distance, (0, 1), value=math.inf).amin(-1, keepdim=True)

    def _together(self, rovers: Rovers) -> Rovers:
        """All rovers of the group of each row."""
        if self._others is None:
            return rovers
        together = self._others.together
        return replace(rovers, position=together(rovers.position[:, 0]), velocity=together(rovers.velocity[:, 0]))

    def _change(self, method: str, rows: Tensor, rovers: Rovers) -> None:
        """Calls a method of every motion for its movers in ``rows``, and stores the states."""
        before = after = self.state
        for number, motion in enumerate(self._tables.motions):
            mine = (self._motion == number) & rows
            inputs = MotionInput(
                state=before,
                settings=self._settings[motion],
                mine=mine,
                present=self.present,
                radius=self.radius,
                time=self._steps.double() * self._dt,
                dt=self._dt,
                walls=self._wall_distances,
                bounds=self._corners[:, :4],
                arena=self._corners[:, 4:],
                rovers=rovers,
                keys=self._mover_keys,
                bits=self._bits,
            )
            moved = getattr(motion, method)(inputs)
            after = moved if motion.keeps_others and after is before else moved.where(mine, after)
        self.state = after

    def _bits(self, count: int) -> Tensor:
        keys, draws = self._mover_keys, self.state.draws
        return random_bits(keys.reshape(-1, 1), _DRAWS, draws.reshape(-1, 1), count).reshape(*draws.shape, count)

    def _place(self, rows: Tensor, begins: bool = False) -> None:
        """Places the parts of the movers in ``rows`` on the ground. Those of other rows do not move."""
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.worlds.movers.part_kernels import place

        assert self._own is not None
        swing = self._walked
        if self._tables.swing:
            phase = self._walked * (2 * math.pi / STRIDE)
            swing = (_length(self.state.velocity) / FULL_SWING).clamp(max=1) * torch.sin(phase)
        terrains = self._terrains.of(self._worlds.slots)
        place(self._own, self._yaw, self._local, self.state, swing, terrains, rows, begins, self._dt)


def _length(vectors: Tensor) -> Tensor:
    """Lengths of ``vectors [..., D]``, several times faster than ``norm`` for small D."""
    return torch.sqrt(sum((part.square() for part in vectors.unbind(-1)), start=torch.zeros((), device=vectors.device)))


def shown_parts(movers: MoverField | None, row: int) -> Parts | None:
    """Returns a copy of the parts that a row has, on the CPU and with one row. ``None`` if it has none."""
    return None if movers is None or movers.parts is None else movers.parts.of_row(row)


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
