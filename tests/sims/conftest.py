"""Fixture for tests that run with every simulator."""

from __future__ import annotations

import pytest

from tests.extras import needs_warp


@pytest.fixture(params=["bullet", pytest.param("warp", marks=needs_warp)])
def backend(request: pytest.FixtureRequest) -> str:
    """Name of a simulation backend."""
    return request.param
