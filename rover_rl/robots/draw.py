"""Picture of a robot: its outline, wheels, sensors and turning circle. Drawn with Matplotlib; needs no display."""

from __future__ import annotations

import math
from pathlib import Path

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
    """Draws a robot from above and from the side, and its turning circle.

    Args:
        robot: robot to draw.
        lines: text beside the pictures.
        path: path of the image file, whose suffix selects the format. ``None`` does not save the figure.

    Returns:
        The figure.
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
    outline = robot.footprint
    _add_boxes(ax, robot, (0, 1))
    _add_wheels(ax, robot)
    width, depth = outline.front - outline.back, outline.left - outline.right
    corner = (outline.back, outline.right)
    ax.add_patch(Rectangle(corner, width, depth, fill=False, edgecolor=OUTLINE, linewidth=1.4, label="footprint"))
    ax.add_patch(
        Circle(
            (0, 0), robot.radius, fill=False, edgecolor=OUTLINE, linestyle=(0, (4, 3)), label="disc that is kept free"
        )
    )
    half = (1 + MARGIN) * max(robot.radius, outline.corner)
    _add_lidar(ax, robot, 1.4 * half)
    _add_points(ax, robot, (0, 1))
    ax.annotate("", (0.3 * half, 0), (0, 0), arrowprops={"arrowstyle": "->", "color": EDGE})
    ax.set(xlim=(-1.6 * half, 1.6 * half), ylim=(-half, half), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    ax.set_title("from above", fontsize=10)
    ax.legend(loc="upper left", fontsize=7, framealpha=0.9)


def _draw_side(ax: Axes, robot: Robot) -> None:
    outline, wheels = robot.footprint, robot.wheels
    ax.axhline(0.0, color=EDGE, linewidth=1.0)
    _add_boxes(ax, robot, (0, 2))
    for name, (x, _, z) in zip(robot.drive.wheels, wheels.hubs, strict=True):
        color = CASTER if name in robot.drive.passive and isinstance(robot.drive, SkidSteer) else TIRE
        ax.add_patch(Circle((x, z), wheels.radius, facecolor=color, alpha=0.75))
    _add_points(ax, robot, (0, 2))
    z = robot.lidar_position[2]
    ax.axhline(z, color=LIDAR, linewidth=0.8, linestyle=(0, (2, 3)))
    half = (1 + MARGIN) * max(outline.half_length, robot.radius)
    top = max([z, *(center[2] + size[2] / 2 for center, size, _ in robot.boxes)])
    ax.set(xlim=(-1.6 * half, 1.6 * half), ylim=(-0.1 * half, top + 0.2 * half), xlabel="x (m)", ylabel="z (m)")
    ax.set_aspect("equal")
    ax.set_title("from the right, with the plane of the lidar", fontsize=10)


def _draw_turn(ax: Axes, robot: Robot) -> None:
    """Draws the sharpest turn: the way of the origin or of the rear axle, and the ground that the body covers."""
    outline, drive, wheels = robot.footprint, robot.drive, robot.wheels
    radius, rear = drive.min_radius(wheels), 0.0
    if isinstance(drive, Ackermann):
        rear = (wheels.hubs[0][0] + wheels.hubs[1][0]) / 2
    corners = [(x, y) for x in (outline.back, outline.front) for y in (outline.right, outline.left)]
    reach = [math.hypot(x - rear, radius - y) for x, y in corners]
    inner = max(radius - outline.left, 0.0)
    color = {"facecolor": TURN, "alpha": 0.18}
    ax.add_patch(Wedge((rear, radius), max(reach), 0, 360, width=max(reach) - inner, **color))
    if radius:
        ax.add_patch(Circle((rear, radius), radius, fill=False, edgecolor=TURN, linewidth=1.2))
        ax.plot([rear, rear], [radius, 0.0], color=TURN, linewidth=0.8, linestyle=(0, (4, 3)))
        ax.plot([rear], [radius], "+", color=CENTER)
    size = (outline.back, outline.right), outline.front - outline.back, outline.left - outline.right
    ax.add_patch(Rectangle(*size, facecolor=BODY, edgecolor=EDGE))
    _add_wheels(ax, robot)
    text = f"radius {radius:.2f} m" if radius else "turns in place"
    ax.set_title(f"sharpest turn: {text}, needs {2 * max(reach):.2f} m", fontsize=10)
    low, high = radius - 1.1 * max(reach), radius + 1.1 * max(reach)
    ax.set(xlim=(rear - 1.1 * max(reach), rear + 1.1 * max(reach)), ylim=(low, high), aspect="equal", xlabel="x (m)")


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
        corner = (x - wheels.radius, y - width / 2)
        ax.add_patch(Rectangle(corner, 2 * wheels.radius, width, facecolor=TIRE, alpha=0.85))
        if isinstance(drive, Ackermann) and wheels.steering[number] >= 0:
            curvature, rear = 1 / drive.min_radius(wheels), (wheels.hubs[0][0] + wheels.hubs[1][0]) / 2
            angle = math.atan2(curvature * (x - rear), 1 - curvature * y)
            turn = Affine2D().rotate_around(x, y, angle) + ax.transData
            turned = Rectangle(corner, 2 * wheels.radius, width, fill=False, edgecolor=STEERED, linewidth=1.2)
            turned.set_transform(turn)
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
    """Marks the lidar, the IMU and the center of mass."""
    points = {
        "lidar": (robot.lidar_position, "o", LIDAR),
        "IMU": (robot.imu_position, "s", IMU),
        "center of mass": (robot.center_of_mass, "X", CENTER),
    }
    for label, (place, marker, color) in points.items():
        x, y = (place[axis] for axis in plane)
        ax.plot([x], [y], marker, color=color, label=label, markersize=6, linestyle="none")
