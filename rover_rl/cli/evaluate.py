"""``rover-rl evaluate``."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

if TYPE_CHECKING:
    from rover_rl.algos.episodes import EpisodeSet
    from rover_rl.algos.evaluate import EndlessEvaluation, Evaluation, Policy

PRETRAINED = "pretrained:"


@dataclass(frozen=True)
class Evaluate:
    """Drive fixed starts and goals with any number of policies, and measure them side by side.

    Writes evaluation.json, evaluation.csv and pictures of the paths.
    """

    policies: tyro.conf.Positional[tuple[str, ...]]
    """Folders of runs, checkpoint files, pretrained:NAME, scripted or random."""
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
    endless: bool = False
    """Drive 32 episodes of 2,000 steps with goals without end, too, as the original does."""
    jam: bool = True
    """End those at a long collision, as the contract has it; the original never does."""
    baselines: bool = True
    """Drive with the scripted and the random policy, too."""
    out: Path | None = None
    """Folder to write to; by default that of the first checkpoint, or runs/evaluation."""

    def __call__(self) -> int:
        """Evaluates, and says where the results are."""
        from rover_rl.algos.evaluate import print_table, write_evaluation
        from rover_rl.algos.plots import draw_paths

        drivers = self._drivers()
        sets = self._episode_sets(drivers)
        results: list[Evaluation | EndlessEvaluation] = []
        out = self.out or next((driver.folder for driver in drivers if driver.folder), Path("runs/evaluation"))
        pictures = []
        for world, episodes in sets.items():
            here = [driver for driver in drivers if world in (driver.worlds or sets)]
            driven = [self._drive(driver, episodes) for driver in here]
            results += driven
            if self.endless:
                results += [self._drive_endlessly(driver, world) for driver in here]
            pictures.append(out / ("paths.png" if len(sets) == 1 else f"paths-{world.replace(':', '-')}.png"))
            draw_paths(driven, pictures[-1])
        print_table(results, groups={driver.name: driver.group for driver in drivers if driver.group})
        write_evaluation(out / "evaluation.json", results)
        print(f"Results: {out / 'evaluation.json'}, evaluation.csv")
        print("Paths driven: " + ", ".join(str(picture) for picture in pictures))
        return 0

    def _drivers(self) -> list[_Driver]:
        """All policies to drive with, each of a name of its own."""
        if not self.policies:
            raise ValueError("name a policy: the folder of a run, a checkpoint, pretrained:NAME, scripted or random")
        words = dict.fromkeys((*self.policies, *(("scripted", "random") if self.baselines else ())))
        drivers = {word: _driver(word, self.world) for word in words}
        names = Counter(driver.name for driver in drivers.values())
        return [driver if names[driver.name] == 1 else replace(driver, name=word) for word, driver in drivers.items()]

    def _episode_sets(self, drivers: list[_Driver]) -> dict[str, EpisodeSet]:
        """The episodes of each world: the stored ones, unless they have to be drawn."""
        from rover_rl.algos.episodes import DEFAULT_SEED, STORED, draw_episodes, stored_episodes
        from rover_rl.sims.worlds import WORLDS, get_world

        worlds = dict.fromkeys(world for driver in drivers for world in driver.worlds)
        if not worlds:
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

    def _drive(self, driver: _Driver, episodes: EpisodeSet) -> Evaluation:
        from rover_rl.algos.evaluate import evaluate

        return evaluate(driver.policy, episodes, seconds=self.seconds, **self._settings(driver))

    def _drive_endlessly(self, driver: _Driver, world: str) -> EndlessEvaluation:
        from rover_rl.algos.evaluate import evaluate_endless

        return evaluate_endless(driver.policy, world, jam=self.jam, **self._settings(driver))

    def _settings(self, driver: _Driver) -> dict[str, Any]:
        return {"name": driver.name, "repeat": self.repeat, "lidar_points": driver.lidar_points}


@dataclass(frozen=True)
class _Driver:
    """A policy to evaluate.

    Attributes:
        name: in tables.
        policy: itself; ``None`` acts at random.
        worlds: to drive in; none: all that others drive in.
        lidar_points: readings that it sees.
        folder: of its checkpoint.
        group: what policies are called that differ in their seed only.
    """

    name: str
    policy: Policy | None
    worlds: tuple[str, ...]
    lidar_points: int = 32
    folder: Path | None = None
    group: str | None = None


def _driver(word: str, worlds: tuple[str, ...]) -> _Driver:
    """The policy that a word on the command line means.

    Raises:
        FileNotFoundError: if it names no checkpoint.
        ValueError: if it names something else.
    """
    from rover_rl.algos.baselines import ScriptedPolicy
    from rover_rl.algos.runs import Checkpoint

    if word == "random":
        return _Driver(word, None, worlds)
    if word == "scripted":
        return _Driver(word, ScriptedPolicy(), worlds)
    folder = None
    if word.startswith(PRETRAINED):
        from rover_rl.algos.pretrained import load_pretrained

        name = word.removeprefix(PRETRAINED)
        checkpoint = load_pretrained(name)
    else:
        checkpoint = Checkpoint.load(word)
        folder = Path(word) if Path(word).is_dir() else Path(word).parent
        name = folder.resolve().name
    trained_in = checkpoint.config.world
    return _Driver(
        name=name,
        policy=checkpoint.make_actor(),
        worlds=worlds or (trained_in,),
        lidar_points=checkpoint.lidar_points,
        folder=folder,
        group=f"{checkpoint.algorithm.upper()} of {trained_in}",
    )
