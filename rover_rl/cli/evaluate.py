"""``rover-rl evaluate``."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from rover_rl.algos.config import Physics, experiments
from rover_rl.cli.policies import ResolvedPolicy, resolve_policy

if TYPE_CHECKING:
    from rover_rl.algos.evaluation.episodes import EpisodeSet
    from rover_rl.algos.evaluation.evaluate import EndlessEvaluation, Evaluation

LOG = ".jsonl"
"""What the name of a log of rover-rl drive ends with."""


@dataclass(frozen=True)
class Evaluate:
    """Drive fixed starts and goals with any number of policies, and measure them side by side.

    Writes evaluation.json, evaluation.csv and pictures of the paths.
    """

    policies: tyro.conf.Positional[tuple[str, ...]]
    """Folders of runs, checkpoint files, pretrained:NAME, ONNX files; scripted and random are yardsticks. A log of
    rover-rl drive (.jsonl) is measured as it was driven."""
    world: tuple[str, ...] = ()
    """Worlds to drive in; by default the one that each policy was trained in."""
    count: int | None = None
    """Episodes in each world: the first of the 256 stored ones, or of those that are drawn. By default 256."""
    seed: int | None = None
    """Draw other starts and goals from this seed instead of the stored ones."""
    seconds: float = 60.0
    """Time in which a goal has to be reached."""
    repeat: int = 1
    """Steps of 50 ms that each action is held for."""
    backend: Literal["bullet", "warp"] = "bullet"
    """Simulator to drive in; warp needs the extra of that name."""
    physics: Physics = "default"
    """Preset of Bullet's physics to drive in: see docs/physics.md."""
    endless: bool = False
    """Drive 32 episodes of 2,000 steps with goals without end, too, as the original does."""
    jam: bool = True
    """End those at a long collision, as the contract has it; the original never does."""
    out: Path | None = None
    """Folder to write to; by default that of the first checkpoint, or runs/evaluation."""

    def __call__(self) -> int:
        """Evaluates, and says where the results are."""
        from rover_rl.algos.deploy.drive_log import read_drives
        from rover_rl.algos.evaluation.plots import draw_paths
        from rover_rl.algos.evaluation.report import print_table, write_evaluation

        logs = {Path(word): read_drives(Path(word)) for word in self.policies if word.endswith(LOG)}
        drivers = self._drivers()
        sets = self._episode_sets(drivers)
        results: list[Evaluation | EndlessEvaluation] = []
        out = self.out or next((driver.folder for driver in drivers if driver.folder), Path("runs/evaluation"))
        # Now, and not after minutes of driving, is the time to hear that nothing can be written there.
        out.mkdir(parents=True, exist_ok=True)
        pictures: dict[Path, list[Evaluation]] = {}
        for world, episodes in sets.items():
            here = [driver for driver in drivers if world in (driver.worlds or sets)]
            driven = [self._drive(driver, episodes) for driver in here]
            results += driven
            if self.endless:
                results += [self._drive_endlessly(driver, world) for driver in here]
            pictures[out / ("paths.png" if len(sets) == 1 else f"paths-{world.replace(':', '-')}.png")] = driven
        for log, drives in logs.items():
            results += drives
            for number, drive in enumerate(drives):
                pictures[out / f"paths-{log.stem}{f'-{number}' if number else ''}.png"] = [drive]
        trained = {driver.name: driver.config for driver in drivers if driver.config}
        try:
            write_evaluation(out / "evaluation.json", results)
            for picture, shown in pictures.items():
                draw_paths(shown, picture)
        finally:
            # Also where a file could not be written: driving took long.
            print_table(results, groups=dict(zip(trained, experiments([*trained.values()]), strict=True)))
        print(f"Results: {out / 'evaluation.json'}, evaluation.csv")
        print("Paths driven: " + ", ".join(str(picture) for picture in pictures))
        return 0

    def _drivers(self) -> list[ResolvedPolicy]:
        """All policies to drive with, each of a name of its own."""
        if not self.policies:
            raise ValueError("name a policy: the folder of a run, a checkpoint, pretrained:NAME, scripted or random")
        words = dict.fromkeys(word for word in self.policies if not word.endswith(LOG))
        drivers = {word: resolve_policy(word, self.world) for word in words}
        names = Counter(driver.name for driver in drivers.values())
        return [driver if names[driver.name] == 1 else replace(driver, name=word) for word, driver in drivers.items()]

    def _episode_sets(self, drivers: list[ResolvedPolicy]) -> dict[str, EpisodeSet]:
        """The episodes of each world: the stored ones, unless they have to be drawn."""
        from rover_rl.algos.evaluation.episodes import DEFAULT_SEED, STORED, draw_episodes, stored_episodes
        from rover_rl.sims.worlds import WORLDS, get_world

        worlds = dict.fromkeys(world for driver in drivers for world in driver.worlds)
        if not worlds and drivers:
            raise ValueError("say which --world to drive in; these policies were trained in none")
        for world in worlds:
            get_world(world)
        count = STORED if self.count is None else self.count
        return {
            world: stored_episodes(world).first(count)
            if world in WORLDS and self.seed is None and count <= STORED
            else draw_episodes(world, count, DEFAULT_SEED if self.seed is None else self.seed)
            for world in worlds
        }

    def _drive(self, driver: ResolvedPolicy, episodes: EpisodeSet) -> Evaluation:
        from rover_rl.algos.evaluation.evaluate import evaluate

        return evaluate(driver.policy, episodes, seconds=self.seconds, **self._settings(driver))

    def _drive_endlessly(self, driver: ResolvedPolicy, world: str) -> EndlessEvaluation:
        from rover_rl.algos.evaluation.evaluate import evaluate_endless

        return evaluate_endless(driver.policy, world, jam=self.jam, **self._settings(driver))

    def _settings(self, driver: ResolvedPolicy) -> dict[str, Any]:
        return {
            "name": driver.name,
            "repeat": self.repeat,
            "lidar_points": driver.lidar_points,
            "backend": self.backend,
            "physics": self.physics,
        }
