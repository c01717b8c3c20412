"""What a calibration says: lines for the terminal, settings of an environment, and a picture."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import yaml
from matplotlib.figure import Figure

from rover_rl.algos.calibration.calibrate import HORIZONS, Calibration
from rover_rl.algos.calibration.sensors import Estimate
from rover_rl.algos.evaluation.plots import BLUE, GREY, ORANGE, style_axes
from rover_rl.envs.config import env_from_plain
from rover_rl.files import MADE, write_through, written_whole
from rover_rl.robots import Robot
from rover_rl.robots.drives import SkidSteer
from rover_rl.robots.options import RobotOptions, with_options
from rover_rl.robots.turning import yaw_gain
from rover_rl.sims.settings import CONTROL_DT

GROUND_FRICTION = 0.5
"""Friction of the ground in the simulators, which factors of friction refer to."""
SHOWN = 30.0
"""Duration of the drive in the picture, s."""


def describe(calibration: Calibration) -> list[str]:
    """Returns a line for each number, then one for each that the drive does not tell."""
    told, untold = [], []
    for number in calibration.numbers.values():
        if number.estimate is None:
            untold.append(f"  {number.label}: {number.advice}")
        else:
            value, low, high = (f"{each:.3g}" for each in number.estimate)
            told.append(f"{number.label:42} {value:>8} {number.unit:8} {low} to {high}")
    head = f"{'number':42} {'value':>8} {'unit':8} 95 % interval"
    horizons = " / ".join(f"{each:g}" for each in HORIZONS)
    before, after = (" / ".join(f"{100 * each:.1f}" for each in row) for row in calibration.errors)
    errors = f"median error of the place after {horizons} s: {before} cm before, {after} cm after the calibration"
    return [head, *told, "", errors, *(["", "not told by this drive; to tell it:", *untold] if untold else [])]


def env_settings(calibration: Calibration, name: str, robot: Robot) -> dict[str, Any]:
    """Returns the settings of :class:`EnvConfig` that the numbers give, ``name`` being that of ``robot``.

    A command is as late as delay and lag together, less half a step, which the simulators take themselves.
    """
    numbers = {name: number.estimate for name, number in calibration.numbers.items() if number.estimate is not None}
    limits = {"max_speed": "speed_top", "max_yaw_rate": "turn_top"}
    limits |= {"max_acceleration": "speed_acceleration", "max_yaw_acceleration": "turn_acceleration"}
    known = {setting: _rounded(numbers[number].value) for setting, number in limits.items() if number in numbers}
    ranges: dict[str, Any] = {}
    if (delay := numbers.get("command_delay")) is not None:
        lag = numbers.get("speed_lag", Estimate(0.0, 0.0, 0.0))
        ranges["latency"] = _steps(delay.low + lag.low - CONTROL_DT / 2, delay.high + lag.high - CONTROL_DT / 2)
    ages = [numbers[each] for each in ("odometry_age", "imu_age", "pose_age") if each in numbers]
    if ages:
        ranges["state_latency"] = _steps(min(age.low for age in ages), max(age.high for age in ages))
    if "scan_age" in numbers:
        ranges["scan_latency"] = _steps(numbers["scan_age"].low, numbers["scan_age"].high)
    for setting, number, unit in (
        ("odometry_scale", "wheel_scale", 1.0),
        ("yaw_bias", "yaw_bias", 1.0),
        ("friction", "friction", GROUND_FRICTION),
    ):
        if number in numbers:
            ranges[setting] = [_rounded(numbers[number].low / unit), _rounded(numbers[number].high / unit)]
    noise = {"odometry_noise": "odometry_noise", "imu_noise": "imu_noise", "range_noise": "range_noise"}
    for setting, number in {**noise, "dropout": "lost_beams"}.items():
        if number in numbers:
            ranges[setting] = _rounded(max(numbers[number].value, 0.0))
    slip = numbers.get("slip")
    if slip is not None and isinstance(robot.drive, SkidSteer) and not 0.95 < slip.value * yaw_gain(robot) < 1.05:
        # The simulated body turns by Coulomb's law: the track of its drive gives it the yaw rate of the real one.
        track = robot.drive.track(robot.wheels) / yaw_gain(robot) / slip.value
        name = with_options(name, RobotOptions(separation=_rounded(track)))
    settings = {"robot": name, "randomization": ranges}
    return {**settings, "limits": {"apply": True, **known}} if known else settings


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
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplot_mosaic([["speed", "speed", "errors"], ["yaw rate", "yaw rate", "errors"]])
    for index, (name, unit) in enumerate((("speed", "m/s"), ("yaw rate", "rad/s"))):
        ax = axes[name]
        ax.plot(time[part], measured[part, index], color=GREY, linewidth=3, alpha=0.6, label="measured")
        ax.plot(time[part], calibration.before[part, index], color=ORANGE, linewidth=1, label="before")
        ax.plot(time[part], calibration.after[part, index], color=BLUE, linewidth=1.3, label="calibrated")
        ax.set(ylabel=f"{name} ({unit})", xlabel="time (s)")
        style_axes(ax)
    axes["speed"].legend(frameon=False, ncols=3, loc="upper left", bbox_to_anchor=(0, 1.14))
    for row, color, label, side in zip(
        calibration.errors, (ORANGE, BLUE), ("before", "calibrated"), (-0.2, 0.2), strict=True
    ):
        axes["errors"].bar([side + each for each in range(len(HORIZONS))], 100 * row, 0.4, color=color, label=label)
    axes["errors"].set(xticks=range(len(HORIZONS)), xticklabels=[f"{each:g} s" for each in HORIZONS])
    axes["errors"].set(title="error of the predicted place (cm)")
    style_axes(axes["errors"])
    with written_whole(path) as temporary:
        figure.savefig(temporary, dpi=120)
