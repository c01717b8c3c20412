"""Elevation maps as ROS 2 messages: ``grid_map_msgs/GridMap``.

Conventions are those of https://github.com/ANYbotics/grid_map (``GridMapMath.cpp``, ``GridMapMsgHelpers.hpp``): the
pose is that of the middle of the map, and rows go toward -x and columns toward -y from the cell at the start indices,
in a circular buffer. Heights are those in the frame of the map: z of the pose does not count.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from rover_rl.sims.elevation_map import ElevationMap
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.poses import read_finite

COLUMN_MAJOR, ROW_MAJOR = ["column_index", "row_index"], ["row_index", "column_index"]
"""Labels of the dimensions of a layer. grid_map itself writes the first ones."""


def read_elevation_map(msg: Any, layer: str = "elevation") -> ElevationMap:
    """Reads a layer of a ``grid_map_msgs/GridMap``.

    Raises:
        ValueError: if the layer is missing or has another size than the map, a number of the geometry is out of range,
            or the map is turned in its frame.
    """
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
        raise ValueError(
            f"an elevation map of {info.length_x} x {info.length_y} m with cells of {cell} m has {heights.shape} cells"
        )
    start = -int(msg.outer_start_index), -int(msg.inner_start_index)
    unwrapped = torch.from_numpy(np.array(heights)).roll(start, (0, 1))
    return ElevationMap(unwrapped.masked_fill(~unwrapped.isfinite(), torch.nan), (x, y), cell, layer)


def _read_layer(array: Any) -> np.ndarray:
    """Reads a ``std_msgs/Float32MultiArray``, ``[rows, columns]``."""
    sizes, labels = [int(each.size) for each in array.layout.dim], [each.label for each in array.layout.dim]
    data = np.asarray(array.data, dtype=np.float32)[int(array.layout.data_offset) :]
    if labels not in (COLUMN_MAJOR, ROW_MAJOR) or min(sizes) < 1 or len(data) < math.prod(sizes):
        raise ValueError(
            f"a layer must have the dimensions {COLUMN_MAJOR}, got {labels} of {sizes} with {len(data)} values"
        )
    grid = data[: math.prod(sizes)].reshape(sizes)
    return grid if labels == ROW_MAJOR else grid.T


def elevation_map_message(ground: ElevationMap, stamp: Any, frame: str) -> Any:
    """Builds the message of an elevation map with one layer."""
    rows, columns = ground.heights.shape
    layout = ros.MultiArrayLayout(
        [
            ros.MultiArrayDimension("column_index", columns, rows * columns),
            ros.MultiArrayDimension("row_index", rows, rows),
        ]
    )
    data = ground.heights.float().T.contiguous().flatten().numpy()
    pose = ros.Pose(ros.Point(*ground.center))
    info = ros.GridMapInfo(ground.cell, rows * ground.cell, columns * ground.cell, pose)
    array = ros.Float32MultiArray(layout, data)
    return ros.GridMap(ros.Header(stamp, frame), info, [ground.layer], [ground.layer], [array])
