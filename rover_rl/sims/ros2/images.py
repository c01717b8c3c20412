"""Images as ROS 2 messages: ``sensor_msgs/Image`` with the encodings of REP 118, and ``sensor_msgs/CompressedImage``.

The end of a topic's name tells how images are compressed, as by the plugins of image_transport. ``compressed`` sends
JPEG or PNG files: colors, or depths of 16 bits in mm. ``compressedDepth`` sends PNG files of 16 bits behind a header of
12 bytes: the number of the format and two parameters, a and b. With the encoding ``16UC1``, the file has depths in mm,
with ``32FC1`` numbers v for depths of a / (v - b), m, where 0 is no depth
(https://github.com/ros-perception/image_transport_plugins, ``compressed_depth_image_transport/src/codec.cpp``).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.sensor_report import ImageKind

try:
    from PIL import Image
except ImportError:  # pragma: no cover
    Image = None  # type: ignore[assignment]

MILLIMETERS = 0.001  # unit of depths that are whole numbers, m
ENCODINGS = {"32FC1": (4, ("f4", 1.0)), "16UC1": (2, ("u2", MILLIMETERS)), "mono16": (2, ("u2", MILLIMETERS))}
"""Number of bytes of a depth, its type, and its unit in m, by the name of the encoding."""
RGB, BGR = [0, 1, 2], [2, 1, 0]
COLOR_ENCODINGS = {"rgb8": (3, RGB), "bgr8": (3, BGR), "rgba8": (4, RGB), "bgra8": (4, BGR), "mono8": (1, [0, 0, 0])}
"""Number of bytes of a pixel, and those of red, green and blue, by the name of the encoding."""
HEADER = struct.Struct("<iff")  # of compressedDepth: number of the format, a and b
PNG = b"\x89PNG"  # first bytes of a PNG file
QUALITY = 95  # of JPEG files, at most 100


class ImageFormat(NamedTuple):
    """Class of the messages of a topic, and functions that read them and write an image, its stamp and its frame.

    ``read`` raises ``ValueError`` for a message that it cannot read. Depth images are ``[rows, columns]``, m: 0 for
    pixels that are lost or too close, ``inf`` without a return (REP 117). Color images are red, green and blue from 0
    to 1, ``[3, rows, columns]``.
    """

    message: Any
    read: Callable[[Any], Tensor]
    write: Callable[[Tensor, Any, str], Any]


def image_format(kind: ImageKind, topic: str) -> ImageFormat:
    """Returns the format of a topic: compressed if it ends in ``/compressed`` or ``/compressedDepth``.

    Raises ``ValueError`` for colors on ``/compressedDepth``, and ``ImportError`` if Pillow is missing.
    """
    transport = topic.rpartition("/")[2]
    if transport not in ("compressed", "compressedDepth"):
        raw = {"depth": (_read_depth, _write_depth), "colors": (_read_colors, _write_colors)}
        return ImageFormat(ros.Image, *raw[kind])
    if Image is None:
        raise ImportError('compressed images require the package Pillow: pip install "rover_rl[ros2]"')
    if kind == "depth":
        form, header = "16UC1; png compressed", b""
        if transport == "compressedDepth":
            form, header = "16UC1; compressedDepth png", HEADER.pack(0, 0.0, 0.0)

        def write(depth: Tensor, stamp: Any, frame: str) -> Any:
            millimeters = (depth / MILLIMETERS).round().clamp(0, 65535).numpy().astype(np.uint16)
            return _compressed(form, header + _file(millimeters, "PNG"), stamp, frame)

        return ImageFormat(ros.CompressedImage, _read_compressed_depth, write)
    if transport != "compressed":
        raise ValueError(f"topics of colors end in /compressed if they are compressed, got {topic!r}")
    return ImageFormat(ros.CompressedImage, _read_compressed_colors, _write_jpeg)


def _read_depth(msg: Any) -> Tensor:
    (kind, unit), lines = _lines(msg, ENCODINGS, "depth")
    return _depths(lines.view(np.dtype(kind).newbyteorder(">" if msg.is_bigendian else "<")), unit)


def _depths(values: np.ndarray, unit: float = 1.0) -> Tensor:
    """Converts depths in a unit (m) to m. NaN and what is negative becomes 0."""
    depth = torch.from_numpy(values.astype(np.float32)) * unit
    return torch.nan_to_num(depth, nan=0.0, posinf=torch.inf, neginf=0.0).clamp_min(0.0)


def _read_colors(msg: Any) -> Tensor:
    channels, lines = _lines(msg, COLOR_ENCODINGS, "color")
    return _colors(lines.reshape(len(lines), int(msg.width), -1)[..., channels])


def _colors(pixels: np.ndarray) -> Tensor:
    return torch.from_numpy(np.moveaxis(pixels, -1, 0).astype(np.float32)) / 255


def _lines(msg: Any, encodings: dict[str, tuple[int, Any]], what: str) -> tuple[Any, np.ndarray]:
    """Returns what a table has of the encoding of an image, and the bytes of its rows, uint8 ``[rows, bytes]``."""
    if msg.encoding not in encodings:
        raise ValueError(f"the encoding of a {what} image must be one of {[*encodings]}, got {msg.encoding!r}")
    width, layout = encodings[msg.encoding]
    rows, columns, step = int(msg.height), int(msg.width), int(msg.step)
    data = np.frombuffer(bytes(msg.data), dtype=np.uint8)
    if rows < 1 or columns < 1 or step < columns * width or len(data) < rows * step:
        raise ValueError(f"a {what} image of {columns} x {rows} pixels has {len(data)} bytes, in rows of {step}")
    return layout, np.ascontiguousarray(data[: rows * step].reshape(rows, step)[:, : columns * width])


def _read_compressed_colors(msg: Any) -> Tensor:
    image = _opened(bytes(msg.data))
    if image.mode.startswith(("I", "F")):
        raise ValueError(f"a color image must have 8 bits a channel, got {msg.format!r} with more")
    pixels = np.array(image.convert("RGB"))
    # Files that were made from RGB pixels have red and blue interchanged, as the plugin expects BGR.
    return _colors(pixels[..., ::-1] if "compressed rgb" in msg.format else pixels)


def _read_compressed_depth(msg: Any) -> Tensor:
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
        return _depths(values, MILLIMETERS)
    if not start:
        raise ValueError("a compressed depth image of 32FC1 must have the header of compressedDepth")
    _, a, b = HEADER.unpack_from(data)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return _depths(np.where(values > 0, a / (values - b), 0.0))


def _opened(data: bytes) -> Any:
    try:
        image = Image.open(BytesIO(data), formats=("JPEG", "PNG"))
        image.load()
    except (OSError, EOFError, SyntaxError, ValueError, struct.error, Image.DecompressionBombError) as error:
        raise ValueError(f"a compressed image must be a whole JPEG or PNG, got {len(data)} bytes") from error
    return image


def _write_depth(depth: Tensor, stamp: Any, frame: str) -> Any:
    return _raw(depth.float().contiguous().numpy().astype("<f4")[..., None], "32FC1", stamp, frame)


def _write_colors(colors: Tensor, stamp: Any, frame: str) -> Any:
    return _raw(_pixels(colors), "rgb8", stamp, frame)


def _write_jpeg(colors: Tensor, stamp: Any, frame: str) -> Any:
    return _compressed("rgb8; jpeg compressed bgr8", _file(_pixels(colors), "JPEG"), stamp, frame)


def _pixels(colors: Tensor) -> np.ndarray:
    return (255 * colors).round().clamp(0, 255).byte().permute(1, 2, 0).contiguous().numpy()


def _raw(pixels: np.ndarray, encoding: str, stamp: Any, frame: str) -> Any:
    rows, columns, _ = pixels.shape
    data, header = np.frombuffer(pixels.tobytes(), dtype=np.uint8), ros.Header(stamp, frame)
    layout = {"height": rows, "width": columns, "encoding": encoding, "is_bigendian": 0, "step": len(data) // rows}
    return ros.Image(header, **layout, data=data)


def _file(pixels: np.ndarray, kind: str) -> bytes:
    file = BytesIO()
    Image.fromarray(pixels).save(file, kind, quality=QUALITY)
    return file.getvalue()


def _compressed(form: str, data: bytes, stamp: Any, frame: str) -> Any:
    return ros.CompressedImage(ros.Header(stamp, frame), format=form, data=np.frombuffer(data, dtype=np.uint8))
