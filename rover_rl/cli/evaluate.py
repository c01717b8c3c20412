"""``rover-rl evaluate``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro


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
