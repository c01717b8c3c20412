"""Marks for tests that need an extra of the package."""

from __future__ import annotations

import os
from importlib.util import find_spec

import pytest

needs_mujoco = pytest.mark.skipif(find_spec("mujoco") is None, reason="needs rover_rl[mujoco]")
BACKENDS = ["bullet", "warp", pytest.param("mujoco", marks=needs_mujoco)]
"""Backends that simulate."""
needs_pettingzoo = pytest.mark.skipif(find_spec("pettingzoo") is None, reason="needs rover_rl[multiagent]")
_WORLDS = ("coacd", "collada", "mapbox_earcut", "tifffile")
needs_worlds = pytest.mark.skipif(any(find_spec(name) is None for name in _WORLDS), reason="needs rover_rl[worlds]")
needs_minari = pytest.mark.skipif(
    not (os.environ.get("CI") == "true" or (find_spec("minari") and find_spec("h5py"))), reason="needs rover_rl[minari]"
)
