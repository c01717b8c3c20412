"""RoboTerrain: goals one after the other among people who walk back and forth, from its SDF files.

Worlds with walkers are SDF files of https://github.com/jackvice/RoboTerrain (Apache-2.0). Rovers drive for some
minutes, and contacts do not end a run. What counts is how long a rover is within 0.5 m of a person, and how long it
takes, per goal; both have published logs::

    python -m benchmarks.roboterrain RoboTerrain/worlds orca scripted --rovers 8
"""

from __future__ import annotations

import math
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console

from rover_rl.algos.driving import drives
from rover_rl.algos.evaluation.metrics import Estimate, ratio
from rover_rl.algos.evaluation.report import Column, cell, print_tables
from rover_rl.algos.evaluation.trajectory import count_runs
from rover_rl.algos.policy.names import resolve_policies
from rover_rl.algos.policy.runner import Policy, sensors_for
from rover_rl.checks import MAX_COUNT
from rover_rl.cli.options import EnvOptions
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.rover import RoverEnv
from rover_rl.native.threads import single_threaded
from rover_rl.worlds import World

GOAL_RADIUS = 0.3  # distance from a goal at which it is reached, m
TOO_CLOSE = 0.5  # distance of the centers of rover and person below which the rover is at risk, m
COLUMNS = {"risk": "s closer than 0.5 m, per goal", "time": "s per goal", "goals": "goals", "contacts": "contacts"}
PUBLISHED = {
    "Nav2 (lidar, true pose)": {"inspect": (0.542, 27.0), "construct": (0.352, 17.1), "island": (0.417, 9.06)},
    "best learned (camera)": {"inspect": (0.097, 18.5), "construct": (0.020, 34.6), "island": (0.025, 10.2)},
}
"""Published seconds closer than 0.5 m and seconds, per goal, by policy and world."""
NOTHING = Estimate(math.nan, math.nan, math.nan)


@single_threaded()
def drive(policy: Policy | None, config: EnvConfig, seconds: float) -> dict[str, Estimate]:
    """Metrics of rovers that drive for some time. One that leaves the world starts again."""
    env = RoverEnv(sensors_for(policy, config))
    steps = round(seconds / env.control_dt)
    touched, close, reached = torch.zeros(3, steps, env.num_envs, dtype=torch.bool)
    done = 0
    with closing(env):
        for step in drives(env, policy, min_rows=32):
            if step.transition is None:
                continue
            touched[done] = env.rover_state.contact[:, 0]  # type: ignore[index]
            reached[done] = step.observation["outcome", "goal_reached"][:, 0]
            close[done] = env.movers.nearest_center(env.rover_state.position[:, :2])[:, 0] < TOO_CLOSE
            done += 1
            if done == steps:
                break
    goals, risk = reached.sum(0).double().tolist(), (close.sum(0) * env.control_dt).double().tolist()
    contacts = sum(count_runs(flags) for flags in touched.T)
    return {
        "risk": ratio(risk, goals),
        "time": ratio([seconds] * len(goals), goals),
        "goals": replace(NOTHING, value=sum(goals)),
        "contacts": replace(NOTHING, value=float(contacts)),
    }


@dataclass
class RoboTerrain:
    """Run policies among RoboTerrain's walkers."""

    data: tyro.conf.Positional[Path]
    policies: tyro.conf.Positional[tuple[str, ...]]
    rovers: int = 16
    seconds: float = 300.0
    seed: int = 0
    backend: str = "warp"
    environment: Annotated[EnvOptions, tyro.conf.arg(name="")] = EnvOptions()  # noqa: RUF009

    def __call__(self) -> None:
        files = [path for path in sorted(self.data.iterdir()) if path.suffix in (".sdf", ".world")]
        worlds = {path.stem: World.from_file(path, missing="skip") for path in files if "<actor" in path.read_text()}
        policies = resolve_policies(self.policies, ("roboterrain",), self.environment.given_robot)
        for name, world in worlds.items():
            rows = {one.name: self._drive(one.module, world) for one in policies}
            for policy, figures in PUBLISHED.items():
                for place, (risk, time) in figures.items():
                    if place in name:
                        told = {"risk": replace(NOTHING, value=risk), "time": replace(NOTHING, value=time)}
                        rows[f"{policy}, published"] = {key: told.get(key, NOTHING) for key in COLUMNS}
            columns = [
                Column(heading, "", [cell(row[key], "", digits=3) for row in rows.values()])
                for key, heading in COLUMNS.items()
            ]
            title = f"RoboTerrain, {name}: {self.rovers} rovers, {self.seconds:g} s each"
            print_tables(f"{title}; goals within {GOAL_RADIUS:g} m", list(rows), columns, Console())

    def _drive(self, policy: Policy | None, world: World) -> dict[str, Estimate]:
        env = self.environment.description(policy, self.backend)
        never = {"collision_window": MAX_COUNT, "stuck_threshold": 0.0, "flip_threshold": 2 * math.pi}
        task = replace(env.task, success_distance=GOAL_RADIUS, collision_from="contact", **never)  # type: ignore[arg-type]
        settings = {"num_envs": self.rovers, "end_on_goal": False, "seed": self.seed, "length": MAX_COUNT}
        return drive(policy, replace(env, task=task, world=world, **settings), self.seconds)  # type: ignore[arg-type]


if __name__ == "__main__":
    tyro.cli(RoboTerrain)()
