"""Bullet clients, the static geometry of a world in them, and its friction."""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rover_rl.native.bullet import pybullet
from rover_rl.sims.bullet import BulletSettings
from rover_rl.worlds import Solids, Terrain, World
from rover_rl.worlds.region import Area, expanded

STATIC, ROVERS = 1, 2
"""Collision groups. Rovers collide with the world and not with one another."""
GROUND_MARGIN = 3.0
"""Width of the ground mesh beyond a world's bounds, where episodes end, m."""
MESH_CELLS = 60_000
"""Maximum number of cells in one strip of a terrain mesh. Bullet accepts at most 524,288 indices per mesh."""
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

# PyBullet's createCollisionShape never releases the lists that are passed to it, neither those of vertices and indices,
# nor the list of each vertex. The same lists, filled in place, serve all shapes: only the empty lists of the largest
# one so far remain in memory. A thread that uses them holds the lock.
_LOCK = threading.Lock()
_ROWS: list[list[float]] = []
_VERTICES: list[list[float]] = []
_INDICES: list[int] = []


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
    """Adds the ground for wheel contacts: a plane or triangle meshes, each in the frame of :func:`_ground_frame`."""
    terrain = world.terrain
    if terrain.is_flat:
        plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
        return [_add_static(client, plane, _ground_frame(np.array((0.0, 0.0, 1.0))), terrain.heights[0, 0].item())]
    bodies = []
    # A heightfield would align with the axes of the rotated frame, so the ground is a mesh.
    for strip in _strips(terrain, expanded(world.bounds, GROUND_MARGIN)):
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
    """Adds terrain and obstacles as concave triangle meshes, the targets of the lidar rays of length ``reach`` (m).

    Terrain that no ray reaches from the ground of :func:`load_world` is left out.
    """
    area = expanded(world.bounds, GROUND_MARGIN + reach)
    meshes = [world.terrain.mesh(*strip) for strip in _strips(world.terrain, area)]
    if world.obstacles:
        solids = Solids.of(world.obstacles)
        meshes.append((solids.vertices, solids.faces))
    for vertices, faces in meshes:
        shape = make_mesh(client, vertices.numpy(), faces.numpy())
        pybullet.createMultiBody(0, shape, physicsClientId=client)


def _strips(terrain: Terrain, area: Area) -> list[tuple[slice, slice]]:
    """Splits the part of a terrain that covers an area into strips, which share their borders: rows and columns."""
    rows, columns = terrain.covering(area)
    step, last = max(1, MESH_CELLS // (columns.stop - columns.start)), rows.stop - 1
    return [(slice(row, min(row + step, last) + 1), columns) for row in range(rows.start, last, step)]


def make_hull(client: int, vertices: np.ndarray) -> int:
    """Creates the convex hull of ``vertices [V, 3]`` (m) as a collision shape. Returns its id."""
    return _make(client, vertices)


def make_mesh(client: int, vertices: np.ndarray, faces: np.ndarray, *, smooth: bool = False) -> int:
    """Creates a concave mesh of ``vertices [V, 3]`` (m) and triangles ``[F, 3]`` as a collision shape. Returns its id.

    ``smooth`` corrects the normals of contacts at edges: without it, an edge within a plane of triangles stops a body
    that slides over it now and then. Rays do not need it.
    """
    flags = pybullet.GEOM_FORCE_CONCAVE_TRIMESH | (pybullet.GEOM_CONCAVE_INTERNAL_EDGE if smooth else 0)
    return _make(client, vertices, faces.ravel().tolist(), flags=flags)


def _make(client: int, vertices: np.ndarray, indices: list[int] | None = None, **options: Any) -> int:
    with _LOCK:
        try:
            _ROWS.extend([] for _ in range(len(vertices) - len(_ROWS)))
            _VERTICES[:] = _ROWS[: len(vertices)]
            # Column by column: a list of each point would wake the garbage collector again and again.
            for row, values in zip(_VERTICES, zip(*vertices.T.tolist(), strict=True), strict=True):
                row[:] = values
            if indices is not None:
                _INDICES[:], options["indices"] = indices, _INDICES
            options |= {"vertices": _VERTICES, "physicsClientId": client}
            return pybullet.createCollisionShape(pybullet.GEOM_MESH, **options)
        finally:
            for row in _VERTICES:
                row.clear()
            _VERTICES.clear()
            _INDICES.clear()


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

    In the plane of the ground's frame, ``c`` has no effect. On ground that is inclined to it, ``S`` turns directions
    out of the tangent plane, so that friction also acts on the normal force. Mirrored directions stay close to the
    plane of the frame, ``c = (a + b) / 2``: an uphill force presses the wheel into the ground, which strengthens
    friction. With twice that, the other directions turn to the other side, which weakens friction by about as much.
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
