"""Maps of worlds with the free space of a robot."""

from __future__ import annotations

import pytest

from rover_rl.robots import get_robot
from rover_rl.sims.free_space.draw import draw_world
from rover_rl.worlds import get_world

ROVER = get_robot("rover_zero")


@pytest.mark.parametrize("name", ["inspect", "maze"])
def test_draw_world_saves_an_image(name, tmp_path):
    path = tmp_path / f"{name}.png"
    figure = draw_world(get_world(name), ROVER, path)
    assert path.read_bytes().startswith(b"\x89PNG")
    ax = figure.axes[0]
    assert name in ax.get_title()
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    entries = ["free: starts, goals", "free: only driven over", "free, but out of reach", "obstacle"]
    assert [label.split(" (")[0] for label in labels] == [*entries, "start area", "goal area", "bounds"]
    # Only worlds with elevation have a color bar.
    assert [other.get_ylabel() for other in figure.axes[1:]] == ([] if name == "maze" else ["elevation (m)"])
