"""Marks for tests that need an extra of the package."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

needs_mujoco = pytest.mark.skipif(find_spec("mujoco") is None, reason="needs rover_rl[mujoco]")
BACKENDS = ["bullet", "warp", pytest.param("mujoco", marks=needs_mujoco)]
"""Backends that simulate."""
needs_pettingzoo = pytest.mark.skipif(find_spec("pettingzoo") is None, reason="needs rover_rl[multiagent]")
needs_worlds = pytest.mark.skipif(
    any(find_spec(module) is None for module in ("coacd", "collada", "mapbox_earcut", "tifffile")),
    reason="needs rover_rl[worlds]",
)
