"""The command ``rover-rl demo``."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Literal

from rover_rl.algos.config import UNLIMITED_STEPS, TrainingConfig, training_config, with_settings
from rover_rl.checks import MAX_SECONDS, check_at_least
from rover_rl.cli.evaluate import Evaluate
from rover_rl.cli.train import INTERRUPTED, format_summary
from rover_rl.progress import ProgressDisplay
from rover_rl.sims.settings import CONTROL_DT

TRAINED_IN = "0-299@0.2-0.9"
"""Seeds and difficulties of the worlds to train in."""
FIRST_UNSEEN = 10_000
"""Seed of the first world to evaluate in. Seeds from here up are never trained in."""
MAX_WORLDS = 1_000
"""Largest number of worlds to evaluate in."""
FILMED = 20.0
"""Longest duration of the drive to a goal that is filmed, s."""


@dataclass(frozen=True)
class Demo:
    """Train a policy in about a minute, then drive it in worlds that it has never seen, beside others, and film it.

    Trains PPO with the settings of pretrained:anywhere in Warp, the fast simulator. Then drives the trained policy, the
    planner that it starts from, and a script from the same starts in Bullet, another simulator.
    """

    world: Literal["maze", "rooms", "forest"] = "maze"
    """Kind of the generated worlds to train and evaluate in."""
    minutes: float = 1.0
    """Duration of training, minutes."""
    seed: int = 0
    """Seed of the training run."""
    count: int = 32
    """Number of unseen worlds to evaluate in, with one start and goal each."""
    seconds: float = 30.0
    """Time limit of each evaluation episode, s."""
    runs: str = "runs"
    """Folder that the run is written to."""

    def __call__(self) -> int:
        # Before PyTorch is imported and a policy is trained.
        training_config("ppo", max_minutes=self.minutes, seed=self.seed).check()
        check_at_least(1, MAX_WORLDS, count=self.count)
        check_at_least(CONTROL_DT, MAX_SECONDS, seconds=self.seconds)
        print(f"Training PPO in generated worlds ({self.world}) for {self.minutes:g} minutes", flush=True)
        with ProgressDisplay("preparing"):
            from rover_rl.algos.pretrained import load_pretrained
            from rover_rl.algos.train import train

            config = self._config(load_pretrained("anywhere").config)
            _warm_up(config)
        summary = train(config)
        print(format_summary(summary), flush=True)
        if summary.interrupted:
            return INTERRUPTED
        self._evaluate(summary.folder)
        return 0

    def _config(self, base: TrainingConfig) -> TrainingConfig:
        names = (f"demo-{self.world}" if number == 1 else f"demo-{self.world}-{number}" for number in count(1))
        return with_settings(
            base,
            world=f"{self.world}:{TRAINED_IN}",
            total_steps=UNLIMITED_STEPS,
            max_minutes=self.minutes,
            seed=self.seed,
            runs=self.runs,
            name=next(name for name in names if not Path(self.runs, name).exists()),
        )

    def _evaluate(self, folder: Path) -> None:
        from rover_rl.algos.experiments.curves import draw_learning_curve
        from rover_rl.algos.policy.checkpoint import Checkpoint
        from rover_rl.algos.video.film import film_to_goal

        policies = (str(folder), "gridplanner", "scripted")
        print(f"Driving {len(policies)} policies from the same starts in {self.count} unseen worlds", flush=True)
        unseen = f"{self.world}:{FIRST_UNSEEN}-{FIRST_UNSEEN + self.count - 1}"
        Evaluate(policies, world=(unseen,), count=1, seconds=self.seconds, out=folder)()
        curve, moving = folder / "learning_curve.png", folder / "film.gif"
        draw_learning_curve([folder], curve)
        trained, world = Checkpoint.load(folder).make_actor(), f"{self.world}:{FIRST_UNSEEN}"
        film_to_goal(trained, moving, world=world, seconds=FILMED, seed=self.seed)
        print(f"Learning curve: {curve}\nFilm of the trained policy: {moving}")
        print(f"To watch more of it: rover-rl play {folder}")


def _warm_up(config: TrainingConfig) -> None:
    """Compiles the simulator and the map on their first use, before the time of the training counts."""
    from rover_rl.algos.train.env import make_training_env

    world = str(config.env.world).partition("@")[0].partition("-")[0]
    few = with_settings(config, world=world, num_envs=1, workers=1, curriculum="none")
    with closing(make_training_env(few)) as env:
        env.rollout(1)
