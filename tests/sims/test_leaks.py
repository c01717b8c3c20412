"""Closed environments release their memory."""

from __future__ import annotations

import pytest

from benchmarks.leaks import in_fresh_process
from tests.extras import BACKENDS

WARMUP, CYCLES = 1, 2
WORLDS = ("new",)
"""World with a mesh of the ground, boulders and a box. The built-in ones have nothing that it does not have."""
LIMIT = 5.0 * CYCLES
"""Allowed growth in MB. The lists leaked by PyBullet's own functions take 21 to 115 MB per environment, except in the
maze (`python -m benchmarks.leaks` measures all worlds)."""
ALLOCATOR = {"MALLOC_MMAP_THRESHOLD_": str(2**14), "MALLOC_TRIM_THRESHOLD_": str(2**16)}
"""Settings of the C library of Linux (glibc), which returns freed memory to the system early. By default it keeps 40 MB
or none of MuJoCo's and Bullet's, depending on the order of the calls."""


@pytest.mark.slow
@pytest.mark.parametrize("backend", BACKENDS)
def test_opening_and_closing_environments_leaks_no_memory(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in ALLOCATOR.items():
        monkeypatch.setenv(name, value)
    growth = in_fresh_process(backend, CYCLES, WARMUP, WORLDS)
    assert max(growth.values()) < LIMIT, growth
