"""What a calibration says: lines for the terminal, settings of an environment, and a picture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from matplotlib.figure import Figure

from rover_rl.algos.calibration.calibrate import HORIZONS, Calibration
from rover_rl.algos.evaluation.plots import BLUE, GREY, ORANGE, style_axes
from rover_rl.envs.config import env_from_plain
from rover_rl.files import MADE, write_through, written_whole
from rover_rl.robots import Robot
from rover_rl.robots.drives import SkidSteer
from rover_rl.robots.options import RobotOptions, with_options
from rover_rl.robots.turning import yaw_gain
from rover_rl.sims.settings import CONTROL_DT

GROUND_FRICTION = 0.5  # friction of the ground in the simulators, which factors of friction refer to
SHOWN = 30.0  # duration of the drive in the picture, s
UNTOLD = "not told by this drive; to tell it (rover-rl drive --excite drives all of this):"
LIMITS = {"speed": "speed_top", "yaw_rate": "turn_top", "acceleration": "speed_acceleration"}
LIMITS |= {"yaw_acceleration": "turn_acceleration"}
AGES = {"state_latency": ("odometry_age", "imu_age", "pose_age"), "scan_latency": ("scan_age",)}
RANGES = {"odometry_scale": "wheel_scale", "yaw_bias": "yaw_bias", "friction": "friction"}
VALUES = {"odometry_noise": "odometry_noise", "imu_noise": "imu_noise", "range_noise": "range_noise"}
VALUES |= {"dropout": "lost_beams"}
"""Settings, and the numbers that they are made of."""


def describe(calibration: Calibration) -> list[str]:
    """Returns a line for each number, then one for each that the drive does not tell."""
    told, untold = [f"{'number':42} {'value':>8} {'unit':8} 95 % interval"], []
    for number in calibration.numbers.values():
        if number.estimate is None:
            untold.append(f"  {number.label}: {number.advice}")
        else:
            value, low, high = (f"{each:.3g}" for each in number.estimate)
            told.append(f"{number.label:42} {value:>8} {number.unit:8} {low} to {high}")
    horizons = " / ".join(f"{each:g}" for each in HORIZONS)
    rows = (*calibration.errors, calibration.restless)
    before, after, own = (" / ".join(f"{100 * each:.1f}" for each in row) for row in rows)
    told += ["", f"median error of the place after {horizons} s: {before} cm before, {after} cm after the calibration"]
    if np.isfinite(calibration.restless).all():
        told.append(f"while the robot stands, its measured place goes by {own} cm in these times, a part of both")
    return [*told, *(["", UNTOLD, *untold] if untold else [])]


def env_settings(calibration: Calibration, name: str, robot: Robot) -> dict[str, Any]:
    """Returns the settings of :class:`EnvConfig` that the numbers give, ``name`` being that of ``robot``.

    A command is as late as delay and lag together, less half a step, which the simulators take themselves.
    """
    numbers = {name: number.estimate for name, number in calibration.numbers.items() if number.estimate is not None}
    ranges: dict[str, Any] = {}
    if "command_delay" in numbers:
        late = [numbers[each] for each in ("command_delay", "speed_lag") if each in numbers]
        ends = (sum(each.low for each in late), sum(each.high for each in late))
        ranges["latency"] = _steps(*(end - CONTROL_DT / 2 for end in ends))
    for setting, names in AGES.items():
        if ages := [numbers[each] for each in names if each in numbers]:
            ranges[setting] = _steps(min(age.low for age in ages), max(age.high for age in ages))
    for setting, number in RANGES.items():
        if number in numbers:
            unit = GROUND_FRICTION if number == "friction" else 1.0
            ranges[setting] = [_rounded(end / unit) for end in numbers[number][1:]]
    ranges |= {key: max(_rounded(numbers[each].value), 0.0) for key, each in VALUES.items() if each in numbers}
    limits = {f"max_{key}": _rounded(numbers[each].value) for key, each in LIMITS.items() if each in numbers}
    slip = numbers.get("slip")
    if slip is not None and isinstance(robot.drive, SkidSteer) and not 0.95 < slip.value * yaw_gain(robot) < 1.05:
        # The simulated body turns by Coulomb's law: the track of its drive gives it the yaw rate of the real one.
        track = robot.drive.track(robot.wheels) / yaw_gain(robot) / slip.value
        name = with_options(name, RobotOptions(separation=_rounded(track)))
    settings = {"robot": name, "randomization": ranges}
    return {**settings, "limits": {"apply": True, **limits}} if limits else settings


def _steps(low: float, high: float) -> list[int]:
    """Returns a range of delays in control steps around one in seconds; a tenth of a step is none."""
    return [max(math.floor(low / CONTROL_DT + 0.1), 0), max(math.ceil(high / CONTROL_DT - 0.1), 0)]


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


def write_settings(settings: dict[str, Any], lines: list[str], path: Path) -> None:
    """Writes settings as YAML that ``train --config`` and ``--env`` take, with the report as a comment."""
    env_from_plain(settings, str(path))
    comment = "".join(f"# {line}".rstrip() + "\n" for line in (MADE, *lines))
    text = yaml.safe_dump({"algo": "ppo", "env": settings}, sort_keys=False)
    with written_whole(path) as temporary:
        write_through(temporary, (comment + text).encode())


def draw(calibration: Calibration, path: Path) -> None:
    """Draws velocities as measured and replayed, where the drive changes most, and the errors of prediction."""
    time, measured = calibration.time, calibration.measured
    changes = abs(measured[1:] - measured[:-1]).sum(1).cumsum()
    ends = time[:-1].searchsorted(time[:-1] + SHOWN).clip(max=len(changes) - 1)
    begin = int((changes[ends] - changes).argmax())
    part = slice(begin, int(ends[begin]) + 1)
    lines = (
        (measured, GREY, "measured"),
        (calibration.before, ORANGE, "before"),
        (calibration.after, BLUE, "calibrated"),
    )
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplot_mosaic([["speed", "speed", "errors"], ["yaw rate", "yaw rate", "errors"]])
    for index, (name, unit) in enumerate((("speed", "m/s"), ("yaw rate", "rad/s"))):
        for values, color, label in lines:
            wide: dict[str, Any] = {"linewidth": 3, "alpha": 0.6} if color == GREY else {"linewidth": 1.2}
            axes[name].plot(time[part], values[part, index], color=color, label=label, **wide)
        axes[name].set(ylabel=f"{name} ({unit})", xlabel="time (s)")
    axes["speed"].legend(frameon=False, ncols=3, loc="upper left", bbox_to_anchor=(0, 1.14))
    for row, (_, color, _), side in zip(calibration.errors, lines[1:], (-0.2, 0.2), strict=True):
        axes["errors"].bar([side + each for each in range(len(HORIZONS))], 100 * row, 0.4, color=color)
    axes["errors"].set(xticks=range(len(HORIZONS)), xticklabels=[f"{each:g} s" for each in HORIZONS])
    axes["errors"].set(title="error of the predicted place (cm)")
    for ax in axes.values():
        style_axes(ax)
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=120)
