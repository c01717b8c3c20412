"""Simulator whose sensor values follow a script, regardless of the commands, and environments of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from scipy.spatial.transform import Rotation
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase

from rover_rl import RoverEnv, make_env
from rover_rl.envs.task import StepEvent
from rover_rl.sims import RoverState, Simulator
from rover_rl.worlds import Terrain, World
from tests.envs import transcription as contract

DT = 0.05
"""Control step in seconds."""


@dataclass(frozen=True)
class Moment:
    """Sensor values of one rover at one step: meters, radians, m/s, rad/s.

    ``ranges`` is one lidar reading for all beams, or a reading for each. ``contact`` tells whether the rover touches an
    obstacle, if the backend reports contacts.
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    v: float = 0.0
    w: float = 0.0
    ranges: float | Sequence[float] = 5.0
    contact: bool = False


@dataclass(frozen=True)
class ScriptedBackend:
    """Backend of :class:`ScriptedSimulator`, which reports contacts only if asked to."""

    contacts: bool = False

    def make(self, *, worlds: Sequence[World], **_: object) -> ScriptedSimulator:
        return ScriptedSimulator(worlds, self.contacts)


class ScriptedSimulator(Simulator):
    """Plays one list of moments per row: the first after a reset, the next after each step. The last one repeats.

    Set :attr:`scripts` before the environment's first reset.

    Attributes:
        scripts: list of moments of each row.
        commands: commanded linear and angular velocity of each step so far, ``[N, 2]`` each.
        poses: requested poses (x, y, yaw) of the last reset, ``[N, 3]``.
    """

    features = frozenset({"lidar"})

    def __init__(self, worlds: Sequence[World], contacts: bool = False) -> None:
        self._contacts = contacts
        if contacts:
            self.features = self.features | {"contacts"}
        self.num_envs = len(worlds)
        self.control_dt = DT
        self.device = torch.device("cpu")
        self.scripts: Sequence[Sequence[Moment]] = [[Moment()]] * self.num_envs
        self.commands: list[Tensor] = []
        self.poses = torch.zeros(self.num_envs, 3)
        self._step = [0] * self.num_envs
        self._stamp = torch.zeros(self.num_envs, 1, dtype=torch.float64)

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        for row in mask.nonzero().flatten().tolist():
            self._step[row] = 0
        self.poses = poses
        return self.state()

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        active = torch.ones(self.num_envs, dtype=torch.bool) if active is None else active
        self.commands.append(commands)
        self._step = [step + int(moves) for step, moves in zip(self._step, active.tolist(), strict=True)]
        self._stamp = self._stamp + DT * active[:, None]
        return self.state()

    def moments(self) -> list[Moment]:
        return [script[min(step, len(script) - 1)] for script, step in zip(self.scripts, self._step, strict=True)]

    def scanner(self, beams: int) -> ScriptedScanner:
        return ScriptedScanner(self, beams)

    def state(self) -> RoverState:
        moments = self.moments()
        angles = [(m.roll, m.pitch, m.yaw) for m in moments]
        contact = {"contact": torch.tensor([[m.contact] for m in moments])} if self._contacts else {}
        return RoverState.pack(
            position=torch.tensor([(m.x, m.y, m.z) for m in moments], dtype=torch.float32),
            orientation=torch.from_numpy(Rotation.from_euler("xyz", angles).as_quat()).float(),
            linear_velocity=torch.tensor([[m.v] for m in moments], dtype=torch.float32),
            angular_velocity=torch.tensor([[m.w] for m in moments], dtype=torch.float32),
            dt=torch.full((self.num_envs, 1), DT),
            stamp=self._stamp,
            **contact,
        )

    def render(self, row: int, view: str, width: int, height: int, goal: Tensor | None = None) -> Tensor:
        return torch.zeros(height, width, 3, dtype=torch.uint8)

    def close(self) -> None:
        pass


class ScriptedScanner:
    """Lidar of a scripted rover."""

    def __init__(self, simulator: ScriptedSimulator, beams: int) -> None:
        self.angles = torch.arange(beams) * (2 * math.pi / beams)
        self._simulator = simulator

    def scan(self, rows: Tensor | None = None) -> Tensor:
        ranges = [torch.as_tensor(moment.ranges, dtype=torch.float32) for moment in self._simulator.moments()]
        return torch.stack([each.expand(len(self.angles)) for each in ranges])


# Environments with scripted sensors, and shorthands for stepping them and reading their results


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
    """A script of a rover that moves along x by ``speed`` meters per step and is never stuck."""
    return [Moment(x=speed * k, **values) for k in range(steps + 1)]


def random_actions(k: int, rows: int) -> Tensor:
    """Actions of step ``k``: speeds from 0 to 1 m/s, heading offsets within 0.5 rad."""
    generator = torch.Generator().manual_seed(k)
    return torch.rand(rows, 2, generator=generator) - torch.tensor([0.0, 0.5])


def assert_same_angle(actual: float, expected: float, tolerance: float = 1e-5) -> None:
    assert abs(contract.normalize(actual - expected)) < tolerance
