"""Whether a robot can stand at a pose: on the terrain, and in no obstacle or mover."""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import linprog
from scipy.spatial.transform import Rotation

from rover_rl.robots import Robot
from rover_rl.sims.free_space.ground import rest_on_ground
from rover_rl.sims.movers.other_rovers import solids_of
from rover_rl.worlds import World
from rover_rl.worlds.movers.parts import Parts, corners
from rover_rl.worlds.solids import Solids


def check_standing(world: World, robot: Robot, pose: tuple[float, float, float], movers: Parts | None = None) -> None:
    """Raises ``ValueError`` if a robot at x, y (m) and yaw (rad) is off the terrain or overlaps with something.

    ``movers`` are the parts of movers of one row.
    """
    position, rotation = (each[0].numpy() for each in rest_on_ground(world, robot, torch.tensor([pose]).double()))
    body = [
        (Rotation.from_quat(part.orientation).apply(part.corners()) + part.center) @ rotation.T + position
        for part in solids_of(robot)
    ]
    where = f"x {pose[0]:g} m, y {pose[1]:g} m and yaw {pose[2]:g} rad"
    points = np.concatenate(body)
    low, high = points.min(0), points.max(0)
    extent = world.terrain.extent
    if any(low[axis] < start or high[axis] > end for axis, (start, end) in enumerate(extent)):
        (left, right), (bottom, top) = extent
        terrain = f"x {left:g} to {right:g} m and y {bottom:g} to {top:g} m"
        raise ValueError(f"at {where}, the rover is not on the terrain, which is {terrain}")
    solids = Solids.of(world.obstacles)
    lows, highs = solids.bounding_boxes
    near = np.flatnonzero(((lows <= high) & (highs >= low)).all(-1)).tolist()
    if any(_overlap(part, solids[index].vertices.numpy()) for index in near for part in body):
        raise ValueError(f"at {where}, the rover is in an obstacle")
    if movers is not None:
        shapes = (movers.kind[0], movers.half[0], movers.position[0], movers.orientation[0])
        if any(_overlap(part, solid) for part in body for solid in corners(*shapes)):
            raise ValueError(f"at {where}, the rover is in something that moves")


def _overlap(a: np.ndarray, b: np.ndarray) -> bool:
    """Returns whether the convex hulls of points ``[A, 3]`` and ``[B, 3]`` have a point in common."""
    # Weights of the points of each, at least 0 and with the sum 1, whose means are the same point.
    equations = np.zeros((5, len(a) + len(b)))
    equations[:3] = np.concatenate((a, -b)).T
    equations[3, : len(a)] = equations[4, len(a) :] = 1
    return linprog(np.zeros(len(a) + len(b)), A_eq=equations, b_eq=(0, 0, 0, 1, 1)).success
