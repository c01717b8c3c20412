"""Videos of driving policies, as GIF or, with the extra ``video``, as MP4."""

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
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.evaluation.evaluate import ENDINGS, Policy, environment_for
from rover_rl.algos.policy.baselines import RandomPolicy
from rover_rl.algos.policy.networks import single_threaded
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.algos.video.views import ChaseView, Moment, TopView
from rover_rl.checks import MAX_ROVERS, MAX_SECONDS, check_at_least, check_positive
from rover_rl.envs import EnvConfig, RoverEnv, StepEvent
from rover_rl.envs.make import add_reward
from rover_rl.envs.rewards import reward_components
from rover_rl.files import written_whole
from rover_rl.progress import ProgressDisplay
from rover_rl.sims.base import View
from rover_rl.sims.rendering.cache import MAX_SIDE
from rover_rl.sims.worlds import World


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
    """Films rovers in endless mode: a reached goal is followed by a new goal, an ended episode by a new start.

    Args:
        policy: module that maps observations to actions, used without exploration at 20 Hz, with memory as often as in
            training; ``None`` acts at random.
        path: path of the video, ``.mp4`` or ``.gif``. GIFs have fewer colors.
        world: world to drive in.
        view: ``"chase"`` follows the first rover, ``"top"`` shows all rovers from above.
        seconds: duration of the drive, s.
        seed: seed of starts and goals.
        rows: number of rovers.
        width, height: size of the video, pixels.
        fps: frames per second; ``None``: 20 for MP4, 10 for GIF.
        speed: playback speed; 2 is twice as fast as real time.
        env: environment to drive in, as for :func:`~rover_rl.algos.evaluation.evaluate.evaluate`. Its reward is
            recorded.

    Returns:
        Rollout of the first rover, ``[T]``, with the components of its reward.

    Raises:
        ValueError: for another suffix, MP4 without the extra, an unknown view or world, or a number out of range.
    """
    write, default_fps = _writer(path)
    fps = default_fps if fps is None else fps
    check_positive(MAX_SECONDS, seconds=seconds, speed=speed)
    check_positive(1000, fps=fps)
    check_at_least(1, MAX_ROVERS, rows=rows)
    check_positive(MAX_SIDE, width=width, height=height)
    if view not in _VIEWS:
        raise ValueError(f"unknown view {view!r}; use one of {sorted(_VIEWS)}")
    env_config = environment_for(policy, env)
    env_config = replace(env_config, world=world, num_envs=rows, end_on_goal=False, seed=seed)
    reward_components(env_config.reward, env_config.contract_reward)
    rovers = RoverEnv(**env_config.arguments())
    steps = max(1, round(seconds / rovers.control_dt))
    rovers.length = steps + 1
    rewarded = add_reward(rovers, env_config.reward, env_config)
    with closing(rewarded), set_exploration_type(ExplorationType.DETERMINISTIC):
        rollout = _Rollout(rewarded, rovers, policy or RandomPolicy(seed))
        camera = _VIEWS[view](rovers, width, height)
        # Steps after which a frame is drawn.
        frame_steps = np.linspace(0, steps, max(1, round(seconds / speed * fps)) + 1)[1:].round().astype(int)
        pictures = (camera.picture(rollout.advance_to(step)) for step in frame_steps)
        with written_whole(path) as temporary, ProgressDisplay("filming") as display:
            write(temporary, display.track(pictures, len(frame_steps)), fps)
    return torch.stack(rollout.steps)


_VIEWS: dict[str, Callable[..., ChaseView | TopView]] = {"chase": ChaseView, "top": TopView}


class _Rollout:
    """Drives rovers with a policy and counts their goals and endings.

    Args:
        env: environment with the reward.
        rovers: base environment of ``env``.
        policy: policy that drives.

    Attributes:
        steps: steps of the first rover.
    """

    def __init__(self, env: EnvBase, rovers: RoverEnv, policy: Policy) -> None:
        self.steps: list[TensorDict] = []
        self._env, self._rovers, self._runner = env, rovers, PolicyRunner(policy, env=rovers)
        self._tensordict = env.reset()
        self._goals = self._episodes = torch.zeros(env.batch_size, dtype=torch.int64)
        self._endings: list[str] = []
        self._event = "", 0.0

    def advance_to(self, steps: int) -> Moment:
        """Drives until ``steps`` steps have been taken and returns the state for the next frame."""
        while len(self.steps) < steps:
            self._step()
        rovers, seconds = self._rovers, len(self.steps) * self._rovers.control_dt
        counts = (self._goals, self._episodes, self._endings)
        return Moment(seconds, rovers.rover_state, rovers.goal, *counts, self._event)

    def _step(self) -> None:
        """Takes a step and updates the counts and the latest event."""
        action = self._runner(self._tensordict)
        step, self._tensordict = self._env.step_and_maybe_reset(self._tensordict.set("action", action))
        self.steps.append(step[0])
        outcome, done = step["next", "outcome"], step["next", "done"].squeeze(-1)
        self._runner.reset(done)
        reached = outcome["goal_reached"].squeeze(-1)
        self._goals, self._episodes = self._goals + reached, self._episodes + done
        endings = [ENDINGS[StepEvent(phase)] for phase in outcome["phase"].squeeze(-1)[done].tolist()]
        self._endings = self._endings + endings
        if done[0] or reached[0]:
            event = f"{endings[0]}: new start" if done[0] else "goal reached"
            self._event = event, len(self.steps) * self._rovers.control_dt


_Writer = Callable[[Path, Iterable[np.ndarray], int], None]


def _writer(path: Path) -> tuple[_Writer, int]:
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
    # Dithered frames compress poorly.
    first, *others = (
        Image.fromarray(picture).quantize(palette=palette, dither=Image.Dither.NONE) for picture in frames
    )
    first.save(path, save_all=True, append_images=others, duration=1000 / fps, loop=0)


_COLORS = 128
"""Number of colors of a GIF."""
