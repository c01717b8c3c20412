"""Convex solids of SDF as points: boxes, round shapes, and prisms of polylines."""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element

import numpy as np

from rover_rl.tiny_xml import numbers
from rover_rl.worlds.files.options import MAX_SIZE, optional
from rover_rl.worlds.files.triangles import merge_triangles

TOLERANCE = 0.005
"""Largest distance between a round shape and the polygon in its place, m."""
SIDES = (12, 96)
"""Least and largest number of sides of a polygon in place of a circle."""
KINDS = ("box", "cylinder", "cone", "capsule", "sphere", "ellipsoid")


def solid_points(shape: Element, what: str) -> np.ndarray:
    """Returns points whose convex hull is a shape of one of :data:`KINDS`, ``[K, 3]``, m. ``what`` is for messages."""
    if shape.tag == "box":
        corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        return corners * _lengths(shape, "size", 3, what)
    if shape.tag == "ellipsoid":
        radii = _lengths(shape, "radii", 3, what)
        return _ball(radii.max()) / radii.max() * radii
    (radius,) = _lengths(shape, "radius", 1, what)
    if shape.tag == "sphere":
        return _ball(radius)
    half = float(_lengths(shape, "length", 1, what)[0]) / 2
    if shape.tag == "capsule":
        ball = _ball(radius)
        return np.concatenate((ball[ball[:, 2] >= -1e-9] + (0, 0, half), ball[ball[:, 2] <= 1e-9] - (0, 0, half)))
    turn = 2 * math.pi * np.arange(_sides(radius)) / _sides(radius)
    circle = np.stack((radius * np.cos(turn), radius * np.sin(turn), np.full(len(turn), -half)), -1)
    return np.concatenate((circle, [[0.0, 0.0, half]] if shape.tag == "cone" else circle * (1, 1, -1)))


def prisms(shapes: list[Element], what: str) -> list[np.ndarray]:
    """Returns points of convex prisms ``[K, 3]`` in place of polylines, m. A polyline in another one is a hole."""
    rings = [_ring(shape, what) for shape in shapes]
    (height,) = _lengths(shapes[0], "height", 1, what)
    around = [{k for k, other in enumerate(rings) if other is not ring and _contains(other, ring[0])} for ring in rings]
    found = []
    for n, ring in enumerate(rings):
        if len(around[n]) % 2:
            continue
        parts = [ring, *(rings[k] for k, outer in enumerate(around) if outer == {*around[n], n})]
        points, ends = np.concatenate(parts), np.cumsum([len(part) for part in parts])
        earcut = optional("mapbox_earcut")
        triangles = np.asarray(earcut.triangulate_float64(points, ends.astype(np.uint32))).reshape(-1, 3)
        if not len(triangles):
            raise ValueError(f"{what} has no area")
        found += [
            np.concatenate([np.column_stack((points[polygon], np.full(len(polygon), z))) for z in (0.0, height)])
            for polygon in merge_triangles(points, triangles)
        ]
    return found


def _ring(shape: Element, what: str) -> np.ndarray:
    points = np.array([numbers(point, 2, None, f"a point of {what}") for point in shape.findall("point")])
    if len(points) > 1 and np.allclose(points[0], points[-1]):
        points = points[:-1]
    if len(points) < 3:
        raise ValueError(f"{what} must have at least 3 points, got {len(points)}")
    return points


def _contains(ring: np.ndarray, point: np.ndarray) -> bool:
    (x, y), following = (ring - point).T, np.roll(ring - point, -1, 0)
    up, down = following[:, 1] > 0, y > 0
    side = x * following[:, 1] - following[:, 0] * y
    return bool(((up != down) & ((side > 0) == up)).sum() % 2)


def _lengths(shape: Element, key: str, count: int, what: str) -> np.ndarray:
    values = numbers(shape.find(key), count, None, f"the {key} of {what}")
    if not ((values > 0) & (values <= 2 * MAX_SIZE)).all():
        raise ValueError(f"the {key} of {what} must be positive and at most {2 * MAX_SIZE:g} m, got {values.tolist()}")
    return values


def _sides(radius: float) -> int:
    wanted = math.pi / math.acos(max(0.0, 1 - TOLERANCE / radius)) if radius > TOLERANCE else 0
    return 4 * math.ceil(min(max(wanted, SIDES[0]), SIDES[1]) / 4)


def _ball(radius: float) -> np.ndarray:
    around = min(_sides(radius), 32)
    latitudes = np.arange(-(around // 4), around // 4 + 1) * (2 * math.pi / around)
    turn = 2 * math.pi * np.arange(around) / around
    rings = [
        np.stack((np.cos(a) * np.cos(turn), np.cos(a) * np.sin(turn), np.full(around, np.sin(a))), -1)
        for a in latitudes[1:-1]
    ]
    return radius * np.concatenate((*rings, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]))
