"""Generators of worlds: functions from a seed and a difficulty to a layout."""

from collections.abc import Callable

from rover_rl.worlds.generators.crowds import corridor, crossing, field, plaza, yard
from rover_rl.worlds.generators.forest import forest
from rover_rl.worlds.generators.hills import hills
from rover_rl.worlds.generators.inspect_site import inspect
from rover_rl.worlds.generators.maze import maze
from rover_rl.worlds.generators.moon import moon
from rover_rl.worlds.generators.ramps import ramps
from rover_rl.worlds.generators.rooms import rooms
from rover_rl.worlds.world import World

WORLDS: dict[str, Callable[..., World]] = {
    generate.__name__: generate
    for generate in (inspect, moon, maze, rooms, forest, hills, ramps, plaza, corridor, crossing, field, yard)
}
"""Built-in worlds, by name."""
