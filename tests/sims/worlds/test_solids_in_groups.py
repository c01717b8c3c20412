"""Boxes and cylinders made together, compared with the convex hulls of their vertices."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl.sims.worlds import Obstacle, boxes, cylinder, cylinders

finite = st.floats(-30, 30, allow_subnormal=False)
length = st.floats(0.01, 30)


@settings(max_examples=60, deadline=None)
@given(center=st.tuples(finite, finite, finite), size=st.tuples(length, length, length))
def test_a_box_equals_the_hull_of_its_vertices(center, size):
    (solid,) = boxes([center], [size])
    hull = Obstacle(solid.vertices)
    assert torch.equal(solid.vertices, hull.vertices)
    assert torch.equal(solid.faces, hull.faces)
    assert torch.allclose(solid.planes, hull.planes, rtol=0, atol=1e-11)
    assert torch.equal(solid.footprint, hull.footprint)


@pytest.mark.parametrize("corner", [(x, y) for x in (-2.0, -1.0, 0.0, 1.0) for y in (-2.0, -1.0, 0.0, 1.0)])
def test_a_box_on_a_grid_equals_its_hull_to_the_last_bit(corner):
    """The signs of zeros count, too: maze layouts have planes through the origin."""
    (solid,) = boxes([(corner[0] + 0.5, corner[1] + 1.0, 0.5)], [(1, 2, 1)])
    hull = Obstacle(solid.vertices)
    assert solid.planes.numpy().tobytes() == hull.planes.numpy().tobytes()
    assert torch.equal(solid.faces, hull.faces)


@settings(max_examples=30, deadline=None)
@given(center=st.tuples(finite, finite, finite), radius=st.floats(0.05, 5), height=length, sides=st.integers(3, 20))
def test_a_cylinder_equals_the_hull_of_its_vertices(center, radius, height, sides):
    solid = cylinder(center, radius, height, sides)
    hull = Obstacle(solid.vertices)
    assert torch.equal(solid.vertices, hull.vertices)
    order, other = (np.lexsort(planes.numpy().round(6).T) for planes in (solid.planes, hull.planes))
    assert torch.allclose(solid.planes[order], hull.planes[other], rtol=0, atol=1e-9)
    assert len(solid.faces) == len(hull.faces) == 4 * sides - 4
    a, b, c = solid.vertices[solid.faces].unbind(1)
    outward = torch.linalg.cross(b - a, c - a)
    away = (outward * (a - solid.vertices.mean(0))).sum(1)
    assert (away > 0).all()
    edges = torch.cat((solid.faces[:, :2], solid.faces[:, 1:], solid.faces[:, [2, 0]])).tolist()
    assert sorted(map(tuple, edges)) == sorted((b, a) for a, b in edges)


def test_members_of_a_group_are_the_solids_in_order():
    radii = [0.1, 0.2, 0.3]
    group = cylinders([(0, 0, 0.5), (2, 0, 0.5), (4, 0, 1.0)], radii, [1.0, 1.0, 2.0], sides=8)
    assert [float(solid.footprint[:, 0].mean()) for solid in group] == pytest.approx([0, 2, 4])
    assert [float(solid.vertices[:, 0].max() - 2 * k) for k, solid in enumerate(group)] == pytest.approx(radii)
    assert [float(solid.vertices[:, 2].max()) for solid in group] == [1.0, 1.0, 2.0]
    again = pickle.loads(pickle.dumps(group))
    assert all(torch.equal(a.planes, b.planes) for a, b in zip(group, again, strict=True))


def test_empty_groups():
    assert boxes([], [1, 1, 1]) == cylinders([], 1.0, 1.0) == ()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: boxes([(0, 0, 0)], [(1, 0, 1)]), "positive side lengths"),
        (lambda: boxes([(0, math.nan, 0)], [(1, 1, 1)]), "finite centers"),
        (lambda: cylinders([(0, 0, 0)], [0.0], 1.0), "radius > 0"),
        (lambda: cylinders([(math.inf, 0, 0)], 1.0, 1.0), "a cylinder needs"),
    ],
)
def test_invalid_groups_raise(make, message):
    with pytest.raises(ValueError, match=message):
        make()
