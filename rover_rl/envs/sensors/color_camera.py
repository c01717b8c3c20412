"""Color camera: what the films show, from the rover."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from rover_rl.envs.sensors.base import SensorInput
from rover_rl.envs.sensors.ray_images import Pinhole, turned_rays
from rover_rl.envs.sensors.suite import COLORS
from rover_rl.envs.specs import Bounds
from rover_rl.sims.base import LiveRover


@dataclass(frozen=True, kw_only=True)
class ColorCamera(Pinhole):
    """Color image of a pinhole camera with square pixels, ``[N, 3 * rows * columns]``, from 0 to 1.

    The images of red, green and blue follow one another. Each is row by row from the top left, as a screen shows it.
    The colors are those of films: ground with its grid, obstacles, movers, the other rovers of a group, the post of the
    goal, sky, sunlight with shadows, and haze. A pixel is what one ray sees, so that edges are not smooth. The robot
    itself is not seen, nor its shadow, and corners are not darker than what is around them. People have shoulders and a
    head, while rays of other sensors meet a cylinder in their place.

    Args:
        name, period: as for :class:`~rover_rl.Sensor`.
        size, mount, yaw: as for :class:`~rover_rl.envs.sensors.ray_images.PixelImage`.
        field_of_view, pitch: as for :class:`~rover_rl.envs.sensors.ray_images.Pinhole`.
        noise: standard deviation of each channel.
        dropout: fraction of the pixels that are lost. They are black.
        topic: topic of the images of a live rover, a ``sensor_msgs/Image``, or a ``sensor_msgs/CompressedImage`` if it
            ends in ``/compressed``. ``None``: that of the connection. The camera must see what this one does.

    Raises:
        ValueError: if a setting is out of range.

    Example:
        >>> env = RoverEnv(world_n="moon", num_envs=2, seed=0, sensors=[ColorCamera(size=(16, 24))])
        >>> env.reset()["colors"].unflatten(-1, (3, 16, 24)).shape
        torch.Size([2, 3, 16, 24])
    """

    name: str = COLORS
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
        origins, rays = inputs.rays(self.mount, turned_rays(self, inputs.goal.device).directions)
        colors = inputs.surroundings.colors(origins, rays, inputs.goal, 1 / self.focal_length)
        if self.noise:
            colors = colors + self.noise * inputs.normal(self, 3 * colors.shape[-1]).view_as(colors)
        if self.dropout:
            lost = inputs.uniform(self, colors.shape[-1]) < self.dropout
            colors = colors.masked_fill(lost[:, None], 0.0)
        return colors.flatten(1)
