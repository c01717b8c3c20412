"""Maps with movers."""

from __future__ import annotations

import math
from io import BytesIO

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from rover_rl.robots import get_robot
from rover_rl.sims.free_space.draw import draw_world
from rover_rl.sims.movers.draw import draw_movers
from rover_rl.worlds import Terrain, World, get_world
from rover_rl.worlds.draw import draw_map
from rover_rl.worlds.movers import Box, Cross, Cylinder, Mover, Person, Wander, Waypoints

LINE = Waypoints([(0.0, -3.0, 0.0, 0.0), (6.0, 3.0, 0.0, 0.0)])
SIDE = 400


def world(*movers: Mover) -> World:
    return World("square", Terrain.flat((10.0, 10.0)), movers=movers)


def drawn(scene: World, seed: int = 0) -> np.ndarray:
    """A map without axes, ``[SIDE, SIDE, 3]``: 40 pixels are a meter."""
    figure = Figure(figsize=(4, 4), dpi=SIDE / 4)
    ax = figure.add_axes((0, 0, 1, 1))
    draw_map(ax, scene)
    draw_movers(ax, scene, seed)
    image = BytesIO()
    figure.savefig(image)
    return np.asarray(Image.open(image).convert("RGB")).astype(int)


def differs(scene: World, x: float, y: float, reach: float = 0.15) -> bool:
    """Whether the movers of a world change its map within ``reach`` of a point."""
    rows, columns = (slice(round(40 * (5 + k - reach)), round(40 * (5 + k + reach))) for k in (-y, x))
    return bool((drawn(scene) != drawn(world()))[rows, columns].any())


def test_a_mover_is_drawn_in_its_color_where_it_starts() -> None:
    image = drawn(world(Mover(LINE, Cylinder(0.5))))
    assert image[200, 80, 0] > 2 * image[200, 80, 1]
    person = drawn(world(Mover(LINE, Person())))[200, 80]
    assert person[2] > person[0] > person[1]


def test_an_arrow_shows_the_way_of_two_seconds_and_a_dashed_line_the_path() -> None:
    scene = world(Mover(LINE, Cylinder(0.1)))
    # From -3 to -1 at 1 m/s, and on to 3.
    assert [differs(scene, x, 0.06, 0.02) for x in (-1.03, 0.0, 2.0)] == [True, False, False]
    assert [differs(scene, x, 0.0, 0.2) for x in (-1.2, 0.0, 2.8, 3.4)] == [True, True, True, False]


@pytest.mark.parametrize(
    ("mover", "on", "off"),
    [
        (Mover(Waypoints.door(hinge=(0.0, 0.0), width=2.0), Box(2.0, 0.05, 2.0)), (0.7, 0.7), (-0.7, -0.7)),
        (Mover(Cross(start=((-4, -2), (-4, -2)), goal=(3.0, 3.0)), Person()), (-2.5, -3.9), (0.0, 4.0)),
        (Mover(Cross(start=(-3.0, 3.0), goal=(3.0, 3.0)), Person()), (2.0, 3.0), (2.0, -3.0)),
        (Mover(Wander(area=((-4, 4), (-3, 3))), Person()), (4.0, 0.0), (4.5, 0.0)),
    ],
    ids=["door", "area", "points", "wander"],
)
def test_paths_and_areas_are_drawn(mover: Mover, on: tuple[float, float], off: tuple[float, float]) -> None:
    assert differs(world(mover), *on)
    assert not differs(world(mover), *off)


def test_movers_start_as_a_seed_has_it() -> None:
    plaza = get_world("plaza:1")
    assert np.array_equal(drawn(plaza, 1), drawn(plaza, 1))
    assert not np.array_equal(drawn(plaza, 1), drawn(plaza, 2))


def test_a_map_of_a_world_names_its_movers() -> None:
    texts = draw_world(get_world("maze+walkers"), get_robot("rover_zero")).axes[0].get_legend().get_texts()
    assert "mover, and 2 s of its way" in [text.get_text() for text in texts]


def test_a_mover_at_rest_has_no_arrow() -> None:
    scene = world(Mover(Waypoints([(0.0, 0.0, 0.0, math.pi / 2)]), Cylinder(0.1)))
    assert not differs(scene, 0.0, 0.4)
    assert not differs(scene, 0.4, 0.0)
