"""Depth images as ROS 2 messages: ``sensor_msgs/Image`` with the encodings of REP 118."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from rover_rl.sims.ros2 import messages as ros

ENCODINGS = {"32FC1": ("f4", 1.0), "16UC1": ("u2", 0.001), "mono16": ("u2", 0.001)}
"""Type of a depth, and its unit in m, by the name of the encoding."""


def read_depth(msg: Any) -> Tensor:
    """Reads a depth image, float32 ``[rows, columns]``, m; 0 for pixels that are lost or too close.

    ``inf`` is a pixel without a return (REP 117).

    Raises:
        ValueError: for another encoding, or too little data.
    """
    if msg.encoding not in ENCODINGS:
        raise ValueError(f"the encoding of a depth image must be one of {[*ENCODINGS]}, got {msg.encoding!r}")
    kind, unit = ENCODINGS[msg.encoding]
    depth_type = np.dtype(kind).newbyteorder(">" if msg.is_bigendian else "<")
    rows, columns, step = int(msg.height), int(msg.width), int(msg.step)
    data = np.frombuffer(bytes(msg.data), dtype=np.uint8)
    if rows < 1 or columns < 1 or step < columns * depth_type.itemsize or len(data) < rows * step:
        raise ValueError(f"a depth image of {columns} x {rows} pixels has {len(data)} bytes, in rows of {step}")
    lines = data[: rows * step].reshape(rows, step)[:, : columns * depth_type.itemsize]
    depth = torch.from_numpy(np.ascontiguousarray(lines).view(depth_type).astype(np.float32)) * unit
    return torch.nan_to_num(depth, nan=0.0, posinf=torch.inf, neginf=0.0).clamp_min(0.0)


def resized(depth: Tensor, size: tuple[int, int]) -> Tensor:
    """Returns the nearest pixels of a depth image ``[rows, columns]`` in another size. Depths are not mixed."""
    return interpolate(depth[None, None], size, mode="nearest-exact")[0, 0]


def depth_message(depth: Tensor, stamp: Any, frame: str) -> Any:
    """Builds the message of a depth image ``[rows, columns]``, m."""
    rows, columns = depth.shape
    data = depth.float().contiguous().numpy().astype("<f4").tobytes()
    return ros.Image(
        ros.Header(stamp, frame),
        height=rows,
        width=columns,
        encoding="32FC1",
        is_bigendian=0,
        step=4 * columns,
        data=np.frombuffer(data, dtype=np.uint8),
    )
