"""Cameras and 3D lidar, without a renderer: a ray for each pixel."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import TypeAlias

import torch
from torch import Tensor

from rover_rl.checks import MAX_COUNT, MAX_NUMBER, check_at_least, check_positive
from rover_rl.envs.sensors.base import Sensor, SensorInput
from rover_rl.envs.specs import Bounds
from rover_rl.sims.base import LiveRover
from rover_rl.sims.rendering.scenery import POST_LENGTH, POST_RADIUS

MAX_RANGE = 1000.0
"""Largest range, m."""
ABOVE = 0.005
"""Height above the ground from which on a point is that of an obstacle, m."""
Vectors: TypeAlias = list[list[float]]


@dataclass(frozen=True, kw_only=True)
class PixelImage(Sensor):
    """Image with a ray for each pixel, row by row from the top left: base of cameras and 3D lidars.

    Args:
        size: numbers of rows and columns.
        mount: position in the frame of the robot, whose origin is on the ground and whose axes point forward, left and
            up, m.
        yaw: angle by which the device looks to the left, rad.
        noise: standard deviation of a value.
        dropout: fraction of the pixels that are lost.
    """

    size: tuple[int, int]
    mount: tuple[float, float, float]
    yaw: float = 0.0
    noise: float = 0.0
    dropout: float = 0.0
    delayed = "scan"
    takes_long = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(1, MAX_COUNT, rows=self.size[0], columns=self.size[1])
        check_at_least(0, MAX_NUMBER, noise=self.noise)
        check_at_least(0, 1, dropout=self.dropout)

    @property
    def image(self) -> tuple[int, int]:
        return self.size

    @abstractmethod
    def rays(self) -> tuple[Vectors, list[float]]:
        """Returns the direction of each pixel (ahead, left and up), and the range at which it reads 1 m."""

    def received(self, live: LiveRover) -> Tensor:
        """Returns the image or images ``[..., rows, columns]`` of a live rover. Raises ``ValueError`` without any."""
        raise ValueError(f"sensor {self.name!r} casts rays, which needs a simulated world: a live rover has none")

    def mirror(self, value: Tensor) -> Tensor:
        """Swaps left and right. Raises ``ValueError`` for a device that is not in the middle or does not look ahead."""
        if self.yaw or self.mount[1]:
            raise ValueError(
                f"sensor {self.name!r} has no mirror image, as it is not in the middle or does not look ahead: train "
                "with --no-mirror-augmentation"
            )
        return value.unflatten(-1, (-1, *self.size)).flip(-1).flatten(-3)

    def lost(self, inputs: SensorInput) -> Tensor:
        """Returns which pixels are lost, bool ``[N, rows * columns]``."""
        return inputs.uniform(self, self.size[0] * self.size[1]) < self.dropout


@dataclass(frozen=True, kw_only=True)
class RayImage(PixelImage):
    """Image ``[N, rows * columns]`` of distances, m: base of depth cameras and 3D lidars.

    It shows ground, obstacles, movers and the other rovers of a group, but not the robot itself. A pixel without a
    return reads ``max_range``, and one closer than ``min_range`` or lost reads 0, as those of most devices do.

    It also has the settings of :class:`PixelImage`.

    Args:
        min_range, max_range: least and largest distance, m.
    """

    min_range: float = 0.1
    max_range: float = 8.0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(MAX_RANGE, max_range=self.max_range)
        if not 0 <= self.min_range < self.max_range:
            raise ValueError(f"min_range must be from 0 to below max_range={self.max_range}, got {self.min_range}")

    @property
    def bounds(self) -> Bounds:
        count = self.size[0] * self.size[1]
        return Bounds((0.0,) * count, (self.max_range,) * count)

    def spread(self, distance: Tensor) -> Tensor | float:
        """Returns the standard deviation of the noise at distances, m."""
        return self.noise

    def read(self, inputs: SensorInput) -> Tensor:
        if (live := inputs.surroundings.live) is not None:
            return self.received(live).clamp(max=self.max_range).flatten()[None]
        directions, scales, longest = turned_rays(self, inputs.goal.device)
        distance = (inputs.scan(self.mount, directions, self.max_range * longest) / scales).clamp(max=self.max_range)
        if self.noise:
            noisy = distance + self.spread(distance) * inputs.normal(self, distance.shape[-1])
            distance = torch.where(distance < self.max_range, noisy, distance)
        lost = distance < self.min_range
        return distance.masked_fill(lost | self.lost(inputs) if self.dropout else lost, 0.0)

    def encode(self, value: Tensor) -> Tensor:
        """Returns the logarithm of the distances, since centimeters matter only at short range."""
        return value.log1p() / 1.3 - 1


@dataclass(frozen=True, kw_only=True)
class Pinhole(PixelImage):
    """Image of a pinhole camera with square pixels: base of cameras.

    It also has the settings of :class:`PixelImage`.

    Args:
        field_of_view: horizontal field of view, rad.
        pitch: angle by which the camera looks down, rad.
    """

    size: tuple[int, int] = (64, 64)
    mount: tuple[float, float, float] = (0.25, 0.0, 0.3)
    field_of_view: float = math.radians(87)
    pitch: float = math.radians(15)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.field_of_view < math.pi:
            raise ValueError(f"field_of_view must be between 0 and pi, got {self.field_of_view}")

    @property
    def focal_length(self) -> float:
        return self.size[1] / 2 / math.tan(self.field_of_view / 2)

    def rays(self) -> tuple[Vectors, list[float]]:
        # (1, -u / f, -v / f), turned down by the pitch, for a pixel that lies u to the right of the middle of the image
        # and v below it, with the focal length f, all in pixels.
        focal = self.focal_length
        v, u = torch.meshgrid(*(torch.arange(count) - (count - 1) / 2 for count in self.size), indexing="ij")
        directions = torch.stack((torch.ones_like(u), -u / focal, -v / focal), -1).reshape(-1, 3)
        ahead, left, up = directions.unbind(-1)
        cos, sin = math.cos(self.pitch), math.sin(self.pitch)
        turned = torch.stack((cos * ahead + sin * up, left, cos * up - sin * ahead), -1)
        return turned.tolist(), directions.norm(dim=-1).tolist()


@dataclass(frozen=True, kw_only=True)
class DepthCamera(Pinhole, RayImage):
    """Depth image of a pinhole camera with square pixels, ``[N, rows * columns]``, m, along the optical axis.

    The noise is that of stereo and structured light, whose standard deviation grows with the square of the depth
    (K. Khoshelham and S. O. Elberink, "Accuracy and resolution of Kinect depth data for indoor mapping applications",
    Sensors 12, 2012).

    It also has the settings of :class:`RayImage` and :class:`Pinhole`.

    Args:
        noise: standard deviation of the depth at 1 m, m.
        topic: topic of the images of a live rover, a ``sensor_msgs/Image``, or a ``sensor_msgs/CompressedImage`` if it
            ends in ``/compressed`` or ``/compressedDepth``. ``None``: that of the connection. The camera must see what
            this one does: the same field of view from the same place.

    Example:
        >>> env = RoverEnv(world_n="moon", num_envs=2, seed=0, sensors=[DepthCamera(size=(16, 24))])
        >>> env.reset()["depth"].unflatten(-1, (16, 24)).shape
        torch.Size([2, 16, 24])
    """

    name: str = "depth"
    topic: str | None = None

    def received(self, live: LiveRover) -> Tensor:
        return live.image("depth", self.topic, self.size)

    def spread(self, distance: Tensor) -> Tensor:
        return self.noise * distance.square()


@dataclass(frozen=True, kw_only=True)
class ColorCamera(Pinhole):
    """Color image of a pinhole camera with square pixels, ``[N, 3 * rows * columns]``, from 0 to 1.

    The images of red, green and blue follow one another. Each is row by row from the top left, as a screen shows it.
    The colors are those of films: ground with its grid, obstacles, movers, the other rovers of a group, the post of the
    goal, sky, sunlight with shadows, and haze. A pixel is what one ray sees, so that edges are not smooth. The robot
    itself is not seen, nor its shadow, and corners are not darker than what is around them. People have shoulders and a
    head, while rays of other sensors meet a cylinder in their place.

    It also has the settings of :class:`Pinhole`.

    Args:
        noise: standard deviation of each channel.
        dropout: fraction of the pixels that are lost. They are black.
        topic: topic of the images of a live rover, as for :class:`DepthCamera`.

    Example:
        >>> env = RoverEnv(world_n="moon", num_envs=2, seed=0, sensors=[ColorCamera(size=(16, 24))])
        >>> env.reset()["colors"].unflatten(-1, (3, 16, 24)).shape
        torch.Size([2, 3, 16, 24])
    """

    name: str = "colors"
    topic: str | None = None

    @property
    def bounds(self) -> Bounds:
        count = 3 * self.size[0] * self.size[1]
        return Bounds((0.0,) * count, (1.0,) * count)

    def received(self, live: LiveRover) -> Tensor:
        return live.image("colors", self.topic, self.size)

    def read(self, inputs: SensorInput) -> Tensor:
        if (live := inputs.surroundings.live) is not None:
            return self.received(live).flatten()[None]
        origins, rays = inputs.rays(self.mount, turned_rays(self, inputs.goal.device)[0])
        colors = inputs.surroundings.colors(origins, rays, inputs.goal, 1 / self.focal_length)
        if self.noise:
            colors = colors + self.noise * inputs.normal(self, 3 * colors.shape[-1]).view_as(colors)
        if self.dropout:
            colors = colors.masked_fill(self.lost(inputs)[:, None], 0.0)
        return colors.flatten(1)


class Seen(IntEnum):
    """What a pixel of a :class:`SegmentationCamera` shows."""

    NOTHING = 0
    """Sky, or nothing within the range."""
    GROUND = 1
    OBSTACLE = 2
    MOVER = 3
    """A mover, or another rover of the group."""
    GOAL = 4
    """The post of the goal, which only this camera sees: 8 cm in radius and 1.2 m high, as in films."""


@dataclass(frozen=True, kw_only=True)
class SegmentationCamera(Pinhole, RayImage):
    """What each pixel of a pinhole camera shows, ``[N, rows * columns]``: the numbers of :class:`Seen`, as floats.

    Networks read an image of zeros and ones for each kind. A live rover has no such camera. Its settings are those of
    :class:`RayImage` and :class:`Pinhole`, without noise. A pixel that is lost, or whose ray ends too close or too far,
    shows nothing.

    Example:
        >>> env = RoverEnv(world_n="moon", num_envs=2, seed=0, sensors=[SegmentationCamera(size=(16, 24))])
        >>> (env.reset()["segmentation"] == Seen.GROUND).any()
        tensor(True)
    """

    name: str = "segmentation"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.noise:
            raise ValueError(f"a segmentation has no noise, but lost pixels (dropout), got noise={self.noise}")

    @property
    def bounds(self) -> Bounds:
        count = self.size[0] * self.size[1]
        return Bounds((float(min(Seen)),) * count, (float(max(Seen)),) * count)

    def read(self, inputs: SensorInput) -> Tensor:
        origins, rays = inputs.rays(self.mount, turned_rays(self, inputs.goal.device)[0])
        still, ranges = inputs.surroundings.cast_apart(origins, rays, self.max_range)
        rays = rays / rays.norm(dim=-1, keepdim=True)
        ends = origins + rays * ranges.masked_fill(ranges.isinf(), 0.0)[..., None]
        above = ends[..., 2] - inputs.surroundings.height_at(ends[..., :2])
        kinds = torch.where(above > ABOVE, float(Seen.OBSTACLE), float(Seen.GROUND))
        kinds = kinds.masked_fill(ranges < still, Seen.MOVER)
        post = self._post(inputs, origins, rays)
        kinds = kinds.masked_fill(post < ranges, Seen.GOAL)
        ranges = torch.minimum(ranges, post)
        lost = (ranges < self.min_range) | (ranges >= self.max_range)
        return kinds.masked_fill(lost | self.lost(inputs) if self.dropout else lost, Seen.NOTHING)

    def _post(self, inputs: SensorInput, origins: Tensor, rays: Tensor) -> Tensor:
        """Returns the ranges ``[N, K]`` at which rays of length 1 meet the side of the post; ``inf`` for no return."""
        # A ray o + t d meets the circle with the radius r around the goal g where |o - g + t d| = r in the plane.
        offset, plane = origins[..., :2] - inputs.goal[:, None], rays[..., :2]
        a, b = plane.square().sum(-1), (offset * plane).sum(-1)
        under_root = b.square() - a * (offset.square().sum(-1) - POST_RADIUS**2)
        ranges = (-b - under_root.clamp(min=0.0).sqrt()) / a
        height = (origins + rays * ranges[..., None])[..., 2] - inputs.surroundings.height_at(inputs.goal)[:, None]
        meets = (under_root > 0) & (ranges > 0) & (height >= 0) & (height <= POST_LENGTH)
        return ranges.masked_fill(~meets, math.inf)

    def encode(self, value: Tensor) -> Tensor:
        """Returns an image for each kind, ``[..., 5 * rows * columns]``: 1 where it is shown, else 0."""
        kinds = torch.arange(len(Seen), device=value.device, dtype=value.dtype)
        return (value[..., None, :] == kinds[:, None]).to(value.dtype).flatten(-2)


@dataclass(frozen=True, kw_only=True)
class Lidar3D(RayImage):
    """Range image of a lidar with several planes, ``[N, planes * beams]``, m.

    The first row is the highest plane. Beams are equally spaced over the field of view, from left to right; those of a
    full turn begin behind the robot.

    It also has the settings of :class:`RayImage`.

    Args:
        size: numbers of planes and of the beams of each.
        field_of_view: horizontal field of view, rad.
        elevation: angles of the lowest and the highest plane above the horizon, rad.
        topic: topic of the ``sensor_msgs/PointCloud2`` of a live rover, in the frame of the lidar, whose x points where
            the lidar looks. ``None``: that of the connection.

    Example:
        >>> env = RoverEnv(world_n="moon", num_envs=2, seed=0, sensors=[Lidar3D(size=(4, 32))])
        >>> env.reset()["lidar3d"].shape
        torch.Size([2, 128])
    """

    name: str = "lidar3d"
    size: tuple[int, int] = (16, 128)
    mount: tuple[float, float, float] = (0.0, 0.0, 0.5)
    max_range: float = 12.0
    field_of_view: float = 2 * math.pi
    elevation: tuple[float, float] = (math.radians(-25), math.radians(15))
    topic: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.elevation
        if not 0 < self.field_of_view <= 2 * math.pi:
            raise ValueError(f"field_of_view must be positive and at most 2 pi, got {self.field_of_view}")
        if not -math.pi / 2 <= low <= high <= math.pi / 2:
            raise ValueError(f"elevation must be two ascending angles between -pi/2 and pi/2, got {self.elevation}")

    def rays(self) -> tuple[Vectors, list[float]]:
        planes, beams = self.size
        low, high = self.elevation
        up = torch.linspace(high, low, planes) if planes > 1 else torch.tensor([(low + high) / 2])
        # The middle of the image is ahead, so that its mirror image swaps left and right.
        left = self.field_of_view * (0.5 - (torch.arange(beams) + 0.5) / beams)
        up, left = torch.meshgrid(up, left, indexing="ij")
        directions = torch.stack((up.cos() * left.cos(), up.cos() * left.sin(), up.sin()), -1)
        return directions.reshape(-1, 3).tolist(), [1.0] * (planes * beams)

    def received(self, live: LiveRover) -> Tensor:
        points = live.point_cloud(self.topic)
        return torch.zeros(self.size) if points is None else self.range_image(points)

    def range_image(self, points: Tensor) -> Tensor:
        """Returns the image ``[planes, beams]``, m, of the nearest points in each pixel, ``[P, 3]``, m.

        Points are in the frame of the lidar. Those outside of the image or at the origin (no return) are left out.
        """
        (planes, beams), (low, high) = self.size, self.elevation
        ahead, left, up = points.unbind(-1)
        ranges = points.norm(dim=-1)
        column = ((0.5 - torch.atan2(left, ahead) / self.field_of_view) * beams).floor().long()
        if self.field_of_view == 2 * math.pi:
            column = column % beams
        # One plane has all of the elevation, or of a square pixel.
        height = (high - low) / max(1, planes - 1) or self.field_of_view / beams
        top = high if planes > 1 else (low + high) / 2
        row = ((top - torch.atan2(up, torch.hypot(ahead, left))) / height).round().long()
        inside = (row >= 0) & (row < planes) & (column >= 0) & (column < beams) & (ranges > 0)
        image = ranges.new_full((planes * beams,), self.max_range)
        image = image.scatter_reduce(0, (row * beams + column)[inside], ranges[inside], "amin")
        return image.masked_fill(image < self.min_range, 0.0).unflatten(0, self.size)


@cache
def turned_rays(sensor: PixelImage, device: torch.device) -> tuple[Tensor, Tensor, float]:
    """Returns directions of rays in the frame of the robot, ``[K, 3]``, ranges of 1 m, ``[K]``, and their largest."""
    directions, scales = sensor.rays()
    cos, sin = math.cos(sensor.yaw), math.sin(sensor.yaw)
    turned = [[cos * x - sin * y, sin * x + cos * y, z] for x, y, z in directions]
    return torch.tensor(turned, device=device), torch.tensor(scales, device=device), max(scales)
