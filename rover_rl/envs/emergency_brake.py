"""``EmergencyBrake``: limits the speed so that a rover stops before what its scan shows in its way."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rover_rl.envs.config import GuardConfig
from rover_rl.envs.stages import SensorDelays, Stage, StepState
from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet
from rover_rl.robots.turning import estimated_yaw_gain

SPACING = 0.08
"""Distance of the places along the arc at which the outline is tested, m."""
TIGHTEST = 0.25
"""Smallest radius of an arc, m. On tighter ones, the rover turns rather than drives."""


class EmergencyBrake(Stage):
    """Limits speeds: see :class:`~rover_rl.envs.config.GuardConfig`.

    The brake sees what the scan sees, by beams of some ``angles`` ``[beams]`` (rad), and late if there are ``delays``.
    It does not keep the corners of a rover that turns on the spot from obstacles. What is within the outline already
    does not count, so that a rover in contact can leave. ``acts`` says whether it lowered the last speeds, bool
    ``[N, 1]``.
    """

    def __init__(self, config: GuardConfig, fleet: Fleet, angles: Tensor, delays: SensorDelays | None = None) -> None:
        self._config, self._fleet, self._delays, self.acts = config, fleet, delays, torch.tensor(False)
        self._table = fleet.table(self._numbers)
        device = fleet.index.device
        self._beams = torch.stack((angles.cos(), angles.sin()), -1).float().to(device)
        # As far as the fastest of them needs to stop.
        speed = max(robot.drive.max_speed for robot in fleet.robots)
        stop = config.reaction + speed / config.deceleration
        reach = speed * (config.reaction + stop) / 2 + config.approach * stop
        self._way = torch.arange(1, math.ceil(reach / SPACING) + 2, device=device) * SPACING

    def _numbers(self, robot: Robot) -> list[float]:
        """Returns back, front and half the width of the outline with the margin, place of the lidar, and yaw gain."""
        outline, margin = robot.footprint, self._config.margin
        size = [outline.back - margin, outline.front + margin, outline.half_width + margin]
        return [*size, *robot.lidar_position[:2], estimated_yaw_gain(robot)]

    def command(self, command: Tensor, state: StepState) -> Tensor:
        config, speed, ranges = self._config, command[:, :1], state.sensed.ranges
        if self._delays is not None:
            ranges = self._delays.late("scan", ranges, state.steps, self._delays.scan)
        free = self._free_way(speed, command[:, 1:2], ranges)
        # The braking distance, solved for the speed.
        reach = config.deceleration * config.reaction + config.approach
        rest = 2 * config.deceleration * (free - config.approach * config.reaction).clamp(min=0)
        most = (reach * reach + rest).sqrt() - reach
        self.acts = speed.abs() > most
        return torch.cat((torch.clamp(speed, -most, most), command[:, 1:]), -1)

    def _free_way(self, speed: Tensor, yaw_rate: Tensor, ranges: Tensor) -> Tensor:
        """Returns how far the outline can go along the arc of the command, ``[N, 1]``, m; ``inf`` beyond the places."""
        back, front, side, ahead, left, gain = self._table[self._fleet.index].split(1, -1)
        points = ranges[..., None] * self._beams + torch.stack((ahead, left), -1)
        # A rover that slips turns less than it is told.
        turn = gain * yaw_rate / speed.abs().clamp(min=1e-3)
        curvature = turn.clamp(-1 / TIGHTEST, 1 / TIGHTEST)
        way, forward = self._way, torch.where(speed < 0, -1.0, 1.0)
        turned = curvature * way
        # Position after a way s on an arc: sin(c s) / c and (1 - cos(c s)) / c.
        half = turned / 2
        chord = way * torch.sinc(half / torch.pi)
        x, y = forward * chord * half.cos(), forward * chord * half.sin()
        dx, dy = points[:, None, :, 0] - x[..., None], points[:, None, :, 1] - y[..., None]
        cos, sin = turned.cos()[..., None], turned.sin()[..., None]
        px, py = cos * dx + sin * dy, cos * dy - sin * dx

        def within(px: Tensor, py: Tensor, outline: tuple[Tensor, Tensor, Tensor]) -> Tensor:
            return (px > outline[0]) & (px < outline[1]) & (py.abs() < outline[2])

        start = within(points[..., 0], points[..., 1], (back, front, side))
        met = within(px, py, (back[..., None], front[..., None], side[..., None])) & ~start[:, None]
        blocked = met.any(-1)
        first = blocked.to(torch.uint8).argmax(-1, keepdim=True)
        return torch.where(blocked.any(-1, keepdim=True), first * SPACING, torch.inf)
