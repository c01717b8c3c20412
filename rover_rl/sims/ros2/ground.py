"""Ground and points around a live rover, from elevation maps and point clouds.

Elevation maps are ``grid_map_msgs/GridMap`` with the conventions of https://github.com/ANYbotics/grid_map
(``GridMapMath.cpp``, ``GridMapMsgHelpers.hpp``): the pose is that of the middle of the map, and rows go toward -x and
columns toward -y from the cell at the start indices, in a circular buffer. Heights are those in the frame of the map: z
of the pose does not count. Point clouds are ``sensor_msgs/PointCloud2``.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_rl.rotations import rotate
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.poses import read_finite
from rover_rl.sims.ros2.sensors import Sensors, read_frame, read_stamp
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.sensor_report import ElevationMap
from rover_rl.sims.settings import Connection

COLUMN_MAJOR, ROW_MAJOR = ["column_index", "row_index"], ["row_index", "column_index"]
"""Labels of the dimensions of a layer. grid_map itself writes the first ones."""
KINDS = {7: "f4", 8: "f8"}  # type of a coordinate, by its number in sensor_msgs/PointField
GROUND_TYPES = {kind.ros_type: kind for kind in (ros.GridMap, ros.PointCloud2)}  # that the ground is read from
LOWER_PART = 4  # the height of a cell of a point cloud is that above which three quarters of its points lie
ITERATIONS = 4
"""Number of iterations along the vertical in a tilted map. Each leaves an error of tilt times slope of the last one."""
POLL = 0.02  # time between two looks for the publisher of a topic, s


class LivePoints:
    """Elevation maps and point clouds of a live rover. Topics are subscribed to when they are first asked for.

    The name of a frame tells whether it is that of the pose, or that of the robot (``Ros2Settings.frame_id``) at the
    time of the message. Any other frame of a point cloud is that of the lidar, whose axes are those of the robot.
    """

    def __init__(self, sensors: Sensors, settings: Ros2Settings, connection: Connection) -> None:
        self._sensors, self._connection = sensors, connection
        self._base, self._timeout = settings.frame_id.strip("/"), settings.step_timeout
        self._kinds: dict[str, Any] = {}

    def cloud(self, topic: str | None) -> Tensor | None:
        found = self._latest(topic or self._connection.points_topic, "lidar3d", ros.PointCloud2, self._read_own)
        return None if found is None else found[0]

    def ground_at(
        self, grid: Tensor, yaw: Tensor, cell: float, topic: str | None, layer: str, mount: tuple[float, float, float]
    ) -> Tensor:
        topic = topic or self._connection.elevation_topic
        if (kind := self._kind_of(topic)) is ros.GridMap:
            found = self._latest(topic, f"layer {layer}", kind, partial(self._read_map, layer))
        else:
            found = self._latest(topic, "ground", kind, read_points)
        if found is None:
            return torch.full(grid.shape[:2], torch.nan)
        (value, frame, stamp), pose_frame = found, self._sensors.pose_frame
        if frame != self._base and (kind is ros.GridMap or (frame and frame == pose_frame)):
            position, orientation = self._sensors.pose_estimator.frame
        else:
            position, orientation = self._sensors.pose_at(stamp)
            if frame != self._base:
                position = position + rotate(orientation, torch.tensor(mount))
        if kind is ros.GridMap:
            return sample(value, position, orientation, grid)
        return lowest_quarter(position + rotate(orientation, value), grid, yaw, cell)

    def _latest(self, topic: str, what: str, kind: Any, read: Callable[[Any], Any]) -> Any:
        """What was read from the latest message, and its frame and stamp (s); ``None`` before the first one."""
        return self._sensors.latest_on(topic, what, kind, lambda msg: (read(msg), read_frame(msg), read_stamp(msg)))

    def _kind_of(self, topic: str) -> Any:
        """Returns the class of the messages on a topic: elevation maps, if no publisher appears in time."""
        if topic not in self._kinds:
            deadline = time.monotonic() + self._timeout
            while not (types := self._sensors.transport.types(topic)) and time.monotonic() < deadline:
                time.sleep(POLL)
            kinds = [kind for name, kind in GROUND_TYPES.items() if name in types or not types]
            if not kinds:
                raise ValueError(f"the ground is read from {[*GROUND_TYPES]}, and {topic} has {sorted(types)}")
            self._kinds[topic] = kinds[0]
        return self._kinds[topic]

    def _read_map(self, layer: str, msg: Any) -> ElevationMap:
        frame, known = read_frame(msg), {self._base, self._sensors.pose_frame}
        if frame not in known and "" not in known:
            raise ValueError(f"an elevation map must be in the frame of pose or robot, {sorted(known)}, got {frame!r}")
        return read_elevation_map(msg, layer)

    def _read_own(self, msg: Any) -> Tensor:
        frame = read_frame(msg)
        if frame and frame in (self._base, self._sensors.pose_frame):
            raise ValueError(f"the points of a 3D lidar must be in the frame of the lidar, got {frame!r}")
        return read_points(msg)


def sample(ground: ElevationMap, position: Tensor, orientation: Tensor, grid: Tensor) -> Tensor:
    """Returns the heights of a map at points ``grid [..., 2]`` of the world, ``[...]``, m; NaN where none is known.

    Its frame, at ``position [3]`` (m) and ``orientation [4]``, may be tilted: a point on the vertical above each point
    is moved to the surface.
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
    """Returns the height of the ground around each point of a grid, ``[rows, columns]``, m; NaN without a point there.

    It is the first quartile of the heights of the points ``[P, 3]`` (m, world frame) in the cell of side ``cell`` (m)
    around it: most of those on an obstacle are higher, and a single one below the ground does not count among five and
    more. On a slope, it lies below the middle of the cell by a quarter of the rise from one cell to the next. ``grid``
    and ``yaw`` are those of :meth:`~rover_rl.sims.base.LiveRover.ground_at`.
    """
    rows, columns = grid.shape[:2]
    back, right = (grid[0, 0] - points[:, :2]).unbind(-1)
    cosine, sine = yaw.cos(), yaw.sin()
    row = ((cosine * back + sine * right) / cell).round().long()
    column = ((cosine * right - sine * back) / cell).round().long()
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    heights, order = points[inside, 2].sort()
    cells, by_cell = (row * columns + column)[inside][order].sort(stable=True)
    count = cells.bincount(minlength=rows * columns)
    quarter = count.cumsum(0) - count + (count - 1).clamp(min=0) // LOWER_PART
    ordered = torch.cat((heights[by_cell], heights.new_full((1,), torch.nan)))
    return ordered[quarter.masked_fill(count == 0, len(heights))].unflatten(0, (rows, columns))


def read_elevation_map(msg: Any, layer: str = "elevation") -> ElevationMap:
    """Reads a layer of a ``grid_map_msgs/GridMap``. Raises ``ValueError`` if it is missing, malformed or turned."""
    names, info = [*msg.layers], msg.info
    if layer not in names or len(names) != len(msg.data):
        raise ValueError(f"an elevation map must have the layer {layer!r}, got {names} with {len(msg.data)} arrays")
    cell, center, turn = float(info.resolution), info.pose.position, info.pose.orientation
    if not 0 < cell < math.inf:
        raise ValueError(f"the resolution of an elevation map must be positive and finite, got {cell}")
    x, y = read_finite("center of an elevation map", center.x, center.y).tolist()
    if max(map(abs, (turn.x, turn.y, turn.z))) > 1e-3:
        raise ValueError(f"an elevation map must not be turned in its frame, got the orientation {turn}")
    heights = _read_layer(msg.data[names.index(layer)])
    size = [length / cell for length in (info.length_x, info.length_y)]
    if any(not abs(cells - count) < 0.5 for cells, count in zip(size, heights.shape, strict=True)):
        sides = f"{info.length_x} x {info.length_y} m with cells of {cell} m"
        raise ValueError(f"an elevation map of {sides} has {heights.shape} cells")
    start = -int(msg.outer_start_index), -int(msg.inner_start_index)
    unwrapped = torch.from_numpy(np.array(heights)).roll(start, (0, 1))
    return ElevationMap(unwrapped.masked_fill(~unwrapped.isfinite(), torch.nan), (x, y), cell, layer)


def _read_layer(array: Any) -> np.ndarray:
    sizes, labels = [int(each.size) for each in array.layout.dim], [each.label for each in array.layout.dim]
    data = np.asarray(array.data, dtype=np.float32)[int(array.layout.data_offset) :]
    if labels not in (COLUMN_MAJOR, ROW_MAJOR) or min(sizes) < 1 or len(data) < math.prod(sizes):
        found = f"{labels} of {sizes} with {len(data)} values"
        raise ValueError(f"a layer must have the dimensions {COLUMN_MAJOR}, got {found}")
    grid = data[: math.prod(sizes)].reshape(sizes)
    return grid if labels == ROW_MAJOR else grid.T


def elevation_map_message(ground: ElevationMap, stamp: Any, frame: str) -> Any:
    rows, columns = ground.heights.shape
    sizes = [("column_index", columns, rows * columns), ("row_index", rows, rows)]
    layout = ros.MultiArrayLayout([ros.MultiArrayDimension(*size) for size in sizes])
    array = ros.Float32MultiArray(layout, ground.heights.float().T.contiguous().flatten().numpy())
    pose = ros.Pose(ros.Point(*ground.center))
    info = ros.GridMapInfo(ground.cell, rows * ground.cell, columns * ground.cell, pose)
    return ros.GridMap(ros.Header(stamp, frame), info, [ground.layer], [ground.layer], [array])


def read_points(msg: Any) -> Tensor:
    """Reads the points with finite coordinates, float32 ``[P, 3]``, m. Raises ``ValueError`` if there is no such."""
    fields = {each.name: (KINDS.get(int(each.datatype), ""), int(each.offset)) for each in msg.fields}
    kinds, offsets = zip(*(fields.get(name, ("", 0)) for name in "xyz"), strict=True)
    if not all(kinds):
        raise ValueError(f"a point cloud must have x, y and z as float32 or float64, got the fields {sorted(fields)}")
    rows, columns, step, row_step = int(msg.height), int(msg.width), int(msg.point_step), int(msg.row_step)
    data = bytes(msg.data)
    end = max(offset + int(kind[1]) for kind, offset in zip(kinds, offsets, strict=True))
    # Drivers of unorganized clouds often leave out the length of the only row.
    row_step = columns * step if rows == 1 else row_step
    if step < end or row_step < columns * step or len(data) < rows * row_step:
        size = f"{columns} x {rows} points of {step} bytes, whose coordinates end at {end},"
        raise ValueError(f"a point cloud of {size} has {len(data)} bytes, in rows of {row_step}")
    formats = [(">" if msg.is_bigendian else "<") + kind for kind in kinds]
    point = np.dtype({"names": [*"xyz"], "formats": formats, "offsets": offsets, "itemsize": step})
    cloud = np.ndarray((rows, columns), point, data, strides=(row_step, step)).reshape(-1)
    points = torch.from_numpy(np.stack([cloud[name].astype(np.float32) for name in "xyz"], -1))
    return points[points.isfinite().all(-1)]


def point_cloud_message(points: Tensor, stamp: Any, frame: str) -> Any:
    """Makes a ``sensor_msgs/PointCloud2`` of points ``[rows, columns, 3]``, m, with NaN for no return."""
    rows, columns, _ = points.shape
    data = np.frombuffer(points.float().contiguous().numpy().astype("<f4").tobytes(), dtype=np.uint8)
    fields = [ros.PointField(name, 4 * number, 7, 1) for number, name in enumerate("xyz")]
    layout = {"height": rows, "width": columns, "fields": fields, "point_step": 12, "row_step": 12 * columns}
    return ros.PointCloud2(ros.Header(stamp, frame), **layout, data=data)
