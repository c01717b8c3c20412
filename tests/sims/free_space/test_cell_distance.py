"""Distances between cells, compared with SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from rover_rl.sims.free_space.cell_distance import distance_to_cells


@pytest.mark.parametrize(("seed", "share"), [(0, 0.01), (1, 0.2), (2, 0.9)])
def test_distances_and_nearest_cells(seed, share):
    marked = np.random.default_rng(seed).random((40, 70)) < share
    expected, indices = distance_transform_edt(~marked, return_indices=True)
    distance, nearest = distance_to_cells(marked)
    assert np.array_equal(distance, expected)
    assert np.array_equal(nearest, np.ravel_multi_index(tuple(indices), marked.shape))


def test_distances_end_at_the_limit():
    marked = np.zeros((30, 30), dtype=bool)
    marked[3, 4] = True
    expected = distance_transform_edt(~marked)
    distance, nearest = distance_to_cells(marked, 5.0)
    assert np.array_equal(distance, expected.clip(max=5))
    assert (nearest == 3 * 30 + 4).all()
