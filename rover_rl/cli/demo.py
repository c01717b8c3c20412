"""``rover-rl demo``."""

from __future__ import annotations

from dataclasses import dataclass

from rover_rl.algos.config import PPOConfig, default_workers
from rover_rl.cli.train import INTERRUPTED, told


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
        print(told(summary))
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
