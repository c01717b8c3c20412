"""``rover-rl worlds``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Worlds:
    """List the worlds, and draw a map of each."""

    out: Path = Path("worlds")
    """Folder for the maps."""

    def __call__(self) -> int:
        """Draws the maps."""
        from rover_rl.files import written_whole
        from rover_rl.sims.robots import get_robot
        from rover_rl.sims.worlds import WORLDS, get_world
        from rover_rl.sims.worlds.draw import draw_world

        for name in WORLDS:
            world, path = get_world(name), self.out / f"{name}.png"
            with written_whole(path) as temporary:
                draw_world(world, get_robot("rover_zero"), temporary)
            width, depth = (f"{high - low:.0f}" for low, high in world.spawn_range)
            print(f"{name:8} {len(world.obstacles):3} obstacles, starts on {width} x {depth} m: {path}")
        return 0
