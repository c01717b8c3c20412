"""``rover-rl demo``."""

from __future__ import annotations

from dataclasses import dataclass, replace

from rover_rl.algos.config import ENDLESS, PPOConfig
from rover_rl.cli.train import INTERRUPTED, format_summary, train

FILMED = 12.0
"""Seconds of the film."""


@dataclass(frozen=True)
class Demo:
    """Train PPO for some minutes, drive fixed starts and goals beside others, and film the policy of the package.

    The training has the settings of the package's policy for the world.
    """

    world: str = "moon"
    """World to train and drive in: inspect, moon or maze."""
    minutes: float = 4.0
    """Of training."""
    seed: int = 0
    """Of the training."""
    num_envs: int = PPOConfig.num_envs
    """Rovers that drive at once in training."""
    count: int = 64
    """Episodes to evaluate on, each with one goal to be reached within 60 s."""
    runs: str = "runs"
    """Folder that the run is written into."""

    def __call__(self) -> int:
        """Trains, evaluates, draws, films, and says where the pictures are."""
        from rover_rl.algos.evaluation.episodes import draw_episodes
        from rover_rl.algos.evaluation.evaluate import evaluate
        from rover_rl.algos.evaluation.plots import draw_learning_curve, draw_paths
        from rover_rl.algos.evaluation.report import print_table, write_evaluation
        from rover_rl.algos.policy.checkpoint import Checkpoint
        from rover_rl.algos.pretrained import load_pretrained
        from rover_rl.algos.video.film import film
        from rover_rl.sims.worlds import get_world

        get_world(self.world)
        name = f"{self.world.split(':')[0]}-ppo"
        package = load_pretrained(name)
        expert = package.make_actor()
        config = replace(
            package.config,
            world=self.world,
            total_steps=ENDLESS,
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
