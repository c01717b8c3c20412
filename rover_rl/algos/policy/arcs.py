"""Driving in arcs: robots that do not turn in place, among what their lidars see.

A robot with a smallest turning radius reaches a place beside or behind it by driving back and forth, as J. A. Reeds and
L. A. Shepp describe without obstacles ("Optimal paths for a car that goes both forwards and backwards", Pacific Journal
of Mathematics 145, 1990). Here, it begins the arc from whose end the way to the place is the shortest, of a few
curvatures, forward and backward, as long as the body touches nothing on them. The free length of an arc is exact for
a rectangular body and points. Nothing is remembered: a robot that drives goes on in its direction unless a change of
direction is worth its cost. All functions take robots of different size, a row each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from rover_rl.envs.config import HeadingGains
from rover_rl.envs.sensors.robot import RobotNumbers
from rover_rl.envs.sensors.standard import seen_from_now
from rover_rl.robots.robot import FULL_VIEW
from rover_rl.rotations import angle_of

RESERVE = 1.08  # smallest radius of an arc, relative to the robot's, for what steering lags behind
RADII = (1.0, 2.0, 4.0)  # radii of arcs, in smallest ones
LONGEST = 1.2  # length of the arcs that are compared, m; the radius, if that is longer
ENDS = (0.25, 0.5, 1.0)  # shares of this length after which an arc may end
SAFETY = 0.08  # distance that the body keeps, m
MARGIN, MARGIN_COST = 0.15, 0.6  # distance below which an arc costs more, m, and cost, m
FORWARD = 0.97  # cost of a meter forward, which lets the longest of equal arcs win, m
REVERSE, BLIND = 1.4, 10.0  # cost of a meter backward, and of one to where the lidar does not see, m
SWITCH = 0.4  # cost of a change between forward and backward, m
MOVING = 0.08  # speed above which a robot drives in a direction, m/s
BRAKING, DECELERATION = 0.8, 0.8  # time (s) and deceleration (m/s^2) with which it can stop at the end of an arc
SIDEWAYS = 3.0  # largest acceleration to the side, m/s^2
SLOWEST, FASTEST_BACK = 0.2, 0.6  # lowest speed, and highest speed backward, m/s
PACE = 4.0  # speed that clearance beside the body permits beyond the lowest one, 1/s
ARC = 1.6  # cost of a meter of an arc that is yet to be driven in the way to a place, where obstacles may stop it
OBSTRUCTED = 2.0  # cost of a way to a place on which something is in the straight line, in smallest radii
INSIDE = 1.5  # cost of a place within the smallest turning circle, relative to half of that circle
LEAD, LONGEST_LEAD = 0.3, 0.3  # time (s) and longest way (m) in which a robot goes on as it does before it is on an arc
POINTS = 64  # number of readings that arcs keep free of, each the nearest of its neighbors
_BLOCKED = 1e6  # cost of an arc that is not free, m
_TURN = 2 * math.pi


def hit_points(
    lidar: Tensor, lidar_offset: Tensor | float, middle: float = 0.5, scan_pose: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Returns x and y of the points that readings of a lidar hit, in the base frame, ``[..., points]`` each, m.

    Args:
        lidar: lidar readings, ``[..., points]``, m.
        lidar_offset: distance of the lidar in front of the base, m.
        middle: where in its segment a reading is taken to come from, a share of the segment.
        scan_pose: where the scan was taken, ``[..., 6]``: see :class:`~rover_rl.envs.sensors.standard.ScanPose`.
            ``None``: where the rover is.
    """
    points = lidar.shape[-1]
    angles = (torch.arange(points, dtype=lidar.dtype, device=lidar.device) + middle) * (2 * math.pi / points)
    return seen_from_now(lidar * angles.cos() + lidar_offset, lidar * angles.sin(), scan_pose)


class Body(NamedTuple):
    """Robots in the frame of the pivot, ``[N, 1]`` each, m and m/s.

    The pivot is the middle of the rear axle, ``behind`` and ``ahead`` the reach of the footprint from there, ``radius``
    the smallest one of its arcs, and ``reverse`` the cost of a meter backward.
    """

    behind: Tensor
    ahead: Tensor
    half_width: Tensor
    radius: Tensor
    pivot: Tensor
    max_speed: Tensor
    reverse: Tensor

    @classmethod
    def of(cls, robot: RobotNumbers) -> Body:
        # One that turns in place has some small radius.
        return cls(
            behind=robot.behind + robot.pivot,
            ahead=robot.ahead - robot.pivot,
            half_width=robot.half_width,
            radius=RESERVE * robot.min_radius.clamp(min=0.1),
            pivot=robot.pivot,
            max_speed=robot.max_speed,
            reverse=torch.where(robot.lidar_view > FULL_VIEW, REVERSE, BLIND),
        )


def all_arcs(device: torch.device) -> tuple[Tensor, Tensor]:
    """Returns the arcs of the pivot, the same for all robots, ``[A]`` each: gear (1 forward, -1 back), curvature (1/R).

    They are straight lines, left and right arcs, forward and backward, in the order of :func:`free_lengths`.
    """
    bends = [0.0, *(side / radius for radius in RADII for side in (1.0, -1.0))]
    gears = torch.tensor([1.0, -1.0], device=device).repeat(len(bends))
    return gears, torch.tensor(bends, device=device).repeat_interleave(2)


def free_lengths(x: Tensor, y: Tensor, body: Body, margin: float) -> Tensor:
    """Returns the lengths of :func:`all_arcs` that are free of points for robots, ``[N, A]``, m.

    On an arc around a center C, a point turns around C in the frame of the body, at a distance d. It enters the
    rectangle through the side at C or the front, ``min(acos((R - w) / d), asin(F / d))`` ahead of the pivot, or through
    the other side behind the pivot, ``acos((R + w) / d)`` behind it, with half the width w and the reach F ahead.

    Args:
        x, y: points in the frame of the pivot, ``[N, P]``, m.
        body: robots.
        margin: distance that the body keeps, m. A point that is closer may get no closer.
    """
    gap = torch.maximum(y.abs() - body.half_width, torch.maximum(x - body.ahead, -body.behind - x))
    kept = (0.9 * gap).clamp(max=margin)
    wide, ahead, behind = body.half_width + kept, body.ahead + kept, body.behind + kept
    solid = gap > 0
    beside = solid & (y.abs() < wide)
    straight = (
        (x - ahead).masked_fill(~beside | (x < 0), math.inf).amin(-1),
        (-x - behind).masked_fill(~beside | (x > 0), math.inf).amin(-1),
    )
    # Bent arcs, [N, B, P] each: with each radius, to the left and to the right. Tensors of constants would have to be
    # copied from the host to a GPU.
    x, solid, wide, ahead, behind = (part[:, None] for part in (x, solid, wide, ahead, behind))
    radius = torch.stack([ratio * body.radius for ratio in RADII for _ in ("left", "right")], 1)
    aside = radius - torch.stack((y, -y) * len(RADII), 1)
    distance = _length(x, aside).clamp(min=1e-6)
    angle = angle_of(torch.stack((aside, x.expand_as(aside)), -1))
    inner, outer = radius - wide, radius + wide
    at_side = (inner / distance).clamp(-1, 1).acos()
    at_other = -(outer / distance).clamp(max=1).acos()
    reached = solid & (distance > inner)
    swung = solid & (distance > outer)
    bent = []
    for gear, front, back in ((1.0, ahead, behind), (-1.0, behind, ahead)):
        entry = torch.minimum(at_side, (front / distance).clamp(max=1).asin())
        turn = (gear * angle - entry).remainder(_TURN)
        turn = turn.masked_fill(~reached | (distance > _length(front, outer)), _TURN)
        swing = (gear * angle - at_other).remainder(_TURN)
        swing = swing.masked_fill(~swung | (distance > _length(back, outer)), _TURN)
        bent.append((radius * torch.minimum(turn, swing)).amin(-1))
    return torch.cat((torch.stack(straight, -1), torch.stack(bent, -1).flatten(1)), -1)


def drive_to(
    place: Tensor,
    length: Tensor,
    lidar: Tensor,
    velocities: Tensor,
    robot: RobotNumbers,
    scan_pose: Tensor | None = None,
) -> Tensor:
    """Returns the actions of robots that drive to places, ``[N, 2]``: forward speed (m/s) and heading offset (rad).

    Args:
        place: places in the base frame, ``[N, 2]``, m.
        length: lengths of the whole routes, ``[N, 1]``, m: a long one is better driven forward.
        lidar: lidar readings, ``[N, points]``, m. What no beam covers is taken to be free.
        velocities: forward speed (m/s) and yaw rate (rad/s) of the robots, ``[N, 2]``.
        robot: values of the sensor ``robot``, ``[N, 1]`` each.
        scan_pose: where the scan was taken, ``[N, 6]``. ``None``: where the rover is.
    """
    points = lidar.shape[-1]
    if points > POINTS and points % POINTS == 0:
        lidar = lidar.unflatten(-1, (POINTS, points // POINTS)).amin(-1)
    x, y = hit_points(lidar, robot.lidar_x, scan_pose=scan_pose)
    return drive_among(place, length, x, y, velocities, Body.of(robot))


def drive_among(place: Tensor, length: Tensor, x: Tensor, y: Tensor, velocities: Tensor, body: Body) -> Tensor:
    """Does what :func:`drive_to` does among points in the base frame, ``x`` and ``y [N, P]``, m."""
    gears, bends = all_arcs(x.device)
    # Until the wheels have turned, the robot goes on as it does: the arcs begin where it is then.
    speed = velocities[:, :1]
    lead = (LONGEST_LEAD / speed.abs().clamp(min=1e-3)).clamp(max=LEAD)
    turned = lead * velocities[:, 1:]
    way = lead * speed * torch.sinc(turned / _TURN)
    moved = body.pivot + way * (turned / 2).cos(), way * (turned / 2).sin()
    x, y = _in_frame(x, y, *moved, turned)
    place = torch.cat(_in_frame(place[:, :1], place[:, 1:], *moved, turned), -1)
    free = free_lengths(x, y, body, SAFETY)
    longest = body.radius.clamp(min=LONGEST)
    ends = torch.tensor(ENDS, device=x.device) * longest  # [N, E]
    driven = torch.minimum(ends[:, None], free[..., None])  # [N, A, E]
    curvature = bends / body.radius  # [N, A]
    effort = torch.where(gears > 0, FORWARD, body.reverse)[..., None]
    cost = effort * driven + _way(driven, gears, curvature, place, length, x, y, body)
    cost = cost + 0.05 * bends.abs()[:, None] * driven
    near = free_lengths(x, y, body, MARGIN)[..., None] < driven
    cost = cost + MARGIN_COST * near
    switches = (speed.abs() > MOVING) & (speed.sign() != gears)
    cost = cost + SWITCH * switches[..., None]
    cost, _ = (cost + _BLOCKED * (driven < 0.03)).min(-1)
    best = cost.argmin(-1, keepdim=True)
    gear, bend = gears[best], curvature.gather(-1, best)
    room = free.gather(-1, best)
    fastest = torch.where(gear > 0, body.max_speed, body.max_speed.clamp(max=FASTEST_BACK))
    pace = torch.minimum(room / BRAKING, (2 * DECELERATION * room.clamp(min=0)).sqrt())
    pace = torch.minimum(pace, (SIDEWAYS / bend.abs().clamp(min=1e-3)).sqrt())
    gap = torch.maximum(y.abs() - body.half_width, torch.maximum(x - body.ahead, -body.behind - x))
    pace = torch.minimum(pace, SLOWEST + PACE * (gap.amin(-1, keepdim=True) - SAFETY).clamp(min=0))
    pace = torch.minimum(pace.clamp(min=SLOWEST), fastest)
    forward = gear * torch.where(cost.gather(-1, best) >= _BLOCKED, SLOWEST, pace)
    return torch.cat((forward, (forward * bend / HeadingGains.kp).clamp(-math.pi, math.pi)), -1)


def _length(x: Tensor, y: Tensor) -> Tensor:
    # torch.hypot, which ONNX does not have.
    return (x.square() + y.square()).sqrt()


def _in_frame(x: Tensor, y: Tensor, x_frame: Tensor, y_frame: Tensor, heading: Tensor) -> tuple[Tensor, Tensor]:
    x, y, cos, sin = x - x_frame, y - y_frame, heading.cos(), heading.sin()
    return x * cos + y * sin, y * cos - x * sin


def _way(
    driven: Tensor, gear: Tensor, curvature: Tensor, place: Tensor, length: Tensor, x: Tensor, y: Tensor, body: Body
) -> Tensor:
    """Returns the cost of the way from the ends of arcs to places in the frame of the pivot, ``[N, A, E]``, m."""
    way = gear[:, None] * driven
    heading = way * curvature[..., None]
    chord = way * torch.sinc(heading / _TURN)
    x_end, y_end = chord * (heading / 2).cos(), chord * (heading / 2).sin()
    dx, dy = place[:, None, :1] - x_end, place[:, None, 1:] - y_end
    cos, sin = heading.cos(), heading.sin()
    ahead, aside = dx * cos + dy * sin, (dy * cos - dx * sin).abs()
    radius, gear = body.radius[..., None], gear[:, None]
    forward = _arc_and_tangent(ahead, aside, radius) + SWITCH * (gear < 0)
    reverse = body.reverse[..., None]
    backward = reverse * _arc_and_tangent(-ahead, aside, radius) + SWITCH * (gear > 0)
    cost = torch.minimum(forward, backward + (reverse - 1) * length.clamp(0, 6)[..., None])
    return cost + OBSTRUCTED * radius * _obstructed(x_end, y_end, dx, dy, x, y, body.half_width)


def _obstructed(
    x_end: Tensor, y_end: Tensor, dx: Tensor, dy: Tensor, x: Tensor, y: Tensor, half_width: Tensor
) -> Tensor:
    """Returns whether points are in the lane straight from ends of arcs to places, bool ``[N, A, E]``."""
    length = _length(dx, dy).clamp(min=1e-6)
    ux, uy = dx / length, dy / length
    past, beside = ux * x_end + uy * y_end, ux * y_end - uy * x_end
    x, y = x[:, None, None], y[:, None, None]
    ahead = ux[..., None] * x + uy[..., None] * y - past[..., None]
    aside = ux[..., None] * y - uy[..., None] * x - beside[..., None]
    lane = half_width[..., None, None] + SAFETY
    return ((ahead > 0) & (ahead < length[..., None]) & (aside.abs() < lane)).any(-1)


def _arc_and_tangent(ahead: Tensor, aside: Tensor, radius: Tensor) -> Tensor:
    """Returns the cost of the way to places, ``ahead`` and ``aside`` of a pose: an arc and its tangent."""
    across = aside - radius
    distance = _length(ahead, across)
    tangent = (distance.square() - radius.square()).clamp(min=0).sqrt()
    # Angle of the arc: of the place around the center of the turn, less that of the tangent.
    angle = angle_of(torch.stack((-across, ahead), -1)) - torch.acos((radius / distance.clamp(min=1e-6)).clamp(max=1))
    angle = angle.remainder(_TURN)
    # Rounding may turn no angle into a whole turn.
    angle = torch.where(angle > _TURN - 1e-3, 0.0, angle)
    inside = INSIDE * math.pi * radius + _length(ahead, aside)
    return torch.where(distance < radius, inside, ARC * radius * angle + tangent)
