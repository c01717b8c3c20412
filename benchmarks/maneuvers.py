"""Maneuvers of rovers on planes, level or tilted, measured in a simulator in 16 directions.

Each maneuver returns a value per direction, ``[16]``. On level ground the rovers face in these directions. On slopes
each rover has a plane of its own, tilted toward its direction, so that all rovers stand on their slopes alike, and only
the axes of the world and of the ground's triangles differ. Maneuvers begin at rest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from benchmarks.engines import with_friction
from rover_rl.robots import Robot, get_robot
from rover_rl.rotations import quaternion_to_euler, wrap_angle
from rover_rl.sims import make_simulator
from rover_rl.worlds import Terrain, World

STEPS_PER_SECOND = 20
DIRECTIONS = torch.arange(16) * (2 * math.pi / 16)  # directions of the rovers, or toward which the ground rises, rad
PLANE = World("plane", Terrain.flat((60, 60)))  # level ground that simulators represent by a plane
RESTING = 0.01  # mean speed below which a rover stands, m/s
NEARLY_LEVEL = 0.001  # slope that makes simulators represent level ground by triangles, degrees
_BRACKET = 16.0  # largest distance of a measured limit from the expected one, degrees
_BISECTIONS = 7  # number of halvings of the bracket around a limit: to an eighth of a degree


@dataclass(frozen=True)
class Trajectories:
    """Poses of rovers over time: positions ``[T, N, 3]`` (m), and roll, pitch and yaw ``[T, N, 3]`` (rad)."""

    position: Tensor
    euler: Tensor

    def difference(self, other: Trajectories) -> dict[str, float]:
        """Medians over the rovers: final position (m), final yaw (rad), and mean roll and pitch (rad)."""
        position = (self.position[-1, :, :2] - other.position[-1, :, :2]).norm(dim=-1)
        turned = wrap_angle(self.euler - other.euler).abs()
        return {
            "position_m": position.median().item(),
            "yaw_rad": turned[-1, :, 2].median().item(),
            "tilt_rad": turned[..., :2].mean((0, 2)).median().item(),
        }


def incline(degrees: float, direction: float = 0.0, size: float = 8.0, cell: float = 0.25) -> World:
    """A square plane of triangles that rises toward a direction (rad), with sides and cells in m.

    Smaller planes are quicker to build.
    """
    along = torch.linspace(-size / 2, size / 2, round(size / cell) + 1, dtype=torch.float64)
    heights = math.cos(direction) * along + math.sin(direction) * along[:, None]
    return World(f"incline {degrees:g}", Terrain(math.tan(math.radians(degrees)) * heights, cell))


LEVEL_MESH = incline(NEARLY_LEVEL, size=60.0)  # level ground that simulators represent by triangles


def inclines(slopes: Tensor, size: float = 8.0) -> list[World]:
    """A plane for each of :data:`DIRECTIONS` with slopes ``[16]`` in degrees."""
    return [incline(slope, to, size) for slope, to in zip(slopes.tolist(), DIRECTIONS.tolist(), strict=True)]


def drive(
    engine: Any,
    worlds: list[World],
    starts: Tensor,
    commands: list[tuple[Tensor, float]],
    robot: str | Robot = "rover_zero",
) -> Trajectories:
    """Drives rovers from rest, each in its world, and returns their poses at the start and after each step.

    The ``engine`` is the name or the settings of a simulator, as for all maneuvers. ``starts`` are x, y (m) and yaw
    (rad), ``[N, 3]``. A command is speed (m/s) and yaw rate (rad/s), ``[2]`` or ``[N, 2]``, and for how many seconds.
    """
    simulator = make_simulator(engine, worlds=worlds, robot=get_robot(robot))
    states = [simulator.reset(torch.ones(len(worlds), dtype=torch.bool), starts)]
    for command, seconds in commands:
        rows = command.expand(len(worlds), 2).contiguous()
        states += [simulator.step(rows) for _ in range(round(seconds * STEPS_PER_SECOND))]
    simulator.close()
    return Trajectories(
        torch.stack([state.position for state in states]),
        torch.stack([quaternion_to_euler(state.orientation) for state in states]),
    )


def _starts(turned: float = 0.0) -> Tensor:
    """Start poses ``[16, 3]`` at the origin that face in :data:`DIRECTIONS`, turned by an angle (rad)."""
    return torch.stack((torch.zeros(16), torch.zeros(16), DIRECTIONS + turned), -1)


def _command(linear: float, angular: float = 0.0) -> Tensor:
    return torch.tensor((linear, angular))


def _velocities(trajectories: Trajectories) -> Tensor:
    """Velocities in each step, ``[T, 16, 3]``, m/s."""
    return trajectories.position.double().diff(dim=0) * STEPS_PER_SECOND


def _uphill(trajectories: Trajectories, slopes: Tensor) -> Tensor:
    """Speeds up the slopes (degrees, ``[16]``) in each step, ``[T, 16]``, m/s."""
    ahead = torch.stack((DIRECTIONS.cos(), DIRECTIONS.sin()), -1).double()
    return (_velocities(trajectories)[..., :2] * ahead).sum(-1) / torch.deg2rad(slopes.double()).cos()


def _acceleration(speeds: Tensor, start: float, end: float) -> Tensor:
    """Mean acceleration between two times (s) from the speeds ``[T, 16]`` in each step, m/s^2."""
    first, last = round(start * STEPS_PER_SECOND), round(end * STEPS_PER_SECOND)
    return (speeds[last] - speeds[first]) * STEPS_PER_SECOND / (last - first)


def turning_rate(engine: Any, world: World, linear: float, angular: float, seconds: float = 3.0) -> Tensor:
    """Mean yaw rate on level ground under a constant command (m/s, rad/s), without the first second, rad/s."""
    driven = drive(engine, [world] * 16, _starts(), [(_command(linear, angular), 1.0 + seconds)])
    return wrap_angle(driven.euler[STEPS_PER_SECOND:, :, 2].double().diff(dim=0)).sum(0) / seconds


def level_speed(engine: Any, world: World, speed: float = 1.0) -> Tensor:
    """Steady speed on level ground under a commanded speed, m/s: the mean of the third second."""
    driven = drive(engine, [world] * 16, _starts(), [(_command(speed), 3.0)])
    return _velocities(driven)[-STEPS_PER_SECOND:].norm(dim=-1).mean(0)


def climbing_speed(engine: Any, slope: float, speed: float = 1.0, after: float = 5.0) -> Tensor:
    """Steady speed up a slope (degrees) under a commanded speed, m/s: the mean of the second that follows ``after``."""
    slopes = torch.full((16,), slope)
    driven = drive(engine, inclines(slopes, 16.0), _starts(), [(_command(speed), after + 1.0)])
    return _uphill(driven, slopes)[-STEPS_PER_SECOND:].mean(0)


def climbing_acceleration(engine: Any, slope: float) -> Tensor:
    """Mean acceleration up a slope (degrees) from 0.25 to 0.75 s after the start, m/s^2.

    The commanded speed of 5 m/s is above that of the rover, so that all wheels spin.
    """
    slopes = torch.full((16,), slope)
    driven = drive(engine, inclines(slopes), _starts(), [(_command(5.0), 1.0)])
    return _acceleration(_uphill(driven, slopes), 0.25, 0.75)


def climbs(engine: Any, slopes: Tensor) -> Tensor:
    """Whether rovers climb slopes (degrees, ``[16]``), bool ``[16]``: whether they gain height.

    The rovers start at rest with full command, 1 m/s, and drive for 2 s. On a slope of a degree less than the limit
    they accelerate by 0.19 m/s^2 and gain 0.38 m; on one of a degree more they slide down as far.
    """
    driven = drive(engine, inclines(slopes), _starts(), [(_command(1.0), 2.0)])
    return _uphill(driven, slopes).mean(0) > 0


def stands(engine: Any, slopes: Tensor, turned: float = 0.0) -> Tensor:
    """Whether rovers stand on slopes (degrees, ``[16]``) with their wheels held, bool ``[16]``.

    They stand if they move by less than 1 cm/s in the two seconds after the first, in which they settle. On a slope of
    a degree more than the limit they slide by 0.38 m/s on average. They are ``turned`` from facing uphill, rad.
    """
    driven = drive(engine, inclines(slopes), _starts(turned), [(_command(0.0), 3.0)])
    return (driven.position[-1] - driven.position[STEPS_PER_SECOND]).norm(dim=-1) < RESTING * 2


def steepest(holds: Callable[[Tensor], Tensor], expected: float) -> Tensor:
    """The steepest slopes at which rovers hold, degrees, by bisection in each direction.

    ``holds`` tells whether rovers hold on slopes (degrees, ``[16]``), bool ``[16]``. Limits that differ by more than 16
    degrees from the ``expected`` one are given as 16 degrees.
    """
    low, high = torch.full((16,), expected - _BRACKET), torch.full((16,), expected + _BRACKET)
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        held = holds(middle)
        low, high = torch.where(held, middle, low), torch.where(held, high, middle)
    return (low + high) / 2


def braking(engine: Any, world: World, friction: float) -> tuple[Tensor, Tensor]:
    """Braking distances (m) from about 1 m/s on level ground, and the speeds (m/s) at which the wheels lock, ``[16]``.

    The acceleration limit of the drive is out of reach, so that friction alone brakes.
    """
    rover = get_robot("rover_zero")
    robot = replace(rover, drive=replace(rover.drive, max_linear_acceleration=1000.0))
    commands = [(_command(1.0), 2.0), (_command(0.0), 1.0)]
    driven = drive(with_friction(engine, friction), [world] * 16, _starts(), commands, robot)
    distance = (driven.position[-1] - driven.position[-STEPS_PER_SECOND - 1]).norm(dim=-1)
    return distance.double(), _velocities(driven)[-STEPS_PER_SECOND - 1].norm(dim=-1)


def sliding_acceleration(engine: Any, slope: float) -> Tensor:
    """Acceleration down a slope (degrees) of rovers across it with locked wheels, from 0.25 to 1.25 s on, m/s^2."""
    slopes = torch.full((16,), slope)
    driven = drive(engine, inclines(slopes), _starts(math.pi / 2), [(_command(0.0), 1.5)])
    return -_acceleration(_uphill(driven, slopes), 0.25, 1.25)


def drift(engine: Any, slope: float, speed: float = 0.5, seconds: float = 6.0) -> Tensor:
    """Angle by which rovers that drive straight across a slope (degrees) drift down, degrees."""
    slopes = torch.full((16,), slope)
    driven = drive(engine, inclines(slopes), _starts(math.pi / 2), [(_command(speed), seconds)])
    moved = (driven.position[-1] - driven.position[0]).double()
    across = torch.stack((-DIRECTIONS.sin(), DIRECTIONS.cos()), -1).double()
    down = -_uphill(driven, slopes).mean(0) * seconds
    return torch.rad2deg(torch.atan2(down, (moved[:, :2] * across).sum(-1)))
