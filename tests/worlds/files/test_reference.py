"""Worlds of others: the files in ``ROVER_RL_DATA``, against what an independent reading of them gives."""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from rover_rl.worlds import World
from tests.extras import needs_worlds

DATA = Path(os.environ.get("ROVER_RL_DATA", "."))
pytestmark = [
    needs_worlds,
    pytest.mark.skipif(not (DATA / "roboterrain").is_dir(), reason="needs the data in ROVER_RL_DATA"),
]
MAZES = {"maze_pillars.sdf": 20, "maze_and_person.sdf": 40}


def imported(name: str) -> World:
    return World.from_file(DATA / name)


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


def test_the_ground_of_the_marsyard_is_that_of_the_file(tmp_path):
    """A part of it: the whole ground takes minutes."""
    import tifffile

    file = DATA / "roboterrain/marsyard2021_terrain/dem/marsyard_terrain_hm.tif"
    heights = tifffile.imread(file)[200:301, 300:401].astype(np.float32)
    tifffile.imwrite(tmp_path / "part.tif", heights)
    shape = f"<heightmap><uri>part.tif</uri><size>9.4 9.4 {np.ptp(heights)}</size></heightmap>"
    link = f"<link name='l'><collision name='c'><geometry>{shape}</geometry></collision></link>"
    (tmp_path / "yard.sdf").write_text(f"<sdf version='1.7'><model name='m'><static>1</static>{link}</model></sdf>")
    world = World.from_file(tmp_path / "yard.sdf")
    grid = np.linspace(-4.7, 4.7, 101)
    nodes = torch.from_numpy(np.stack(np.meshgrid(grid, grid), -1))
    assert np.abs(world.height_at(nodes).numpy() - heights[::-1]).max() < 1e-3


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
