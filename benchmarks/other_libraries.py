"""Runs a program of another library for some time, and measures its speed and whether it learns.

The program runs in this process as it is. The environment counts simulated steps and attempts: an attempt succeeds if
a goal is reached within 60 s, and fails if the episode terminates or 60 s pass. Exploration is on. After the time limit
(of the processor, not of the clock) the program is stopped, so that other programs on the machine hardly matter.

    python -m benchmarks.other_libraries examples/other_libraries/skrl_ppo.py
    python -m benchmarks.other_libraries "ppo_continuous_action.py --env-id rover_rl:rover_rl/Rover5Hz-v0"
"""

from __future__ import annotations

import math
import runpy
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from rover_rl.envs.encoding import ObservationEncoder
from rover_rl.envs.rover import RoverEnv
from rover_rl.sims.settings import CONTROL_DT
from rover_rl.tasks import Task

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

    ``points`` has the steps, the minutes and the success of the attempts at each report. With ``total`` steps, reports
    are equal numbers of steps apart, else equal times.
    """

    options: Options
    total: int | None = None
    points: dict[str, list[float]] = field(default_factory=lambda: {"steps": [], "minutes": [], "success": []})
    steps: int = 0
    attempts: int = 0
    successes: int = 0
    _started: float = 0.0
    _ages: dict[int, Tensor] = field(default_factory=dict)

    def add(self, env: RoverEnv, before: TensorDictBase, after: TensorDictBase) -> None:
        """Counts a step of an environment. Reports if it is time, and stops the program at the end of the time."""
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
        self._started = self._started or now
        seconds, reported = now - self._started, len(self.points["steps"])
        done = self.steps / self.total if self.total else seconds / self.options.seconds
        if done >= (reported + 1) / self.options.reports:
            self._report(seconds)
            if self.total is None and reported + 1 == self.options.reports:
                raise TimeIsUp

    def _report(self, seconds: float) -> None:
        share = self.successes / self.attempts if self.attempts else math.nan
        rate = f"{self.steps / 1e6:.2f} M steps, {self.steps / seconds:,.0f} steps/s"
        print(f"{seconds:.0f} s: {rate}, {share:.0%} of {self.attempts} attempts reached the goal", flush=True)
        for key, value in zip(self.points, (self.steps, seconds / 60, share), strict=True):
            self.points[key].append(value)
        self.attempts = self.successes = 0


def run_program(path: Path, arguments: Sequence[str], meter: Meter) -> dict[str, Any]:
    """Runs a program until its end, or until its time is up, and returns its global names."""
    step, given = RoverEnv._step, [*sys.argv]

    def counted(env: RoverEnv, tensordict: TensorDictBase) -> TensorDictBase:
        after = step(env, tensordict)
        meter.add(env, tensordict, after)
        return after

    sys.argv[:] = [str(path), *arguments]
    sys.path.insert(0, str(path.parent))
    RoverEnv._step = counted
    try:
        return runpy.run_path(str(path), run_name="__main__")
    except TimeIsUp:
        return {}
    finally:
        RoverEnv._step = step
        sys.argv[:] = given
        sys.path.remove(str(path.parent))


class OtherActor:
    """Policy of another library, from its function of the scaled features that it has learned from."""

    def __init__(self, task: Task, act: Callable[[Tensor], Tensor]) -> None:
        self._encoder, self._act = ObservationEncoder.of(task.test_env, task.observation), act
        self.in_keys = [*self._encoder.keys]

    @torch.no_grad()
    def __call__(self, now: TensorDictBase) -> TensorDictBase:
        return now.set("action", self._act(self._encoder(*(now[key] for key in self.in_keys))))


def _of_sb3(found: dict[str, Any]) -> Callable[[Tensor], Tensor]:
    return lambda features: torch.from_numpy(found["model"].predict(features.numpy(), deterministic=True)[0])


def _of_rsl_rl(found: dict[str, Any]) -> Callable[[Tensor], Tensor]:
    act = found["runner"].get_inference_policy()
    return lambda features: act(TensorDict({"observation": features}, [len(features)]))


def _of_skrl(found: dict[str, Any]) -> Callable[[Tensor], Tensor]:
    policy = found["runner"].agent.models["policy"]
    return lambda features: policy.act({"observations": features}, role="policy")[1]["mean_actions"]


def _of_cleanrl(found: dict[str, Any]) -> Callable[[Tensor], Tensor]:
    env = found["envs"].envs[0]
    while not hasattr(env, "obs_rms"):
        env = env.env
    mean, deviation = (torch.tensor(one, dtype=torch.float32) for one in (env.obs_rms.mean, env.obs_rms.var**0.5))
    return lambda features: found["agent"].actor_mean(((features - mean) / (deviation + 1e-4)).clamp(-10, 10))


LIBRARIES: dict[str, Callable[[dict[str, Any]], Callable[[Tensor], Tensor]]] = {
    "sb3": _of_sb3,
    "rsl_rl": _of_rsl_rl,
    "skrl": _of_skrl,
    "cleanrl": _of_cleanrl,
}
"""Function of the features without exploration, from the global names of a library's program."""


if __name__ == "__main__":
    given = tyro.cli(Options, description=__doc__)
    program, *arguments = shlex.split(given.program)
    run_program(Path(program), arguments, Meter(given))
