"""Worlds with movers in the way of a rover, and drives through them."""

from __future__ import annotations

import torch

from rover_rl import RoverEnv
from rover_rl.algos.policy.runner import Policy, PolicyRunner, sensors_for
from rover_rl.envs.config import EnvConfig, TaskConfig
from rover_rl.worlds import Terrain, World, box
from rover_rl.worlds.movers import Box, Cylinder, Mover, Waypoints

START = (-5.0, 0.0, 0.0)


def crossing(speed: float = 1.0, phase: float = 0.0, *, gate: bool = True) -> World:
    """A yard of 14 x 14 m with a gate of 3 m in the middle. Three cylinders and a box cross the way to it."""
    walls = [box((0.0, y, 0.5), (0.3, 5.5, 1.0)) for y in (4.25, -4.25)] if gate else []
    movers = []
    for k, shape in enumerate((Cylinder(0.5, 1.0), Cylinder(0.4, 1.0), Box(0.4, 0.8, 1.0), Cylinder(0.3, 1.0))):
        x, ahead = -3.0 + 2.0 * k, 1 if k % 2 else -1
        clear = x if abs(x) > 0.7 else 1.2
        keys = [(0.0, clear, -6.0 * ahead, 1.57 * ahead), (12.0 / speed, clear, 6.0 * ahead, 1.57 * ahead)]
        movers.append(Mover(Waypoints(keys, repeat="back_and_forth", delay=phase * k), shape))
    return World("crossing", Terrain.flat((14.0, 14.0)), walls, movers=movers)


def reached(
    policy: Policy, worlds: list[World] | str, rows: int, seconds: float = 30.0, robot="rover_zero", **places
) -> int:
    """Drives a policy through worlds, in rows, and returns how many reach their goals without a contact."""
    lidar, task = getattr(policy, "made_for", EnvConfig()).lidar, TaskConfig(collision_from="contact")
    worlds = worlds if isinstance(worlds, str) else tuple(worlds)
    config = EnvConfig(world=worlds, robot=robot, num_envs=rows, backend="warp", lidar=lidar, task=task, seed=0)
    env = RoverEnv(sensors_for(policy, config))
    runner, td = PolicyRunner(policy, env=env), env.reset(**places)
    ended, goals = (torch.zeros(rows, 1, dtype=torch.bool) for _ in range(2))
    with torch.no_grad():
        for _ in range(round(seconds / env.control_dt)):
            td = env.step(td.set("action", runner(td)).set("_step", ~ended))["next"]
            goals |= ~ended & td["outcome", "goal_reached"]
            ended |= goals | td["outcome", "jammed"] | td["done"]
            if ended.all():
                break
    env.close()
    return int(goals.sum())


def across(policy: Policy, worlds: list[World], goal: tuple[float, float] = (5.0, 0.0)) -> int:
    """Returns how many of such worlds a policy crosses on its way to a goal."""
    count = len(worlds)
    places = {"start": torch.tensor([START]).repeat(count, 1), "goal": torch.tensor([goal]).repeat(count, 1)}
    return reached(policy, worlds, count, **places)
