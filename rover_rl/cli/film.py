"""The command ``rover-rl film``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from rover_rl.algos.policy.names import ResolvedPolicy, resolve_policy
from rover_rl.checks import MAX_COUNT, MAX_ROVERS, MAX_SECONDS, check_at_least, check_positive
from rover_rl.cli.options import BACKEND, ONE_POLICY, EnvOptions, Force, is_bag
from rover_rl.cli.replays import check_page
from rover_rl.files import check_outputs
from rover_rl.sims.ros2.settings import BAG, BagTopics

if TYPE_CHECKING:
    from rover_rl.algos.evaluation.results import StoredEvaluation
    from rover_rl.algos.video.film import Style
    from rover_rl.algos.video.recording import Recording

FILMED = 20.0  # default duration of a film in endless mode, s
POLICY = tyro.conf.arg(metavar="POLICY", help=f"{ONE_POLICY} Or a bag ({BAG}): of rover-rl drive, or of ROS 2.")


@dataclass(frozen=True)
class Film:
    """Film a policy, an episode of its evaluation, its failures, or a drive of a bag.

    One rover from behind with its lidar beams, or many rovers from above. Without --episode and --failures, the rovers
    drive from goal to goal.
    """

    policy: Annotated[tyro.conf.Positional[str], POLICY]
    out: Path = Path("film.mp4")
    """File to write: .mp4 (needs the extra video) or .gif."""
    html: Path | None = None
    """Page to write in place of a film: one file that opens offline, with a time slider (needs the extra view)."""
    episode: int | None = None
    """Episode to film, from 0: of the policy's evaluation, else of the episodes of --world. Of a bag: the drive in it;
    default: the last one."""
    failures: bool = False
    """Film the episodes of the policy's evaluation that do not reach their goal, each in a file with its number."""
    count: int = 4
    """Largest number of films with --failures."""
    evaluation: Path | None = None
    """evaluation.json, or its folder. Default: the one in the folder of the run."""
    view: Literal["chase", "top"] = "chase"
    """Camera: chase follows the first rover, top shows all rovers from above."""
    world: str | None = None
    """World to drive in. Default: that of the episode, the one that the policy was trained in, or maze.
    For a bag: the world that it names; none shows the lidar readings on flat ground."""
    seconds: float | None = None
    """Duration of the film, s: 20 by default, and the end of an episode or a bag, of which all is shown by default."""
    seed: int | None = None
    """Seed of starts and goals. Default: 0; with --episode the stored starts and goals."""
    rovers: int | None = None
    """Number of rovers. Default: 1 for chase and in worlds with movers, 16 for top."""
    width: int = 480
    """Width of the video, pixels."""
    height: int = 360
    """Height of the video, pixels."""
    fps: int | None = None
    """Frames per second. Default: 20 for .mp4, 10 for .gif."""
    speed: float = 1.0
    """Playback speed; 2 is twice as fast as real time."""
    rewards: Path | None = None
    """File to plot the first rover's reward components to, such as rewards.png."""
    force: Force = False
    environment: Annotated[EnvOptions, tyro.conf.arg(name="")] = field(default_factory=EnvOptions)
    backend: Annotated[str | None, tyro.conf.arg(help=BACKEND)] = None
    topics: BagTopics = field(default_factory=BagTopics)

    def __call__(self) -> int:
        self._check()
        if is_bag(self.policy):
            from rover_rl.algos.deploy.recorded_drives import read_drives, recording_of_drive

            drives = read_drives(Path(self.policy), self.topics, self.world, self.environment.given_robot)
            recording = recording_of_drive(drives, self.episode)
            self._film(recording, self._out, f"of {self.policy}")
        elif self.episode is not None or self.failures:
            self._film_episodes()
        else:
            self._film_endless()
        return 0

    def _check(self) -> None:
        self._style.check(self.out if self.html is None else Path("page.gif"))
        check_at_least(1, MAX_COUNT, count=self.count)
        check_at_least(1, MAX_ROVERS, rovers=self.rovers or 1)
        if self.seconds is not None:
            check_positive(MAX_SECONDS, seconds=self.seconds)
        single = self.episode is not None or self.failures or is_bag(self.policy)
        for name, given in {"--rovers": self.rovers, "--rewards": self.rewards}.items():
            if single and given is not None:
                raise ValueError(f"{name} belongs to films without --episode, --failures and bags")
        if self.episode is not None and self.failures:
            raise ValueError("give --episode or --failures, not both")
        if self.html is not None and self.rewards is not None:
            raise ValueError("--rewards belongs to films without --html")
        if self.failures and is_bag(self.policy):
            raise ValueError("--failures reads an evaluation; name a drive of a bag with --episode")
        if self.html is not None:
            check_page(self.html)
        if not self.failures:
            self._check_outputs([self._out])

    def _check_outputs(self, films: list[Path]) -> None:
        rewards = [] if self.rewards is None else [self.rewards]
        inputs = (self.policy, self.world or "", self.evaluation or "", self.environment.env or "")
        check_outputs(*films, *rewards, inputs=inputs, force=self.force, option="--html" if self.html else "--out")

    @property
    def _style(self) -> Style:
        from rover_rl.algos.video.film import Style

        return Style(self.view, self.width, self.height, self.fps, self.speed)

    def _film(self, recording: Recording, out: Path, of: str) -> None:
        self._write(recording if self.seconds is None else recording.last(self.seconds), out)
        where = f" in {recording.world.name}" if recording.world.name != "none" else ""
        print(f"Film: {out}: episode {recording.episode} {of}{where}, {how_it_ended(recording)}", flush=True)

    def _write(self, recording: Recording, out: Path) -> None:
        if self.html is not None:
            from rover_rl.view.replay import write_replay

            write_replay([recording], out)
        else:
            from rover_rl.algos.video.film import film_recording

            film_recording(recording, out, self._style)

    def _resolve(self) -> ResolvedPolicy:
        return resolve_policy(self.policy, () if self.world is None else (self.world,), self.environment.given_robot)

    def _film_episodes(self) -> None:
        policy = self._resolve()
        stored = self._stored(policy)
        if stored is None:
            self._film_undriven(policy)
            return
        of = f"of {stored.policy}'s evaluation"
        if self.episode is not None:
            self._film(_drive_again(policy, stored, self.episode), self._out, of)
            return
        failed = stored.failures
        print(f"{len(failed)} of {len(stored.endings)} episodes do not reach their goal", flush=True)
        films = {episode: self._out.with_stem(f"{self._out.stem}-{episode}") for episode in failed[: self.count]}
        self._check_outputs([*films.values()])
        for episode, out in films.items():
            self._film(_drive_again(policy, stored, episode), out, of)
        if left := failed[self.count :]:
            print(f"Not filmed: {', '.join(f'{one} ({stored.endings[one]})' for one in left)}; see --count, --episode")

    def _stored(self, policy: ResolvedPolicy) -> StoredEvaluation | None:
        """Returns the evaluation of the policy, ``None`` if there is none and the episodes of a world are filmed."""
        from rover_rl.algos.evaluation.results import FILE, read_evaluation

        path = self.evaluation or policy.folder
        if path is not None and (self.evaluation or (path / FILE).is_file()):
            return read_evaluation(path, policy.name, self.world, self.backend)
        if self.failures:
            raise ValueError(f"no evaluation of {self.policy} to take failures from: rover-rl evaluate {self.policy}")
        return None

    def _film_undriven(self, policy: ResolvedPolicy) -> None:
        from rover_rl.algos.evaluation.episodes import choose_episodes
        from rover_rl.algos.video.recording import record_episodes
        from rover_rl.worlds.pool import WorldPool

        assert self.episode is not None
        world = policy.worlds[0] if policy.worlds else "maze"
        env = self.environment.description(policy.module, self.backend)
        count = None if len(WorldPool(world)) > 1 else max(self.episode, 0) + 1
        episodes = choose_episodes(world, count, self.seed, robot=env.robot)
        if not 0 <= self.episode < len(episodes):
            raise ValueError(f"episode must be between 0 and {len(episodes) - 1}, got {self.episode}")
        chosen = episodes.part(self.episode, self.episode + 1)
        (drive,) = record_episodes(policy.module, chosen, seconds=60.0, name=policy.name, env=env)
        self._film(drive, self._out, f"of the episodes for {world}")

    def _film_endless(self) -> None:
        import torch

        from rover_rl.algos.evaluation.plots import draw_reward_components
        from rover_rl.algos.video.recording import record_endless
        from rover_rl.worlds.pool import WorldPool

        policy = self._resolve()
        world = policy.worlds[0] if policy.worlds else "maze"
        # Each rover meets movers of its own, of which a film shows those of the first one.
        alone = self.view == "chase" or bool(WorldPool(world)[0].movers)
        rows = self.rovers or (1 if alone else 16)
        seconds = FILMED if self.seconds is None else self.seconds
        env = self.environment.description(policy.module, self.backend)
        recording = record_endless(policy.module, world, seconds=seconds, rows=rows, seed=self.seed or 0, env=env)
        self._write(recording, self._out)
        print(f"{'Page' if self.html else 'Film'}: {self._out}")
        if self.rewards is not None:
            draw_reward_components(torch.stack(recording.steps), self.rewards)
            print(f"Rewards: {self.rewards}")

    @property
    def _out(self) -> Path:
        return self.html or self.out


def _drive_again(policy: ResolvedPolicy, stored: StoredEvaluation, episode: int) -> Recording:
    from rover_rl.algos.video.recording import record_stored

    driven = record_stored(policy.module, stored, episode)
    ending, seconds = stored.endings[episode], stored.durations[episode]
    if (driven.ending, round(driven.seconds, 3)) != (ending, seconds):
        print(f"Episode {episode} ended otherwise in the evaluation: {ending} after {seconds:.1f} s", flush=True)
    return driven


def how_it_ended(recording: Recording) -> str:
    ending = "goal reached" if recording.ending == "goal" else recording.ending
    return f"{ending} after {recording.seconds:.1f} s"
