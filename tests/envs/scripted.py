"""A simulator that tells what it is given: each rover's sensors follow a script, whatever is commanded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rover_rl.sims import RoverState
from rover_rl.sims.connection import Connection
from rover_rl.sims.robots import Robot
from rover_rl.sims.worlds import World

DT = 0.05


@dataclass(frozen=True)
class Moment:
    """What the sensors of one rover tell at one moment: metres, radians, m/s, rad/s.

    ``ranges`` is one reading for all beams, or one a beam.
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


class ScriptedBackend:
    """Settings of the simulator below; it has none."""

    def make(
        self,
        *,
        worlds: Sequence[World],
        robot: Robot,
        lidar_beams: int,
        connection: Connection | None = None,
        device: torch.device | None = None,
    ) -> ScriptedSimulator:
        return ScriptedSimulator(worlds, robot, lidar_beams)


class ScriptedSimulator:
    """Plays one list of moments a row: the first after a reset, the next after each step, the last for ever.

    Set :attr:`scripts` before the environment's first reset.

    Attributes:
        scripts: moments of each row.
        commands: what was commanded in each step, ``[N, 2]`` each.
        poses: the poses of the last reset, ``[N, 3]``.
    """

    robot_connected = True

    def __init__(self, worlds: Sequence[World], robot: Robot, lidar_beams: int) -> None:
        self.num_envs = len(worlds)
        self.control_dt = DT
        self.device = torch.device("cpu")
        self.ray_angles = torch.arange(lidar_beams) * (2 * math.pi / lidar_beams)
        self.scripts: Sequence[Sequence[Moment]] = [[Moment()]] * self.num_envs
        self.commands: list[Tensor] = []
        self.poses = torch.zeros(self.num_envs, 3)
        self._at = [0] * self.num_envs
        self._stamp = torch.zeros(self.num_envs, 1, dtype=torch.float64)

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        for row in mask.nonzero().flatten().tolist():
            self._at[row] = 0
        self.poses = poses
        return self.state()

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        active = torch.ones(self.num_envs, dtype=torch.bool) if active is None else active
        self.commands.append(commands)
        self._at = [at + int(moves) for at, moves in zip(self._at, active.tolist(), strict=True)]
        self._stamp = self._stamp + DT * active[:, None]
        return self.state()

    def state(self) -> RoverState:
        now = [script[min(at, len(script) - 1)] for script, at in zip(self.scripts, self._at, strict=True)]
        beams = len(self.ray_angles)
        return RoverState.pack(
            position=torch.tensor([(m.x, m.y, m.z) for m in now], dtype=torch.float32),
            orientation=torch.tensor([_quaternion(m.roll, m.pitch, m.yaw) for m in now], dtype=torch.float32),
            linear_velocity=torch.tensor([[m.v] for m in now], dtype=torch.float32),
            angular_velocity=torch.tensor([[m.w] for m in now], dtype=torch.float32),
            ranges=torch.stack([torch.as_tensor(m.ranges, dtype=torch.float32).expand(beams) for m in now]),
            dt=torch.full((self.num_envs, 1), DT),
            stamp=self._stamp,
        )

    def render(self, row: int, view: str, width: int, height: int, goal: Tensor | None = None) -> Tensor:
        return torch.zeros(height, width, 3, dtype=torch.uint8)

    def close(self) -> None:
        pass


def _quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """(x, y, z, w) of a turn by roll, pitch and yaw about the fixed axes x, y, z, in this order."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a / 2), math.sin(a / 2)) for a in (roll, pitch, yaw))
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )
