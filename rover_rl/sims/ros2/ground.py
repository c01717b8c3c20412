"""Ground and points around a live rover, from elevation maps and point clouds."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rover_rl.rotations import rotate
from rover_rl.sims.elevation_map import ElevationMap
from rover_rl.sims.ros2.elevation_maps import read_elevation_map
from rover_rl.sims.ros2.messages import GridMap, PointCloud2
from rover_rl.sims.ros2.point_clouds import read_points
from rover_rl.sims.ros2.sensors import Sensors, read_frame, read_stamp
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.ros2.transport import Transport
from rover_rl.sims.settings import Connection

GROUND_TYPES = {kind.ros_type: kind for kind in (GridMap, PointCloud2)}
"""Messages that the ground is read from, by type."""
LOWER_PART = 4
"""The height of a cell of a point cloud is that above which three quarters of its points lie."""
ITERATIONS = 4
"""Number of iterations along the vertical in a tilted map. Each leaves an error of tilt times slope of the last one."""
POLL = 0.02
"""Time between two looks for the publisher of a topic, s."""


class _Framed(NamedTuple):
    """What was read from a message, and the frame and time (s) of the message."""

    value: Any
    frame: str
    stamp: float


class LivePoints:
    """Elevation maps and point clouds of a live rover. Topics are subscribed to when they are first asked for.

    What is in the frame of the pose, or in that of the robot (``Ros2Settings.frame_id``) at the time of the message, is
    told by the name of the frame. Any other frame of a point cloud is that of the lidar, whose axes are those of the
    robot.
    """

    def __init__(self, sensors: Sensors, transport: Transport, settings: Ros2Settings, connection: Connection) -> None:
        self._sensors, self._transport = sensors, transport
        self._base, self._timeout = settings.frame_id.strip("/"), settings.step_timeout
        self._elevation_topic, self._points_topic = connection.elevation_topic, connection.points_topic
        self._kinds: dict[str, Any] = {}

    def cloud(self, topic: str | None) -> Tensor | None:
        """See :meth:`~rover_rl.sims.base.LiveRover.point_cloud`."""
        found = self._latest(topic or self._points_topic, "lidar3d", PointCloud2, self._read_own)
        return None if found is None else found.value

    def ground_at(
        self, grid: Tensor, yaw: Tensor, cell: float, topic: str | None, layer: str, mount: tuple[float, float, float]
    ) -> Tensor:
        """See :meth:`~rover_rl.sims.base.LiveRover.ground_at`."""
        topic = topic or self._elevation_topic
        kind = self._kind_of(topic)
        if kind is GridMap:
            found = self._latest(topic, f"layer {layer}", kind, partial(self._read_map, layer))
        else:
            found = self._latest(topic, "ground", kind, read_points)
        if found is None:
            return torch.full(grid.shape[:2], torch.nan)
        position, orientation = self._place(found, mount)
        if kind is GridMap:
            return sample(found.value, position, orientation, grid)
        return lowest_quarter(position + rotate(orientation, found.value), grid, yaw, cell)

    def _latest(self, topic: str, what: str, kind: Any, read: Callable[[Any], Any]) -> _Framed | None:
        latest: _Framed | None = self._sensors.latest_on(
            topic, what, kind, lambda msg: _Framed(read(msg), read_frame(msg), read_stamp(msg))
        )
        return latest

    def _kind_of(self, topic: str) -> Any:
        """Returns the class of the messages on a topic: elevation maps, if no publisher appears in time.

        Raises:
            ValueError: if the messages on the topic are others.
        """
        if topic not in self._kinds:
            deadline = time.monotonic() + self._timeout
            while not (types := self._transport.types(topic)) and time.monotonic() < deadline:
                time.sleep(POLL)
            kinds = [kind for name, kind in GROUND_TYPES.items() if name in types or not types]
            if not kinds:
                raise ValueError(f"the ground is read from {[*GROUND_TYPES]}, and {topic} has {sorted(types)}")
            self._kinds[topic] = kinds[0]
        return self._kinds[topic]

    def _read_map(self, layer: str, msg: Any) -> ElevationMap:
        """Reads an elevation map. Raises ``ValueError`` if it cannot be placed in the world: see the class."""
        frame, known = read_frame(msg), {self._base, self._sensors.pose_frame}
        if frame not in known and "" not in known:
            raise ValueError(f"an elevation map must be in the frame of pose or robot, {sorted(known)}, got {frame!r}")
        return read_elevation_map(msg, layer)

    def _read_own(self, msg: Any) -> Tensor:
        """Reads the points of a cloud in the frame of its lidar. Raises ``ValueError`` for another frame."""
        frame = read_frame(msg)
        if frame and frame in (self._base, self._sensors.pose_frame):
            raise ValueError(f"the points of a 3D lidar must be in the frame of the lidar, got {frame!r}")
        return read_points(msg)

    def _place(self, found: _Framed, mount: tuple[float, float, float]) -> tuple[Tensor, Tensor]:
        """Returns position ``[3]`` (m) and orientation ``[4]`` in the world of the frame of a message."""
        is_map = isinstance(found.value, ElevationMap)
        in_base = found.frame == self._base
        if not in_base and (is_map or (found.frame and found.frame == self._sensors.pose_frame)):
            return self._sensors.pose_frame_in_world()
        position, orientation = self._sensors.pose_at(found.stamp)
        return (position if in_base else position + rotate(orientation, torch.tensor(mount))), orientation


def sample(ground: ElevationMap, position: Tensor, orientation: Tensor, grid: Tensor) -> Tensor:
    """Returns the heights of a map at points ``grid [..., 2]`` of the world, ``[...]``, m; NaN where none is known.

    The frame of the map is at ``position [3]`` (m) and ``orientation [4]``. It may be tilted, as that of a robot: a
    point on the vertical above each point is moved to the surface of the map.
    """
    to_map = orientation * orientation.new_tensor([-1.0, -1.0, -1.0, 1.0])
    up = rotate(to_map, position.new_tensor([0.0, 0.0, 1.0]))
    height = position[2].expand(grid.shape[:-1])
    for _ in range(ITERATIONS):
        point = rotate(to_map, torch.cat((grid, height[..., None]), -1) - position)
        error = (ground.height_at(point[..., :2]) - point[..., 2]) / up[2]
        height = height + error.nan_to_num()
    return height.masked_fill(error.isnan(), torch.nan)


def lowest_quarter(points: Tensor, grid: Tensor, yaw: Tensor, cell: float) -> Tensor:
    """Returns the height of the ground in the cell around each point of a grid, m, from points of the world ``[P, 3]``.

    It is the first quartile of the heights of the points in the cell: most of those above an overhang or on the side of
    an obstacle are higher, and a single one below the ground does not count where there are five and more. On a slope,
    it lies below the middle of the cell by a quarter of the rise from one cell to the next.

    Args:
        points: points ``[P, 3]``, m.
        grid, yaw, cell: see :meth:`~rover_rl.sims.base.LiveRover.ground_at`.

    Returns:
        Heights ``[rows, columns]``, m; NaN in cells without a point.
    """
    rows, columns = grid.shape[:2]
    back, right = (grid[0, 0] - points[:, :2]).unbind(-1)
    cosine, sine = yaw.cos(), yaw.sin()
    row, column = (
        (distance / cell).round().long() for distance in (cosine * back + sine * right, cosine * right - sine * back)
    )
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    heights, order = points[inside, 2].sort()
    cells, by_cell = (row * columns + column)[inside][order].sort(stable=True)
    count = cells.bincount(minlength=rows * columns)
    quarter = count.cumsum(0) - count + (count - 1).clamp(min=0) // LOWER_PART
    ordered = torch.cat((heights[by_cell], heights.new_full((1,), torch.nan)))
    return ordered[quarter.masked_fill(count == 0, len(heights))].unflatten(0, (rows, columns))
