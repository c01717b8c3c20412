"""Worlds like those of DynaBARN, in the format of ``rover-rl benchmark dynabarn``.

    python -m benchmarks.moving_fields --out fields.json
    rover-rl benchmark dynabarn --data fields.json foresight gridplanner --backend warp

They have the published numbers: cylinders with a radius of 0.5 m in a yard of 20 x 20 m, 5 to 14 of 0.5 to 0.95 m/s
(easy), 15 to 19 of 1.0 to 1.45 m/s (medium) and 20 to 24 of 1.5 to 1.95 m/s (hard). Each goes round a polyline through
the yard again and again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from rover_rl.files import write_json

RADIUS = 0.5  # radius of the cylinders, m
REACH = 9.0  # largest x and y of a corner of a path, m
GROUPS = {"easy": ((5, 14), (0.5, 0.95)), "medium": ((15, 19), (1.0, 1.45)), "hard": ((20, 24), (1.5, 1.95))}
"""Numbers and speeds (m/s) of the cylinders."""
CORNERS = (3, 6)  # numbers of corners of a path


@dataclass(frozen=True)
class Options:
    """Options of the script."""

    out: Path
    """File to write."""
    count: int = 20
    """Number of worlds of each difficulty."""
    seed: int = 7
    """Seed of the worlds."""


def make_fields(count: int, seed: int) -> dict[str, object]:
    """Returns worlds: ``count`` easy ones, then as many medium and hard ones."""
    motions, worlds = {}, {}
    for group, ((fewest, most), speeds) in enumerate(GROUPS.values()):
        for world in range(group * count, (group + 1) * count):
            rng = np.random.default_rng((seed, world))
            names = [f"world_{world}_{number}" for number in range(rng.integers(fewest, most + 1))]
            motions.update({name: _motion(rng, rng.uniform(*speeds)) for name in names})
            worlds[str(world)] = names
    return {"cylinder_radius": RADIUS, "worlds": worlds, "motions": motions}


def _motion(rng: np.random.Generator, speed: float) -> dict[str, object]:
    """Returns a closed polyline with random corners, gone round at a speed."""
    corners = rng.uniform(-REACH, REACH, (rng.integers(CORNERS[0], CORNERS[1] + 1), 2))
    path = np.vstack((corners, corners[:1]))
    steps = np.diff(path, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    times = np.concatenate(([0.0], np.cumsum(lengths / speed)))
    yaws = np.append(np.arctan2(steps[:, 1], steps[:, 0]), math.atan2(steps[0, 1], steps[0, 0]))
    keys = np.column_stack((times, path, yaws)).round(4)
    return {"period": float(keys[-1, 0]), "keys": keys.tolist()}


def main() -> None:
    """Writes the worlds."""
    options = tyro.cli(Options, description=__doc__)
    write_json(options.out, make_fields(options.count, options.seed))


if __name__ == "__main__":
    main()
