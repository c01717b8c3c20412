"""Tests here that take ``backend`` hold for every simulator."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

needs_warp = pytest.mark.skipif(find_spec("warp") is None, reason="needs rover_rl[warp]")


@pytest.fixture(params=["bullet", pytest.param("warp", marks=needs_warp)])
def backend(request: pytest.FixtureRequest) -> str:
    """The name of a simulator."""
    return request.param
