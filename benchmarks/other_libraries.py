"""Runs a program of another library for some time, and measures its speed and whether it learns.

The program runs in this process as it is. The environment counts simulated steps and attempts: an attempt succeeds if
a goal is reached within 60 s, and fails if the episode terminates or 60 s pass. Exploration is on. After the time limit
the program is stopped. Time is that of the processor, so that other programs on the machine hardly matter: on one idle
core it passes as fast as the clock.

    python -m benchmarks.other_libraries examples/other_libraries/skrl_ppo.py
    python -m benchmarks.other_libraries "ppo_continuous_action.py --env-id rover_rl:rover_rl/Rover5Hz-v0"
"""

from __future__ import annotations

import runpy
import shlex
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
import tyro
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.rover import RoverEnv
from rover_rl.sims.settings import CONTROL_DT

ATTEMPT = round(60 / CONTROL_DT)  # number of steps in which a goal must be reached


class TimeIsUp(BaseException):
    """Stops a program, through its handlers of errors."""


@dataclass(frozen=True)
class Options:
    program: Annotated[tyro.conf.Positional[str], tyro.conf.arg(help="Program and its arguments, in quotes.")]
    seconds: float = 180.0
    """Duration of the training, seconds of the processor. It begins with the first step."""
    reports: int = 6
    """Number of reports. Each tells the success since the one before."""


@dataclass
class Meter:
    """Counts simulated steps and attempts of all environments of a program, and reports them.

    ``started`` is the processor time of the first step, s. ``attempts`` and ``successes`` are those since the last
    report.
    """

    options: Options
    started: float = 0.0
    steps: int = 0
    reported: int = 0
    attempts: int = 0
    successes: int = 0
    _ages: dict[int, Tensor] = field(default_factory=dict)

    def add(self, env: RoverEnv, before: TensorDictBase, after: TensorDictBase) -> None:
        """Counts a step of an environment. Reports if it is time, and stops the program at the end."""
        goal, terminated, truncated = (
            after.get(key).reshape(-1) for key in (("outcome", "goal_reached"), "terminated", "truncated")
        )
        active = torch.ones_like(goal) if (given := before.get("_step", None)) is None else given.reshape(-1)
        age = self._ages.get(id(env), torch.zeros_like(goal, dtype=torch.int64)) + active
        over = active & (goal | terminated | (age >= ATTEMPT))
        self._ages[id(env)] = age.masked_fill(over | (active & truncated), 0)
        self.attempts += int(over.sum())
        self.successes += int((over & goal).sum())
        self.steps += int(active.sum())
        now = time.process_time()
        self.started = self.started or now
        if now - self.started >= (self.reported + 1) * self.options.seconds / self.options.reports:
            self.report(now - self.started)
            if self.reported == self.options.reports:
                raise TimeIsUp

    def report(self, seconds: float) -> None:
        share = f"{100 * self.successes / self.attempts:.0f} %" if self.attempts else "none"
        print(
            f"{seconds:.0f} s: {self.steps / 1e6:.2f} M steps, {self.steps / seconds:,.0f} steps/s, "
            f"{share} of {self.attempts} attempts reached the goal",
            flush=True,
        )
        self.reported, self.attempts, self.successes = self.reported + 1, 0, 0


def run(options: Options) -> Meter:
    """Runs a program until its end or the time limit."""
    meter, step = Meter(options), RoverEnv._step

    def measured(env: RoverEnv, tensordict: TensorDictBase) -> TensorDictBase:
        after = step(env, tensordict)
        meter.add(env, tensordict, after)
        return after

    program, *arguments = shlex.split(options.program)
    sys.argv[:] = [program, *arguments]
    sys.path.insert(0, str(Path(program).parent))
    RoverEnv._step = measured
    try:
        runpy.run_path(program, run_name="__main__")
    except TimeIsUp:
        pass
    finally:
        RoverEnv._step = step
    return meter


if __name__ == "__main__":
    run(tyro.cli(Options, description=__doc__))
