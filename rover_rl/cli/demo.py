"""The command ``rover-rl demo``."""

from __future__ import annotations

from dataclasses import dataclass

from rover_rl.algos.config import UNLIMITED_STEPS, with_settings
from rover_rl.cli.train import INTERRUPTED, format_summary

FILMED = 12.0
"""Duration of the video, s."""


@dataclass(frozen=True)
class Demo:
    """Train PPO for a few minutes, evaluate it against a pretrained and a random policy, and film the pretrained one.

    Uses the training settings of the pretrained policy for the world.
    """

    world: str = "moon"
    """World to train and evaluate in: inspect, moon or maze."""
    minutes: float = 4.0
    """Duration of training, minutes."""
    seed: int = 0
    """Seed of the training run."""
    num_envs: int = 64
    """Number of rovers in training."""
    count: int = 64
    """Number of evaluation episodes, each with one goal and a time limit of 60 s."""
    runs: str = "runs"
    """Folder that the run is written to."""

    def __call__(self) -> int:
        """Trains, evaluates, plots and films, and prints the paths of the results."""
        from rover_rl.algos.evaluation.episodes import draw_episodes
        from rover_rl.algos.evaluation.evaluate import evaluate
        from rover_rl.algos.evaluation.plots import draw_learning_curve, draw_paths
        from rover_rl.algos.evaluation.report import print_table, write_evaluation
        from rover_rl.algos.policy.checkpoint import Checkpoint
        from rover_rl.algos.pretrained import load_pretrained
        from rover_rl.algos.train import train
        from rover_rl.algos.video.film import film
        from rover_rl.sims.worlds import get_world

        get_world(self.world)
        name = f"{self.world.split(':')[0]}-ppo"
        package = load_pretrained(name)
        expert = package.make_actor()
        config = with_settings(
            package.config,
            world=self.world,
            total_steps=UNLIMITED_STEPS,
            max_minutes=self.minutes,
            seed=self.seed,
            num_envs=self.num_envs,
            runs=self.runs,
        )
        config.check()
        episodes = draw_episodes(self.world, self.count)
        print(f"Training PPO in {self.world} for {self.minutes:g} minutes with {config.num_envs} rovers")
        summary = train(config)
        print(format_summary(summary))
        if summary.interrupted:
            return INTERRUPTED
        folder = summary.folder
        trained = evaluate(Checkpoint.load(folder).make_actor(), episodes, name="trained")
        pretrained = evaluate(expert, episodes, name="pretrained")
        random = evaluate(None, episodes)
        print_table([trained, pretrained, random])
        write_evaluation(folder / "evaluation.json", [trained, pretrained, random])
        pictures = {
            "Learning curve": folder / "learning_curve.png",
            "Paths driven": folder / "paths.png",
            f"Film of pretrained:{name}": folder / f"{name}.gif",
        }
        curve, paths, moving = pictures.values()
        draw_learning_curve([folder], curve, random)
        draw_paths([trained, pretrained, random], paths)
        film(expert, moving, world=self.world, seconds=FILMED)
        print("\n".join(f"{what}: {path}" for what, path in pictures.items()))
        return 0
