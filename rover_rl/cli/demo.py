"""The command ``rover-rl demo``."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rover_rl.algos.config import UNLIMITED_STEPS, TrainingConfig, training_config, with_settings
from rover_rl.checks import MAX_COUNT, MAX_SECONDS, check_at_least
from rover_rl.cli.train import INTERRUPTED, format_summary
from rover_rl.progress import ProgressDisplay
from rover_rl.registry import perhaps
from rover_rl.sims.timing import CONTROL_DT

if TYPE_CHECKING:
    from rover_rl.algos.evaluation.evaluate import Policy
    from rover_rl.algos.evaluation.results import Evaluation

WORLDS = ("inspect", "maze", "moon")
"""Worlds that the package stores starts and goals for."""
FILMED = 8.0
"""Duration of the drive that is filmed, s."""
SETTINGS = {"num_envs": 256, "minibatch": 512, "imitation": 0.25}
"""Settings of training that differ from those of ``pretrained:moon-ppo``: they need fewer steps."""
MAZE: dict[str, Any] = {
    "path_reward": 10.0,
    "gamma": 0.97,
    "epochs": 6,
    "entropy_coef": 0.0,
    "max_std": 0.4,
    "north_up": True,
    "mirror_augmentation": False,
    "hidden": (256, 256),
}
"""Further settings of training in a maze, where progress in a straight line misleads."""


@dataclass(frozen=True)
class Demo:
    """Train a policy in about a minute, evaluate it beside other policies, and film it.

    Trains PPO in the fast simulator, Warp. Then drives the trained policy, pretrained:anywhere, the scripted and the
    random policy from the same starts in another simulator, Bullet.
    """

    world: str = "moon"
    """World to train and evaluate in: inspect, moon or maze."""
    minutes: float = 1.0
    """Duration of training, minutes."""
    seed: int = 0
    """Seed of the training run."""
    count: int = 48
    """Number of evaluation episodes, each with one goal."""
    seconds: float = 20.0
    """Time limit of each evaluation episode, s."""
    runs: str = "runs"
    """Folder that the run is written to."""

    def __call__(self) -> int:
        """Trains, evaluates, plots and films, and prints the paths of the results."""
        self._check()
        print(f"Training PPO in {self.world} for {self.minutes:g} minutes, after some preparation", flush=True)
        with ProgressDisplay("preparing"):
            from rover_rl.algos.pretrained import load_pretrained
            from rover_rl.algos.train import train

            config = self._config(load_pretrained("moon-ppo").config)
            _warm_up(config)
        summary = train(config)
        print(format_summary(summary), flush=True)
        if summary.interrupted:
            return INTERRUPTED
        self._evaluate(summary.folder, load_pretrained("anywhere").make_actor())
        return 0

    def _check(self) -> None:
        """Checks the options, before PyTorch is imported and a policy is trained."""
        if self.world.split(":")[0] not in WORLDS:
            raise ValueError(
                f"unknown world {self.world!r}{perhaps(self.world, WORLDS)}; use one of {[*WORLDS]}, or 'name:seed'"
            )
        training_config("ppo", max_minutes=self.minutes, seed=self.seed).check()
        check_at_least(1, MAX_COUNT, count=self.count)
        check_at_least(CONTROL_DT, MAX_SECONDS, seconds=self.seconds)

    def _config(self, base: TrainingConfig) -> TrainingConfig:
        """Returns the settings of the training, which start from those of a pretrained policy."""
        config = with_settings(
            base,
            world=self.world,
            total_steps=UNLIMITED_STEPS,
            max_minutes=self.minutes,
            seed=self.seed,
            runs=self.runs,
            name=None,
            **SETTINGS,
        )
        if self.world.split(":")[0] != "maze":
            return config
        return with_settings(config, action=replace(config.env.action, min_speed=0.0), **MAZE)

    def _evaluate(self, folder: Path, pretrained: Policy) -> None:
        """Evaluates the trained policy beside others, and writes figures, plots and a film to the run's folder."""
        from rover_rl.algos.evaluation.episodes import choose_episodes
        from rover_rl.algos.evaluation.parallel import GoalRequest, evaluate_all
        from rover_rl.algos.policy.baselines import ScriptedPolicy
        from rover_rl.algos.policy.checkpoint import Checkpoint

        trained = Checkpoint.load(folder).make_actor()
        policies = {"trained": trained, "pretrained": pretrained, "scripted": ScriptedPolicy(), "random": None}
        print(f"Driving {len(policies)} policies from the same {self.count} starts in Bullet", flush=True)
        episodes = choose_episodes(self.world, self.count)
        options = {"seconds": self.seconds}
        evaluations = evaluate_all(
            [GoalRequest(policy, episodes, {**options, "name": name}) for name, policy in policies.items()]
        )
        self._show(folder, trained, evaluations)  # type: ignore[arg-type]  # requests with goals give evaluations

    def _show(self, folder: Path, trained: Policy, evaluations: list[Evaluation]) -> None:
        """Prints the results, and draws the learning curve, the paths and a film of the trained policy."""
        from rover_rl.algos.evaluation.plots import draw_learning_curve, draw_paths
        from rover_rl.algos.evaluation.report import print_table, write_evaluation
        from rover_rl.algos.video.film import film

        pictures = {
            "Learning curve": folder / "learning_curve.png",
            "Paths driven": folder / "paths.png",
            "Film of the trained policy": folder / "film.gif",
        }
        curve, paths, moving = pictures.values()
        with ProgressDisplay("drawing"):
            write_evaluation(folder / "evaluation.json", evaluations)
            draw_learning_curve([folder], curve, evaluations[-1])
            draw_paths(evaluations, paths)
        print_table(evaluations)
        film(trained, moving, world=self.world, seconds=FILMED, seed=self.seed, width=480, height=360)
        print("\n".join(f"{what}: {path}" for what, path in pictures.items()))
        print(f"To watch more of it: rover-rl play {folder}")


def _warm_up(config: TrainingConfig) -> None:
    """Makes the world, and compiles the simulator on its first use, before the time of the training counts."""
    from rover_rl.envs import RoverEnv
    from rover_rl.sims.worlds import Terrain, World, get_world

    get_world(config.env.world_names[0])
    flat = World("flat", Terrain.flat((12.0, 12.0)))
    with closing(RoverEnv(world_n=flat, backend=config.env.backend)) as env:
        env.reset()
