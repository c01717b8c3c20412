"""Worlds of others: the files in ``ROVER_RL_DATA``, against what an independent reading of them gives."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
import trimesh
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from rover_rl.worlds import World
from tests.extras import needs_worlds

DATA = Path(os.environ.get("ROVER_RL_DATA", "."))
pytestmark = [
    needs_worlds,
    pytest.mark.skipif(not (DATA / "roboterrain").is_dir(), reason="needs the data in ROVER_RL_DATA"),
]
MAZES = {"maze.sdf": 40, "maze_pillars.sdf": 20, "maze_and_person.sdf": 40}


@pytest.fixture(scope="module")
def module_cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def cache(module_cache: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Shares the cache of convex decompositions, which take half a minute for the rocks, between these tests."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(module_cache))
    return module_cache


SKIP = pytest.mark.filterwarnings("ignore:.*left out, as missing")


@lru_cache
def imported(name: str) -> World:
    return World.from_file(DATA / name, **({"missing": "skip"} if "marsyard" in name else {}))


def solids(path: Path) -> list[trimesh.Trimesh]:
    """The boxes and cylinders of a world without nested models and frames, as meshes."""
    found = []
    for model in ElementTree.parse(path).getroot().iter("model"):
        for link in model.iter("link"):
            for collision in link.iter("collision"):
                transform = pose(model) @ pose(link) @ pose(collision)
                box, cylinder = (collision.find(f"geometry/{kind}") for kind in ("box", "cylinder"))
                if box is not None:
                    size = [float(side) for side in box.find("size").text.split()]
                    found.append(trimesh.creation.box(size, transform=transform))
                if cylinder is not None:
                    radius, length = (float(cylinder.find(key).text) for key in ("radius", "length"))
                    found.append(trimesh.creation.cylinder(radius, length, sections=256, transform=transform))
    return found


def pose(element: ElementTree.Element) -> np.ndarray:
    transform = np.eye(4)
    if element.find("pose") is not None:
        values = [float(word) for word in element.find("pose").text.split()]
        transform[:3, :3] = Rotation.from_euler("xyz", values[3:]).as_matrix()
        transform[:3, 3] = values[:3]
    return transform


@pytest.mark.parametrize("name", MAZES)
def test_the_obstacles_of_the_mazes_are_those_of_the_file(name):
    world, expected = imported(f"roboterrain/{name}"), solids(DATA / "roboterrain" / name)
    assert len(world.obstacles) == len(expected) == MAZES[name]
    for ours, theirs in zip(world.obstacles, expected, strict=True):
        outline = theirs.vertices[:, :2]
        assert ours.vertices[:, :2].amin(0).tolist() == pytest.approx(outline.min(0).tolist(), abs=0.02)
        assert ours.vertices[:, :2].amax(0).tolist() == pytest.approx(outline.max(0).tolist(), abs=0.02)
        assert ours.vertices[:, 2].max().item() == pytest.approx(theirs.vertices[:, 2].max(), abs=1e-6)
    assert world.terrain.is_flat
    assert world.spawn_range == (pytest.approx((-9.6, 9.6), abs=0.2),) * 2


@pytest.mark.slow
@SKIP
def test_the_ground_of_the_marsyard_is_that_of_the_file():
    import tifffile

    heights = tifffile.imread(DATA / "roboterrain/marsyard2021_terrain/dem/marsyard_terrain_hm.tif")[::-1].astype(float)
    world = imported("roboterrain/marsyard2021.sdf")
    x, y = np.random.default_rng(0).uniform(-23.4, 23.4, (2, 20_000))
    expected = map_coordinates(heights, [(y + 23.5) / 47 * 499, (x + 23.5) / 47 * 499], order=1)
    ours = world.height_at(torch.from_numpy(np.stack((x, y), -1))).numpy()
    # Between the samples, triangles differ from bilinear interpolation.
    assert np.quantile(np.abs(ours - expected), 0.99) < 0.01
    grid = np.linspace(-23.5, 23.5, 500)
    nodes = torch.from_numpy(np.stack(np.meshgrid(grid, grid), -1))
    assert np.abs(world.height_at(nodes).numpy() - heights).max() < 1e-3


def test_the_walls_of_the_depot_are_those_of_the_picture():
    picture = (DATA / "maps/nav2_depot.pgm").read_bytes()
    pixels = np.frombuffer(picture[-604 * 307 :], dtype=np.uint8).reshape(307, 604)[::-1]
    world = imported("maps/nav2_depot.yaml")
    rows, columns = np.mgrid[0:307:3, 0:604:3]
    points = np.stack((0.05 * columns.ravel() + 0.025, 0.05 * rows.ravel() + 0.025, np.ones(rows.size)), -1)
    assert (world.inside(torch.from_numpy(points)).numpy() == (pixels[rows, columns] == 0).ravel()).all()
    assert sum(
        float(o.vertices.amax(0)[:2].sub(o.vertices.amin(0)[:2]).prod()) for o in world.obstacles
    ) == pytest.approx(0.05**2 * (pixels == 0).sum())
