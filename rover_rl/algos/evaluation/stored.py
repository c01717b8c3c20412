"""Episodes of evaluations that were written to ``evaluation.json``, to drive them again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.parallel import EPISODES_PER_PART
from rover_rl.envs.config import EnvConfig, Randomization, env_from_plain
from rover_rl.worlds.pool import WorldPool

FILE = "evaluation.json"  # name of the file in the folder of a run


@dataclass(frozen=True)
class StoredEvaluation:
    """An evaluation with one goal per episode, as ``evaluation.json`` holds it.

    ``seconds`` is the time limit of an episode, s, and ``durations`` are those of the episodes, s. Each action was held
    for ``action_repeat`` steps.
    """

    policy: str
    episodes: EpisodeSet
    action_repeat: int
    seconds: float
    env: EnvConfig
    endings: list[str]
    durations: list[float]

    @property
    def failures(self) -> list[int]:
        """Indices of the episodes that did not reach their goal."""
        return [index for index, ending in enumerate(self.endings) if ending != "goal"]

    def telling(self, worst: int, good: int) -> list[int]:
        """Returns the indices of some episodes that are worth seeing.

        They are the ``worst`` ones, failures or else those that took longest, and ``good`` ones that took as long as
        most.
        """
        failed, all_ones = set(self.failures), range(len(self.endings))
        # Failures first, in their order, then the others by their duration.
        order = sorted(all_ones, key=lambda one: (one not in failed, 0.0 if one in failed else -self.durations[one]))
        usual = [one for one in order[worst:] if one not in failed]
        middle = max(0, (len(usual) - good) // 2)
        return order[:worst] + usual[middle : middle + good]

    def to_drive(self, episode: int) -> EpisodeSet:
        """Returns the episodes to drive for the same drive as in the evaluation: the episode alone if possible.

        The random numbers of a randomized environment depend on the episodes that were driven with it. Raises
        ``ValueError`` if there is no such episode.
        """
        if not 0 <= episode < len(self.episodes):
            raise ValueError(f"episode must be between 0 and {len(self.episodes) - 1}, got {episode}")
        exact = self.env.randomization == Randomization() and self.env.pose.source in ("truth", "odometry")
        size = 1 if exact else EPISODES_PER_PART
        begin = episode // size * size
        return self.episodes.part(begin, begin + size).with_used_worlds()


def read_evaluation(path: Path, policy: str, world: str | None = None, backend: str | None = None) -> StoredEvaluation:
    """Reads the first evaluation of a policy from a file, or from ``evaluation.json`` in a folder.

    Args:
        world: name of the world, or range of worlds; ``None``: any.
        backend: name of the simulator; ``None``: any.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file holds no such evaluation.
    """
    path = path / FILE if path.is_dir() else path
    try:
        entries = json.loads(path.read_text())
        driven = [entry for entry in entries if entry["mode"] == "one goal" and entry["backend"] != "ros2"]
        wanted = {"policy": policy, "world": world, "backend": backend}
        given = {key: value for key, value in wanted.items() if value is not None}
        found = [entry for entry in driven if all(entry[key] == value for key, value in given.items())]
        if found:
            return _stored(found[0])
        held = sorted({", ".join(entry[key] for key in given) for entry in driven})
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is no evaluation of rover-rl evaluate") from error
    raise ValueError(f"{path} has no evaluation of {', '.join(given.values())}; it has {'; '.join(held) or 'none'}")


def _stored(entry: Mapping[str, Any]) -> StoredEvaluation:
    rows, pool = entry["episodes"], WorldPool(entry["world"])
    start, goal, shortest = (torch.tensor([row[key] for row in rows]) for key in ("start", "goal", "shortest"))
    worlds = torch.tensor([row.get("world", 0) for row in rows])
    env = EnvConfig(backend=entry["backend"]) if entry["env"] is None else env_from_plain(entry["env"], FILE)
    return StoredEvaluation(
        entry["policy"],
        EpisodeSet(entry["world"], pool, entry["seed"], start, goal, shortest, world_index=worlds),
        entry["action_repeat"],
        entry["time_limit"],
        replace(env, world=entry["world"]),
        [row["ending"] for row in rows],
        [row["seconds"] for row in rows],
    )
