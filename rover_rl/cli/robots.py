"""The command ``rover-rl robots``."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Union

import tyro

from rover_rl.cli.options import Force, OptionsOfRobot
from rover_rl.files import check_outputs, written_whole
from rover_rl.robots.options import RobotOptions, with_options

if TYPE_CHECKING:
    from rover_rl.robots import Robot


@dataclass(frozen=True)
class ShowRobot:
    """Draw a robot and describe it: its outline, wheels, mounts, turning circle, masses and limits.

    For a URDF file, that is what was understood of it, and what was assumed.
    """

    robot: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ROBOT")]
    """Robot to draw: a name, a URDF file, or module:attribute."""
    options: OptionsOfRobot = field(default_factory=RobotOptions)
    out: Path | None = None
    """Picture to write. Default: the robot's name with .robot.png, in this folder."""
    force: Force = False
    backend: str = "warp"
    """Simulator that a skid-steer robot spins in, for its effective track."""

    def __call__(self) -> int:
        from rover_rl.robots import get_robot
        from rover_rl.robots.draw import draw_robot

        name = with_options(self.robot, self.options)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            robot = get_robot(name)
        out = self.out or Path(f"{robot.name.replace(':', '-')}.robot.png")
        check_outputs(out, inputs=[self.robot], force=self.force)
        lines = describe(robot)
        print("\n".join(lines))
        for note in robot.notes or [str(each.message) for each in caught]:
            print(f"  {note}")
        with written_whole(out) as temporary:
            draw_robot(robot, lines[1:], temporary)
        print(self._spin(robot), end="")
        print(f"drawn in {out}")
        return 0

    def _spin(self, robot: Robot) -> str:
        from rover_rl.robots.drives import SkidSteer
        from rover_rl.sims.effective_track import measured_track

        if not isinstance(robot.drive, SkidSteer):
            return ""
        measured, stated = measured_track(robot, self.backend), robot.drive.track(robot.wheels)
        return f"  effective track, measured in {self.backend}: {measured:.3f} m; the drive takes {stated:.3f} m\n"


@dataclass(frozen=True)
class Robots:
    """List the robots. The subcommand show draws one, also from a URDF file."""

    action: Annotated[
        Union[  # noqa: UP007
            Annotated[None, tyro.conf.subcommand("list", prefix_name=False)],
            Annotated[ShowRobot, tyro.conf.subcommand("show", prefix_name=False)],
        ],
        tyro.conf.arg(name=""),
    ] = field(default=None)
    """Draw a robot. Default: list all."""

    def __call__(self) -> int:
        if self.action is not None:
            return self.action()
        from rover_rl.robots import FAMILIES, ROBOTS, get_robot, robot_names

        print(f"{'name':12} {'mass':>9} {'size':>13} {'drive':12} {'speed':>9} {'turn':>12}  source")
        for name in robot_names():
            try:
                robot = get_robot(name)
            except (ValueError, OSError) as error:
                print(f"{name:12} cannot be loaded: {error}")
                continue
            outline, drive = robot.footprint, robot.drive
            size = f"{outline.front - outline.back:.2f} x {outline.left - outline.right:.2f} m"
            radius = drive.min_radius(robot.wheels)
            turn = "in place" if drive.turns_in_place else f"{radius:.2f} m"
            source = "built in" if name in ROBOTS else str(robot.urdf or "")
            if name in FAMILIES:
                source = f"one of a family: {name}:0, {name}:1, ..."
            kind, speed = type(drive).__name__, f"{drive.max_speed:.3g} m/s"
            print(f"{name:12} {robot.mass:6.1f} kg {size:>13} {kind:12} {speed:>9} {turn:>12}  {source}")
        print("also: a URDF file, as --robot FILE.urdf; look at one with: rover-rl robots show FILE.urdf")
        return 0


def describe(robot: Robot) -> list[str]:
    """Describes a robot, in lines: the first has its name, the others are indented."""
    from rover_rl.robots.drives import Ackermann, SkidSteer

    outline, wheels, drive = robot.footprint, robot.wheels, robot.drive
    casters = len(drive.casters) if isinstance(drive, SkidSteer) else 0
    count, with_casters = len(wheels.hubs) - casters, f" on the ground and {casters} for casters" if casters else ""
    width = f"{wheels.width:.3g} m wide" if wheels.width else "spheres"
    x = [hub[0] for hub in wheels.hubs[:count]]
    y = [hub[1] for hub in wheels.hubs[:count]]
    view = f"{math.degrees(robot.lidar_view):.0f} degrees"
    lines = [
        f"{robot.name}: {type(drive).__name__}, {robot.mass:.4g} kg",
        f"  size: {outline.front - outline.back:.3g} x {outline.left - outline.right:.3g} m",
        f"  disc that is kept free: radius {robot.radius:.3g} m",
        f"  wheels: {count}{with_casters}, radius {wheels.radius:.3g} m, {width}",
        f"  wheelbase: {max(x) - min(x):.3g} m, track {max(y) - min(y):.3g} m",
        f"  center of mass: {_place(robot.center_of_mass)} m",
        f"  lidar: {_place(robot.lidar_position)} m, {robot.lidar_range:g} m, {view}",
        f"  IMU: {_place(robot.imu_position)} m",
        f"  limits: {drive.max_speed:g} m/s, {drive.max_yaw_rate:g} rad/s, {drive.max_linear_acceleration:g} m/s^2,",
        f"    {drive.max_angular_acceleration:g} rad/s^2, {drive.torque:g} N m at a wheel",
    ]
    if isinstance(drive, SkidSteer):
        lines.append(f"  effective track: {drive.track(wheels):.3g} m; it turns in place")
    if isinstance(drive, Ackermann):
        radius = drive.min_radius(wheels)
        lines.append(f"  steering: {drive.max_steering:.3g} rad; smallest radius {radius:.3g} m, of the rear axle")
    for name, joints in _joints(robot):
        lines += [f"  joints {name}:", *(f"    {joint}" for joint in joints)]
    return lines


def _joints(robot: Robot) -> list[tuple[str, tuple[str, ...]]]:
    drive = robot.drive
    named = {
        "of motors": tuple(", ".join(motor) for motor in drive.motors),
        "without motor": drive.passive,
        "of steering": drive.steering,
    }
    return [(name, joints) for name, joints in named.items() if joints]


def _place(position: tuple[float, ...]) -> str:
    # To a tenth of a millimeter; adding 0 turns -0.0 into 0.0.
    return " ".join(f"{round(each, 4) + 0.0:.3g}" for each in position)
