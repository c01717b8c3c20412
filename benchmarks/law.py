"""Every simulator compared with Coulomb's law of friction by hand, in 16 directions.

Turns, speeds and accelerations, limits of slopes, braking and side slopes (``benchmarks.maneuvers``), on level ground
as a plane and as triangles, and on slopes of triangles, with a friction coefficient of 0.5 unless stated. The values by
hand are those of ``benchmarks.coulomb``. A simulator passes a quantity if no direction is off by more than 5 %, or by
more than 1 degree for angles. Errors of accelerations on slopes are relative to what friction contributes to them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from rich.table import Table
from torch import Tensor

from benchmarks import coulomb, maneuvers
from benchmarks.engines import choose_engines, with_friction
from benchmarks.options import Options
from benchmarks.ratios import told
from rover_rl.robots import get_robot

FRICTION = 0.5  # friction coefficient between rover and ground
BRAKING_FRICTION = 0.3  # friction coefficient in the braking maneuver
RELATIVE_BAR, DEGREES_BAR = 0.05, 1.0  # largest error of a direction that passes: relative, and of angles in degrees


@dataclass(frozen=True)
class Quantity:
    """A quantity, its value by hand (``law``), and a function that measures it in a simulator, ``[16]``.

    ``ground`` is ``"plane"``, ``"triangles"`` or ``"slope"``. Errors of quantities in ``"deg"`` are absolute, others
    are relative to ``scale``, by default to the value by hand.
    """

    name: str
    ground: str
    unit: str
    law: float
    measure: Callable[[Any], Tensor]
    scale: float | None = None

    def compare(self, engine: Any) -> dict[str, Any]:
        """Measures the quantity: mean, least and greatest value, and the error of the worst direction."""
        values = self.measure(engine).double()
        errors = (values - self.law) / (1.0 if self.unit == "deg" else self.scale or self.law)
        worst = errors[errors.abs().argmax()].item()
        return {
            "mean": values.mean().item(),
            "least": values.min().item(),
            "greatest": values.max().item(),
            "worst_error": worst,
            "passes": abs(worst) <= (DEGREES_BAR if self.unit == "deg" else RELATIVE_BAR),
        }


def center_of_mass(robot_name: str = "rover_zero") -> tuple[float, float]:
    """The x and z coordinate of the center of mass of a rover in its base frame, m."""
    center = torch.tensor(get_robot(robot_name).center_of_mass, dtype=torch.float64)
    return center[0].item(), center[2].item()


def quantities() -> list[Quantity]:
    return [*_level_ground(), *_slopes(), *_side_slopes()]


def _level_ground() -> Iterator[Quantity]:
    robot, (center, _) = get_robot("rover_zero"), center_of_mass()
    for ground, world in (("plane", maneuvers.PLANE), ("triangles", maneuvers.LEVEL_MESH)):
        for linear, angular in ((0.0, 0.5), (0.0, 1.0), (0.0, 2.0), (0.5, 1.0)):

            def turn(engine: Any, world: Any = world, linear: float = linear, angular: float = angular) -> Tensor:
                return maneuvers.turning_rate(engine, world, linear, angular)

            name = f"yaw rate, command {f'{linear:g} m/s and ' if linear else ''}{angular:g} rad/s"
            yield Quantity(name, ground, "rad/s", coulomb.steady_motion(robot, center, linear, angular).yaw, turn)

        def speed(engine: Any, world: Any = world) -> Tensor:
            return maneuvers.level_speed(engine, world)

        def brake(engine: Any, world: Any = world) -> Tensor:
            distance, start = maneuvers.braking(engine, world, BRAKING_FRICTION)
            # Scales the distance to that from 1 m/s.
            return distance / start**2

        yield Quantity("speed, command 1 m/s", ground, "m/s", 1.0, speed)
        stop = coulomb.braking_distance(BRAKING_FRICTION, 1.0)
        yield Quantity(f"braking distance from 1 m/s, friction {BRAKING_FRICTION:g}", ground, "m", stop, brake)


def _slopes() -> Iterator[Quantity]:
    for slope in (10.0, 20.0, 25.0):

        def speed(engine: Any, slope: float = slope) -> Tensor:
            # 25 degrees take 3.3 s to reach the speed.
            after = 1.5 * coulomb.climbing_time(FRICTION, slope, 1.0)
            return maneuvers.climbing_speed(_set(engine), slope, after=math.ceil(after))

        yield Quantity(f"speed up {slope:g} deg, command 1 m/s", "slope", "m/s", 1.0, speed)
    for slope in (10.0, 20.0, 25.0):

        def accelerate(engine: Any, slope: float = slope) -> Tensor:
            return maneuvers.climbing_acceleration(_set(engine), slope)

        law = coulomb.climbing_acceleration(FRICTION, slope)
        yield Quantity(
            f"acceleration up {slope:g} deg, wheels spinning", "slope", "m/s^2", law, accelerate, _by_friction(slope)
        )
    limit = coulomb.friction_angle(FRICTION)
    yield Quantity("steepest slope climbed", "slope", "deg", limit, _steepest(maneuvers.climbs))
    yield Quantity("steepest slope stood on, facing up", "slope", "deg", limit, _steepest(maneuvers.stands))


def _side_slopes() -> Iterator[Quantity]:
    limit = coulomb.friction_angle(FRICTION)
    across = _steepest(partial(maneuvers.stands, turned=math.pi / 2))
    yield Quantity("steepest slope stood on, across", "slope", "deg", limit, across)
    for slope in (30.0, 35.0):

        def slide(engine: Any, slope: float = slope) -> Tensor:
            return maneuvers.sliding_acceleration(_set(engine), slope)

        law = coulomb.sliding_acceleration(FRICTION, slope)
        name = f"sliding down sideways on {slope:g} deg"
        yield Quantity(name, "slope", "m/s^2", law, slide, _by_friction(slope))

    def drift(engine: Any) -> Tensor:
        return maneuvers.drift(_set(engine), 20.0)

    yield Quantity("drift down while driving across 20 deg", "slope", "deg", 0.0, drift)


def _by_friction(slope: float) -> float:
    """Acceleration that friction contributes on a slope (degrees), ``mu g cos s``, m/s^2."""
    return FRICTION * coulomb.GRAVITY * math.cos(math.radians(slope))


def _set(engine: Any) -> Any:
    """Settings of a simulator with the friction of all quantities but braking."""
    return with_friction(engine, FRICTION)


def _steepest(holds: Callable[[Any, Tensor], Tensor]) -> Callable[[Any], Tensor]:
    """Returns a function that finds the steepest slopes at which rovers hold in a simulator, degrees ``[16]``."""
    limit = coulomb.friction_angle(FRICTION)
    return lambda engine: maneuvers.steepest(lambda slopes: holds(_set(engine), slopes), limit)


def measure(options: Options) -> list[dict[str, Any]]:
    """Measures every quantity in every simulator of the options. Returns a row for each quantity."""
    engines = choose_engines(options.engines)
    return [
        {
            "quantity": quantity.name,
            "ground": quantity.ground,
            "unit": quantity.unit,
            "law": quantity.law,
            "engines": {
                engine: told(f"{quantity.name}, {quantity.ground}, {engine}", partial(quantity.compare, engine))
                for engine in engines
            },
        }
        for quantity in quantities()
    ]


def table(rows: list[dict[str, Any]]) -> Table:
    engines = list(rows[0]["engines"])
    climbing, braking = (
        coulomb.front_load(get_robot("rover_zero"), center_of_mass(), friction)
        for friction in (FRICTION, -BRAKING_FRICTION)
    )
    table = Table(
        "quantity",
        "ground",
        "by hand",
        *(f"{engine}: mean (worst)" for engine in engines),
        title="Coulomb's law: mean over 16 directions, and error of the worst",
        caption=(
            f"* off by more than {RELATIVE_BAR:.0%} or {DEGREES_BAR:g} degree in some direction. "
            f"Load on the front wheels by hand: {climbing:.0%} while they spin uphill, {braking:.0%} while they brake."
        ),
    )
    for row in rows:
        cells = (_cell(row["unit"], row["engines"][engine]) for engine in engines)
        table.add_row(row["quantity"], row["ground"], f"{row['law']:.3f} {row['unit']}", *cells)
    return table


def _cell(unit: str, found: dict[str, Any]) -> str:
    worst = f"{found['worst_error']:+.2f} deg" if unit == "deg" else f"{found['worst_error']:+.1%}"
    text = f"{found['mean']:.3f} ({worst})"
    return text if found["passes"] else f"[red]{text} *[/red]"
