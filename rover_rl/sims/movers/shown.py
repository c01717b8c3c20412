"""Movers of one row, for pictures and records."""

from __future__ import annotations

from dataclasses import fields

from rover_rl.sims.movers.field import MoverField, Parts


def parts_of(movers: MoverField | None, row: int) -> Parts | None:
    """Returns a copy of the parts that a row has, on the CPU and with one row. ``None`` if it has none."""
    if movers is None or movers.parts is None:
        return None
    parts = movers.parts
    shown = (parts.kind[row] >= 0).nonzero().squeeze(-1)
    if not len(shown):
        return None
    return Parts(**{item.name: getattr(parts, item.name)[row : row + 1, shown].cpu() for item in fields(Parts)})
