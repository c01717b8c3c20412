"""What the sensors of a simulated rover report, for a node that publishes it on ROS 2."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple, Protocol, TypeAlias

import torch
from torch import Tensor

from rover_rl.robots import Robot
from rover_rl.sims.rover_state import RoverState

ImageKind: TypeAlias = Literal["depth", "colors"]
"""What an image shows: distances along the optical axis, ``[rows, columns]``, m, or red, green and blue from 0 to 1,
``[3, rows, columns]``."""


DeviceKind: TypeAlias = Literal["depth", "colors", "points"]


class Device(NamedTuple):
    """A camera or a 3D lidar of a simulated rover.

    ``topic`` is ``None`` for that of the connection. ``mount`` is in the frame of the robot, m; it looks to the left by
    ``yaw`` and down by ``pitch``, rad. ``size`` are rows and columns, and ``focal_length`` is in pixels.
    """

    kind: DeviceKind
    name: str
    topic: str | None
    mount: tuple[float, float, float]
    yaw: float
    pitch: float
    size: tuple[int, int]
    focal_length: float


class ElevationMap(NamedTuple):
    """Heights of the ground on a grid along the axes of a frame, in the order of ANYbotics' grid_map.

    ``heights`` are ``[rows, columns]``, m; NaN where none is known. The first row has the largest x, and the first
    column the largest y. ``center`` is the middle of the map, and ``cell`` the side of a cell, m.

    Example:
        >>> slope = ElevationMap(torch.tensor([[3.0, 3.0], [1.0, 1.0]]), (0.0, 0.0), cell=1.0)
        >>> slope.height_at(torch.tensor([[0.0, 0.25], [0.5, 0.0], [9.0, 0.0]]))
        tensor([2., 3., nan])
    """

    heights: Tensor
    center: tuple[float, float]
    cell: float
    layer: str = "elevation"

    def height_at(self, xy: Tensor) -> Tensor:
        """Returns the heights at points ``xy [..., 2]`` (m): ``[...]``; NaN in cells that are unknown or outside.

        Between the middles of cells, heights are interpolated linearly, without the neighbors that are unknown.
        """
        last = torch.tensor(self.heights.shape, device=xy.device) - 1
        place = (xy.new_tensor(self.center) - xy) / self.cell + last / 2
        own = place.round().long()
        known = ((own >= 0) & (own <= last)).all(-1) & ~self._nearest(own, last).isnan()
        total = weight = torch.zeros_like(place[..., 0])
        for corner in itertools.product((0, 1), repeat=2):
            index = place.floor().long() + torch.tensor(corner, device=xy.device)
            height = self._nearest(index, last)
            share = (1 - (place - index).abs()).prod(-1).masked_fill(height.isnan(), 0.0)
            total, weight = total + share * height.nan_to_num(), weight + share
        return (total / weight).masked_fill(~known, torch.nan)

    def _nearest(self, index: Tensor, last: Tensor) -> Tensor:
        return self.heights[tuple(index.clamp(torch.zeros_like(last), last).unbind(-1))]


class Variances(NamedTuple):
    """Mean squares of errors: of roll and pitch each, of the heading (rad^2), and of its rate (rad^2/s^2).

    Those of wheel velocities are relative to them: ``noise`` is drawn anew in each step, and ``scale`` stays.
    """

    tilt: float = 0.0
    heading: float = 0.0
    yaw_rate: float = 0.0
    noise: float = 0.0
    scale: float = 0.0


class SensorReport(NamedTuple):
    """What arrives from the sensors of one rover in a step.

    It has the time of the step (s), pose and velocities as the sensors tell them (``[1]``, with the stamp of their
    time), the scan (``[beams]``, m; ``None`` if none has arrived) and its time (s), images of each kind, points of each
    3D lidar in its frame (``[planes, beams, 3]``, m; NaN for no return) and an elevation map of each height scan, by
    the topic of the sensor. ``None`` is that of the connection. ``variances`` say how far off pose and velocities are.
    """

    time: float
    state: RoverState
    ranges: Tensor | None
    scan_stamp: float
    images: Mapping[ImageKind, Mapping[str | None, Tensor]] = MappingProxyType({})
    points: Mapping[str | None, Tensor] = MappingProxyType({})
    ground: Mapping[str | None, ElevationMap] = MappingProxyType({})
    variances: Variances = Variances()


class SimulatedRover(Protocol):
    """One simulated rover, whose steps last ``control_dt``, s. Poses are x, y (m) and yaw (rad)."""

    control_dt: float
    robot: Robot
    devices: tuple[Device, ...]

    def reset(self, pose: tuple[float, float, float]) -> None:
        """Moves the rover to a pose, at rest."""

    def move_to(self, pose: tuple[float, float, float]) -> None:
        """Does the same as :meth:`reset`; raises ``ValueError`` if the rover cannot stand there, and leaves it."""

    def step(self, command: tuple[float, float]) -> SensorReport:
        """Takes a step with a command: forward speed, m/s, and yaw rate, rad/s."""
