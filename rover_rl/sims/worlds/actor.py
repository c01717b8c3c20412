"""Actors: moving figures of a world, with the waypoints of their path."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

Pose: TypeAlias = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Actor:
    """A moving figure and its waypoints, as an SDF file's ``<actor>`` defines them.

    Simulators do not move actors: a world keeps them for moving obstacles.

    Args:
        name: name of the actor.
        times: time of each waypoint after the start of the script, s, in ascending order.
        poses: pose of each waypoint in the world frame: x, y, z (m), roll, pitch, yaw (rad). The pose between two
            waypoints is interpolated.
        loop: whether the script starts again after the last waypoint.
        delay_start: time before the script starts, s.
        auto_start: whether the script starts by itself.

    Raises:
        ValueError: if there are not as many times as poses, or the times are not in order.
    """

    name: str
    times: tuple[float, ...] = ()
    poses: tuple[Pose, ...] = ()
    loop: bool = True
    delay_start: float = 0.0
    auto_start: bool = True

    def __post_init__(self) -> None:
        if len(self.times) != len(self.poses) or any(len(pose) != 6 for pose in self.poses):
            raise ValueError(f"actor {self.name!r} needs a pose of 6 numbers for each of its {len(self.times)} times")
        if any(b < a for a, b in zip(self.times, self.times[1:], strict=False)):
            raise ValueError(f"the times of actor {self.name!r} must be in ascending order, got {self.times}")
