"""Tests here that take ``backend`` hold for every simulator."""

from __future__ import annotations

import pytest

from tests.extras import needs_warp


@pytest.fixture(params=["bullet", pytest.param("warp", marks=needs_warp)])
def backend(request: pytest.FixtureRequest) -> str:
    """The name of a simulator."""
    return request.param
