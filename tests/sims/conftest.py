"""Fixture for tests that run with every simulator."""

from __future__ import annotations

import pytest

from tests.extras import BACKENDS


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> str:
    """Name of a simulation backend."""
    return request.param
