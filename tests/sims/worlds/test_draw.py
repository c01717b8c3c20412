"""Maps of worlds."""

from __future__ import annotations

import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import Terrain, World, get_world
from rover_rl.sims.worlds.draw import draw_map, draw_world

ROVER = get_robot("rover_zero")


@pytest.mark.parametrize("name", ["inspect", "maze"])
def test_draw_world_saves_an_image(name, tmp_path):
    path = tmp_path / f"{name}.png"
    figure = draw_world(get_world(name), ROVER, path)
    assert path.read_bytes().startswith(b"\x89PNG")
    ax = figure.axes[0]
    assert name in ax.get_title()
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert [label.split(" (")[0] for label in labels] == [
        "free: starts, goals",
        "free: only driven over",
        "free, but out of reach",
        "obstacle",
        "start area",
        "goal area",
        "bounds",
    ]
    # Only worlds with elevation have a color bar.
    assert [other.get_ylabel() for other in figure.axes[1:]] == ([] if name == "maze" else ["elevation (m)"])


def test_the_map_covers_the_bounds_and_a_margin():
    ax = draw_world(get_world("inspect"), ROVER).axes[0]
    assert ax.get_xlim() == (-32.0, -10.0)
    assert ax.get_ylim() == (-32.0, -14.0)


def test_draw_world_uses_the_given_axes():
    figure = Figure()
    left, right = figure.subplots(1, 2)
    assert draw_world(get_world("maze"), ROVER, ax=right) is figure
    assert right.get_title()
    assert not left.get_title()


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
