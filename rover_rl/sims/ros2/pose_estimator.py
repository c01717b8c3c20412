"""Where a live rover is: put together from what tells its pose, and the IMU."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rover_rl.sims.ros2.messages import Message, Odometry, PoseArray, PoseStamped
from rover_rl.sims.ros2.pose_reset import Target
from rover_rl.sims.ros2.readings import Place, read_pose, read_pose_array
from rover_rl.sims.ros2.settings import PoseSource
from rover_rl.sims.rotations import quaternion_product, quaternion_to_euler

UPRIGHT = torch.tensor([0.0, 0.0, 0.0, 1.0])
"""An attitude: level, with yaw 0."""
NOWHERE = Place(torch.zeros(3), UPRIGHT)
"""A place before there are any."""
FACING = 0.3
"""How far from where it was put to face a rover may face, rad."""


class PoseMessage(NamedTuple):
    """A message that tells poses, and how it is read."""

    kind: type[Message]
    read: Callable[[Any], Place]


POSE_MESSAGES: dict[PoseSource, PoseMessage] = {
    "pose_array": PoseMessage(PoseArray, read_pose_array),
    "pose_stamped": PoseMessage(PoseStamped, lambda msg: read_pose(msg.pose)),
    "odometry": PoseMessage(Odometry, lambda msg: read_pose(msg.pose.pose)),
    "wheels": PoseMessage(Odometry, lambda msg: read_pose(msg.pose.pose)),
}


class PoseEstimator:
    """Turns poses and attitudes into the world's.

    Args:
        source: of the poses. Those of a pose array are the world's, as the IMU's heading is. A localiser knows the
            heading in its map, and the IMU how it changes between two poses. Wheels know neither: they have a frame of
            their own, which is laid into the world when an episode begins.
    """

    def __init__(self, source: PoseSource) -> None:
        self._source = source
        self._frame = _Frame()

    def located(self, place: Place, attitude: Tensor) -> Place:
        """A pose as it is kept: with how far its frame is turned from the IMU's, which just told ``attitude [4]``."""
        if self._source in ("pose_stamped", "odometry"):
            return place._replace(turn=_yaw(place.orientation) - _yaw(attitude))
        return place

    def of(self, place: Place, attitude: Tensor) -> tuple[Tensor, Tensor]:
        """Position ``[3]`` and orientation ``[4]`` in the world, from the newest pose and attitude."""
        if self._source == "wheels":
            return self._frame.position(place.position), _turned(attitude, self._frame.imu_turn)
        return place.position, _turned(attitude, place.turn) if place.turn else attitude

    def begin(self, place: Place, attitude: Tensor, target: Target | None, ground: float = 0.0) -> None:
        """An episode begins here: wheels take the present pose for ``target``, or their own for the world's.

        Args:
            place: the newest pose.
            attitude: of the IMU, ``[4]``.
            target: where the rover was put; ``None`` where nobody did.
            ground: height of the ground there, m.
        """
        wheels, imu = _yaw(place.orientation), _yaw(attitude)
        if target is None:
            self._frame = _Frame(imu_turn=wheels - imu)
        else:
            here = torch.tensor([target.x, target.y, ground])
            self._frame = _Frame(target.yaw - wheels, place.position, here, target.yaw - imu)

    def arrived(self, place: Place, target: Target, tolerance: float) -> bool:
        """Whether a pose is within ``tolerance`` (m) of ``target``, and faces as it; wheels alone cannot tell."""
        if self._source == "wheels":
            return True
        x, y, _ = place.position.tolist()
        near = math.hypot(x - target.x, y - target.y) <= tolerance
        away = 0.0 if place.orientation is None else _yaw(place.orientation) - target.yaw
        return near and abs(math.remainder(away, 2 * math.pi)) <= FACING


class _Frame(NamedTuple):
    """Where the wheels' frame lies in the world, and how far the IMU's north is turned from it, rad."""

    turn: float = 0.0
    origin: Tensor = torch.zeros(3)
    target: Tensor = torch.zeros(3)
    imu_turn: float = 0.0

    def position(self, wheels: Tensor) -> Tensor:
        """A position ``[3]`` of the wheels' in the world."""
        dx, dy, dz = (wheels - self.origin).tolist()
        cosine, sine = math.cos(self.turn), math.sin(self.turn)
        return self.target + torch.tensor([cosine * dx - sine * dy, sine * dx + cosine * dy, dz])


def _yaw(orientation: Tensor | None) -> float:
    """Of ``orientation [4]``, rad; 0 where there is none."""
    return 0.0 if orientation is None else quaternion_to_euler(orientation)[2].item()


def _turned(orientation: Tensor, yaw: float) -> Tensor:
    """``orientation [4]``, turned by ``yaw`` (rad) about the vertical."""
    return quaternion_product(torch.tensor([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]), orientation)
