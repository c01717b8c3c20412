"""Environments that come and go leave no memory behind."""

from __future__ import annotations

import pytest

from benchmarks.leaks import WORLDS, in_fresh_process
from tests.extras import needs_warp

WARMUP, CYCLES = 2, 4
LIMIT = 20.0
"""MB. Lists that PyBullet leaked once made it 21 to 115 MB for each environment, except in the maze."""


@pytest.fixture(scope="module", params=["bullet", pytest.param("warp", marks=needs_warp)])
def grown(request: pytest.FixtureRequest) -> dict[str, float]:
    return in_fresh_process(request.param, CYCLES, WARMUP)


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS)
def test_opening_and_closing_environments_leaks_no_memory(grown: dict[str, float], world: str) -> None:
    assert grown[world] < LIMIT
