"""Environments that come and go leave no memory behind."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from tests.extras import needs_warp
from tests.sims.open_close import WORLDS, growth

LIMIT = 20.0
"""MB. Lists that PyBullet leaked once made it 21 to 115 MB for each environment, except in the maze."""


@pytest.fixture(scope="module", params=["bullet", pytest.param("warp", marks=needs_warp)])
def grown(request: pytest.FixtureRequest) -> dict[str, float]:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(growth, request.param).result()


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS)
def test_opening_and_closing_environments_leaks_no_memory(grown: dict[str, float], world: str) -> None:
    assert grown[world] < LIMIT
