"""Scripted and simulated rollouts, compared with the transcription of the contract."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from rover_rl import RoverEnv, TaskConfig, World, make_env
from rover_rl.worlds import Terrain
from tests.envs import transcription as contract
from tests.envs.contract.witness import NAME_OF_PHASE, Witness, check_witnessed, witness
from tests.envs.scripted import AREA, Moment, bare, scripted


def test_scripts_of_every_kind_give_what_the_transcription_says():
    rng = np.random.default_rng(0)
    rows, steps = 24, 100

    def script() -> list[Moment]:
        x, y, near = *rng.uniform(-2, 2, 2), 0.0
        moments = []
        for _ in range(steps):
            if rng.random() < 0.9:
                x, y = np.clip(np.array((x, y)) + rng.normal(0, 0.3, 2), -32, 32)
            near = rng.uniform(0, 25) if rng.random() < 0.15 else near
            ranges = rng.uniform(0, 14, 50) + (near > 3) * 0.4
            ranges[rng.integers(50)] = rng.choice([math.inf, math.nan, -math.inf if near < 0.5 else 5.0])
            tilt = rng.normal(0, 0.3, 2) if rng.random() < 0.99 else rng.normal(0, 1.2, 2)
            v, w = rng.normal(0, 5, 2)
            moments.append(Moment(x, y, rng.normal(0, 5), *tilt, rng.uniform(-3.1, 3.1), v, w, ranges.tolist()))
        return moments

    scripts = [script() for _ in range(rows)]
    # Some rovers stand still long enough to be stuck.
    for k in range(0, rows, 3):
        scripts[k] = [scripts[k][0], *[scripts[k][1]] * 40, *scripts[k][2:]]
    world = World("small", Terrain.flat((8, 8)), spawn_range=AREA, bounds=((-4, 5), (-6, 4)))
    env = scripted(*scripts, world_n=world, lidar_beams=50, length=60, task=TaskConfig(stuck_window=20))

    def policy(td: TensorDict, _: RoverEnv, k: int) -> Tensor:
        return torch.from_numpy(rng.uniform(-1.5, 1.5, (rows, 2))).float() * torch.tensor([1.0, 2.0])

    seen = witness(env, world.bounds, steps, policy, length=60, stuck_window=20)
    check_witnessed(seen)
    assert {v.expected.decided_by for v in seen.verdicts} == set(NAME_OF_PHASE.values())
    assert any(v.truncated for v in seen.verdicts)


ROLLOUT_ROWS, ROLLOUT_STEPS, ROLLOUT_LENGTH = 8, 160, 110
EDGES = {"moon": (9.5, 3.0, 0.0), "maze": (0.0, 0.0, 0.0)}
"""Poses near the bounds, facing outward. Walls keep rovers from the bounds of the maze: its pose is the origin."""


def mixed_policies(td: TensorDict, env: RoverEnv, k: int) -> Tensor:
    """One policy per row: two drive to the goal, two to an obstacle, two at random, one straight on, one in curves."""
    angle = td["target"][:, 1]
    ranges, angles = env.scan, env.scanner.angles
    nearest = angles[ranges.nan_to_num(posinf=99.0).argmin(-1)]
    nearest = torch.atan2(nearest.sin(), nearest.cos())
    generator = torch.Generator().manual_seed(k)
    action = (torch.rand(ROLLOUT_ROWS, 2, generator=generator) * 2 - 1) * torch.tensor([1.0, math.pi])
    action[:2, 0], action[:2, 1] = angle[:2].cos().clamp(min=0.2), angle[:2].clamp(-0.8, 0.8)
    action[2:4, 0], action[2:4, 1] = 0.8, nearest[2:4].clamp(-0.8, 0.8)
    action[6] = torch.tensor([1.0, 0.0])
    action[7] = torch.tensor([math.cos(k / 25), 1.5 * math.sin(k / 40)])
    return action


def recorded(name: str) -> Witness:
    """A record of 1,280 steps in one world: 8 rovers, 160 steps each, with automatic resets."""
    env = make_env(world_n=name, num_envs=ROLLOUT_ROWS, seed=11, length=ROLLOUT_LENGTH, lidar_beams=50)
    env.reset()
    state = bare(env).rover_state
    yaw = torch.tensor([contract.euler(q)[2] for q in state.orientation.tolist()])
    start = torch.cat((state.position[:, :2], yaw[:, None]), -1)
    goal = bare(env).goal
    # The first two rovers have goals 0.9 m straight ahead.
    ahead = torch.stack((yaw.cos(), yaw.sin()), -1)
    goal[:2] = start[:2, :2] + 0.9 * ahead[:2]
    start[6] = torch.tensor(EDGES[name])
    table = contract.WORLDS[name]
    bounds = (table.too_far_away_x, table.too_far_away_y)
    seen = witness(env, bounds, ROLLOUT_STEPS, mixed_policies, start, goal, length=ROLLOUT_LENGTH)
    env.close()
    return seen


@pytest.mark.parametrize("name", ["moon", "maze"])
def test_recorded_rollouts_give_what_the_transcription_says(name):
    rollout = recorded(name)
    assert len(rollout.verdicts) == ROLLOUT_ROWS * ROLLOUT_STEPS
    check_witnessed(rollout)
    # They hold goals, collisions, endings and time limits.
    decided = [v.expected.decided_by for v in rollout.verdicts]
    assert decided.count("goal") >= 2
    assert decided.count("collision") >= 15
    assert {"jam", "out_of_bounds"} & set(decided)
    assert any(v.truncated for v in rollout.verdicts)
    assert decided.count("dense") > 640
    # A goal stays until it is reached; the next one is 1 m away or more.
    x_range, y_range = bare(rollout.env).worlds[0].goal_range
    for v in rollout.verdicts:
        if v.expected.decided_by != "goal":
            assert v.goal == v.goal_before
        else:
            assert math.dist(v.goal, (v.reading.x, v.reading.y)) >= 1 - 1e-5
            assert x_range[0] <= v.goal[0] <= x_range[1]
            assert y_range[0] <= v.goal[1] <= y_range[1]
