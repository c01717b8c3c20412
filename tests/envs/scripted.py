"""Simulator whose sensor values follow a script, regardless of the commands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from rover_rl.sims import RoverState, Simulator
from rover_rl.worlds import World

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
