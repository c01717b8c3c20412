"""Generators of worlds: functions from a seed and a difficulty to a layout."""

from rover_rl.worlds.generators.crowds import corridor, crossing, field, plaza, with_walkers, yard
from rover_rl.worlds.generators.forest import forest
from rover_rl.worlds.generators.hills import hills
from rover_rl.worlds.generators.inspect_site import inspect
from rover_rl.worlds.generators.maze import maze
from rover_rl.worlds.generators.moon import moon
from rover_rl.worlds.generators.ramps import ramps
from rover_rl.worlds.generators.rooms import rooms

__all__ = [
    "corridor",
    "crossing",
    "field",
    "forest",
    "hills",
    "inspect",
    "maze",
    "moon",
    "plaza",
    "ramps",
    "rooms",
    "with_walkers",
    "yard",
]
