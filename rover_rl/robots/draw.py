"""Picture of a robot: its outline, wheels, sensors and turning circle. Drawn with Matplotlib; needs no display."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle, Wedge
from matplotlib.transforms import Affine2D

from rover_rl.robots.drives import Ackermann, SkidSteer
from rover_rl.robots.robot import Robot

BODY, EDGE, TIRE, CASTER, STEERED = "#b8c4d6", "#475569", "#27272a", "#a1a1aa", "#f97316"
LIDAR, IMU, CENTER, OUTLINE, TURN = "#1d4ed8", "#86198f", "#b91c1c", "#2a9d8f", "#2a9d8f"
BEAMS = 24
"""Number of beams that are drawn."""
MARGIN = 0.15
"""Margin around the robot, as a share of its size."""


def draw_robot(robot: Robot, lines: list[str], path: str | Path | None = None) -> Figure:
    """Draws a robot from above and from the side, its turning circle, and ``lines`` of text.

    ``path`` is that of the image file, whose suffix selects the format. ``None`` does not save the figure.
    """
    figure = Figure(figsize=(12.5, 8.0), layout="constrained")
    axes = figure.subplot_mosaic("AAC;BBT", height_ratios=(1.3, 1.0))
    _draw_above(axes["A"], robot)
    _draw_side(axes["B"], robot)
    _draw_turn(axes["C"], robot)
    axes["T"].axis("off")
    axes["T"].text(0.0, 1.0, "\n".join(lines), va="top", family="monospace", fontsize=8, transform=axes["T"].transAxes)
    figure.suptitle(robot.name)
    if path is not None:
        figure.savefig(path, dpi=130)
    return figure


def _draw_above(ax: Axes, robot: Robot) -> None:
    _add_boxes(ax, robot, (0, 1))
    _add_wheels(ax, robot)
    ax.add_patch(_outline(robot, fill=False, edgecolor=OUTLINE, linewidth=1.4, label="footprint"))
    style: dict[str, Any] = {"fill": False, "edgecolor": OUTLINE, "linestyle": (0, (4, 3))}
    ax.add_patch(Circle((0, 0), robot.radius, label="disc that is kept free", **style))
    half = (1 + MARGIN) * max(robot.radius, robot.footprint.corner)
    _add_lidar(ax, robot, 1.4 * half)
    _add_points(ax, robot, (0, 1))
    ax.annotate("", (0.3 * half, 0), (0, 0), arrowprops={"arrowstyle": "->", "color": EDGE})
    ax.set(xlim=(-1.6 * half, 1.6 * half), ylim=(-half, half), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    ax.set_title("from above", fontsize=10)
    ax.legend(loc="upper left", fontsize=7, framealpha=0.9)


def _draw_side(ax: Axes, robot: Robot) -> None:
    drive, z = robot.drive, robot.lidar_position[2]
    ax.axhline(0.0, color=EDGE, linewidth=1.0)
    _add_boxes(ax, robot, (0, 2))
    casters = drive.casters if isinstance(drive, SkidSteer) else ()
    for name, (x, _, height) in zip(drive.wheels, robot.wheels.hubs, strict=True):
        color = CASTER if name in casters else TIRE
        ax.add_patch(Circle((x, height), robot.wheels.radius, facecolor=color, alpha=0.75))
    _add_points(ax, robot, (0, 2))
    ax.axhline(z, color=LIDAR, linewidth=0.8, linestyle=(0, (2, 3)))
    half = (1 + MARGIN) * max(robot.footprint.half_length, robot.radius)
    top = max([z, *(center[2] + size[2] / 2 for center, size, _ in robot.boxes)])
    ax.set(xlim=(-1.6 * half, 1.6 * half), ylim=(-0.1 * half, top + 0.2 * half), xlabel="x (m)", ylabel="z (m)")
    ax.set_aspect("equal")
    ax.set_title("from the right, with the plane of the lidar", fontsize=10)


def _draw_turn(ax: Axes, robot: Robot) -> None:
    """Draws the sharpest turn: the way of the origin or of the rear axle, and the ground that the body covers."""
    outline, radius, rear = robot.footprint, robot.drive.min_radius(robot.wheels), robot.drive.pivot(robot.wheels)
    corners = [(x, y) for x in (outline.back, outline.front) for y in (outline.right, outline.left)]
    reach = max(math.hypot(x - rear, radius - y) for x, y in corners)
    width = reach - max(radius - outline.left, 0.0)
    ax.add_patch(Wedge((rear, radius), reach, 0, 360, width=width, facecolor=TURN, alpha=0.18))
    if radius:
        ax.add_patch(Circle((rear, radius), radius, fill=False, edgecolor=TURN, linewidth=1.2))
        ax.plot([rear, rear], [radius, 0.0], color=TURN, linewidth=0.8, linestyle=(0, (4, 3)))
        ax.plot([rear], [radius], "+", color=CENTER)
    ax.add_patch(_outline(robot, facecolor=BODY, edgecolor=EDGE))
    _add_wheels(ax, robot)
    text = f"radius {radius:.2f} m" if radius else "turns in place"
    ax.set_title(f"sharpest turn: {text}, needs {2 * reach:.2f} m", fontsize=10)
    sides = {"xlim": (rear - 1.1 * reach, rear + 1.1 * reach), "ylim": (radius - 1.1 * reach, radius + 1.1 * reach)}
    ax.set(**sides, aspect="equal", xlabel="x (m)")


def _outline(robot: Robot, **style: Any) -> Rectangle:
    back, front, right, left = robot.footprint
    return Rectangle((back, right), front - back, left - right, **style)


def _add_boxes(ax: Axes, robot: Robot, plane: tuple[int, int]) -> None:
    for center, sides, _ in robot.boxes:
        corner, size = [center[k] - sides[k] / 2 for k in plane], [sides[k] for k in plane]
        ax.add_patch(Rectangle((corner[0], corner[1]), *size, facecolor=BODY, edgecolor=EDGE, linewidth=0.6, alpha=0.7))


def _add_wheels(ax: Axes, robot: Robot) -> None:
    """Draws the wheels from above. Steered ones are drawn as in the sharpest turn to the left, too."""
    drive, wheels = robot.drive, robot.wheels
    width = wheels.width or 0.3 * wheels.radius
    for number, (name, (x, y, _)) in enumerate(zip(drive.wheels, wheels.hubs, strict=True)):
        if isinstance(drive, SkidSteer) and name in drive.casters:
            ax.add_patch(Circle((x, y), width / 2, facecolor=CASTER, edgecolor=TIRE, linewidth=0.6))
            continue
        tire = (x - wheels.radius, y - width / 2), 2 * wheels.radius, width
        ax.add_patch(Rectangle(*tire, facecolor=TIRE, alpha=0.85))
        if isinstance(drive, Ackermann) and wheels.steering[number] >= 0:
            curvature, ahead = 1 / drive.min_radius(wheels), x - drive.pivot(wheels)
            angle = math.atan2(curvature * ahead, 1 - curvature * y)
            turned = Rectangle(*tire, fill=False, edgecolor=STEERED, linewidth=1.2)
            turned.set_transform(Affine2D().rotate_around(x, y, angle) + ax.transData)
            ax.add_patch(turned)


def _add_lidar(ax: Axes, robot: Robot, length: float) -> None:
    """Draws what the lidar sees: its angle, and a few beams as far as the picture goes."""
    x, y, _ = robot.lidar_position
    length, half = min(length, robot.lidar_range), robot.lidar_view / 2
    degrees = math.degrees(half)
    ax.add_patch(Wedge((x, y), length, -degrees, degrees, facecolor=LIDAR, alpha=0.07))
    for angle in np.linspace(-half, half, BEAMS + 1):
        ends = [x, x + length * math.cos(angle)], [y, y + length * math.sin(angle)]
        ax.plot(*ends, color=LIDAR, linewidth=0.5, alpha=0.5)


def _add_points(ax: Axes, robot: Robot, plane: tuple[int, int]) -> None:
    points = [("lidar", robot.lidar_position, "o", LIDAR), ("IMU", robot.imu_position, "s", IMU)]
    for label, place, marker, color in [*points, ("center of mass", robot.center_of_mass, "X", CENTER)]:
        x, y = (place[axis] for axis in plane)
        ax.plot([x], [y], marker, color=color, label=label, markersize=6, linestyle="none")
