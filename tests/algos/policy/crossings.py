"""Worlds with movers in the way of a rover, and drives through them."""

from __future__ import annotations

import torch

from rover_rl import RoverEnv
from rover_rl.algos.policy.runner import Policy, PolicyRunner, sensors_for
from rover_rl.envs.config import EnvConfig, TaskConfig
from rover_rl.worlds import Terrain, World, box
from rover_rl.worlds.movers import Box, Cylinder, Mover, Waypoints

START, GOAL = (-5.0, 0.0, 0.0), (5.0, 0.0)


def crossing(speed: float = 1.0, phase: float = 0.0, *, gate: bool = True) -> World:
    """A yard of 14 x 14 m with a gate of 3 m in the middle. Three cylinders and a box cross the way to it."""
    walls = [box((0.0, y, 0.5), (0.3, 5.5, 1.0)) for y in (4.25, -4.25)] if gate else []
    movers = []
    for k, shape in enumerate((Cylinder(0.5, 1.0), Cylinder(0.4, 1.0), Box(0.4, 0.8, 1.0), Cylinder(0.3, 1.0))):
        x, ahead = -3.0 + 2.0 * k, 1 if k % 2 else -1
        ends = [(0.0, x, -6.0 * ahead, 1.57 * ahead), (12.0 / speed, x, 6.0 * ahead, 1.57 * ahead)]
        clear = x if abs(x) > 0.7 else 1.2
        keys = [(t, clear, y, yaw) for t, _, y, yaw in ends]
        movers.append(Mover(Waypoints(keys, repeat="back_and_forth", delay=phase * k), shape))
    return World("crossing", Terrain.flat((14.0, 14.0)), walls, movers=movers)


def drive(policy: Policy, worlds: list[World], seconds: float = 30.0) -> list[str]:
    """Drives a policy through worlds, a row each, and returns how each drive ended."""
    lidar = getattr(policy, "made_for", EnvConfig()).lidar
    task = TaskConfig(collision_from="contact", collision_window=0)
    config = EnvConfig(
        world=tuple(worlds), num_envs=len(worlds), backend="warp", lidar=lidar, task=task, end_on_goal=True, seed=7
    )
    env = RoverEnv(sensors_for(policy, config))
    runner = PolicyRunner(policy, env=env)
    count = len(worlds)
    tensordict = env.reset(start=torch.tensor([START]).repeat(count, 1), goal=torch.tensor([GOAL]).repeat(count, 1))
    endings = [""] * count
    for _ in range(round(seconds / env.control_dt)):
        driving = torch.tensor([not ending for ending in endings])
        tensordict = env.step(tensordict.set("action", runner(tensordict)).set("_step", driving[:, None]))["next"]
        outcome = tensordict["outcome"]
        for row in range(count):
            for name in ("goal_reached", "jammed"):
                if driving[row] and outcome[name][row]:
                    endings[row] = name
        if all(endings):
            break
    env.close()
    return endings
