"""Static geometry of a world as Bullet bodies."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from scipy.spatial.transform import Rotation

from rover_rl.sims.native.bullet import pybullet
from rover_rl.sims.native.shapes import make_hull, make_mesh, terrain_strips
from rover_rl.sims.worlds import Obstacle, World

GROUND_MARGIN = 3.0
"""Width of the ground mesh beyond a world's bounds, m."""

GROUND_TURN = math.pi / 8
"""Rotation of the ground's frame about the vertical, rad. See :data:`FRICTION_AXES`."""

FRICTION_AXES = ((1, 1, 1), (1, -1, 1))
"""Scales of the friction directions in the ground's frame, which alternate between physics steps.

Bullet bounds the friction force by a square along the world's axes. Grip is up to sqrt(2) higher along its diagonals,
and the yaw rate of a skid-steer rover depends on its heading. Mirroring the square in a frame rotated by 22.5 degrees
rotates it by 45 degrees. The mean of the two squares is an octagon, which is round within 8 %.
"""


def add_mesh_bodies(client: int, world: World) -> None:
    """Adds terrain and obstacles as concave triangle meshes, the targets of the lidar rays."""
    meshes = [world.terrain.mesh(*strip) for strip in terrain_strips(world.terrain)]
    if world.obstacles:
        offsets = torch.tensor([0] + [len(o.vertices) for o in world.obstacles]).cumsum(0)
        faces = torch.cat([o.faces + offset for o, offset in zip(world.obstacles, offsets[:-1], strict=True)])
        meshes.append((torch.cat([o.vertices for o in world.obstacles]), faces))
    for vertices, faces in meshes:
        shape = make_mesh(client, vertices.numpy(), faces.numpy())
        pybullet.createMultiBody(0, shape, physicsClientId=client)


def add_ground(client: int, world: World) -> list[int]:
    """Adds the ground for wheel contacts: a plane or triangle meshes, in a frame rotated by :data:`GROUND_TURN`.

    A mesh reaches :data:`GROUND_MARGIN` beyond the world's bounds, where episodes end.

    Returns:
        Ids of the ground's bodies.
    """
    terrain = world.terrain
    turn = Rotation.from_euler("z", GROUND_TURN)
    if terrain.is_flat:
        shapes = [pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)]
        height = terrain.heights[0, 0].item()
    else:
        # A heightfield would align with the axes of the rotated frame, so the ground is a mesh.
        shapes = []
        (x_low, x_high), (y_low, y_high) = world.bounds
        area = (x_low - GROUND_MARGIN, x_high + GROUND_MARGIN), (y_low - GROUND_MARGIN, y_high + GROUND_MARGIN)
        for strip in terrain_strips(terrain, area):
            vertices, faces = terrain.mesh(*strip)
            shapes.append(make_mesh(client, turn.inv().apply(vertices.numpy()), faces.numpy()))
        height = 0.0
    return [
        pybullet.createMultiBody(
            0, shape, basePosition=(0, 0, height), baseOrientation=turn.as_quat().tolist(), physicsClientId=client
        )
        for shape in shapes
    ]


def add_obstacles(client: int, obstacles: Iterable[Obstacle]) -> list[int]:
    """Adds obstacles for contacts with rovers, as convex hulls. Returns the ids of their bodies."""
    bodies = []
    for obstacle in obstacles:
        # Vertices relative to the body keep their precision far from the origin.
        center = obstacle.vertices.mean(0)
        shape = make_hull(client, (obstacle.vertices - center).numpy())
        bodies.append(pybullet.createMultiBody(0, shape, basePosition=center.tolist(), physicsClientId=client))
    return bodies
