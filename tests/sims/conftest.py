"""Fixture for tests that run with every simulator."""

from __future__ import annotations

import pytest

from tests.extras import needs_mujoco, needs_warp


@pytest.fixture(params=["bullet", pytest.param("warp", marks=needs_warp), pytest.param("mujoco", marks=needs_mujoco)])
def backend(request: pytest.FixtureRequest) -> str:
    """Name of a simulation backend."""
    return request.param
