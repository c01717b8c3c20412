"""Command reversals of a rover without drive lag, with and without the command limits of live rovers.

    python -m benchmarks.lag_free

In training, the drive accelerates at a limited rate and the wheels slip. Here, a rover follows its commands exactly.
Without the limits (``rover_rl.sims.ros2.settings``), the yaw rate of the heading PID then changes its sign in nearly
every step. The table shows success, SPL, reversals per second and the share of steps at the PID's maximum,
without and with the limits, over the same stored episodes. Writes the results to ``runs/lag_free/lag_free.json``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from rich.console import Console
from rich.table import Table
from torch import Tensor

from benchmarks.stored import stored_worlds
from rover_rl.algos.evaluation.body_contacts import is_touching
from rover_rl.algos.evaluation.episodes import stored_episodes
from rover_rl.algos.evaluation.evaluate import environment_for, evaluate
from rover_rl.algos.evaluation.metrics import count_reversals
from rover_rl.algos.policy.names import BASELINES, make_baseline
from rover_rl.algos.policy.runner import Policy
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.envs.config import HeadingGains
from rover_rl.files import write_json
from rover_rl.robots import Robot
from rover_rl.rotations import matrix_to_quaternion, quaternion_to_euler
from rover_rl.sims.base import Simulator
from rover_rl.sims.command_limiter import CommandLimiter, CommandLimits
from rover_rl.sims.free_space import rest_on_ground
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.rover_state import RoverState
from rover_rl.sims.settings import Connection
from rover_rl.worlds import World

DT = 0.05
"""Control step, s."""


@dataclass
class LagFree:
    """Settings of :class:`LagFreeRovers`. Also records their commands.

    Attributes:
        limited: whether the command limits of live rovers apply.
        commands: forward speeds (m/s) and yaw rates (rad/s) of each step, ``[N, 2]``; NaN in inactive rows.
    """

    limited: bool
    commands: list[Tensor] = field(default_factory=list)

    def make(
        self,
        *,
        worlds: Sequence[World],
        robot: Robot,
        connection: Connection | None = None,
        device: torch.device | None = None,
    ) -> LagFreeRovers:
        """Creates the simulator."""
        return LagFreeRovers(worlds, robot, self)

    def reversals(self) -> float:
        """Returns the number of changes of the commanded turning direction per second."""
        yaw_rates = torch.stack(self.commands)[..., 1]
        active = yaw_rates.isfinite()
        count = sum(count_reversals(yaw_rates[active[:, row], row].tolist()) for row in range(yaw_rates.shape[1]))
        return count / (DT * active.sum().item())

    def at_maximum(self) -> float:
        """Returns the share of steps at the heading PID's maximum."""
        yaw_rates = torch.stack(self.commands)[..., 1]
        return (yaw_rates[yaw_rates.isfinite()].abs() >= HeadingGains.max_output).float().mean().item()


class LagFreeRovers(Simulator):
    """Rovers that follow their commands exactly, on the ground of one world.

    Obstacles do not stop them. The body touches one where its outline is within 1 cm of it.
    """

    features = frozenset({"contacts"})

    def __init__(self, worlds: Sequence[World], robot: Robot, settings: LagFree) -> None:
        self.num_envs, self.device = len(worlds), torch.device("cpu")
        self.control_dt = DT
        self._world, self._robot, self._settings = worlds[0], robot, settings
        self._limits = torch.tensor([CommandLimits.of(robot, Ros2Settings())])
        self._limiter = CommandLimiter(Ros2Settings().min_reversal, self.num_envs) if settings.limited else None
        self._pose = torch.zeros(self.num_envs, 3, dtype=torch.float64)
        self._twist = torch.zeros(self.num_envs, 2)

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        """Places rovers at ``poses``, at rest."""
        self._pose = torch.where(mask[:, None], poses.double(), self._pose)
        self._twist = self._twist.masked_fill(mask[:, None], 0.0)
        if self._limiter is not None:
            self._limiter.reset(mask[:, None])
        return self.state()

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        """Executes the commands for one control step."""
        active = torch.ones(self.num_envs, dtype=torch.bool) if active is None else active
        if self._limiter is not None:
            dt = torch.full((self.num_envs, 1), DT)
            commands = self._limiter(self._twist, commands, dt, self._limits, active[:, None])
        self._settings.commands.append(commands.masked_fill(~active[:, None], math.nan))
        self._twist = torch.where(active[:, None], commands, self._twist)
        speed, yaw_rate = commands.double().unbind(-1)
        middle = self._pose[:, 2] + yaw_rate * DT / 2
        displacement = torch.stack((speed * middle.cos(), speed * middle.sin(), yaw_rate), -1) * DT
        self._pose = torch.where(active[:, None], self._pose + displacement, self._pose)
        return self.state()

    def state(self) -> RoverState:
        """Returns poses and velocities."""
        position, rotation = rest_on_ground(self._world, self._robot, self._pose)
        orientation = matrix_to_quaternion(rotation).float()
        return RoverState.pack(
            position=position.float(),
            orientation=orientation,
            linear_velocity=self._twist[:, :1].clone(),
            angular_velocity=self._twist[:, 1:].clone(),
            dt=torch.full((self.num_envs, 1), DT),
            stamp=torch.zeros(self.num_envs, 1, dtype=torch.float64),
            contact=is_touching(position.float(), quaternion_to_euler(orientation), self._world, self._robot)[:, None],
        )

    def close(self) -> None:
        """Does nothing: there are no resources."""


@dataclass
class Options:
    """Measure command reversals without and with the command limits."""

    policies: tuple[str, ...] = ("anywhere", "gridplanner", "moon-ppo", "moon-sac")
    """Pretrained policies and baselines. A pretrained one drives in the first world with stored episodes that it was
    trained for, a baseline in the maze."""
    count: int = 64
    """Number of stored episodes."""
    seconds: float = 60.0
    """Time limit of an episode, s."""
    out: Path = Path("runs/lag_free")
    """Output folder."""


def measure(policy: str, count: int, seconds: float) -> dict[str, dict[str, float]]:
    """Evaluates a policy on the same episodes without and with the limits."""
    actor: Policy
    if policy in BASELINES:
        actor, world = make_baseline(policy), "maze"
    else:
        checkpoint = load_pretrained(policy)
        actor, (world, *_) = checkpoint.make_actor(), stored_worlds(checkpoint.env)
    results = {}
    for name, limited in (("without limits", False), ("with limits", True)):
        settings = LagFree(limited)
        episodes = stored_episodes(world).first(count)
        evaluation = evaluate(
            actor, episodes, rows=count, seconds=seconds, env=replace(environment_for(actor, None), backend=settings)
        )
        results[name] = {
            "success": evaluation.success_rate,
            "SPL": evaluation.metrics["spl"].value,
            "reversals a second": settings.reversals(),
            "steps at the PID's maximum": settings.at_maximum(),
        }
    return results


def main(options: Options) -> dict[str, Any]:
    """Measures all policies, writes the results and prints a table."""
    table = Table("policy", "", "success", "SPL", "reversals a second", "steps at the PID's maximum")
    results = {}
    for policy in options.policies:
        results[policy] = measure(policy, options.count, options.seconds)
        for name, row in results[policy].items():
            table.add_row(policy, name, *(f"{value:.3f}" for value in row.values()))
    write_json(options.out / "lag_free.json", results)
    Console(width=120).print(table)
    return results


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
