"""Obstacles: convex hulls, containment and footprints."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from rover_rl.sims.worlds import Obstacle, boulder, box, cylinder


def area(outline: torch.Tensor) -> float:
    """Returns the signed area of a polygon, positive for counter-clockwise order."""
    after = outline.roll(-1, 0)
    return float((outline[:, 0] * after[:, 1] - outline[:, 1] * after[:, 0]).sum() / 2)


def volume(solid: Obstacle) -> float:
    """Returns the volume enclosed by the faces, positive if all are counter-clockwise from outside."""
    a, b, c = solid.vertices[solid.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum() / 6)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), count=st.integers(5, 30))
def test_hull_of_random_points(seed, count):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3)) * (1, 2, 3) + (5, -4, 1)
    solid = Obstacle(torch.from_numpy(points))
    assert volume(solid) == pytest.approx(ConvexHull(points).volume)
    assert area(solid.footprint) == pytest.approx(ConvexHull(points[:, :2]).volume)
    weights = torch.from_numpy(rng.dirichlet(np.ones(len(solid.vertices)), 50))
    inside = weights @ solid.vertices
    assert solid.contains(inside).all()
    middle = solid.vertices.mean(0)
    # Points 1 % beyond the center of each face.
    outside = middle + 1.01 * (solid.vertices[solid.faces].mean(1) - middle)
    assert not solid.contains(outside).any()


def test_points_inside_the_hull_are_dropped():
    corners = box((0, 0, 0), (2, 2, 2)).vertices
    solid = Obstacle(torch.cat((corners, torch.tensor([[0.1, 0.2, 0.3]], dtype=torch.float64))))
    assert len(solid.vertices) == 8
    assert solid.planes.shape == (6, 4)


def test_rotations_of_a_box():
    solid = box((1, 2, 3), (4, 2, 1), yaw=math.pi / 2)
    low, high = solid.vertices.aminmax(dim=0)
    assert torch.allclose(low, torch.tensor([0.0, 0.0, 2.5], dtype=torch.float64))
    assert torch.allclose(high, torch.tensor([2.0, 4.0, 3.5], dtype=torch.float64))
    # Positive pitch lowers the front (x forward), positive roll raises the left side (y left).
    nose = box((0, 0, 0), (2, 0.1, 0.1), pitch=math.radians(30)).vertices
    assert nose[nose[:, 0].argmax(), 2] < -0.4
    wing = box((0, 0, 0), (0.1, 2, 0.1), roll=math.radians(30)).vertices
    assert wing[wing[:, 1].argmax(), 2] > 0.4


def test_cylinder():
    pillar = cylinder((1, 0, 1), radius=0.5, height=2, sides=64)
    points = torch.tensor([[1.0, 0.0, 1.0], [1.49, 0.0, 0.1], [1.51, 0.0, 1.0], [1.0, 0.0, 2.1]])
    assert pillar.contains(points).tolist() == [True, True, False, False]
    assert volume(pillar) == pytest.approx(math.pi * 0.25 * 2, rel=0.01)


@given(seed=st.integers(0, 10**6), radius=st.floats(0.1, 2.0))
@settings(max_examples=25, deadline=None)
def test_a_boulder_is_within_its_radius_and_contains_its_center(seed, radius):
    rock = boulder((3, 4, 5), radius, np.random.default_rng(seed))
    middle = torch.tensor([3.0, 4.0, 5.0], dtype=torch.float64)
    assert ((rock.vertices - middle).norm(dim=1) <= radius + 1e-9).all()
    assert rock.contains(middle)
    again = boulder((3, 4, 5), radius, np.random.default_rng(seed))
    assert torch.equal(rock.vertices, again.vertices)


@pytest.mark.parametrize(
    "points",
    [
        [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [2, 1, 0]],
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, math.nan]],
        [[0, 0], [1, 0], [0, 1], [1, 1]],
    ],
)
def test_points_without_a_volume_raise(points):
    with pytest.raises(ValueError, match=r"one plane|finite points"):
        Obstacle(torch.tensor(points, dtype=torch.float64))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: box((0, 0, 0), (1, 0, 1)), "sides of a box"),
        (lambda: cylinder((0, 0, 0), 0, 1), "radius > 0"),
        (lambda: cylinder((0, 0, 0), 1, 1, sides=2), "sides >= 3"),
        (lambda: boulder((0, 0, 0), -1, np.random.default_rng(0)), "radius of a boulder"),
    ],
)
def test_invalid_sizes_raise(make, message):
    with pytest.raises(ValueError, match=message):
        make()
