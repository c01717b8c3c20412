"""Launches of Warp kernels on all cores."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import numpy as np

from rover_rl.native.warp import wp

DEVICE = "cpu"
"""Device of the renderer, the same on every machine, so that pictures are the same too."""
MAX_THREADS = 8
"""Largest number of threads."""
BANDS_PER_THREAD = 4
"""Number of parts of a launch per thread, as some parts of a picture take longer than others."""
SMALL = 4096
"""Number of elements up to which threads take longer to start than to work."""


def launch(kernel: wp.Kernel, size: Sequence[int], inputs: Sequence[Any]) -> None:
    """Launches a kernel whose first argument is the first row of ``size``, on several threads, and waits for it."""
    threads = min(os.cpu_count() or 1, MAX_THREADS)
    count = BANDS_PER_THREAD * threads if math.prod(size) > SMALL else 1
    ends = np.linspace(0, size[0], count + 1).astype(int).tolist()
    bands = [
        wp.launch(kernel, (last - first, *size[1:]), [first, *inputs], device=DEVICE, record_cmd=True)
        for first, last in pairwise(ends)
        if last > first
    ]
    if count == 1:
        bands[0].launch()
        return
    # A new pool for each launch: threads do not survive a fork of the process.
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(wp.Launch.launch, bands))


def array(values: Any, dtype: Any, device: Any = DEVICE) -> wp.array:
    """Copies values to an array of a device, by default the renderer's."""
    return wp.array(np.asarray(values), dtype=dtype, device=device)
