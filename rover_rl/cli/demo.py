"""``rover-rl demo``."""

from __future__ import annotations

from dataclasses import dataclass

from rover_rl.algos.config import PPOConfig, default_workers
from rover_rl.cli.train import INTERRUPTED, told


@dataclass(frozen=True)
class Demo:
    """Train PPO for some minutes, then drive fixed starts and goals beside a policy that acts at random."""

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
        """Trains, evaluates, draws, and says where the pictures are."""
        from rover_rl.algos.episodes import draw_episodes
        from rover_rl.algos.evaluate import evaluate
        from rover_rl.algos.plots import draw_learning_curve, draw_paths
        from rover_rl.algos.ppo import train_ppo
        from rover_rl.algos.report import print_table, write_evaluation
        from rover_rl.algos.runs import Checkpoint

        config = PPOConfig(
            world=self.world,
            max_minutes=self.minutes,
            seed=self.seed,
            num_envs=self.num_envs,
            workers=default_workers(self.num_envs),
            runs=self.runs,
        )
        config.check()
        episodes = draw_episodes(self.world, self.count)
        print(f"Training PPO in {self.world} for {self.minutes:g} minutes with {config.num_envs} rovers")
        summary = train_ppo(config)
        print(told(summary))
        if summary.interrupted:
            return INTERRUPTED
        folder = summary.folder
        trained = evaluate(Checkpoint.load(folder).make_actor(), episodes, name="trained")
        random = evaluate(None, episodes)
        print_table([trained, random])
        write_evaluation(folder / "evaluation.json", [trained, random])
        draw_learning_curve([folder], folder / "learning_curve.png", random)
        draw_paths([trained, random], folder / "paths.png")
        print(f"Learning curve: {folder / 'learning_curve.png'}\nPaths driven: {folder / 'paths.png'}")
        return 0
