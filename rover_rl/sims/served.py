"""What a simulated rover tells a node that publishes it on ROS 2."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal, NamedTuple, Protocol, TypeAlias

from torch import Tensor

from rover_rl.robots.footprint import Footprint
from rover_rl.sims.elevation_map import ElevationMap
from rover_rl.sims.rover_state import RoverState

ImageKind: TypeAlias = Literal["depth", "colors"]
"""What an image shows: distances along the optical axis, ``[rows, columns]``, m, or red, green and blue from 0 to 1,
``[3, rows, columns]``."""


class Report(NamedTuple):
    """What arrives from the sensors of one rover in a step.

    Attributes:
        time: time of the step, s.
        state: pose and velocities as the sensors tell them, ``[1]``, with the stamp of their time.
        ranges: scan, ``[beams]``, m; ``None`` if none has arrived.
        scan_stamp: time of the scan, s.
        images: images of each kind by the topic of the camera; ``None``: that of the connection.
        points: points of each 3D lidar in its frame, ``[planes, beams, 3]``, m, by its topic; NaN for no return.
        ground: elevation map of each height scan, by its topic.
        wheels: joints of the wheels whose motor torques ``state`` has. Empty: it has none.
        outline: outline of the robot, whose contact forces ``state`` has. ``None``: it has none.
    """

    time: float
    state: RoverState
    ranges: Tensor | None
    scan_stamp: float
    images: Mapping[ImageKind, Mapping[str | None, Tensor]] = MappingProxyType({})
    points: Mapping[str | None, Tensor] = MappingProxyType({})
    ground: Mapping[str | None, ElevationMap] = MappingProxyType({})
    wheels: tuple[str, ...] = ()
    outline: Footprint | None = None


class Served(Protocol):
    """One simulated rover.

    Attributes:
        control_dt: duration of a step, s.
    """

    control_dt: float

    def reset(self, pose: tuple[float, float, float]) -> None:
        """Moves the rover to a pose: x, y (m) and yaw (rad), at rest."""
        ...

    def move_to(self, pose: tuple[float, float, float]) -> None:
        """Does the same as :meth:`reset`; raises ``ValueError`` if the rover cannot stand there, and leaves it."""
        ...

    def step(self, command: tuple[float, float]) -> Report:
        """Takes a step with a command: forward speed, m/s, and yaw rate, rad/s."""
        ...
