"""Films of policies that drive: MP4 with the extra ``video``, GIF without."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import torch
from PIL import Image
from rich.console import Console
from rich.progress import track
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.evaluation.evaluate import ENDINGS, Policy, environment_for
from rover_rl.algos.policy.baselines import RandomPolicy
from rover_rl.algos.policy.networks import single_threaded
from rover_rl.algos.video.views import ChaseView, Moment, TopView
from rover_rl.checks import MAX_ROVERS, MAX_SECONDS, check_at_least, check_positive
from rover_rl.envs import EnvConfig, RoverEnv, StepEvent
from rover_rl.envs.make import add_reward
from rover_rl.envs.rewards import reward_components
from rover_rl.files import written_whole
from rover_rl.sims.base import View
from rover_rl.sims.worlds import World

MAX_SIDE = 8192
"""Of a picture, pixels."""


@torch.no_grad()
@single_threaded()
def film(
    policy: Policy | None,
    path: Path,
    *,
    world: str | World = "maze",
    view: View = "chase",
    seconds: float = 20.0,
    seed: int = 0,
    rows: int = 1,
    width: int = 640,
    height: int = 480,
    fps: int | None = None,
    speed: float = 1.0,
    env: EnvConfig | None = None,
) -> TensorDictBase:
    """Films rovers that drive without end: a new goal after each, and a new start after an ending.

    Args:
        policy: a module from observation to action, taken without exploration at 20 Hz; ``None`` acts at random.
        path: of the film: ``.mp4``, or ``.gif``, which has fewer colours.
        world: where.
        view: ``"chase"`` follows the first rover, ``"top"`` shows all of them from above.
        seconds: of driving.
        seed: of starts and goals.
        rows: rovers that drive.
        width, height: of the picture, pixels.
        fps: pictures a second; ``None``: 20 for MP4, 10 for GIF.
        speed: of the film; 2 shows everything twice as fast as it is.
        env: environment to drive in, whose reward is recorded: as for
            :func:`~rover_rl.algos.evaluation.evaluate.evaluate`.

    Returns:
        What the first rover did, ``[T]``, with the components of its reward.

    Raises:
        ValueError: for another kind of file, MP4 without the extra, another view, an unknown world, or a number out of
            its range.
    """
    write, usual_fps = _writer(path)
    fps = usual_fps if fps is None else fps
    check_positive(MAX_SECONDS, seconds=seconds, speed=speed)
    check_positive(1000, fps=fps)
    check_at_least(1, MAX_ROVERS, rows=rows)
    check_positive(MAX_SIDE, width=width, height=height)
    if view not in _VIEWS:
        raise ValueError(f"unknown view {view!r}; use one of {sorted(_VIEWS)}")
    described = environment_for(policy, env)
    described = replace(described, world=world, num_envs=rows, end_on_goal=False, seed=seed)
    reward_components(described.reward, described.contract_reward)
    rovers = RoverEnv(**described.arguments())
    steps = max(1, round(seconds / rovers.control_dt))
    rovers.length = steps + 1
    rewarded = add_reward(rovers, described.reward, described)
    with closing(rewarded), set_exploration_type(ExplorationType.DETERMINISTIC):
        drive = _Drive(rewarded, rovers, policy or RandomPolicy(seed))
        camera = _VIEWS[view](rovers, width, height)
        # The steps after which a picture is taken.
        moments = np.linspace(0, steps, max(1, round(seconds / speed * fps)) + 1)[1:].round().astype(int)
        pictures = (camera.picture(drive.moment_after(step)) for step in moments)
        with written_whole(path) as temporary:
            shown = track(pictures, "filming", len(moments), disable=not Console().is_terminal, transient=True)
            write(temporary, shown, fps)
    return torch.stack(drive.steps)


_VIEWS: dict[str, Callable[..., ChaseView | TopView]] = {"chase": ChaseView, "top": TopView}


class _Drive:
    """Rovers under a policy, and what has become of them.

    Args:
        env: the environment with its reward.
        rovers: the environment under it.
        policy: the policy.

    Attributes:
        steps: what the first rover did, step by step.
    """

    def __init__(self, env: EnvBase, rovers: RoverEnv, policy: Policy) -> None:
        self.steps: list[TensorDict] = []
        self._env, self._rovers, self._policy = env, rovers, policy
        self._now = env.reset()
        self._goals = self._episodes = torch.zeros(env.batch_size, dtype=torch.int64)
        self._endings: list[str] = []
        self._news = "", 0.0

    def moment_after(self, steps: int) -> Moment:
        """Drives until so many steps are taken."""
        while len(self.steps) < steps:
            self._step()
        rovers, seconds = self._rovers, len(self.steps) * self._rovers.control_dt
        counts = (self._goals, self._episodes, self._endings)
        return Moment(seconds, rovers.rover_state, rovers.goal, *counts, self._news)

    def _step(self) -> None:
        step, self._now = self._env.step_and_maybe_reset(self._policy(self._now))
        self.steps.append(step[0])
        outcome, done = step["next", "outcome"], step["next", "done"].squeeze(-1)
        reached = outcome["goal_reached"].squeeze(-1)
        self._goals, self._episodes = self._goals + reached, self._episodes + done
        endings = [ENDINGS[StepEvent(phase)] for phase in outcome["phase"].squeeze(-1)[done].tolist()]
        self._endings = self._endings + endings
        if done[0] or reached[0]:
            news = f"{endings[0]}: a new start" if done[0] else "goal reached"
            self._news = news, len(self.steps) * self._rovers.control_dt


_Writer = Callable[[Path, Iterable[np.ndarray], int], None]


def _writer(path: Path) -> tuple[_Writer, int]:
    """What writes a film of this name, and its usual pictures a second."""
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

    # x264 takes even sizes only.
    settings: Any = {"fps": fps, "codec": "libx264", "quality": 7, "macro_block_size": 2, "ffmpeg_log_level": "quiet"}
    writer: Any = imageio.get_writer(path, format="FFMPEG", **settings)
    written = 0
    try:
        with writer:
            for picture in pictures:
                writer.append_data(picture)
                written += 1
        # ffmpeg ends without an error where it cannot write the end of the file.
        if count_frames_and_secs(path)[0] < written:
            raise OSError("pictures are missing")
    except (OSError, RuntimeError) as error:
        _require_space(path)
        raise OSError(f"ffmpeg could not write {path.name}, after {written} pictures") from error


def _require_space(path: Path) -> None:
    """Raises the system's error if nothing more can be written to a file: ffmpeg keeps it to itself."""
    with path.open("ab") as file:
        file.write(bytes(1 << 20))


def _write_gif(path: Path, pictures: Iterable[np.ndarray], fps: int) -> None:
    shown = list(pictures)
    # One palette for all, so that what does not move is not written again. Octrees keep rare colours.
    sample = np.concatenate([picture[::4, ::4] for picture in shown])
    palette = Image.fromarray(sample).quantize(_COLORS, Image.Quantize.FASTOCTREE)
    # Dither would hardly compress.
    first, *others = (Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in shown)
    first.save(path, save_all=True, append_images=others, duration=1000 / fps, loop=0)


_COLORS = 128
"""Of a GIF."""
