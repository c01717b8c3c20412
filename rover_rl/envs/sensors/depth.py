"""Depth camera, without a renderer: a ray for each pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from rover_rl.checks import MAX_COUNT, check_at_least, check_positive
from rover_rl.envs.sensors.base import Sensor, SensorInput
from rover_rl.envs.specs import Bounds

MAX_RANGE = 1000.0
"""Largest range of a camera, m."""


@dataclass(frozen=True, kw_only=True)
class DepthCamera(Sensor):
    """Depth image of a pinhole camera, ``[N, rows * columns]``, m: distances along the optical axis.

    The image has square pixels, its first row above and its first column on the left. It shows ground, obstacles,
    movers and the other rovers of a group, but not the robot itself. A pixel without a return reads ``max_range``, and
    one closer than ``min_range`` or lost reads 0, as those of most cameras do.

    The noise is that of stereo and structured light, whose standard deviation grows with the square of the depth
    (K. Khoshelham and S. O. Elberink, "Accuracy and resolution of Kinect depth data for indoor mapping applications",
    Sensors 12, 2012).

    Args:
        name, period: as for :class:`~rover_rl.Sensor`.
        size: numbers of rows and columns.
        field_of_view: horizontal field of view, rad.
        mount: position in the frame of the robot, whose origin is on the ground and whose axes point forward, left and
            up, m.
        pitch: angle by which the camera looks down, rad.
        yaw: angle by which it looks to the left, rad.
        min_range, max_range: least and largest depth, m.
        noise: standard deviation of the depth at 1 m, m.
        dropout: fraction of the pixels that are lost.

    Raises:
        ValueError: if a setting is out of range.

    Example:
        >>> env = RoverEnv(world_n="moon", num_envs=2, seed=0, sensors=[DepthCamera(size=(16, 24))])
        >>> env.reset()["depth"].unflatten(-1, (16, 24)).shape
        torch.Size([2, 16, 24])
    """

    name: str = "depth"
    size: tuple[int, int] = (64, 64)
    field_of_view: float = math.radians(87)
    mount: tuple[float, float, float] = (0.25, 0.0, 0.3)
    pitch: float = math.radians(15)
    yaw: float = 0.0
    min_range: float = 0.1
    max_range: float = 8.0
    noise: float = 0.0
    dropout: float = 0.0
    delayed = "scan"

    def __post_init__(self) -> None:
        super().__post_init__()
        rows, columns = self.size
        check_at_least(1, MAX_COUNT, rows=rows, columns=columns)
        check_positive(MAX_RANGE, max_range=self.max_range)
        if not 0 < self.field_of_view < math.pi:
            raise ValueError(f"field_of_view must be between 0 and pi, got {self.field_of_view}")
        if not 0 <= self.min_range < self.max_range:
            raise ValueError(f"min_range must be from 0 to below max_range={self.max_range}, got {self.min_range}")
        if not (self.noise >= 0 and 0 <= self.dropout <= 1):
            raise ValueError(
                f"noise must be at least 0 and dropout between 0 and 1, got {self.noise} and {self.dropout}"
            )

    @property
    def bounds(self) -> Bounds:
        """Bounds of the depths, m."""
        count = self.size[0] * self.size[1]
        return Bounds((0.0,) * count, (self.max_range,) * count)

    @property
    def image(self) -> tuple[int, int]:
        """Rows and columns: the depths are an image."""
        return self.size

    def read(self, inputs: SensorInput) -> Tensor:
        """Returns the image, with its noise and without what is lost."""
        directions, lengths = _pixels(self.size, self.field_of_view, self.pitch, self.yaw)
        # A direction has a length of 1 along the optical axis.
        ranges = inputs.scan(self.mount, directions)
        depth = (ranges / ranges.new_tensor(lengths)).clamp(max=self.max_range)
        count = depth.shape[-1]
        if self.noise:
            returned = depth < self.max_range
            depth = torch.where(returned, depth + self.noise * depth.square() * inputs.normal(self, count), depth)
        lost = depth < self.min_range
        if self.dropout:
            lost = lost | (inputs.uniform(self, count) < self.dropout)
        return depth.masked_fill(lost, 0.0)

    def encode(self, value: Tensor) -> Tensor:
        """Returns the logarithm of the depths, since centimeters matter only at short range."""
        return value.log1p() / 1.3 - 1

    def mirror(self, value: Tensor) -> Tensor:
        """Swaps left and right.

        Raises:
            ValueError: for a camera that is not in the middle, or does not look ahead.
        """
        if self.yaw or self.mount[1]:
            raise ValueError(
                f"camera {self.name!r} has no mirror image, as it is not in the middle or does not look ahead: train "
                "with --no-mirror-augmentation"
            )
        return value.unflatten(-1, self.size).flip(-1).flatten(-2)


@cache
def _pixels(
    size: tuple[int, int], field_of_view: float, pitch: float, yaw: float
) -> tuple[list[list[float]], list[float]]:
    """Returns the direction through each pixel in the frame of the robot, and its length.

    In the frame of the camera, whose axes point along the optical axis, left and up, the direction through a pixel is
    ``(1, -u / f, -v / f)``. It lies ``u`` to the right of the middle of the image and ``v`` below it, and the focal
    length is ``f``, all in pixels.
    """
    focal = size[1] / 2 / math.tan(field_of_view / 2)
    v, u = torch.meshgrid(*(torch.arange(count) - (count - 1) / 2 for count in size), indexing="ij")
    left, up = -u.flatten() / focal, -v.flatten() / focal
    forward, up = math.cos(pitch) + math.sin(pitch) * up, math.cos(pitch) * up - math.sin(pitch)
    forward, left = math.cos(yaw) * forward - math.sin(yaw) * left, math.sin(yaw) * forward + math.cos(yaw) * left
    directions = torch.stack((forward, left, up), -1)
    return directions.tolist(), directions.norm(dim=-1).tolist()
