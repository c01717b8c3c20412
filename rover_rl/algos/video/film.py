"""Videos of driving policies, as GIF or, with the extra ``video``, as MP4."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import torch
from PIL import Image
from tensordict import TensorDictBase

from rover_rl.algos.evaluation.episodes import choose_episodes
from rover_rl.algos.evaluation.evaluate import Policy, environment_for
from rover_rl.algos.video.recording import Moment, Recording, record_endless, record_episodes
from rover_rl.algos.video.views import ChaseView, TopView
from rover_rl.checks import MAX_ROVERS, MAX_SECONDS, check_at_least, check_positive
from rover_rl.envs.config import EnvConfig
from rover_rl.files import written_whole
from rover_rl.native.threads import single_threaded
from rover_rl.progress import ProgressDisplay
from rover_rl.sims.base import View
from rover_rl.sims.rendering.cache import MAX_SIDE
from rover_rl.worlds import World

CANDIDATES = 8  # number of starts from which film_to_goal drives
HOLD = 1.0  # duration for which the last picture of an episode is shown, s
_COLORS = 128  # number of colors of a GIF
_VIEWS: dict[str, Callable[..., ChaseView | TopView]] = {"chase": ChaseView, "top": TopView}


@dataclass(frozen=True)
class Style:
    """How a film shows a drive.

    ``view`` is ``"chase"``, which follows the first rover, or ``"top"``, which shows all rovers from above. The size is
    in pixels, ``fps=None`` is 20 for MP4 and 10 for GIF, and a ``speed`` of 2 is twice as fast as real time.
    """

    view: View = "chase"
    width: int = 480
    height: int = 360
    fps: int | None = None
    speed: float = 1.0

    def check(self, path: Path) -> None:
        _writer(path)
        check_positive(MAX_SECONDS, speed=self.speed)
        check_positive(1000, fps=1 if self.fps is None else self.fps)
        check_positive(MAX_SIDE, width=self.width, height=self.height)
        if self.view not in _VIEWS:
            raise ValueError(f"unknown view {self.view!r}; use one of {sorted(_VIEWS)}")


def film(
    policy: Policy | None,
    path: Path,
    style: Style = Style(),
    *,
    world: str | World = "maze",
    seconds: float = 20.0,
    seed: int = 0,
    rows: int = 1,
    env: EnvConfig | None = None,
) -> TensorDictBase:
    """Films rovers in endless mode: a reached goal is followed by a new goal, an ended episode by a new start.

    Args:
        policy: module that maps observations to actions, used without exploration at 20 Hz, with memory as often as in
            training; ``None`` acts at random.
        path: path of the video, ``.mp4`` or ``.gif``. GIFs have fewer colors.
        seconds: duration of the drive, s.
        rows: number of rovers.
        env: environment to drive in, as for :func:`~rover_rl.algos.evaluation.evaluate.evaluate`.

    Returns:
        Rollout of the first rover, ``[T]``, with the components of its reward.

    Raises:
        ValueError: for another suffix, MP4 without the extra, an unknown view or world, or a number out of range.
    """
    style.check(path)
    check_positive(MAX_SECONDS, seconds=seconds)
    check_at_least(1, MAX_ROVERS, rows=rows)
    recording = record_endless(policy, world, seconds=seconds, rows=rows, seed=seed, env=env)
    film_recording(recording, path, style)
    return torch.stack(recording.steps)


def film_to_goal(
    policy: Policy | None,
    path: Path,
    style: Style = Style(),
    *,
    world: str = "maze",
    seconds: float = 20.0,
    seed: int | None = None,
    env: EnvConfig | None = None,
) -> Recording:
    """Films a drive that reaches its goal: the first of several, driven at the same time from different starts.

    If none reaches its goal, the first drive is filmed, however it ends. Arguments and errors are those of
    :func:`film`; ``seed=None`` takes the stored starts and goals if the world has them. Returns the drive: its
    ``episode`` is the index of its start among those of ``rover-rl evaluate``.
    """
    style.check(path)
    episodes = choose_episodes(world, CANDIDATES, seed, robot=environment_for(policy, env).robot)
    drives = record_episodes(policy, episodes, seconds=seconds, name="driving", env=env)
    shown = next((drive for drive in drives if drive.ending == "goal"), drives[0])
    film_recording(shown, path, style)
    return shown


@torch.no_grad()
@single_threaded()
def film_recording(recording: Recording, path: Path, style: Style) -> None:
    """Films a recorded drive. The last picture of an episode is shown for a second."""
    style.check(path)
    write, default_fps = _writer(path)
    fps = style.fps or default_fps
    count = max(1, round(recording.seconds / style.speed * fps))
    steps = np.linspace(0, len(recording.moments) - 1, count + 1)[1:].round().astype(int)
    moments = [recording.moments[step] for step in steps]
    with written_whole(path) as temporary, ProgressDisplay("filming") as display:
        view = _VIEWS[style.view](recording, style.width, style.height)
        pictures = display.track(_pictures(view, moments), count)
        write(temporary, _held(pictures, round(HOLD * fps)) if recording.ending else pictures, fps)


def write_film(path: Path, pictures: Iterable[np.ndarray], fps: int) -> None:
    _writer(path)[0](path, pictures, fps)


def _pictures(view: ChaseView | TopView, moments: Sequence[Moment]) -> Iterator[np.ndarray]:
    threads = os.cpu_count() or 1
    coming, rendered = iter(moments), deque[Future[Any]]()
    with ThreadPoolExecutor(threads) as pool:
        for moment in moments:
            # Few at a time, as a long film does not fit into memory.
            rendered.extend(pool.submit(view.render, one) for one in islice(coming, 2 * threads - len(rendered)))
            yield view.picture(moment, rendered.popleft().result())


def _held(pictures: Iterator[np.ndarray], count: int) -> Iterator[np.ndarray]:
    for picture in pictures:
        yield picture
    yield from [picture] * count


def _writer(path: Path) -> tuple[Callable[[Path, Iterable[np.ndarray], int], None], int]:
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
        with path.open("ab") as file:
            file.write(bytes(1 << 20))  # raises the error of a full disk
        raise OSError(f"ffmpeg could not write {path.name}, after {written} frames") from error


def _write_gif(path: Path, pictures: Iterable[np.ndarray], fps: int) -> None:
    frames = list(pictures)
    # One palette for all frames, so that unchanged areas are not stored again. Octrees keep rare colors.
    sample = np.concatenate([picture[::4, ::4] for picture in frames])
    palette = Image.fromarray(sample).quantize(_COLORS, Image.Quantize.FASTOCTREE)
    # Dithered frames compress poorly.
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    images[0].save(path, save_all=True, append_images=images[1:], duration=1000 / fps, loop=0)
