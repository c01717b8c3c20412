"""Rays in triangle meshes, by the intersection of each ray with each triangle."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rover_rl.robots import get_robot
from rover_rl.sims import make_simulator
from rover_rl.worlds import World

BEAMS = 128
ROVER = get_robot("rover_zero")


def cast(origins: np.ndarray, directions: np.ndarray, triangles: np.ndarray, limit: float) -> np.ndarray:
    """Distances of rays to triangles, at most ``limit``: Möller and Trumbore, doi:10.1080/10867651.1997.10487468.

    Args:
        origins: ``[R, 3]``.
        directions: unit vectors ``[R, 3]``.
        triangles: corners ``[T, 3, 3]``.
        limit: range of the rays.
    """
    first, second = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    nearest = np.full(len(origins), limit)
    for k, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        p = np.cross(direction, second)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / (first * p).sum(1)
            away = origin - triangles[:, 0]
            u = (away * p).sum(1) * inverse
            q = np.cross(away, first)
            v = q @ direction * inverse
            t = (second * q).sum(1) * inverse
            hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        nearest[k] = min(limit, t[hit].min(initial=limit))
    return nearest


def lidar_errors(world: World, triangles: np.ndarray, poses: list[tuple[float, float, float]]) -> np.ndarray:
    """Differences between the simulated lidar and rays in a mesh: ``[poses * beams]``, m.

    Args:
        world: world of the lidar.
        triangles: corners of the mesh, ``[T, 3, 3]``. Those whose sides are longer than a meter reach everywhere.
        poses: poses of the rover, x, y (m) and yaw (rad).
    """
    long = (np.ptp(triangles[..., :2], axis=1) > 1).any(1)
    simulator = make_simulator("bullet", worlds=[world] * len(poses), robot=ROVER)
    try:
        state = simulator.reset(torch.ones(len(poses), dtype=torch.bool), torch.tensor(poses))
        scanner = simulator.scanner(BEAMS)
        angles = scanner.angles.double()
        local = torch.stack((angles.cos(), angles.sin(), torch.zeros_like(angles)), -1)
        errors = []
        for ranges, position, orientation in zip(scanner.scan(), state.position, state.orientation, strict=True):
            rotation = torch.from_numpy(Rotation.from_quat(orientation.numpy()).as_matrix())
            origin = position.double() + rotation @ torch.tensor(ROVER.lidar_position, dtype=torch.float64)
            directions = (local @ rotation.T).numpy()
            near = (np.abs(triangles[:, 0, :2] - origin[:2].numpy()) < ROVER.lidar_range + 1).all(1)
            true = cast(np.tile(origin.numpy(), (BEAMS, 1)), directions, triangles[near | long], ROVER.lidar_range)
            ours = ranges.double().numpy()
            errors.append(np.minimum(ours, ROVER.lidar_range) - true)
        return np.concatenate(errors)
    finally:
        simulator.close()
