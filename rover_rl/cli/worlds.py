"""The command ``rover-rl worlds``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Worlds:
    """List the worlds and draw a map of each."""

    world: tuple[str, ...] = ()
    """Worlds to draw, by name or as module:attribute. Default: all registered worlds."""
    robot: str = "rover_zero"
    """Robot whose free space is drawn: rover_zero, or module:attribute."""
    out: Path = Path("worlds")
    """Folder to write the maps to."""

    def __call__(self) -> int:
        """Draws the maps and prints a line about each world."""
        from rover_rl.files import written_whole
        from rover_rl.sims.robots import get_robot
        from rover_rl.sims.worlds import get_world, world_names
        from rover_rl.sims.worlds.draw import draw_world

        robot = get_robot(self.robot)
        for name in self.world or world_names():
            world, path = get_world(name), self.out / f"{name.replace(':', '-')}.png"
            with written_whole(path) as temporary:
                draw_world(world, robot, temporary)
            width, depth = (f"{high - low:.0f}" for low, high in world.spawn_range)
            print(f"{name:8} {len(world.obstacles):3} obstacles, start area {width} x {depth} m: {path}")
        return 0
