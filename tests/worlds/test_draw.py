"""Maps of worlds."""

from __future__ import annotations

from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from rover_rl.worlds import Terrain, World, get_world
from rover_rl.worlds.draw import draw_map


def test_draw_map_of_an_area():
    ax = Figure().add_subplot()
    colors = draw_map(ax, get_world("moon"), ((-4, 4), (-2, 3)))
    assert colors is not None
    assert ax.get_xlim() == (-4, 4)
    assert ax.get_ylim() == (-2, 3)
    (outlines,) = (c for c in ax.collections if isinstance(c, PolyCollection))
    assert len(outlines.get_paths()) == len(get_world("moon").obstacles)


def test_draw_map_of_a_flat_world_without_obstacles():
    ax = Figure().add_subplot()
    assert draw_map(ax, World("plain", Terrain.flat((10, 8)))) is None
    assert ax.get_xlim() == (-5, 5)
    assert ax.get_ylim() == (-4, 4)
