"""The command ``rover-rl demo``."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rover_rl.algos.config import UNLIMITED_STEPS, TrainingConfig, task_config, with_settings
from rover_rl.cli.train import INTERRUPTED, format_summary
from rover_rl.progress import ProgressDisplay
from rover_rl.tasks.task import get_task

if TYPE_CHECKING:
    from rover_rl.algos.evaluation.results import Evaluation
    from rover_rl.algos.policy.checkpoint import Checkpoint

TASK = "inspect"  # task that is learned. Policies are tested on the first of its 256 stored start-goal pairs.
FILMED = 16.0  # duration of the drive that is filmed, s
POLICIES = ("pretrained:crowd", "gridplanner-moving", "scripted")
UNSEEN = {"plaza:50000-50015": "people in a plaza", "field:50000-50015@1": "fast obstacles in a field"}
"""Worlds that no training has seen, in which the policies are compared."""


@dataclass(frozen=True)
class Demo:
    """Train a policy from nothing in a minute, draw its learning curve and film it; then drive a pretrained policy.

    Learns the task inspect with PPO in Warp. Tests the policy before, along the way and after, from starts that it was
    not trained from. Then drives pretrained:crowd, a planner and a script among people and fast obstacles.
    """

    minutes: float = 1.0
    """Duration of training, minutes."""
    seed: int = 0
    """Seed of the training run."""
    episodes: int = 64
    """Number of episodes of each test, at most 256."""
    seconds: float = 30.0
    """Time limit of each episode, s."""
    pretrained: bool = True
    """Also drive the pretrained policy, the planner and the script."""
    runs: str = "runs"
    """Folder that the run is written to."""

    def __call__(self) -> int:
        config = self._config()
        config.check()
        print(f"1. A policy that has learned nothing drives {TASK} (the first time, Warp compiles)", flush=True)
        with ProgressDisplay("importing"):
            from rover_rl.algos.train import train, untrained

            policy = untrained(config)
        before = self._test(policy)
        reached = f"It reaches {before.success_rate:.0%} of {self.episodes} goals"
        print(f"{reached}\n2. PPO trains it for {self.minutes:g} minutes, from its reward alone", flush=True)
        summary = train(config)
        print(format_summary(summary), flush=True)
        if summary.interrupted:
            return INTERRUPTED
        self._show(summary.folder, before)
        if self.pretrained:
            self._compare()
        print(f"More of the trained policy: rover-rl play {summary.folder}\nMore tasks: rover-rl tasks")
        return 0

    def _config(self) -> TrainingConfig:
        names = (f"demo-{TASK}" if number == 1 else f"demo-{TASK}-{number}" for number in count(1))
        name = next(name for name in names if not Path(self.runs, name).exists())
        budget = {"total_steps": UNLIMITED_STEPS, "max_minutes": self.minutes, "snapshots": 5}
        return with_settings(task_config(TASK), **budget, seed=self.seed, runs=self.runs, name=name)

    def _test(self, policy: Checkpoint) -> Evaluation:
        from rover_rl.algos.evaluation.episodes import stored_episodes
        from rover_rl.algos.evaluation.evaluate import evaluate, test_env

        actor, name, task = policy.make_actor(), f"policy after {policy.steps:,} steps", get_task(TASK)
        episodes, env = stored_episodes(TASK).first(self.episodes), test_env(task, actor)
        return evaluate(actor, episodes, name=name, seconds=self.seconds, rows=self.episodes, env=env)

    def _show(self, folder: Path, before: Evaluation) -> None:
        from rover_rl.algos.evaluation.report import write_evaluation
        from rover_rl.algos.experiments.curves import draw_test_curve
        from rover_rl.algos.policy.checkpoint import Checkpoint
        from rover_rl.algos.video.film import Style, film

        print("3. The trained policy drives to the same goals, which it was not trained with", flush=True)
        trained, moving, curve = Checkpoint.load(folder), folder / "film.gif", folder / "test_curve.png"
        after = self._test(trained)
        print(f"It reaches {after.success_rate:.0%} of them; untrained, it was {before.success_rate:.0%}", flush=True)
        style = Style(width=400, height=300, speed=2.0)
        film(trained.make_actor(), moving, style, world=TASK, seconds=FILMED, seed=self.seed, env=get_task(TASK).env)
        print(f"Its film: {moving}", flush=True)
        along = map(Checkpoint.load, sorted(folder.glob("snapshots/*.pt"))[:-1])  # the last one is the trained policy
        tests = {0: before}
        for policy in along:
            tests[policy.steps] = self._test(policy)
            print(f"After {policy.steps:,} steps, it was {tests[policy.steps].success_rate:.0%}", flush=True)
        tests[trained.steps] = after
        draw_test_curve(folder, tests, curve)
        write_evaluation(folder / "evaluation.json", [*tests.values()])
        print(f"Its learning curve: {curve}", flush=True)

    def _compare(self) -> None:
        from rover_rl.algos.evaluation.episodes import choose_episodes
        from rover_rl.algos.evaluation.evaluate import Request, evaluate_all, test_env
        from rover_rl.algos.policy.names import resolve_policies

        print(f"4. {', '.join(POLICIES)} drive in worlds that no training has seen", flush=True)
        task, settings = get_task("field"), dict[str, Any](seconds=self.seconds)
        requests = [
            Request(one.module, episodes, settings | {"name": one.name, "env": test_env(task, one.module)})
            for episodes in [choose_episodes(world, 1) for world in UNSEEN]
            for one in resolve_policies(POLICIES)
        ]
        results = evaluate_all(requests)
        for world, what in UNSEEN.items():
            reached = [f"{one.name} {one.success_rate:.0%}" for one in results if one.episodes.name == world]
            print(f"{what} ({world}): {', '.join(reached)}", flush=True)
