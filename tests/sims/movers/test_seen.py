"""Lidars see movers as rays in the same geometry, in meshes of trimesh, in every simulator."""

from __future__ import annotations

import math

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from rover_rl import LidarConfig, RoverEnv
from rover_rl.worlds import Terrain, World, box
from rover_rl.worlds.movers import Box, Capsule, Cylinder, Mover, Person, Waypoints
from tests.sims.movers.scenes import act, flat, opened

BEAMS = 240
LIDAR = LidarConfig(beams=BEAMS)
# About two rovers at (-3, 0) and (3, 0): shapes that move past them and turn.
MOVERS = [
    Mover(Waypoints([(0, -5, 1.5, 0.3), (4, -1, 2.0, 2.5)]), Box(0.8, 0.5, 1.0)),
    Mover(Waypoints([(0, -4, -2.0, 0), (4, -2, -1.0, 0.4)]), Cylinder(0.3, 1.2)),
    Mover(Waypoints([(0, -1.5, -1, 1.57), (4, -1.5, 2, 1.57)]), Person()),
    Mover(Waypoints([(0, 2, 2, -1.57), (4, 1.5, -2, -1.57)]), Capsule(0.25, 0.9)),
    Mover(Waypoints([(0, 4.5, 0, 0), (4, 4.6, 1.5, 3)]), Box(0.3, 1.4, 0.5)),
    Mover(Waypoints([(0, 3, -3, 3.1), (4, 2, -1.5, 2)]), Person(1.9)),
]
STARTS = [(-3.0, 0.0, 0.4), (3.0, 0.0, -2.0)]


def mesh_of(part) -> trimesh.Trimesh:
    """Mesh of a part in its own frame."""
    length, _, height = part.size
    if part.kind == "box":
        return trimesh.creation.box(part.size)
    if part.kind == "cylinder":
        return trimesh.creation.cylinder(length / 2, height, sections=96)
    mesh = trimesh.creation.capsule(height - length, length / 2, count=(32, 64))
    return mesh.apply_translation(-mesh.bounds.mean(0))


def placed_meshes(env: RoverEnv, row: int) -> list[trimesh.Trimesh]:
    """Meshes of the parts of a row where the field has them."""
    parts = [part for mover in MOVERS for part in mover.shape.parts()]
    found = []
    for part, place, turn in zip(parts, env.movers.parts.position[row], env.movers.parts.orientation[row], strict=True):
        transform = np.eye(4)
        transform[:3, :3], transform[:3, 3] = Rotation.from_quat(turn.numpy()).as_matrix(), place.numpy()
        found.append(mesh_of(part).apply_transform(transform))
    return found


def cast(mesh: trimesh.Trimesh, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance to the nearest triangle of each ray (T. Moeller and B. Trumbore, 1997), ``inf`` for none."""
    a, b, c = mesh.triangles.transpose(1, 0, 2)
    across = np.cross(directions[:, None], c - a)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / (across * (b - a)).sum(-1)
        u = scale * (across * (origin - a)).sum(-1)
        turned = np.cross(origin - a, b - a)
        v = scale * (turned * directions[:, None]).sum(-1)
        distance = scale * (turned * (c - a)).sum(-1)
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    return np.where(hit, distance, np.inf).min(1)


def expected(env: RoverEnv, row: int, static: torch.Tensor) -> np.ndarray:
    """Scan of a rover among movers, where ``static [beams]`` is that of what does not move."""
    state = env.rover_state
    turn = Rotation.from_quat(state.orientation[row].double().numpy())
    origin = state.position[row].double().numpy() + turn.apply(env.robot.lidar_position)
    angles = np.arange(BEAMS) * 2 * math.pi / BEAMS
    directions = turn.apply(np.stack((np.cos(angles), np.sin(angles), 0 * angles), 1))
    ranges = np.min([cast(solid, origin, directions) for solid in placed_meshes(env, row)], 0)
    return np.minimum(np.where(ranges < env.robot.lidar_range, ranges, np.inf), static.numpy())


def shares_within_1_cm(scan: torch.Tensor, ranges: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return (scan.numpy() == ranges) | (np.abs(scan.numpy() - ranges) < 0.01)


def test_beams_meet_movers_beside_walls_on_uneven_ground(backend):
    x, y = torch.meshgrid(torch.arange(0, 24.1, 0.25), torch.arange(0, 24.1, 0.25), indexing="xy")
    ground = Terrain(0.25 * torch.sin(x) * torch.cos(0.8 * y), 0.25)
    walls = [box((0, 7, 1), (14, 0.2, 3)), box((-7, 0, 1), (0.2, 14, 3))]
    with_movers, without = (World(str(len(movers)), ground, walls, movers=movers) for movers in (MOVERS, []))
    settings, agree, meet = {"backend": backend, "lidar": LIDAR}, [], []
    with opened(with_movers, STARTS, **settings) as env, opened(without, STARTS, **settings) as alone:
        for step in range(17):
            for each in (env, alone):
                act(each, torch.tensor([[0.3, 0.5], [0.2, -0.5]]))
            if step % 8 == 0:
                for row in range(2):
                    ranges = expected(env, row, alone.scan[row])
                    agree.append(shares_within_1_cm(env.scan[row], ranges))
                    meet.append(ranges < alone.scan[row].numpy())
        assert torch.allclose(env.rover_state.position, alone.rover_state.position, atol=2e-3)
        # They are where their keyframes have them.
        keys = torch.tensor([mover.motion.keys for mover in MOVERS])[..., :3]
        places = keys[:, 0, 1:] + (keys[:, 1] - keys[:, 0])[:, 1:] * 17 * 0.05 / keys[:, 1, :1]
        assert torch.allclose(env.movers.state.position, places.float(), atol=1e-5)
        heights = ground.height_at(places[:2]) + torch.tensor([0.5, 0.6])
        assert torch.allclose(env.movers.parts.position[0, :2, 2], heights, atol=1e-3)
    assert np.mean(agree) >= 0.999
    assert np.mean(meet) > 0.1


def test_a_lidar_inside_a_mover_returns_0(backend):
    inside = Mover(Waypoints([(0, 0, 0, 0), (1, 4, 0, 0)], repeat="once"), Cylinder(0.6, 2.0))
    with opened(flat([inside]), [(0.0, 0.0, 0.0), (5.0, 5.0, 0.0)], backend=backend) as env:
        assert not env.scan[0].any()
        assert (env.scan[1] > 0).all()
