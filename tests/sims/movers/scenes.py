"""Worlds with movers, and drives in them, for the tests of movers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.worlds import Terrain, World
from rover_rl.worlds.movers import Box, Capsule, Cylinder, Mover, Person, Shape, Waypoints

SIZE = 24.0
SHAPES: tuple[Shape, ...] = (Cylinder(0.25, 1.2), Box(0.5, 0.4, 0.8), Capsule(0.2, 1.6), Person(), Cylinder(0.3, 0.3))


def flat(movers: Sequence[Mover] = (), name: str = "with movers") -> World:
    """Level ground with movers."""
    return World(name, Terrain.flat((SIZE, SIZE)), movers=movers)


def going(shape: Shape, start: tuple[float, float], end: tuple[float, float], seconds: float, turn: float = 0) -> Mover:
    """A mover that goes straight ahead once, while it turns by ``turn``."""
    yaw = math.atan2(end[1] - start[1], end[0] - start[0])
    return Mover(Waypoints([(0, *start, yaw), (seconds, *end, yaw + turn)], repeat="once"), shape)


def crowd(count: int, random_start: bool) -> World:
    """Movers of all shapes that move back and forth across the middle of the world."""
    generator = np.random.default_rng(0)
    movers = []
    for index in range(count):
        begin = generator.uniform(0, 2 * math.pi)
        end, far = begin + generator.uniform(2, 4), generator.uniform(1, 2.2)
        keys = [(time, far * math.cos(a), far * math.sin(a), a) for time, a in ((0, begin), (3 + 0.2 * index, end))]
        motion = Waypoints(keys, repeat="back_and_forth", random_start=random_start)
        movers.append(Mover(motion, SHAPES[index % len(SHAPES)]))
    return World("crowd", Terrain.flat((12.0, 12.0)), movers=movers)


@contextmanager
def opened(world: World | list[World], starts: Sequence[Sequence[float]], **settings: Any) -> Iterator[RoverEnv]:
    """An environment with rovers at ``starts`` (x, y, yaw)."""
    env = RoverEnv(**{"world_n": world, "num_envs": len(starts), "seed": 0, "length": 10_000, **settings})
    try:
        place(env, starts)
        yield env
    finally:
        env.close()


def place(env: RoverEnv, starts: Sequence[Sequence[float]]) -> None:
    """Begins an episode with rovers at ``starts``, far from their goals."""
    env.reset(start=torch.tensor(starts), goal=torch.tensor([[5.5, 5.5]] * len(starts)))


def act(env: RoverEnv, action: Tensor, rows: Tensor | None = None) -> Any:
    """Takes a step, in the rows of a mask (bool ``[N]``) if one is given. Returns what follows."""
    tensordict = env.rand_action().set("action", action)
    if rows is not None:
        tensordict["_step"] = rows[:, None]
    return env.step(tensordict)["next"]
