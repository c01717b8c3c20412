"""Success of policies as sensors and physics get worse, in unseen worlds: figures and curves.

    python -m benchmarks.robustness --out robustness.json --plot docs/images/robustness.png

Each point is the share of the goals reached in 64 worlds, in Warp. Delays are compensated for all policies. A contact
ends an episode of those that were made so, as these were.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
import tyro
from matplotlib.figure import Figure

from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.evaluation.plots import BLUE, GREY, ORANGE, style_axes
from rover_rl.algos.policy.names import make_policy
from rover_rl.envs import EnvConfig, PoseConfig, Randomization
from rover_rl.files import write_json, written_whole
from rover_rl.sims.settings import CONTROL_DT

JUMP_HEADING = math.radians(30.0)  # error of the heading for each meter of that of the position, rad/m


def _late(value: float) -> tuple[Randomization, PoseConfig]:
    steps = round(value / 1000 / CONTROL_DT)
    return Randomization(scan_latency=(steps, steps), state_latency=(steps, steps)), PoseConfig()


def _jumps(value: float) -> tuple[Randomization, PoseConfig]:
    jump, heading = value / 100, JUMP_HEADING * value / 100
    pose = PoseConfig("localized", drift=0, drift_heading=0, jump=jump, jump_rate=1.0, jump_heading=heading)
    return Randomization(), pose


def _friction(value: float) -> tuple[Randomization, PoseConfig]:
    return Randomization(friction=(value, value)), PoseConfig()


def _noise(value: float) -> tuple[Randomization, PoseConfig]:
    return Randomization(range_noise=value / 100), PoseConfig()


Setting = Callable[[float], tuple[Randomization, PoseConfig]]
SWEEPS: Mapping[str, tuple[Setting, Sequence[float]]] = {
    "delay of scans and state, ms": (_late, (0, 100, 200, 300, 400)),
    "jumps of the pose each second, cm": (_jumps, (0, 10, 20, 30, 40)),
    "noise of the lidar, cm": (_noise, (0, 3, 6, 9, 12)),
    "factor of friction": (_friction, (0.25, 0.5, 1.0, 1.5, 2.0)),
}
"""What gets worse: axis, environment for a value of it, and values."""
COLORS = (BLUE, ORANGE, GREY)
"""Colors of the policies."""


@dataclass(frozen=True)
class Options:
    """Options of the script."""

    out: Path
    """File to write the figures to."""
    plot: Path | None = None
    """Picture to draw."""
    policies: tuple[str, ...] = ("pretrained:robust", "pretrained:anywhere", "gridplanner")
    """Policies to drive with, up to three."""
    world: str = "maze:50000-50063"
    """Unseen worlds."""


def measure(policies: Sequence[str], world: str) -> dict[str, dict[str, list[float]]]:
    """Returns the success rate of each policy for each value of each sweep."""
    episodes, found = draw_episodes(world, episodes=1), dict[str, dict[str, list[float]]]()
    for axis, (setting, values) in SWEEPS.items():
        for name in policies:
            policy = make_policy(name)
            made_for: EnvConfig = getattr(policy, "made_for", EnvConfig())
            base = replace(made_for, backend="warp", compensate_delay=True, privileged=False)
            for value in values:
                randomization, pose = setting(value)
                env = replace(base, randomization=randomization, pose=pose)
                rate = evaluate(policy, episodes, env=env, rows=len(episodes)).success_rate
                found.setdefault(axis, {}).setdefault(name, []).append(rate)
            print(axis, name, [f"{rate:.3f}" for rate in found[axis][name]], flush=True)
    return found


def draw(found: Mapping[str, Mapping[str, Sequence[float]]], world: str, path: Path) -> None:
    """Draws a panel for each sweep, with a line for each policy."""
    figure = Figure(figsize=(3.2 * len(found), 3.0), layout="constrained")
    for number, (ax, (axis, rates)) in enumerate(zip(figure.subplots(1, len(found)), found.items(), strict=True)):
        for order, ((name, line), color) in enumerate(zip(rates.items(), COLORS, strict=False)):
            ax.plot(SWEEPS[axis][1], [100 * rate for rate in line], "o-", color=color, label=name, zorder=9 - order)
        ax.set(xlabel=axis, ylim=(0, 104))
        style_axes(ax)
        if number == 0:
            ax.set_ylabel(f"goals reached, %\n{world}")
            ax.legend(frameon=False, loc="lower left")
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=130)


def main(options: Options) -> None:
    """Measures, writes and draws."""
    if len(options.policies) > len(COLORS):
        raise ValueError(f"policies must be up to {len(COLORS)}, got {len(options.policies)}")
    torch.set_num_threads(1)
    found = measure(options.policies, options.world)
    write_json(options.out, found)
    if options.plot is not None:
        draw(found, options.world, options.plot)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
