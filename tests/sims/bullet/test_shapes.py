"""Meshes and convex hulls as shapes of Bullet, and its clients."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from rover_rl.native.bullet import disconnect, pybullet
from rover_rl.sims.bullet.geometry import make_hull, make_mesh
from rover_rl.worlds import Terrain
from tests.sims.driven import FLAT, drive, placed


@pytest.fixture
def client() -> Iterator[int]:
    client = pybullet.connect(pybullet.DIRECT)
    yield client
    disconnect([client])


def square(side: float, points: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """Returns vertices and faces of flat ground with sides of ``side`` meters and ``points`` vertices per side."""
    vertices, faces = Terrain(np.zeros((points, points)), side / (points - 1)).mesh()
    return vertices.numpy(), faces.numpy()


def size(client: int, shape: int) -> np.ndarray:
    """Returns the side lengths of the bounding box of a collision shape, m."""
    body = pybullet.createMultiBody(0, shape, physicsClientId=client)
    low, high = pybullet.getAABB(body, physicsClientId=client)
    return np.subtract(high, low)


def test_shapes_leak_no_python_objects(client):
    vertices, faces = square(4.0)
    make_hull(client, vertices)
    make_mesh(client, vertices, faces)
    gc.collect()
    before = sys.getallocatedblocks()
    for _ in range(3):
        make_hull(client, vertices)
        make_mesh(client, vertices, faces)
    gc.collect()
    # Without the reused lists, PyBullet leaks a list for each of the 1,600 vertices.
    assert sys.getallocatedblocks() - before < 200


def test_a_shape_does_not_contain_vertices_of_the_previous_larger_shape(client):
    for side, points in ((8.0, 50), (3.0, 10), (5.0, 20)):
        vertices, faces = square(side, points)
        np.testing.assert_allclose(size(client, make_mesh(client, vertices, faces))[:2], side, atol=0.01)
        corners = np.concatenate((vertices, np.add(vertices, (0, 0, 1))))
        np.testing.assert_allclose(size(client, make_hull(client, corners)), (side, side, 1), atol=0.1)


def test_concurrent_threads_create_correct_shapes():
    sides = [1.0, 2.0, 3.0, 4.0]

    def mesh_sizes(side: float) -> list[float]:
        client = pybullet.connect(pybullet.DIRECT)
        vertices, faces = square(side, points=60)
        sizes = [size(client, make_mesh(client, vertices, faces))[0] for _ in range(8)]
        disconnect([client])
        return sizes

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(len(sides)) as pool:
            for side, sizes in zip(sides, pool.map(mesh_sizes, sides), strict=True):
                np.testing.assert_allclose(sizes, side, atol=0.01)
    finally:
        sys.setswitchinterval(interval)


def connected() -> set[int]:
    """Returns the connected Bullet clients of this process."""
    gc.collect()
    return {client for client in range(1024) if pybullet.isConnected(client)}


def test_a_closed_or_deleted_simulator_leaves_only_the_clients_of_others_connected():
    other = placed("bullet", FLAT, torch.zeros(1, 3))
    before = connected()
    closed, deleted = (placed("bullet", FLAT, torch.zeros(1, 3)) for _ in range(2))
    assert len(connected()) == len(before) + 2
    closed.close()
    closed.close()
    assert len(connected()) == len(before) + 1
    del deleted
    assert connected() == before
    drive(other, (0.0, 0.0), 1)
