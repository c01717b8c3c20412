"""Compressed images as ROS 2 messages, ``sensor_msgs/CompressedImage``, in the formats of image_transport's plugins.

``compressed`` sends JPEG or PNG files: colors, or depths of 16 bits in mm. ``compressedDepth`` sends PNG files of 16
bits behind a header of 12 bytes: the number of the format and two parameters, a and b. With the encoding ``16UC1``, the
file has depths in mm, with ``32FC1`` numbers v for depths of a / (v - b), m, where 0 is no depth
(https://github.com/ros-perception/image_transport_plugins, ``compressed_depth_image_transport/src/codec.cpp``).
"""

from __future__ import annotations

import struct
from io import BytesIO
from typing import Any

import numpy as np
from torch import Tensor

from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.images import MILLIMETERS, colors_of, depths_of, pixels_of

try:
    from PIL import Image
except ImportError as error:  # pragma: no cover
    raise ImportError('compressed images require the package Pillow: pip install "rover_rl[ros2]"') from error

HEADER = struct.Struct("<iff")
"""Header of ``compressedDepth``: number of the format, a and b."""
PNG = b"\x89PNG"
"""First bytes of a PNG file."""
QUALITY = 95
"""Quality of JPEG files, at most 100."""


def read_compressed_colors(msg: Any) -> Tensor:
    """Reads a color image, red, green and blue from 0 to 1, float32 ``[3, rows, columns]``.

    Files that were made from ``compressed rgb`` pixels have red and blue interchanged, as the plugin expects ``bgr``.

    Raises:
        ValueError: for a file that is broken, or no color image.
    """
    image = _opened(bytes(msg.data))
    if image.mode.startswith(("I", "F")):
        raise ValueError(f"a color image must have 8 bits a channel, got {msg.format!r} with more")
    pixels = np.array(image.convert("RGB"))
    return colors_of(pixels[..., ::-1] if "compressed rgb" in msg.format else pixels)


def read_compressed_depth(msg: Any) -> Tensor:
    """Reads a depth image, float32 ``[rows, columns]``, m; 0 for pixels that are lost, too close or too far.

    Raises:
        ValueError: for another format, or a file that is broken.
    """
    data, encoding = bytes(msg.data), msg.format.partition(";")[0].strip()
    # Whether there is a header depends on the plugin, and not all publishers name it in the format.
    start = 0 if data.startswith(PNG) else HEADER.size
    if encoding not in ("16UC1", "mono16", "32FC1", "png") or not data[start:].startswith(PNG):
        raise ValueError(f"a compressed depth image must be a PNG of 16UC1 or 32FC1, got {msg.format!r}")
    image = _opened(data[start:])
    if not image.mode.startswith("I"):
        raise ValueError(f"a compressed depth image must have 16 bits a pixel, got {msg.format!r} with less")
    values = np.array(image).astype(np.float64)
    if encoding != "32FC1":
        return depths_of(values, MILLIMETERS)
    if not start:
        raise ValueError("a compressed depth image of 32FC1 must have the header of compressedDepth")
    _, a, b = HEADER.unpack_from(data)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return depths_of(np.where(values > 0, a / (values - b), 0.0))


def _opened(data: bytes) -> Image.Image:
    """Decodes a JPEG or PNG file. Raises ``ValueError`` if it is none, or broken."""
    try:
        image = Image.open(BytesIO(data), formats=("JPEG", "PNG"))
        image.load()
    except (OSError, EOFError, SyntaxError, ValueError, struct.error, Image.DecompressionBombError) as error:
        raise ValueError(f"a compressed image must be a whole JPEG or PNG, got {len(data)} bytes") from error
    if not min(image.size):
        raise ValueError(f"a compressed image has {image.width} x {image.height} pixels")
    return image


def compressed_color_message(colors: Tensor, stamp: Any, frame: str) -> Any:
    """Builds the message of a color image ``[3, rows, columns]``, from 0 to 1: a JPEG."""
    data = _saved(Image.fromarray(pixels_of(colors)), "JPEG", quality=QUALITY)
    return _message("rgb8; jpeg compressed bgr8", data, stamp, frame)


def compressed_depth_message(depth: Tensor, stamp: Any, frame: str) -> Any:
    """Builds the message of a depth image ``[rows, columns]``, m, for ``compressed``."""
    return _message("16UC1; png compressed", _depth_png(depth), stamp, frame)


def header_depth_message(depth: Tensor, stamp: Any, frame: str) -> Any:
    """Builds the message of a depth image ``[rows, columns]``, m, for ``compressedDepth``."""
    return _message("16UC1; compressedDepth png", HEADER.pack(0, 0.0, 0.0) + _depth_png(depth), stamp, frame)


def _depth_png(depth: Tensor) -> bytes:
    millimeters = (depth / MILLIMETERS).round().clamp(0, 65535).numpy().astype(np.uint16)
    return _saved(Image.fromarray(millimeters), "PNG")


def _saved(image: Image.Image, kind: str, **options: Any) -> bytes:
    file = BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def _message(kind: str, data: bytes, stamp: Any, frame: str) -> Any:
    return ros.CompressedImage(ros.Header(stamp, frame), format=kind, data=np.frombuffer(data, dtype=np.uint8))
