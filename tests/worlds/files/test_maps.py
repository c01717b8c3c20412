"""Elevation models and occupancy grids."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageDraw
from scipy.ndimage import distance_transform_edt
from scipy.spatial import Delaunay

from rover_rl.worlds import World
from rover_rl.worlds.files import occupancy
from rover_rl.worlds.files.rectangles import cover, slanted_cover
from tests.worlds.files.scenes import heights_at, inside

SLOPE = 0.1 * np.mgrid[0:9, 0:9][1] - 0.05 * np.mgrid[0:9, 0:9][0]
"""Heights that rise by 0.1 m a column, and fall by 0.05 m a row."""


@pytest.mark.parametrize("kind", ["uint8", "uint16", "npy"])
def test_pictures_and_arrays_have_their_scale_from_options(tmp_path, kind):
    path, options, low = tmp_path / "map.npy", {"pixel": 0.5}, 0.0
    np.save(path, SLOPE)
    if kind != "npy":
        path, options, low = tmp_path / "map.png", {"pixel": 0.5, "height": 1.2}, 0.4
        Image.fromarray(np.rint((SLOPE + 0.4) / 1.2 * np.iinfo(kind).max).astype(kind)).save(path)
    world = World.from_file(path, **options)
    assert world.terrain.extent == ((-2.0, 2.0), (-2.0, 2.0))
    found = heights_at(world, (-2.0, 2.0), (2.0, 2.0), (-2.0, -2.0))
    assert found == pytest.approx([low, low + 0.8, low - 0.4], abs=0.003)


def test_a_cell_resamples_an_elevation_model(tmp_path):
    np.save(tmp_path / "map.npy", SLOPE)
    world = World.from_file(tmp_path / "map.npy", pixel=0.5, cell=0.2)
    assert world.terrain.cell == 0.2
    assert heights_at(world, (-1.9, 1.9), (0.7, -0.3)) == pytest.approx([0.01, 0.31], abs=1e-3)


ROOM = np.pad(np.ones((38, 58), dtype=bool), 1)
"""Free cells of a room of 60 x 40 cells, without a pillar and with a corner that nobody has seen."""
ROOM[10:14, 30:34] = False
UNSEEN = np.zeros_like(ROOM)
UNSEEN[1:9, 1:9] = True


def write_map(folder: Path, states: np.ndarray | None = None, name: str = "map", **changes: object) -> Path:
    """Writes a map whose first row is in the north."""
    if states is None:
        states = np.where(ROOM, 254, 0)
        states[UNSEEN] = 205
    Image.fromarray(states.astype(np.uint8)).save(folder / f"{name}.pgm")
    settings = {
        "image": f"{name}.pgm",
        "resolution": 0.1,
        "origin": [-1.0, -2.0, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.19,
    } | changes
    text = "".join(f"{key}: {value}\n" for key, value in settings.items() if value is not None)
    (folder / f"{name}.yaml").write_text(text)
    return folder / f"{name}.yaml"


def is_wall(world: World, *points: tuple[float, float]) -> list[bool]:
    return inside(world, *((*point, 0.5) for point in points))


# In the west wall, beside it, in the pillar, south of it, and in the unseen corner.
POINTS = [(-0.95, 0.0), (-0.85, 0.0), (2.2, 0.8), (2.2, 0.5), (-0.5, 1.5)]


def test_a_map_has_its_walls_where_they_are(tmp_path):
    world = World.from_file(write_map(tmp_path))
    assert world.name == "map"
    assert is_wall(world, *POINTS) == [True, False, True, False, False]
    assert len(world.obstacles) == 5
    assert world.spawn_range == (pytest.approx((-0.5, 4.6), abs=0.11), pytest.approx((-1.5, 1.6), abs=0.11))
    walls = World.from_file(tmp_path / "map.yaml", unknown="wall", wall_height=0.7)
    assert is_wall(walls, *POINTS) == [True, False, True, False, True]
    assert inside(walls, (-0.5, 1.5, 0.6), (-0.5, 1.5, 0.8)) == [True, False]


def test_the_yaw_of_the_origin_turns_the_map(tmp_path):
    world = World.from_file(write_map(tmp_path, origin=[-1.0, -2.0, 0.5]))
    cos, sin = math.cos(0.5), math.sin(0.5)
    turned = [(-1 + cos * (x + 1) - sin * (y + 2), -2 + sin * (x + 1) + cos * (y + 2)) for x, y in POINTS]
    assert is_wall(world, *turned) == [True, False, True, False, False]


@pytest.mark.parametrize(
    ("occupied", "free", "unseen", "changes"),
    [
        (0, 254, 205, {"mode": "trinary"}),
        (255, 1, 130, {"negate": 1}),
        (80, 254, 128, {"occupied_thresh": 0.6, "free_thresh": 0.1}),
        (0, 254, 128, {"mode": "scale"}),
        (100, 0, 255, {"mode": "raw"}),
        (100, 40, 101, {"mode": "raw"}),
    ],
)
def test_modes_and_thresholds(tmp_path, occupied, free, unseen, changes):
    states = np.where(ROOM, free, occupied)
    states[UNSEEN] = unseen
    path = write_map(tmp_path, states, **changes)
    assert is_wall(World.from_file(path), *POINTS) == [True, False, True, False, False]
    assert is_wall(World.from_file(path, unknown="wall"), *POINTS)[-1]


@pytest.mark.parametrize(
    "changes",
    [
        {"resolution": '"1e-1"'},
        {"resolution": "+.1"},
        {"origin": '["-1e0", -2., +0]'},
        {"origin": "\n- -1\n- -2\n- 1e-9"},
        {"occupied_thresh": ".65", "free_thresh": "190e-3"},
        {"mode": "Trinary"},
        *({"negate": negate} for negate in ("+0", "0x0", "False", "NO")),
    ],
)
def test_numbers_and_words_are_those_of_yaml_cpp(tmp_path, changes):
    assert is_wall(World.from_file(write_map(tmp_path, **changes)), *POINTS) == [True, False, True, False, False]


STATES = np.where(UNSEEN, 205, np.where(ROOM, 254, 0)).astype(np.uint8)


def gray_16(path: Path) -> None:
    Image.fromarray(STATES.astype(np.uint16) * 257).save(path)


def text_pgm(path: Path) -> None:
    numbers = "\n".join(" ".join(str(257 * int(number)) for number in row) for row in STATES)
    path.write_text(f"P2\n# map_saver\n60 40 # cells\n65535\n{numbers}\n")


def palette(path: Path) -> None:
    Image.fromarray(STATES).convert("RGB").quantize(4).save(path)


def with_alpha(path: Path) -> None:
    """Hides the unseen corner, whatever its color."""
    alpha = np.where(UNSEEN, 0, 255).astype(np.uint8)
    Image.fromarray(np.stack((np.where(UNSEEN, 0, STATES), alpha), -1)).save(path)


def with_colors_and_alpha(path: Path) -> None:
    Image.fromarray(np.stack([np.where(UNSEEN, 255, STATES)] * 3 + [np.where(UNSEEN, 99, 255)], -1).astype("u1")).save(
        path
    )


@pytest.mark.parametrize("write", [gray_16, text_pgm, palette, with_alpha, with_colors_and_alpha])
def test_pictures_of_all_kinds(tmp_path, write):
    name = "my map.pgm" if write is text_pgm else "my map.png"
    path = write_map(tmp_path, image=name)
    write(tmp_path / name)
    assert is_wall(World.from_file(path), *POINTS) == [True, False, True, False, False]
    assert is_wall(World.from_file(path, unknown="wall"), *POINTS) == [True, False, True, False, True]


def test_a_picture_is_found_by_its_name_or_that_of_a_renamed_map(tmp_path):
    assert is_wall(World.from_file(write_map(tmp_path, image="/home/someone/maps/map.pgm")), *POINTS)[0]
    world = World.from_file(write_map(tmp_path, image="old.pgm"))
    assert any("old.pgm does not exist, and map.pgm is taken" in note for note in world.notes)


def slanted_walls(side: int) -> np.ndarray:
    """Returns a picture of walls of two cells, 40 cells apart, that are turned by 30 degrees, with gaps for doors."""
    row, column = np.mgrid[0:side, 0:side] - side / 2
    across, along = 0.866 * column + 0.5 * row, 0.866 * row - 0.5 * column
    walls = (across % 40 < 2) & (along % 40 > 12) | (along % 40 < 2) & (across % 40 > 12)
    return np.where(walls, 0, 254)


def test_a_large_map_of_a_turned_building_has_few_slanted_pieces(tmp_path, monkeypatch):
    monkeypatch.setattr(occupancy, "MAX_PIECES", 600)
    states = slanted_walls(300)
    world = World.from_file(write_map(tmp_path, states, origin=[0.0, 0.0, 0.0]), spawn_range=((10, 20), (10, 20)))
    assert 80 < len(world.obstacles) < 400
    assert any("slanted pieces, within about 0.1 m" in note for note in world.notes)
    walls = states[::-1] == 0
    outside, within = (distance_transform_edt(cells) for cells in (~walls, walls))
    rng = np.random.default_rng(0)
    for cells, expected in ((walls & (within > 1), True), (outside > 2, False)):
        chosen = rng.permutation(np.argwhere(cells))[:400]
        assert inside(world, *((0.1 * x + 0.05, 0.1 * y + 0.05, 0.5) for y, x in chosen)) == [expected] * 400


@pytest.mark.parametrize(("width", "degrees"), [(1, 10), (1, 45), (3, 80), (3, 135)])
def test_a_slanted_wall_is_few_pieces_without_a_gap(width, degrees):
    image = Image.new("1", (200, 200))
    end = 80 * np.array((math.cos(math.radians(degrees)), math.sin(math.radians(degrees))))
    ImageDraw.Draw(image).line([tuple(100 - end), tuple(100 + end)], 1, width)
    pieces = slanted_cover(np.asarray(image))
    assert len(pieces) <= 6
    hulls = [Delaunay(piece) for piece in pieces]
    across = np.linspace(-0.7, 0.7, 8)[:, None] * end[::-1] * (1, -1) / 80
    for point in 100.5 + np.linspace(-0.97, 0.97, 200)[:, None] * end:
        assert any((hull.find_simplex(point + across) >= 0).any() for hull in hulls)


def test_the_advice_for_a_map_of_too_many_pieces_helps(tmp_path, monkeypatch):
    monkeypatch.setattr(occupancy, "MAX_PIECES", 200)
    states = np.where(np.random.default_rng(0).random((60, 60)) < 0.2, 0, 254)
    states[20:40, 20:40] = 254
    path = write_map(tmp_path, states)
    with pytest.raises(ValueError, match=r"walls of .*map.yaml are [0-9]+ pieces; at most 200 are supported") as error:
        World.from_file(path)
    enough = float(re.search(r"accept obstacle_error=([0-9.]+)", str(error.value))[1])
    world = World.from_file(path, obstacle_error=enough)
    assert len(world.obstacles) <= 200
    row, column = np.argwhere(states == 0).T
    walls = zip(-1 + 0.1 * (column + 0.5), -2 + 0.1 * (60 - row - 0.5), strict=True)
    assert np.mean(is_wall(world, *walls)) > 0.9
    write_map(tmp_path, states[15:40, 15:40])
    assert len(World.from_file(path).obstacles) <= 200


def test_rectangles_cover_exactly_the_cells():
    rng = np.random.default_rng(0)
    for density in (0.1, 0.5, 0.9):
        cells = rng.random((30, 40)) < density
        drawn = np.zeros(cells.shape, dtype=int)
        for row, column, rows, columns in cover(cells):
            drawn[row : row + rows, column : column + columns] += 1
        assert np.array_equal(drawn, cells.astype(int))
    frame = np.pad(np.zeros((8, 8), dtype=bool), 1, constant_values=True)
    assert len(cover(frame)) == 4
    assert cover(np.zeros((3, 3), dtype=bool)) == []
