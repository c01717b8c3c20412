"""Height scan: the ground around the robot, on a grid, as an elevation map has it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from rover_rl.checks import MAX_COUNT, MAX_NUMBER, check_at_least, check_positive
from rover_rl.envs.sensors.base import Sensor, SensorInput
from rover_rl.envs.specs import Bounds

MAX_SPACING = 10.0
"""Largest distance between two points, m."""


@dataclass(frozen=True, kw_only=True)
class HeightScan(Sensor):
    """Heights of the ground on a grid around the robot, relative to the robot, ``[N, rows * columns]``, m.

    The grid turns with the heading and stays level. The first row is the farthest ahead, and the first column the one
    farthest to the left, as in an image that is seen from above. Obstacles are not part of the ground. Heights of a
    live rover come from an elevation map (``grid_map_msgs/GridMap``) or a point cloud (``sensor_msgs/PointCloud2``),
    and points without a height read 0.

    Args:
        size: numbers of rows and columns.
        spacing: distance between two neighbors, m.
        ahead: distance from the robot to the middle of the grid, m.
        max_height: largest absolute height, to which heights are clipped, m.
        noise: standard deviation of the heights, m.
        holes: fraction of the points without a height, which read 0.
        topic: topic of the elevation map or point cloud of a live rover. ``None``: that of the connection.
        layer: layer of the elevation map.
        mount: position of the lidar in the frame of the robot, m, for a point cloud in the frame of the lidar.

    Example:
        >>> env = RoverEnv(world_n="hills", num_envs=2, seed=0, sensors=[HeightScan(size=(8, 8))])
        >>> env.reset()["heights"].shape
        torch.Size([2, 64])
    """

    name: str = "heights"
    size: tuple[int, int] = (16, 16)
    spacing: float = 0.2
    ahead: float = 1.0
    max_height: float = 1.0
    noise: float = 0.0
    holes: float = 0.0
    topic: str | None = None
    layer: str = "elevation"
    mount: tuple[float, float, float] = (0.0, 0.0, 0.5)
    takes_long = True

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(1, MAX_COUNT, rows=self.size[0], columns=self.size[1])
        check_positive(MAX_SPACING, spacing=self.spacing, max_height=self.max_height)
        check_at_least(0, MAX_NUMBER, noise=self.noise)
        check_at_least(0, 1, holes=self.holes)

    @property
    def bounds(self) -> Bounds:
        count = self.size[0] * self.size[1]
        return Bounds((-self.max_height,) * count, (self.max_height,) * count)

    @property
    def image(self) -> tuple[int, int]:
        return self.size

    def read(self, inputs: SensorInput) -> Tensor:
        position, yaw = inputs.truth.rover.position, inputs.truth.yaw
        forward, left = _grid(self.size, self.spacing, self.ahead, position.device)
        x = position[:, :1] + forward * yaw.cos() - left * yaw.sin()
        y = position[:, 1:2] + forward * yaw.sin() + left * yaw.cos()
        points = torch.stack((x, y), -1)
        if (live := inputs.surroundings.live) is not None:
            grid = points[0].unflatten(0, self.size)
            ground = live.ground_at(grid, yaw[0, 0], self.spacing, self.topic, self.layer, self.mount).flatten()
            return (ground - position[:, 2:]).nan_to_num(0.0)
        heights = inputs.surroundings.height_at(points) - position[:, 2:]
        if self.noise:
            heights = heights + self.noise * inputs.normal(self, heights.shape[-1])
        if self.holes:
            heights = heights.masked_fill(inputs.uniform(self, heights.shape[-1]) < self.holes, 0.0)
        return heights

    def encode(self, value: Tensor) -> Tensor:
        """Returns the heights in units of 0.5 m: a step of a few centimeters matters."""
        return 2 * value

    def mirror(self, value: Tensor) -> Tensor:
        return value.unflatten(-1, self.size).flip(-1).flatten(-2)


@cache
def _grid(size: tuple[int, int], spacing: float, ahead: float, device: torch.device) -> tuple[Tensor, Tensor]:
    """Returns the distances of the points ahead of the robot and to its left, ``[rows * columns]`` each, m."""
    along, across = (spacing * ((count - 1) / 2 - torch.arange(count, device=device)) for count in size)
    forward, left = torch.meshgrid(ahead + along, across, indexing="ij")
    return forward.flatten(), left.flatten()
