"""Video files: GIF, and MP4 with the extra ``video``."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
from PIL import Image

Writer = Callable[[Path, Iterable[np.ndarray], int], None]


def writer(path: Path) -> tuple[Writer, int]:
    """Returns the function that writes the video format of ``path``, and the default number of frames per second."""
    suffix = path.suffix.lower()
    if suffix not in (".mp4", ".gif"):
        raise ValueError(f"a film must be .mp4 or .gif, got {str(path)!r}")
    if suffix == ".gif":
        return _write_gif, 10
    if find_spec("imageio_ffmpeg") is None:
        raise ValueError('MP4 needs imageio-ffmpeg: pip install "rover_rl[video]", or name a .gif')
    return _write_mp4, 20


def _write_mp4(path: Path, pictures: Iterable[np.ndarray], fps: int) -> None:
    from imageio_ffmpeg import count_frames_and_secs

    # x264 requires even sizes.
    settings: Any = {"fps": fps, "codec": "libx264", "quality": 7, "macro_block_size": 2, "ffmpeg_log_level": "quiet"}
    writer: Any = imageio.get_writer(path, format="FFMPEG", **settings)
    written = 0
    try:
        with writer:
            for picture in pictures:
                writer.append_data(picture)
                written += 1
        # ffmpeg reports no error if it cannot write the end of the file.
        if count_frames_and_secs(path)[0] < written:
            raise OSError("frames are missing")
    except (OSError, RuntimeError) as error:
        _require_space(path)
        raise OSError(f"ffmpeg could not write {path.name}, after {written} frames") from error


def _require_space(path: Path) -> None:
    """Raises the error of the operating system if a file cannot grow. ffmpeg does not report it."""
    with path.open("ab") as file:
        file.write(bytes(1 << 20))


def _write_gif(path: Path, pictures: Iterable[np.ndarray], fps: int) -> None:
    frames = list(pictures)
    # One palette for all frames, so that unchanged areas are not stored again. Octrees keep rare colors.
    sample = np.concatenate([picture[::4, ::4] for picture in frames])
    palette = Image.fromarray(sample).quantize(_COLORS, Image.Quantize.FASTOCTREE)
    index_of = _palette_table(palette)
    images = []
    for frame in frames:
        red, green, blue = np.moveaxis(frame >> (8 - _BITS), -1, 0).astype(np.int32)
        images.append(Image.fromarray(index_of[(red << 2 * _BITS) | (green << _BITS) | blue]))
        images[-1].putpalette(palette.getpalette() or ())
    images[0].save(path, save_all=True, append_images=images[1:], duration=1000 / fps, loop=0)


def _palette_table(palette: Image.Image) -> np.ndarray:
    """Computes the index of the palette for each color of ``_BITS`` bits per channel, uint8 ``[2 ** (3 * _BITS)]``."""
    # Pillow takes 20 ms for a frame of 640 x 480, the table a tenth of that. Dithered frames compress poorly.
    levels = ((np.arange(1 << _BITS) + 0.5) * (256 >> _BITS)).astype(np.uint8)
    colors = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), -1).reshape(1, -1, 3)
    return np.asarray(Image.fromarray(colors).quantize(palette=palette, dither=Image.Dither.NONE)).reshape(-1)


_COLORS = 128
"""Number of colors of a GIF."""
_BITS = 6
"""Number of bits of each channel that decide on the color of the palette."""
