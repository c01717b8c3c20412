"""Rovers that tests place in a simulator and drive there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from rover_rl.robots import Robot, get_robot
from rover_rl.robots.fleet import Fleet
from rover_rl.sims import RoverState, Simulator, make_simulator
from rover_rl.worlds import Terrain, World, box

ROVER = get_robot("rover_zero")
FLAT = World("flat", Terrain.flat((40, 40)))
WALLED = World("walled", Terrain.flat((20, 20)), [box((3, 0, 1), (1, 10, 2))])
"""Level ground with a wall that begins 2.5 m ahead of the origin."""


def all_rows(count: int) -> Tensor:
    return torch.ones(count, dtype=torch.bool)


def placed(backend: Any, worlds: World | Sequence[World], poses: Any, robot: Robot | Fleet = ROVER) -> Simulator:
    """Returns a simulator with a rover at each of ``poses`` (x, y, yaw), in one world or in a world for each."""
    poses = torch.as_tensor(poses, dtype=torch.float32)
    worlds = [worlds] * len(poses) if isinstance(worlds, World) else worlds
    simulator = make_simulator(backend, worlds=worlds, robot=robot)
    simulator.reset(all_rows(len(poses)), poses)
    return simulator


def drive(simulator: Simulator, commands: Any, steps: int) -> list[RoverState]:
    """Returns the states of ``steps`` steps with a constant command, of all rovers or for each."""
    commands = torch.as_tensor(commands, dtype=torch.float32)
    commands = commands.expand(simulator.num_envs, commands.shape[-1])
    return [simulator.step(commands) for _ in range(steps)]


def slope(degrees: float, size: float = 40.0, cell: float = 0.25) -> World:
    """A plane that rises along x."""
    count = int(size / cell) + 1
    x = torch.arange(count) * cell - size / 2
    return World(f"slope {degrees}", Terrain((math.tan(math.radians(degrees)) * x).expand(count, -1), cell))


def in_world(state: RoverState, points: Any) -> Tensor:
    """Returns the places ``[N, P, 3]`` in the world of ``points [P, 3]`` of the base frame, in float64."""
    turns = Rotation.from_quat(state.orientation.numpy()).as_matrix()
    turned = torch.from_numpy(np.asarray(points, dtype=float)) @ torch.from_numpy(turns).mT
    return state.position.double()[:, None] + turned
