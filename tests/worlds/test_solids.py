"""Obstacles: convex hulls, containment, footprints, and boxes and cylinders that are made together."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from rover_rl.worlds import Solids, boulder, box, boxes, cylinder, cylinders, hull

finite = st.floats(-30, 30, allow_subnormal=False)
length = st.floats(0.01, 30)


def area(outline: torch.Tensor) -> float:
    """Signed area of a polygon, positive for counter-clockwise order."""
    after = outline.roll(-1, 0)
    return float((outline[:, 0] * after[:, 1] - outline[:, 1] * after[:, 0]).sum() / 2)


def volume(solid: Solids) -> float:
    """Volume enclosed by the faces, positive if all are counter-clockwise from outside."""
    a, b, c = solid.vertices[solid.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(5, 30))
def test_hull_of_random_points(seed, count):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * (1, 2, 3) + (5, -4, 1)
    solid = hull(torch.from_numpy(points))
    assert volume(solid) == pytest.approx(ConvexHull(points).volume)
    assert area(solid.footprint) == pytest.approx(ConvexHull(points[:, :2]).volume)
    weights = torch.from_numpy(rng.dirichlet(np.ones(len(solid.vertices)), 50))
    assert solid.contains(weights @ solid.vertices).all()
    middle = solid.vertices.mean(0)
    # Points 1 % beyond the center of each face.
    outside = middle + 1.01 * (solid.vertices[solid.faces].mean(1) - middle)
    assert not solid.contains(outside).any()


def test_a_boulder_is_within_its_radius_and_contains_its_center():
    rock, again = (boulder((3, 4, 5), 1.2, np.random.default_rng(7)) for _ in range(2))
    middle = torch.tensor([3.0, 4.0, 5.0], dtype=torch.float64)
    assert ((rock.vertices - middle).norm(dim=1) <= 1.2 + 1e-9).all()
    assert rock.contains(middle)
    assert torch.equal(rock.vertices, again.vertices)


@settings(max_examples=40, deadline=None)
@given(center=st.tuples(finite, finite, finite), size=st.tuples(length, length, length))
def test_a_box_equals_the_hull_of_its_vertices(center, size):
    (solid,) = boxes([center], [size])
    other = hull(solid.vertices)
    assert torch.equal(solid.vertices, other.vertices)
    assert torch.equal(solid.faces, other.faces)
    assert torch.allclose(solid.planes, other.planes, rtol=0, atol=1e-11)
    assert torch.equal(solid.footprint, other.footprint)


@pytest.mark.parametrize("corner", [(-2.0, -1.0), (-1.0, 0.0), (0.0, 0.0), (0.0, -2.0), (1.0, 1.0)])
def test_a_box_on_a_grid_equals_its_hull_to_the_last_bit(corner):
    """The signs of zeros count, too: maze layouts have planes through the origin."""
    (solid,) = boxes([(corner[0] + 0.5, corner[1] + 1.0, 0.5)], [(1, 2, 1)])
    other = hull(solid.vertices)
    assert solid.planes.numpy().tobytes() == other.planes.numpy().tobytes()
    assert torch.equal(solid.faces, other.faces)


@settings(max_examples=30, deadline=None)
@given(center=st.tuples(finite, finite, finite), radius=st.floats(0.05, 5), height=length, sides=st.integers(3, 20))
def test_a_cylinder_equals_the_hull_of_its_vertices(center, radius, height, sides):
    solid = cylinder(center, radius, height, sides)
    other = hull(solid.vertices)
    assert torch.equal(solid.vertices, other.vertices)
    order, others = (np.lexsort(planes.numpy().round(6).T) for planes in (solid.planes, other.planes))
    assert torch.allclose(solid.planes[order], other.planes[others], rtol=0, atol=1e-9)
    assert len(solid.faces) == len(other.faces) == 4 * sides - 4
    a, b, c = solid.vertices[solid.faces].unbind(1)
    away = (torch.linalg.cross(b - a, c - a) * (a - solid.vertices.mean(0))).sum(1)
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
    assert len(boxes([], [1, 1, 1])) == len(cylinders([], 1.0, 1.0)) == 0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: hull([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), "one plane"),
        (lambda: hull([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [2, 1, 0]]), "one plane"),
        (lambda: hull([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, math.nan]]), "finite points"),
        (lambda: hull([[0, 0], [1, 0], [0, 1], [1, 1]]), "finite points"),
        (lambda: box((0, 0, 0), (1, 0, 1)), "sides of a box"),
        (lambda: cylinder((0, 0, 0), 0, 1), "radius > 0"),
        (lambda: cylinder((0, 0, 0), 1, 1, sides=2), "sides >= 3"),
        (lambda: boulder((0, 0, 0), -1, np.random.default_rng(0)), "radius of a boulder"),
        (lambda: boxes([(0, 0, 0)], [(1, 0, 1)]), "positive side lengths"),
        (lambda: boxes([(0, math.nan, 0)], [(1, 1, 1)]), "finite centers"),
        (lambda: cylinders([(math.inf, 0, 0)], 1.0, 1.0), "a cylinder needs"),
    ],
)
def test_invalid_sizes_raise(make, message):
    with pytest.raises(ValueError, match=message):
        make()
