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
from rover_rl.sims.timing import CONTROL_DT

ATTEMPT = round(60 / CONTROL_DT)
"""Number of steps in which a goal must be reached."""


class TimeIsUp(BaseException):
    """Stops a program, through its handlers of errors."""


@dataclass(frozen=True)
class Options:
    """Program to run."""

    program: Annotated[tyro.conf.Positional[str], tyro.conf.arg(help="Program and its arguments, in quotes.")]
    seconds: float = 180.0
    """Duration of the training, seconds of the processor. It begins with the first step."""
    last: float = 0.2
    """Part of the duration, at its end, in which attempts are counted."""


@dataclass
class Meter:
    """Counts steps and attempts of an environment.

    Attributes:
        options: duration of the training.
        started: processor time of the first step, s; 0 before it.
        steps: number of simulated steps of all rovers.
        attempts, successes: number of ended attempts in the last part of the duration.
    """

    options: Options
    started: float = 0.0
    steps: int = 0
    attempts: int = 0
    successes: int = 0
    _ages: dict[int, Tensor] = field(default_factory=dict)

    def add(self, env: RoverEnv, before: TensorDictBase, after: TensorDictBase) -> None:
        """Counts a step of an environment. Other environments, such as those of evaluations, count too."""
        now = time.process_time()
        self.started = self.started or now
        if now - self.started > self.options.seconds:
            raise TimeIsUp
        goal, ended = (after.get(key).reshape(-1) for key in (("outcome", "goal_reached"), "terminated"))
        active = before.get("_step", None)
        active = torch.ones_like(goal) if active is None else active.reshape(-1)
        age = (self._ages.get(id(env), torch.zeros_like(goal, dtype=torch.int64)) + active) * 1
        over = active & (goal | ended | (age >= ATTEMPT))
        if now - self.started > (1 - self.options.last) * self.options.seconds:
            self.attempts += int(over.sum())
            self.successes += int((over & goal).sum())
        reset = over | (active & after.get("truncated").reshape(-1))
        self._ages[id(env)] = age.masked_fill(reset, 0)
        self.steps += int(active.sum())

    def summary(self) -> str:
        """Returns the results as a sentence."""
        seconds = time.process_time() - self.started
        share = f"{100 * self.successes / self.attempts:.0f} %" if self.attempts else "none"
        return (
            f"{self.steps / 1e6:.2f} M steps in {seconds:.0f} s: {self.steps / seconds:,.0f} steps/s; "
            f"{share} of the last {self.attempts} attempts reached the goal"
        )


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
    print(run(tyro.cli(Options, description=__doc__)).summary())
