"""Closed environments release their memory."""

from __future__ import annotations

import pytest

from benchmarks.leaks import WORLDS, in_fresh_process
from tests.extras import needs_mujoco

WARMUP, CYCLES = 2, 4
LIMIT = 20.0
"""Allowed growth in MB. The lists leaked by PyBullet's own functions take 21 to 115 MB per environment, except in the
maze."""


@pytest.fixture(
    scope="module",
    params=["bullet", "warp", pytest.param("mujoco", marks=needs_mujoco)],
)
def growth(request: pytest.FixtureRequest) -> dict[str, float]:
    return in_fresh_process(request.param, CYCLES, WARMUP)


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS)
def test_opening_and_closing_environments_leaks_no_memory(growth: dict[str, float], world: str) -> None:
    assert growth[world] < LIMIT
