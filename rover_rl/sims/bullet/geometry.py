"""The static geometry of a world as Bullet bodies."""

from __future__ import annotations

import torch

from rover_rl.sims.bullet.library import pybullet
from rover_rl.sims.worlds import Terrain, World

MESH_CELLS = 60_000
"""Cells in one strip of a terrain's mesh: Bullet takes at most 524,288 indices a mesh."""


def terrain_strips(terrain: Terrain) -> list[slice]:
    """Cuts a terrain into strips of rows that share their border rows and are small enough for one mesh each."""
    rows, columns = terrain.heights.shape
    step = max(1, MESH_CELLS // columns)
    return [slice(start, min(start + step + 1, rows)) for start in range(0, rows - 1, step)]


def add_mesh_bodies(client: int, world: World) -> None:
    """Adds terrain and obstacles as concave triangle meshes: what rays are cast at."""
    meshes = [world.terrain.mesh(strip) for strip in terrain_strips(world.terrain)]
    if world.obstacles:
        offsets = torch.tensor([0] + [len(o.vertices) for o in world.obstacles]).cumsum(0)
        faces = torch.cat([o.faces + offset for o, offset in zip(world.obstacles, offsets[:-1], strict=True)])
        meshes.append((torch.cat([o.vertices for o in world.obstacles]), faces))
    for vertices, faces in meshes:
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_MESH,
            vertices=vertices.tolist(),
            indices=faces.flatten().tolist(),
            flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
            physicsClientId=client,
        )
        pybullet.createMultiBody(0, shape, physicsClientId=client)


def add_contact_bodies(client: int, world: World) -> list[int]:
    """Adds the ground as a plane or heightfield and every obstacle as a convex hull: what wheels touch."""
    bodies = [_add_ground(client, world.terrain)]
    for obstacle in world.obstacles:
        # Corners relative to the body keep Bullet's float32 vertices precise far from the origin.
        center = obstacle.vertices.mean(0)
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_MESH, vertices=(obstacle.vertices - center).tolist(), physicsClientId=client
        )
        bodies.append(pybullet.createMultiBody(0, shape, basePosition=center.tolist(), physicsClientId=client))
    return bodies


def _add_ground(client: int, terrain: Terrain) -> int:
    (x_low, x_high), (y_low, y_high) = terrain.extent
    low, high = terrain.heights.min().item(), terrain.heights.max().item()
    # Bullet centres a heightfield on its bounding box.
    center = ((x_low + x_high) / 2, (y_low + y_high) / 2, (low + high) / 2)
    if terrain.is_flat:
        shape = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    else:
        rows, columns = terrain.heights.shape
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_HEIGHTFIELD,
            meshScale=[terrain.cell, terrain.cell, 1],
            heightfieldData=terrain.heights.flatten().tolist(),
            numHeightfieldRows=columns,
            numHeightfieldColumns=rows,
            physicsClientId=client,
        )
    ground = pybullet.createMultiBody(0, shape, physicsClientId=client)
    pybullet.resetBasePositionAndOrientation(ground, center, [0, 0, 0, 1], physicsClientId=client)
    return ground
