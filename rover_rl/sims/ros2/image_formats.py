"""How images go over a topic: raw, or compressed as by image_transport's plugins, which the end of its name tells."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from torch import Tensor

from rover_rl.sims.ros2 import images
from rover_rl.sims.ros2.messages import CompressedImage, Image
from rover_rl.sims.served import ImageKind


class ImageFormat(NamedTuple):
    """How images go over a topic.

    Attributes:
        message: class of the messages.
        read: reads an image from a message, and raises ``ValueError`` if it cannot be read.
        write: builds a message of an image, its stamp and the name of its frame.
    """

    message: Any
    read: Callable[[Any], Tensor]
    write: Callable[[Tensor, Any, str], Any]


def image_format(kind: ImageKind, topic: str) -> ImageFormat:
    """Returns the format of a topic: compressed if it ends in ``/compressed`` or ``/compressedDepth``.

    Raises:
        ValueError: for colors on ``/compressedDepth``.
        ImportError: if images are compressed, and Pillow is not installed.
    """
    transport = topic.rpartition("/")[2]
    if transport not in ("compressed", "compressedDepth"):
        raw = {"depth": (images.read_depth, images.depth_message), "colors": (images.read_colors, images.color_message)}
        return ImageFormat(Image, *raw[kind])
    from rover_rl.sims.ros2 import compressed_images as compressed

    if kind == "depth":
        with_header = transport == "compressedDepth"
        write = compressed.header_depth_message if with_header else compressed.compressed_depth_message
        return ImageFormat(CompressedImage, compressed.read_compressed_depth, write)
    if transport != "compressed":
        raise ValueError(f"topics of colors end in /compressed if they are compressed, got {topic!r}")
    return ImageFormat(CompressedImage, compressed.read_compressed_colors, compressed.compressed_color_message)
