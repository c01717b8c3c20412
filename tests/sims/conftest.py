"""Fixture for tests that run with every simulator."""

from __future__ import annotations

import pytest

from tests.extras import needs_mujoco


@pytest.fixture(params=["bullet", "warp", pytest.param("mujoco", marks=needs_mujoco)])
def backend(request: pytest.FixtureRequest) -> str:
    """Name of a simulation backend."""
    return request.param
