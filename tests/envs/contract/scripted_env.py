"""Environments with scripted sensors, and shorthands for stepping them and reading their results."""

from __future__ import annotations

from functools import lru_cache

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase

from rover_rl import RoverEnv, World, make_env
from rover_rl.envs.task import StepEvent
from rover_rl.worlds import Terrain
from tests.envs import transcription as contract
from tests.envs.scripted import Moment, ScriptedBackend

WORLD_NAMES = ("inspect", "moon", "maze")
OBSERVATION = ("lidar", "pose", "imu", "target", "velocities")
CPU = torch.device("cpu")
BOUNDS = ((-30.0, 30.0), (-30.0, 30.0))
AREA, GOAL_AREA = ((-1.0, 1.0), (-1.0, 1.0)), ((-2.0, 2.0), (-2.0, 2.0))
FAR_GOAL = (20.0, 0.0)
"""A goal out of reach of a scripted rover near the origin."""


@lru_cache
def flat_world() -> World:
    """Level ground without obstacles, with the bounds of the maze."""
    return World("flat", Terrain.flat((8, 8)), spawn_range=AREA, goal_range=GOAL_AREA, bounds=BOUNDS)


def scripted(*scripts: list[Moment], reward: str = "contract", **settings) -> EnvBase:
    """An environment whose sensors follow ``scripts``, one script per row."""
    settings = {"world_n": flat_world(), "lidar_beams": 32, "seed": 0, "backend": ScriptedBackend(), **settings}
    env = make_env(num_envs=len(scripts), reward=reward, **settings)
    bare(env).simulator.scripts = scripts
    return env


def bare(env: EnvBase) -> RoverEnv:
    """The ``RoverEnv`` below the reward."""
    return getattr(env, "base_env", env)


def pairs(value: tuple[float, float], count: int = 1) -> Tensor:
    """``value`` for each of ``count`` rows."""
    return torch.tensor([value] * count)


def play(env: EnvBase, steps: int, goal: tuple[float, float] = FAR_GOAL, action=(0.0, 0.0)) -> list[TensorDict]:
    """Resets, then repeats one action. Returns the ``"next"`` entry of each step; ended rows are not reset."""
    rows = bare(env).num_envs
    td = env.reset(goal=pairs(goal, rows))
    results = []
    for _ in range(steps):
        td["action"] = pairs(action, rows)
        td = env.step(td)["next"]
        results.append(td)
    return results


def rewards(results: list[TensorDict]) -> list[float]:
    """Rewards of row 0."""
    return [round(td["reward"][0].item(), 5) for td in results]


def step_events(results: list[TensorDict], row: int = 0) -> list[StepEvent]:
    """The deciding event of each step of one row."""
    return [StepEvent(td["outcome", "phase"][row].item()) for td in results]


def moving(steps: int, speed: float = 0.01, **values: float) -> list[Moment]:
    """A script of a rover that moves along x by ``speed`` meters per step, so that it is not stuck."""
    return [Moment(x=speed * k, **values) for k in range(steps + 1)]


def random_actions(k: int, rows: int) -> Tensor:
    """Actions of step ``k``: speeds from 0 to 1 m/s, heading offsets within 0.5 rad."""
    generator = torch.Generator().manual_seed(k)
    return torch.rand(rows, 2, generator=generator) - torch.tensor([0.0, 0.5])


def assert_same_angle(actual: float, expected: float, tolerance: float = 1e-5) -> None:
    assert abs(contract.normalize(actual - expected)) < tolerance
