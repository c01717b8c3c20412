"""The emergency brake stops a rover before what its scan shows in its way, and lets it drive where nothing is."""

from __future__ import annotations

import torch

from rover_rl import RoverEnv, World, box
from rover_rl.envs.config import GuardConfig, TaskConfig
from rover_rl.worlds import Terrain

WALL = World("wall", Terrain.flat((20.0, 20.0)), [box((2.0, 0.0, 0.5), (0.2, 3.0, 1.0))])


def driven(start, action, guard, steps=60):
    """Returns the environment and whether each rover has touched the wall, ``[N]``."""
    task = TaskConfig(collision_from="contact", collision_window=10**6)
    rows = len(start)
    env = RoverEnv(world=WALL, num_envs=rows, seed=0, backend="warp", task=task, guard=guard)
    td = env.reset(start=torch.tensor(start), goal=torch.tensor([[9.0, 9.0]]).expand(rows, 2))
    touched = torch.zeros(rows, dtype=torch.bool)
    for _ in range(steps):
        td = env.step(td.set("action", torch.tensor(action)))["next"]
        touched |= td["outcome", "collision"].squeeze(-1)
    return env, touched


def test_it_stops_a_rover_before_a_wall_forward_and_backward():
    start, action = [[0.0, 0.0, 0.0], [0.0, 0.0, 3.14159]], [[1.0, 0.0], [-1.0, 0.0]]
    assert driven(start, action, GuardConfig())[1].all()
    env, touched = driven(start, action, GuardConfig(deceleration=2.0))
    assert not touched.any()
    # It comes near: the lidar is ahead of the center, and the front is at 0.26 m.
    assert (env.rover_state.position[:, 0] > 1.3).all()


def test_it_lets_a_rover_pass_beside_a_wall_and_leave_it():
    start, action = [[0.0, 1.9, 0.0], [1.5, 0.0, 0.0]], [[1.0, 0.0], [-1.0, 0.0]]
    env, touched = driven(start, action, GuardConfig(deceleration=2.0), 60)
    assert not touched.any()
    assert env.rover_state.position[0, 0] > 2.0
    assert env.rover_state.position[1, 0] < 0.0


def test_it_keeps_more_distance_from_what_may_come_towards_it():
    start, action = [[0.0, 0.0, 0.0]], [[1.0, 0.0]]
    near, far = (
        driven(start, action, GuardConfig(deceleration=2.0, approach=approach))[0].rover_state.position[0, 0]
        for approach in (0.0, 1.0)
    )
    assert far < near - 0.1
