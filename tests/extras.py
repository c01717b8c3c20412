"""Marks for tests that need an extra of the package."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

needs_mujoco = pytest.mark.skipif(find_spec("mujoco") is None, reason="needs rover_rl[mujoco]")
