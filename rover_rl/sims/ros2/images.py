"""Images as ROS 2 messages: depths with the encodings of REP 118, and colors, ``sensor_msgs/Image``."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from rover_rl.sims.ros2 import messages as ros

MILLIMETERS = 0.001
"""Unit of depths that are whole numbers, m."""
ENCODINGS = {"32FC1": ("f4", 1.0), "16UC1": ("u2", MILLIMETERS), "mono16": ("u2", MILLIMETERS)}
"""Type of a depth, and its unit in m, by the name of the encoding."""
COLOR_ENCODINGS = {
    "rgb8": (3, [0, 1, 2]),
    "bgr8": (3, [2, 1, 0]),
    "rgba8": (4, [0, 1, 2]),
    "bgra8": (4, [2, 1, 0]),
    "mono8": (1, [0, 0, 0]),
}
"""Number of bytes of a pixel, and those of red, green and blue, by the name of the encoding."""


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
    return depths_of(_lines(msg, depth_type.itemsize, "depth").view(depth_type), unit)


def depths_of(values: np.ndarray, unit: float = 1.0) -> Tensor:
    """Returns depths in m of ``values`` in a unit (m), float32. NaN and what is negative is 0."""
    depth = torch.from_numpy(values.astype(np.float32)) * unit
    return torch.nan_to_num(depth, nan=0.0, posinf=torch.inf, neginf=0.0).clamp_min(0.0)


def read_colors(msg: Any) -> Tensor:
    """Reads a color image, red, green and blue from 0 to 1, float32 ``[3, rows, columns]``. Gray has equal channels.

    Raises:
        ValueError: for another encoding, or too little data.
    """
    if msg.encoding not in COLOR_ENCODINGS:
        raise ValueError(f"the encoding of a color image must be one of {[*COLOR_ENCODINGS]}, got {msg.encoding!r}")
    width, channels = COLOR_ENCODINGS[msg.encoding]
    lines = _lines(msg, width, "color")
    return colors_of(lines.reshape(len(lines), -1, width)[..., channels])


def colors_of(pixels: np.ndarray) -> Tensor:
    """Returns colors from 0 to 1, float32 ``[3, rows, columns]``, of ``pixels [rows, columns, 3]``, uint8."""
    return torch.from_numpy(np.moveaxis(pixels, -1, 0).astype(np.float32)) / 255


def _lines(msg: Any, width: int, what: str) -> np.ndarray:
    """Returns the bytes of the rows of an image with ``width`` bytes a pixel, uint8 ``[rows, columns * width]``."""
    rows, columns, step = int(msg.height), int(msg.width), int(msg.step)
    data = np.frombuffer(bytes(msg.data), dtype=np.uint8)
    if rows < 1 or columns < 1 or step < columns * width or len(data) < rows * step:
        raise ValueError(f"a {what} image of {columns} x {rows} pixels has {len(data)} bytes, in rows of {step}")
    return np.ascontiguousarray(data[: rows * step].reshape(rows, step)[:, : columns * width])


def resized(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Returns the nearest pixels of an image ``[..., rows, columns]`` in another size. Pixels are not mixed."""
    flat = image.reshape(1, -1, *image.shape[-2:])
    return interpolate(flat, size, mode="nearest-exact").reshape(*image.shape[:-2], *size)


def depth_message(depth: Tensor, stamp: Any, frame: str) -> Any:
    """Builds the message of a depth image ``[rows, columns]``, m."""
    return _message(depth.float().contiguous().numpy().astype("<f4")[..., None], "32FC1", stamp, frame)


def color_message(colors: Tensor, stamp: Any, frame: str) -> Any:
    """Builds the message of a color image ``[3, rows, columns]``, from 0 to 1."""
    return _message(pixels_of(colors), "rgb8", stamp, frame)


def pixels_of(colors: Tensor) -> np.ndarray:
    """Returns the pixels ``[rows, columns, 3]``, uint8, of colors from 0 to 1, ``[3, rows, columns]``."""
    return (255 * colors).round().clamp(0, 255).byte().permute(1, 2, 0).contiguous().numpy()


def _message(pixels: np.ndarray, encoding: str, stamp: Any, frame: str) -> Any:
    """Builds the message of ``pixels [rows, columns, channels]``."""
    rows, columns, _ = pixels.shape
    data = np.frombuffer(pixels.tobytes(), dtype=np.uint8)
    header = ros.Header(stamp, frame)
    return ros.Image(
        header, height=rows, width=columns, encoding=encoding, is_bigendian=0, step=len(data) // rows, data=data
    )
