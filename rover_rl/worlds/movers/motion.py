"""``Motion``: how movers move, batched over the rows of a batch and the movers of each row."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad


@dataclass(frozen=True)
class MoverState:
    """Where movers are and where they go, ``[N, M]`` of each.

    Attributes:
        position: position, ``[N, M, 2]``, m.
        yaw: heading, ``[N, M]``, rad.
        velocity: velocity, ``[N, M, 2]``, m/s.
        goal: where the mover goes, for motions that have goals, ``[N, M, 2]``, m.
        clock: time of a motion's own, such as until it changes its mind, ``[N, M]``, s.
        draws: number of times that the motion has drawn random numbers, int64 ``[N, M]``.
        room: how far the mover is from meeting a wall, at least, for motions that keep it, ``[N, M]``, m.
    """

    position: Tensor
    yaw: Tensor
    velocity: Tensor
    goal: Tensor
    clock: Tensor
    draws: Tensor
    room: Tensor

    @classmethod
    def at_rest(cls, rows: int, movers: int, device: torch.device) -> MoverState:
        """Creates the state of movers at rest at the origin."""
        zeros, pairs = torch.zeros(rows, movers, device=device), torch.zeros(rows, movers, 2, device=device)
        return cls(position=pairs, yaw=zeros, velocity=pairs, goal=pairs, clock=zeros, draws=zeros.long(), room=zeros)

    def padded(self, movers: int) -> MoverState:
        """Adds ``movers`` to each row, which rest at the origin."""
        values = (getattr(self, item.name) for item in fields(self))
        return MoverState(*(pad(value, (0, 0, 0, movers) if value.ndim == 3 else (0, movers)) for value in values))

    def where(self, mask: Tensor, other: MoverState) -> MoverState:
        """Returns this state for the movers of ``mask`` (bool ``[N, M]``), else ``other``, whose types it takes."""
        chosen = []
        for item in fields(self):
            value, rest = getattr(self, item.name), getattr(other, item.name)
            if value is not rest:
                value = torch.where(mask[..., None] if value.ndim == 3 else mask, value.to(rest.dtype), rest)
            chosen.append(value)
        return MoverState(*chosen)


class WallDistances(NamedTuple):
    """Distances to what movers keep away from, obstacles and the bounds of the world of each row, on grids.

    Attributes:
        distances: distances on the points of each grid, row by row, at most 3 m, float32 ``[slots, capacity]``, m.
        grids: x and y of the first point and spacing (m), and numbers of rows and columns, float32 ``[slots, 5]``.
        slots: slot of each row, int64 ``[N]``.
    """

    distances: Tensor
    grids: Tensor
    slots: Tensor

    def at(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the distance from points ``[N, K, 2]`` (m) to the nearest wall, and the direction away from it.

        Returns:
            Distances ``[N, K]``, at most 3 m, negative beyond the bounds, and unit vectors ``[N, K, 2]``, 0 far from
            all walls.
        """
        x, y, cell, rows, columns = self.grids[self.slots].T[..., None]
        u, v = (points[..., 0] - x) / cell, (points[..., 1] - y) / cell
        # The lower limit of the index keeps NaN, whose conversion is undefined, on the grid.
        i = torch.minimum(u.floor().clamp(min=0), columns - 2).long().clamp(min=0)
        j = torch.minimum(v.floor().clamp(min=0), rows - 2).long().clamp(min=0)
        corner, width = j * columns.long() + i, columns.long()
        corners = (corner, corner + 1, corner + width, corner + width + 1)
        d00, d10, d01, d11 = (self.distances[self.slots[:, None], k] for k in corners)
        s, t = (u - i).clamp(0, 1), (v - j).clamp(0, 1)
        low, high = d00 + s * (d10 - d00), d01 + s * (d11 - d01)
        # Beyond the grid, the distance falls with that from its edge.
        beyond = torch.maximum((u - i - s).abs(), (v - j - t).abs()) * cell
        rise = torch.stack(((1 - t) * (d10 - d00) + t * (d11 - d01), high - low), -1)
        length = rise.norm(dim=-1, keepdim=True)
        return low + t * (high - low) - beyond, torch.where(length > 1e-6, rise / length.clamp(min=1e-6), rise * 0)


@dataclass(frozen=True)
class Rovers:
    """Rovers, which movers may react to: positions ``[N, R, 2]`` (m), velocities (m/s) and the radius of each (m)."""

    position: Tensor
    velocity: Tensor
    radius: float


@dataclass(frozen=True)
class MotionInput:
    """What a motion depends on, for ``N`` rows with ``M`` movers each.

    Attributes:
        state: state of all movers before the step, also of those with other motions.
        settings: settings of the motion by name, ``[N, M, ...]``; meaningless for movers with other motions.
        mine: movers that have this motion, bool ``[N, M]``.
        present: movers that exist: rows may have fewer than others, bool ``[N, M]``.
        radius: radius of each mover, ``[N, M]``, m.
        time: time since the episode began, at the end of the step, ``[N, 1]``, s.
        dt: duration of a step, s.
        walls: walls of each row's world.
        bounds: bounds of each row's world: lower x and y, and upper x and y, ``[N, 4]``, m.
        arena: the smallest rectangle around the areas in which episodes start and end, as ``bounds``.
        rovers: rovers of each row.
        keys: random key of each mover and episode, from which ``bits`` come, int64 ``[N, M]``.
        bits: function from a number of hashes to random bits of each mover and draw, int64 ``[N, M, count]``.
    """

    state: MoverState
    settings: dict[str, Tensor]
    mine: Tensor
    present: Tensor
    radius: Tensor
    time: Tensor
    dt: float
    walls: WallDistances
    bounds: Tensor
    arena: Tensor
    rovers: Rovers
    keys: Tensor
    bits: Callable[[int], Tensor]


@dataclass(frozen=True)
class Motion(ABC):
    """How movers move.

    A subclass is a frozen dataclass, whose fields are the settings of one mover. Movers of all rows that have motions
    of the same class are moved at once, without a loop: :meth:`begin` and :meth:`advance` get the settings of all of
    them as tensors. Random numbers must come from ``inputs.bits``, so that a mover depends on the seed of its row
    and the number of the episode alone.

    Attributes:
        has_walls: whether the motion asks for ``inputs.walls``.
        keeps_others: whether movers that are not ``inputs.mine`` are as before in the states that it returns.
    """

    has_walls: ClassVar[bool] = False
    keeps_others: ClassVar[bool] = False

    def tensors(self) -> dict[str, Tensor]:
        """Returns the settings of one mover: by default each field, which must be a number.

        Where the tensors of movers differ in length, the shorter ones are padded with zeros at their ends.
        """
        return {item.name: torch.tensor(float(getattr(self, item.name))) for item in fields(self)}

    @classmethod
    @abstractmethod
    def begin(cls, inputs: MotionInput) -> MoverState:
        """Returns the state of the movers at the start of an episode, when ``inputs.time`` is 0."""

    @classmethod
    @abstractmethod
    def advance(cls, inputs: MotionInput) -> MoverState:
        """Returns the state of the movers after a step."""

    def first_point(self) -> tuple[float, float] | None:
        """Returns the point at which every episode starts, m, or ``None`` if it is drawn."""
        return None
