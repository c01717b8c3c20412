"""The command line: ``rover-rl train | evaluate | worlds | demo``.

What a command needs is imported when it runs, so that ``--help`` comes at once.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from rover_rl.algos.config import PPOConfig, default_workers

if TYPE_CHECKING:
    from rover_rl.algos.ppo import TrainingSummary

FAILED, INTERRUPTED = 2, 130
"""Exit codes for an error of the user's, and for Ctrl-C."""


@dataclass(frozen=True)
class Train:
    """Train a policy. Writes checkpoint.pt, config.json, progress.csv, learning_curve.png to a new folder."""

    config: tyro.conf.OmitArgPrefixes[PPOConfig] = field(default_factory=PPOConfig)
    algo: Literal["ppo"] = "ppo"
    """Learning algorithm."""

    def __call__(self) -> int:
        """Trains, and says where the policy is."""
        from rover_rl.algos.plots import draw_learning_curve
        from rover_rl.algos.ppo import train_ppo

        summary = train_ppo(self.config)
        if summary.steps:
            draw_learning_curve(summary.folder / "progress.csv", summary.folder / "learning_curve.png")
        print(f"{_told(summary)}\nTry it: rover-rl evaluate {summary.checkpoint}")
        return INTERRUPTED if summary.interrupted else 0


@dataclass(frozen=True)
class Evaluate:
    """Drive fixed starts and goals with a policy and at random. Writes evaluation.json and paths.png."""

    checkpoint: tyro.conf.Positional[Path]
    """A checkpoint.pt that training wrote."""
    world: str | None = None
    """World to drive in; by default the one that the policy was trained in."""
    count: int = 64
    """Episodes, each with one goal."""
    seconds: float = 60.0
    """Time in which the goal has to be reached."""
    seed: int = 20_000
    """Of starts and goals."""
    repeat: int = 1
    """Steps of 50 ms that each action is held for."""
    out: Path | None = None
    """Folder to write to; by default that of the checkpoint."""

    def __call__(self) -> int:
        """Evaluates, and says where the results are."""
        from rover_rl.algos.evaluate import draw_episodes, evaluate, print_table, write_evaluation
        from rover_rl.algos.plots import draw_paths
        from rover_rl.algos.runs import Checkpoint

        checkpoint = Checkpoint.load(self.checkpoint)
        episodes = draw_episodes(self.world or checkpoint.config["world"], self.count, self.seed)
        settings: Any = {"repeat": self.repeat, "seconds": self.seconds}
        trained = evaluate(checkpoint.make_actor(), episodes, name=checkpoint.algorithm.upper(), **settings)
        random = evaluate(None, episodes, **settings)
        print_table([trained, random])
        out = self.out or self.checkpoint.parent
        write_evaluation(out / "evaluation.json", [trained, random])
        draw_paths([trained, random], out / "paths.png")
        print(f"Results: {out / 'evaluation.json'}\nPicture: {out / 'paths.png'}")
        return 0


@dataclass(frozen=True)
class Worlds:
    """List the worlds, and draw a map of each."""

    out: Path = Path("worlds")
    """Folder for the maps."""

    def __call__(self) -> int:
        """Draws the maps."""
        from rover_rl.algos.runs import written_whole
        from rover_rl.sims.robots import get_robot
        from rover_rl.sims.worlds import WORLDS, get_world
        from rover_rl.sims.worlds.draw import draw_world

        for name in WORLDS:
            world, path = get_world(name), self.out / f"{name}.png"
            with written_whole(path) as temporary:
                draw_world(world, get_robot("rover_zero"), temporary)
            width, depth = (f"{high - low:.0f}" for low, high in world.spawn_range)
            print(f"{name:8} {len(world.obstacles):3} obstacles, starts on {width} x {depth} m: {path}")
        return 0


@dataclass(frozen=True)
class Demo:
    """Train PPO for some minutes, then drive fixed starts and goals beside a policy that acts at random."""

    world: str = "maze"
    """World to train and drive in: inspect, moon or maze."""
    minutes: float = 4.0
    """Of training."""
    seed: int = 0
    """Of the training."""
    num_envs: int = PPOConfig.num_envs
    """Rovers that drive at once in training."""
    count: int = 32
    """Episodes to evaluate on, each with one goal to be reached within 60 s."""
    runs: str = "runs"
    """Folder that the run is written into."""

    def __call__(self) -> int:
        """Trains, evaluates, draws, and says where the pictures are."""
        from rover_rl.algos.evaluate import draw_episodes, evaluate, print_table, write_evaluation
        from rover_rl.algos.plots import draw_learning_curve, draw_paths
        from rover_rl.algos.ppo import train_ppo
        from rover_rl.algos.runs import Checkpoint

        # For some minutes rather than for 3 million steps: smaller and larger-stepped updates, and short episodes,
        # so that rovers do not spend the time before the goals that are hardest to reach.
        config = PPOConfig(
            world=self.world,
            max_minutes=self.minutes,
            seed=self.seed,
            num_envs=self.num_envs,
            workers=default_workers(self.num_envs),
            runs=self.runs,
            episode_steps=400,
            decisions=16,
            minibatch=256,
            learning_rate=1e-3,
        )
        config.check()
        episodes = draw_episodes(self.world, self.count)
        print(f"Training PPO in {self.world} for {self.minutes:g} minutes with {config.num_envs} rovers")
        summary = train_ppo(config)
        print(_told(summary))
        if summary.interrupted:
            return INTERRUPTED
        trained = evaluate(
            Checkpoint.load(summary.checkpoint).make_actor(), episodes, name="trained", repeat=config.repeat
        )
        random = evaluate(None, episodes, repeat=config.repeat)
        print_table([trained, random])
        folder = summary.folder
        write_evaluation(folder / "evaluation.json", [trained, random])
        draw_learning_curve(folder / "progress.csv", folder / "learning_curve.png", random)
        draw_paths([trained, random], folder / "paths.png")
        print(f"Learning curve: {folder / 'learning_curve.png'}\nPaths driven: {folder / 'paths.png'}")
        return 0


Command = (
    Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Worlds, tyro.conf.subcommand("worlds")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)


def main(args: list[str] | None = None) -> int:
    """Runs a command; returns the exit code.

    Args:
        args: of the command line; ``None`` takes the process's own.
    """
    try:
        command = tyro.cli(Command, args=args, prog="rover-rl", description="Rovers that learn to drive to a goal.")
        return command()
    except (ValueError, OSError) as error:
        print(f"rover-rl: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("rover-rl: interrupted", file=sys.stderr)
        return INTERRUPTED


def _told(summary: TrainingSummary) -> str:
    stopped = "Interrupted" if summary.interrupted else "Trained"
    return f"{stopped} after {summary.steps:,} steps in {summary.minutes:.1f} minutes: {summary.checkpoint}"


if __name__ == "__main__":
    sys.exit(main())
