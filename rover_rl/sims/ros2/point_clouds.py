"""Point clouds as ROS 2 messages: ``sensor_msgs/PointCloud2``."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.ros2 import messages as ros

KINDS = {7: "f4", 8: "f8"}
"""Type of a coordinate, by its number in ``sensor_msgs/PointField``."""


def read_points(msg: Any) -> Tensor:
    """Reads the points of a cloud with finite coordinates, float32 ``[P, 3]``, m.

    Raises:
        ValueError: if the fields x, y and z are missing or no floats, or there is too little data.
    """
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
        raise ValueError(
            f"a point cloud of {columns} x {rows} points of {step} bytes, whose coordinates end at {end}, has "
            f"{len(data)} bytes, in rows of {row_step}"
        )
    order = ">" if msg.is_bigendian else "<"
    formats = [order + kind for kind in kinds]
    point = np.dtype({"names": [*"xyz"], "formats": formats, "offsets": offsets, "itemsize": step})
    cloud = np.ndarray((rows, columns), point, data, strides=(row_step, step)).reshape(-1)
    points = torch.from_numpy(np.stack([cloud[name].astype(np.float32) for name in "xyz"], -1))
    return points[points.isfinite().all(-1)]


def point_cloud_message(points: Tensor, stamp: Any, frame: str) -> Any:
    """Builds the message of an organized cloud ``[rows, columns, 3]``, m, with NaN for no return."""
    rows, columns, _ = points.shape
    data = points.float().contiguous().numpy().astype("<f4").tobytes()
    return ros.PointCloud2(
        ros.Header(stamp, frame),
        height=rows,
        width=columns,
        fields=[ros.PointField(name, 4 * number, 7, 1) for number, name in enumerate("xyz")],
        is_bigendian=False,
        point_step=12,
        row_step=12 * columns,
        data=np.frombuffer(data, dtype=np.uint8),
        is_dense=False,
    )
