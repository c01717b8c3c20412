"""Maneuvers of robots that do not turn in place: arcs forward and backward, one or two of them.

A robot with a smallest turning radius reaches a place beside or behind it by driving back and forth, as J. A. Reeds and
L. A. Shepp describe without obstacles ("Optimal paths for a car that goes both forwards and backwards", Pacific Journal
of Mathematics 145, 1990). Here, the maneuvers are fixed: pairs of arcs of a few lengths and curvatures, in the frame of
the robot. Their poses are computed once. At each decision, those are dropped on which the body would touch something,
and the one that ends best is begun. What counts as best, a cost, is up to the planner.

Nothing is remembered: a robot that drives goes on in its direction unless a change of direction is worth its cost.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rover_rl.envs.config import HeadingGains
from rover_rl.sims.robots import Robot
from rover_rl.sims.robots.footprint import covering_discs, footprint

CURVATURES = 9  # number of curvatures of the first arc, evenly spaced
RESERVE = 1.08  # smallest radius of an arc, relative to the robot's, for what steering lags behind
PIECES, LONGEST = 6, 1.2  # number of poses of an arc, and its length, m; the radius, if that is longer
BRANCHES = (1, 3, 5)  # poses of a first arc of extreme or no curvature at which a second one begins
EXCESS = 0.03  # largest distance by which the discs that cover the footprint exceed its sides, m
SAFETY = 0.03  # distance of the discs below which a pose is not free, m
MARGIN, MARGIN_COST = 0.15, 0.6  # clearance below which an arc costs more, m, and cost without any, m
FORWARD, REVERSE = 0.97, 1.4  # cost of a meter forward, which lets the longest of equal arcs win, and backward, m
SWITCH = 0.4  # cost of a change between forward and backward, m
MOVING = 0.08  # speed above which a robot drives in a direction, m/s
BRAKING = 0.45  # time before the end of an arc in which the robot begins to slow down, s
SLOWEST, FASTEST_BACK = 0.2, 0.6  # lowest speed, and highest speed backward, m/s
PACE = 4.0  # speed that clearance beside the body permits beyond the lowest one, 1/s
ARC = 1.6  # cost of a meter of an arc that is yet to be driven in the way to a place, where obstacles may stop it
OBSTRUCTED = 2.0  # cost of a way to a place on which something is in the straight line, in smallest radii
INSIDE = 1.5  # cost of a place within the smallest turning circle, relative to half of that circle
_BLOCKED = 1e6  # cost of a pose that is not free, m
_FAR = 1e3  # coordinate of readings that hit nothing, m


class Poses(NamedTuple):
    """Poses that maneuvers end in, in the base frame of the robot as it is now.

    Attributes:
        x, y, heading: pose of the base frame, ``[M]``, m and rad.
        x_pivot, y_pivot: place of the pivot, ``[M]``, m.
        gear: direction in which the robot gets there, ``[M]``: 1 forward, -1 backward.
    """

    x: Tensor
    y: Tensor
    heading: Tensor
    x_pivot: Tensor
    y_pivot: Tensor
    gear: Tensor


class Maneuvers:
    """Maneuvers of a robot.

    Args:
        robot: robot that does not turn in place.
        device: device of the observations. ``None`` is the CPU.

    Attributes:
        radius: smallest radius of the arcs, m.
        poses: poses that the maneuvers end in.
    """

    def __init__(self, robot: Robot, device: torch.device | str | None = None) -> None:
        self._robot, self._pivot = robot, robot.drive.pivot(robot.wheels)
        self.radius = RESERVE * robot.drive.min_radius(robot.wheels)
        tree = _grow(self.radius, max(LONGEST, robot.drive.min_radius(robot.wheels)))
        self._tensors = {name: torch.from_numpy(value).to(device) for name, value in tree.items()}
        pivot = self._tensors["pose"].float()
        x, y, heading = pivot.unbind(-1)
        # The pivot starts at x = pivot in the base frame.
        base_x, base_y = x + self._pivot * (1 - heading.cos()), y - self._pivot * heading.sin()
        self.poses = Poses(base_x, base_y, heading, x + self._pivot, y, self._tensors["end_gear"])
        centers, size = covering_discs(robot, EXCESS)
        offsets = torch.from_numpy(centers).float().to(device)
        disc_x = base_x[:, None] + offsets * heading.cos()[:, None]
        disc_y = base_y[:, None] + offsets * heading.sin()[:, None]
        here = torch.stack((offsets, torch.zeros_like(offsets)), -1)
        self._discs = torch.cat((here, torch.stack((disc_x, disc_y), -1).flatten(0, 1)))
        self._count, self._size = len(offsets), size
        self._half_lane = footprint(robot).half_width + SAFETY

    def hits(self, lidar: Tensor, max_range: float) -> Tensor:
        """Returns the points that readings hit, in the base frame, ``[N, points, 2]``, m."""
        points = lidar.shape[-1]
        angles = (torch.arange(points, device=lidar.device) + 0.5) * (2 * math.pi / points)
        x = lidar * angles.cos() + self._robot.lidar_position[0]
        y = lidar * angles.sin() + self._robot.lidar_position[1]
        return torch.stack((x, y), -1).masked_fill((lidar >= max_range - 1e-3)[..., None], _FAR)

    def clearances(self, hits: Tensor) -> Tensor:
        """Returns the distance of the body from the nearest of ``hits``, now and in each pose, ``[N, 1 + M]``, m."""
        # Alone, a row has the same distances whatever the others are, and on a CPU they fit into its cache.
        size = 1 if hits.device.type == "cpu" else 64
        nearest = torch.cat([torch.cdist(self._discs, part).amin(-1) for part in hits.split(size)])
        return nearest.unflatten(-1, (-1, self._count)).amin(-1) - self._size

    def blocked(self, hits: Tensor, place: Tensor) -> Tensor:
        """Returns whether hits are in the lane from each pose straight to a place ``[N, 2]`` (m): bool ``[N, M]``."""
        way_x, way_y = place[:, :1] - self.poses.x, place[:, 1:] - self.poses.y
        length = torch.hypot(way_x, way_y).clamp(min=1e-6)
        way_x, way_y = way_x / length, way_y / length
        past, beside = way_x * self.poses.x + way_y * self.poses.y, way_x * self.poses.y - way_y * self.poses.x
        (x, y), (way_x, way_y) = hits[:, None].unbind(-1), (way_x[..., None], way_y[..., None])
        ahead, aside = way_x * x + way_y * y - past[..., None], way_x * y - way_y * x - beside[..., None]
        return ((ahead > 0) & (ahead < length[..., None]) & (aside.abs() < self._half_lane)).any(-1)

    def free(self, clearances: Tensor) -> Tensor:
        """Returns which poses are free, as all on the way to them are, bool ``[N, M]``.

        A body that is too close already may move as long as it does not get closer.
        """
        least = (clearances[:, :1] - 0.001).clamp(max=SAFETY)
        return self._on_the_way(clearances[:, 1:] >= least)

    def choose(self, cost: Tensor, free: Tensor, clearances: Tensor, speed: Tensor) -> Tensor:
        """Returns the actions that begin the best maneuvers, ``[N, 2]``: speed (m/s) and heading offset (rad).

        Args:
            cost: cost of what remains from each pose, ``[N, M]``, m.
            free: poses that are free with all on the way, bool ``[N, M]``.
            clearances: see :meth:`clearances`.
            speed: forward speed of the robot, ``[N, 1]``, m/s.
        """
        tree = self._tensors
        total = cost + tree["cost"]
        switches = (speed.abs() > MOVING) & (speed.sign() != tree["gear"])
        total = total + SWITCH * switches
        near = (1 - (clearances[:, 1:] - SAFETY) / MARGIN).clamp(0, 1)
        total = total + MARGIN_COST * near
        total = torch.where(free, total, total + _BLOCKED)
        best = total.argmin(-1, keepdim=True)
        gear, curvature, length = (tree[name][best] for name in ("gear", "curvature", "length"))
        drive = self._robot.drive
        fastest = torch.where(gear > 0, drive.max_speed, min(FASTEST_BACK, drive.max_speed))
        pace = torch.minimum((length / BRAKING).clamp(min=SLOWEST), fastest)
        beside = torch.minimum(clearances[:, :1], clearances[:, 1:].gather(-1, best))
        pace = torch.minimum(pace, (SLOWEST + PACE * (beside - SAFETY)).clamp(min=SLOWEST))
        blocked = total.gather(-1, best) >= _BLOCKED
        forward = gear * torch.where(blocked, SLOWEST, pace)
        offset = (forward * curvature / HeadingGains.kp).clamp(-math.pi, math.pi)
        return torch.cat((forward, offset), -1)

    def towards(self, place: Tensor, length: Tensor, lidar: Tensor, max_range: float, speed: Tensor) -> Tensor:
        """Returns the actions of robots that drive to places among what their lidars see, ``[N, 2]``.

        Args:
            place: places in the base frame, ``[N, 2]``, m.
            length: lengths of the whole routes, ``[N, 1]``, m: a long one is better driven forward.
            lidar: lidar readings, ``[N, points]``, m.
            max_range: reading from which on nothing is there, m.
            speed: forward speed of the robot, ``[N, 1]``, m/s.
        """
        hits = self.hits(lidar, max_range)
        clearances = self.clearances(hits)
        cost = cost_to_place(self.poses, self.radius, place, length)
        cost = cost + OBSTRUCTED * self.radius * self.blocked(hits, place)
        return self.choose(cost, self.free(clearances), clearances, speed)

    def _on_the_way(self, free: Tensor) -> Tensor:
        """Returns which poses are free with all poses on the way to them, of which poses are, bool ``[N, M]``."""
        first, rest = free[:, : self._first], free[:, self._first :]
        first = first.unflatten(-1, (-1, PIECES)).cummin(-1).values.flatten(1)
        before = first[:, self._tensors["begin"]][..., None]
        rest = rest.unflatten(-1, (before.shape[1], -1, PIECES)).cummin(-1).values.flatten(2)
        return torch.cat((first, (rest & before).flatten(1)), -1)

    @property
    def _first(self) -> int:
        return 2 * CURVATURES * PIECES


def _grow(radius: float, longest: float) -> dict[str, np.ndarray]:
    """Returns the maneuvers: for each pose of the pivot ``[M, 3]``, the cost and the first arc that leads to it."""
    steps = longest / PIECES * np.arange(1, PIECES + 1)
    gears, curvatures = np.meshgrid((1.0, -1.0), np.linspace(-1, 1, CURVATURES) / radius, indexing="ij")
    gear, curvature = gears.ravel(), curvatures.ravel()
    first = _arc(np.zeros((len(gear), 1, 3)), gear[:, None], curvature[:, None], steps)
    effort = np.where(gear > 0, FORWARD, REVERSE)
    turned = 0.05 * np.abs(curvature) * radius
    cost = effort[:, None] * steps + turned[:, None]
    of_first = (np.repeat(value, PIECES) for value in (gear, curvature))
    rows = {
        "end_gear": [np.repeat(gear, PIECES)],
        "gear": [next(of_first)],
        "curvature": [next(of_first)],
        "length": [np.tile(steps, len(gear))],
    }
    poses, costs = [first.reshape(-1, 3)], [cost.ravel()]
    sharp = np.flatnonzero(np.isin(np.arange(len(gear)) % CURVATURES, (0, CURVATURES // 2, CURVATURES - 1)))
    begins = [(arc, at) for arc in sharp for at in BRANCHES]
    again = np.array([(side, bend / radius) for side in (1.0, -1.0) for bend in (-1.0, 0.0, 1.0)])
    for arc, at in begins:
        start = np.broadcast_to(first[arc, at], (len(again), 1, 3))
        poses.append(_arc(start, again[:, :1], again[:, 1:], steps).reshape(-1, 3))
        switch = SWITCH * (again[:, :1] != gear[arc])
        costs.append((cost[arc, at] + switch + np.where(again[:, :1] > 0, FORWARD, REVERSE) * steps).ravel())
        size = len(again) * PIECES
        # A robot that goes on in its direction does not slow down where the arcs meet.
        through = np.where(again[:, :1] == gear[arc], steps, 0.0).ravel()
        rows["end_gear"].append(np.repeat(again[:, 0], PIECES))
        rows["gear"].append(np.full(size, gear[arc]))
        rows["curvature"].append(np.full(size, curvature[arc]))
        rows["length"].append(steps[at] + through)
    tree = {name: np.concatenate(values).astype(np.float32) for name, values in rows.items()}
    begin = np.array([arc * PIECES + at for arc, at in begins])
    return {**tree, "pose": np.concatenate(poses), "cost": np.concatenate(costs).astype(np.float32), "begin": begin}


def _arc(start: np.ndarray, gear: np.ndarray, curvature: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Returns the poses after ``steps [K]`` (m) of arcs from poses ``start [B, 1, 3]``: ``[B, K, 3]``."""
    way = gear * steps
    x, y, heading = (part[..., 0] for part in np.split(start, 3, -1))
    turn = way * curvature
    # The chord of an arc has the mean of its headings.
    chord = way * np.sinc(turn / (2 * np.pi))
    middle = heading + turn / 2
    return np.stack(np.broadcast_arrays(x + chord * np.cos(middle), y + chord * np.sin(middle), heading + turn), -1)


def cost_to_place(poses: Poses, radius: float, place: Tensor, length: Tensor) -> Tensor:
    """Returns the cost of the way from poses to places in the base frame ``[N, 2]`` (m): ``[N, M]``, m.

    The way is an arc of the smallest radius and its tangent, as short as without obstacles, forward or backward.
    ``length [N, 1]`` (m) is that of the whole route: a long one is better driven forward.
    """
    dx, dy = place[:, :1] - poses.x_pivot, place[:, 1:] - poses.y_pivot
    cos, sin = poses.heading.cos(), poses.heading.sin()
    ahead, aside = dx * cos + dy * sin, (dy * cos - dx * sin).abs()
    forward = _arc_and_tangent(ahead, aside, radius) + SWITCH * (poses.gear < 0)
    backward = REVERSE * _arc_and_tangent(-ahead, aside, radius) + SWITCH * (poses.gear > 0)
    return torch.minimum(forward, backward + (REVERSE - 1) * length.clamp(0, 6))


def _arc_and_tangent(ahead: Tensor, aside: Tensor, radius: float) -> Tensor:
    """Returns the cost of the way to places, ``ahead`` and ``aside`` of a pose."""
    across = aside - radius
    distance = torch.hypot(ahead, across)
    tangent = (distance.square() - radius**2).clamp(min=0).sqrt()
    # Angle of the arc: of the place around the center of the turn, less that of the tangent.
    angle = torch.atan2(ahead, -across) - torch.acos((radius / distance.clamp(min=1e-6)).clamp(max=1))
    angle = angle.remainder(2 * math.pi)
    # Rounding may turn no angle into a whole turn.
    angle = torch.where(angle > 2 * math.pi - 1e-3, 0.0, angle)
    inside = INSIDE * math.pi * radius + torch.hypot(ahead, aside)
    return torch.where(distance < radius, inside, ARC * radius * angle + tangent)


def _corners(route: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """Returns distance (m) and angle (rad) of both corners of routes, ``[N, 1]`` each."""
    columns = [*route.split(1, -1)]
    return columns[:2], columns[2:4]


def way_point(route: Tensor, ahead: Tensor | float) -> Tensor:
    """Returns the place on routes ``[N, 5]`` at most ``ahead`` (m) along them, in the base frame: ``[N, 2]``, m."""
    first, second = (distance * torch.cat((angle.cos(), angle.sin()), -1) for distance, angle in _corners(route))
    left = (ahead - route[:, :1]).clamp(min=0)
    leg = second - first
    share = (left / leg.norm(dim=-1, keepdim=True).clamp(min=1e-6)).clamp(max=1)
    near = first * (ahead / route[:, :1].clamp(min=1e-6)).clamp(max=1)
    return near + share * leg
