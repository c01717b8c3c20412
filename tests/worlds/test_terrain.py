"""Terrain, compared with manually computed triangles and with its own mesh."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl.worlds import Terrain

ONE_CELL = Terrain([[0.0, 1.0], [2.0, 6.0]], cell=2.0, origin=(10.0, 20.0))
"""Terrain of one cell with h00 = 0, h10 = 1 (x), h01 = 2 (y), h11 = 6."""


def test_heights_and_normals_of_known_triangles():
    # Lower triangle: 0 + u * 1 + v * 2 with u = v = 1/4. Upper one: 6 - (1 - u) * (6 - 2) - (1 - v) * (6 - 1).
    inside = torch.tensor([[10.5, 20.5], [11.5, 21.5]], dtype=torch.float64)
    assert ONE_CELL.height_at(inside).tolist() == pytest.approx([0.75, 3.75])
    for point, (x, y) in zip(inside, ((0.5, 1.0), (2.0, 2.5)), strict=True):
        assert ONE_CELL.normal_at(point).numpy() == pytest.approx(np.array([-x, -y, 1.0]) / math.hypot(x, y, 1.0))
    diagonal_and_corners = torch.tensor([[11.0, 21.0], [10.0, 20.0], [12.0, 22.0]])
    assert ONE_CELL.height_at(diagonal_and_corners).tolist() == [1.5, 0.0, 6.0]
    outside = torch.tensor([[0.0, 20.0], [99.0, 20.0], [0.0, 99.0], [99.0, 99.0]])
    assert ONE_CELL.height_at(outside).tolist() == [0.0, 1.0, 2.0, 6.0]
    assert ONE_CELL.height_at(torch.tensor([math.nan, math.nan])).isnan()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), rows=st.integers(2, 6), columns=st.integers(2, 6), cell=st.floats(0.1, 3.0))
def test_heights_and_normals_agree_with_the_mesh(seed, rows, columns, cell):
    rng = np.random.default_rng(seed)
    terrain = Terrain(rng.uniform(-2, 2, (rows, columns)), cell)
    vertices, faces = terrain.mesh()
    assert faces.shape == (2 * (rows - 1) * (columns - 1), 3)
    corners = vertices[faces]
    points = (torch.from_numpy(rng.dirichlet((1, 1, 1), len(faces)))[..., None] * corners).sum(1)
    assert torch.allclose(terrain.height_at(points[:, :2]), points[:, 2], atol=1e-6)
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (normals[:, 2] > 0).all()
    expected = normals / normals.norm(dim=-1, keepdim=True)
    assert torch.allclose(terrain.normal_at(corners.mean(1)[:, :2]), expected, atol=1e-6)


@settings(max_examples=50)
@given(
    rows=st.integers(2, 30),
    columns=st.integers(2, 30),
    cell=st.floats(0.05, 3.0),
    center=st.tuples(st.floats(-60, 60), st.floats(-60, 60)),
    size=st.tuples(st.floats(0, 60), st.floats(0, 60)),
)
def test_the_part_that_covers_an_area_is_that_of_its_cells(rows, columns, cell, center, size):
    terrain = Terrain(torch.zeros(rows, columns), cell)
    area = tuple((middle - side / 2, middle + side / 2) for middle, side in zip(center, size, strict=True))
    corners = terrain.mesh(*terrain.covering(area))[0][:, :2]
    for (low, high), (least, most), axis in zip(area, terrain.extent, corners.T, strict=True):
        start, end = axis.min().item(), axis.max().item()
        assert end - start > 0.99 * cell
        if low < most and high > least:
            assert max(low, least) - 1.01 * cell < start <= max(low, least) + 1e-9
            assert min(high, most) - 1e-9 <= end < min(high, most) + 1.01 * cell


@pytest.mark.parametrize("size", [(20.0, 15.0), (0.3, 0.1), (12.5, 7.1)])
def test_flat_ground_has_the_given_size(size):
    terrain = Terrain.flat(size, height=1.5)
    (x_low, x_high), (y_low, y_high) = terrain.extent
    assert (x_low, x_high, y_low, y_high) == pytest.approx((-size[0] / 2, size[0] / 2, -size[1] / 2, size[1] / 2))
    assert terrain.is_flat
    assert terrain.height_at(torch.zeros(2)) == 1.5


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Terrain([[0.0, 1.0]], 1.0), "at least 2 x 2"),
        (lambda: Terrain([0.0, 1.0], 1.0), "at least 2 x 2"),
        (lambda: Terrain([[0.0, math.nan], [0.0, 0.0]], 1.0), "finite"),
        (lambda: Terrain(torch.zeros(2, 2), 0.0), "positive length"),
        (lambda: Terrain(torch.zeros(2, 2), math.nan), "positive length"),
        (lambda: Terrain.flat((0.0, 5.0)), r"multiples of 0\.1 m"),
        (lambda: Terrain.flat((5.0, 2.34)), r"multiples of 0\.1 m"),
    ],
)
def test_invalid_grids_and_sizes_raise(make, message):
    with pytest.raises(ValueError, match=message):
        make()
