"""Bullet clients, the static geometry of a world in them, and its friction."""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from rover_rl.native.bullet import pybullet
from rover_rl.sims.bullet.settings import BulletSettings
from rover_rl.sims.shapes import make_hull, make_mesh, terrain_strips
from rover_rl.worlds import Solids, World
from rover_rl.worlds.region import expanded

STATIC, ROVERS = 1, 2
"""Collision groups. Rovers collide with the world and not with one another."""

GROUND_MARGIN = 3.0
"""Width of the ground mesh beyond a world's bounds, m."""

GROUND_TURN = math.pi / 8
"""Rotation of the ground's frame about the vertical, rad. See :func:`friction_scales`."""

_STRETCH = 0.35
"""Largest logarithmic stretch of the friction directions. See :func:`friction_scales`.

A larger one makes friction rounder: its direction is off by 13 degrees (root mean square over the directions of slip)
with 0, and by 5 degrees with 0.35. But a rover on a slope creeps faster.
"""

_TILT = 1.0
"""Additional vertical stretch of the unmirrored friction directions. See :func:`friction_scales`."""

_CALIBRATION = 0.975
"""Factor with which climbing, braking and sliding agree with Coulomb's law (``python -m benchmarks law``)."""


def connect(settings: BulletSettings) -> int:
    """Creates an empty Bullet client with gravity and the given settings. Returns its id."""
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=settings.substep,
        numSolverIterations=settings.solver_iterations,
        solverResidualThreshold=settings.solver_residual,
        # Bullet's implicit friction cone rotates friction away from the slip, which halves the yaw rate of a
        # skid-steer rover.
        enableConeFriction=0,
        # Keeps the order of contacts the same in every run and batch.
        deterministicOverlappingPairs=1,
        physicsClientId=client,
    )
    return client


def load_world(client: int, world: World, settings: BulletSettings) -> tuple[list[int], list[int]]:
    """Adds the collision bodies of a world. Returns the ids of the ground's bodies and of the obstacles."""
    ground, obstacles = _add_ground(client, world), _add_obstacles(client, world)
    for bodies, friction in ((ground, settings.ground_friction), (obstacles, settings.obstacle_friction)):
        for body in bodies:
            set_contact(client, body, -1, friction, settings)
            pybullet.setCollisionFilterGroupMask(body, -1, STATIC, ROVERS, physicsClientId=client)
    stiffness, damping = settings.ground_stiffness, settings.ground_damping
    for body in ground:
        pybullet.changeDynamics(body, -1, contactStiffness=stiffness, contactDamping=damping, physicsClientId=client)
    return ground, obstacles


def _add_ground(client: int, world: World) -> list[int]:
    """Adds the ground for wheel contacts: a plane or triangle meshes, each in the frame of :func:`_ground_frame`.

    A mesh reaches :data:`GROUND_MARGIN` beyond the world's bounds, where episodes end. Returns the ids of the bodies.
    """
    terrain = world.terrain
    if terrain.is_flat:
        plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
        return [_add_static(client, plane, _ground_frame(np.array((0.0, 0.0, 1.0))), terrain.heights[0, 0].item())]
    bodies = []
    # A heightfield would align with the axes of the rotated frame, so the ground is a mesh.
    for strip in terrain_strips(terrain, expanded(world.bounds, GROUND_MARGIN)):
        vertices, faces = (part.numpy() for part in terrain.mesh(*strip))
        a, b, c = (vertices[faces[:, corner]] for corner in range(3))
        frame = _ground_frame(np.cross(b - a, c - a).sum(0))
        shape = make_mesh(client, frame.inv().apply(vertices), faces, smooth=True)
        bodies.append(_add_static(client, shape, frame))
    return bodies


def _ground_frame(normal: np.ndarray) -> Rotation:
    """Returns the frame of a ground body: z along the mean normal ``[3]``, rotated about it by :data:`GROUND_TURN`."""
    x, y, z = normal / np.linalg.norm(normal)
    # The shortest rotation of the vertical to the normal: about their cross product, as a quaternion.
    return Rotation.from_quat((-y, x, 0.0, 1.0 + z)) * Rotation.from_euler("z", GROUND_TURN)


def _add_static(client: int, shape: int, frame: Rotation, height: float = 0.0) -> int:
    turn = frame.as_quat().tolist()
    return pybullet.createMultiBody(0, shape, -1, (0, 0, height), turn, physicsClientId=client)


def _add_obstacles(client: int, world: World) -> list[int]:
    """Adds obstacles for contacts with rovers, as convex hulls. Returns the ids of their bodies."""
    bodies = []
    for obstacle in world.obstacles:
        # Vertices relative to the body keep their precision far from the origin.
        center = obstacle.vertices.mean(0)
        shape = make_hull(client, (obstacle.vertices - center).numpy())
        bodies.append(pybullet.createMultiBody(0, shape, basePosition=center.tolist(), physicsClientId=client))
    return bodies


def set_contact(client: int, body: int, link: int, friction: float, settings: BulletSettings) -> None:
    """Sets the friction coefficient of a link. Bullet multiplies the coefficients of two bodies in contact."""
    threshold = settings.contact_threshold
    pybullet.changeDynamics(
        body, link, lateralFriction=friction, contactProcessingThreshold=threshold, physicsClientId=client
    )


def add_mesh_bodies(client: int, world: World, reach: float) -> None:
    """Adds terrain and obstacles as concave triangle meshes, the targets of the lidar rays.

    Args:
        client: Bullet client.
        world: world whose geometry is added.
        reach: length of the rays, m. Terrain that no ray reaches from the ground of :func:`load_world` is left out.
    """
    area = expanded(world.bounds, GROUND_MARGIN + reach)
    meshes = [world.terrain.mesh(*strip) for strip in terrain_strips(world.terrain, area)]
    if world.obstacles:
        solids = Solids.of(world.obstacles)
        meshes.append((solids.vertices, solids.faces))
    for vertices, faces in meshes:
        shape = make_mesh(client, vertices.numpy(), faces.numpy())
        pybullet.createMultiBody(0, shape, physicsClientId=client)


def friction_scales(substeps: int) -> list[tuple[float, float, float]]:
    """Returns the scales ``(a, b, c)`` of the friction directions in each of the physics steps of a control step.

    Bullet bounds the two components of a friction force separately, along the world's horizontal axes: the force lies
    in a square, whose support in the direction of slip is ``mu N (|cos a| + |sin a|)``. As it stands, friction is
    4 / pi times too strong on average, depends on the heading by 41 %, and is up to 45 degrees off the direction of
    slip. The solver multiplies the two directions ``d`` by ``S = diag(a, b, c)``, in the frame of the ground, before it
    applies the bounds. The steps alternate between several ``S`` such that the mean of the parallelograms, a zonotope,
    is close to a disc of radius ``mu N``:

    - ``b < 0`` mirrors the square. In a frame that is rotated by 22.5 degrees, the mirrored square is rotated by 45.
    - ``b / a = t^2`` for several ``t`` between ``exp(-_STRETCH)`` and ``exp(_STRETCH)`` adds directions in between.
    - All scales are divided by the mean support of the parallelograms, ``2 / pi`` times the lengths of their sides.

    In the plane of the ground's frame, ``c`` has no effect. On ground that is inclined to it, ``S`` turns
    directions out of the tangent plane, so that friction also acts on the normal force. Mirrored directions stay
    close to the plane of the frame, ``c = (a + b) / 2``: an uphill force presses the wheel into the ground, which
    strengthens friction. The other directions would stay in the tangent plane with the same ``c``. Twice as large,
    it turns them to the other side, which weakens friction by about as much.
    """
    pairs = substeps // 2
    # From outside in: consecutive steps stretch in different directions.
    order = sorted(range(pairs), key=lambda k: min(k, pairs - 1 - k))
    stretches = [math.exp(_STRETCH * (2 * k / (pairs - 1) - 1)) if pairs > 1 else 1.0 for k in order]
    cos, sin = math.cos(GROUND_TURN), math.sin(GROUND_TURN)
    sides = [math.hypot(cos / t, sin * t) + math.hypot(sin / t, cos * t) for t in stretches]
    scale = _CALIBRATION / (2 / math.pi * sum(sides) / pairs)
    scales = []
    for step in range(substeps):
        t = stretches[step % pairs]
        # Every stretch occurs once with each sign, and the signs alternate.
        mirrored = (step + (step >= pairs and pairs % 2 == 0)) % 2 == 1
        a, b = scale / t, -scale * t if mirrored else scale * t
        scales.append((a, b, (a + b) / 2 * (1.0 if mirrored else 1.0 + _TILT)))
    return scales
