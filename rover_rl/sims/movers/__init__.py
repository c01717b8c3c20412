"""Movers of the rows of a batch: where they are, and what rays meet of them."""

from __future__ import annotations

from rover_rl.sims.movers.field import MoverField
from rover_rl.sims.movers.parts import Parts

__all__ = ["MoverField", "Parts"]
