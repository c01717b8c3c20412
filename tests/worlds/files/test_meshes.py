"""Meshes: formats, units, axes, ground and obstacles."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from rover_rl.worlds import World, get_world
from tests.extras import needs_worlds
from tests.worlds.files.scenes import heights_at, hill_height, house, inside, with_y_up, yard

pytestmark = needs_worlds
FLOOR = trimesh.creation.box((10.0, 10.0, 0.1))


def saved(scene: trimesh.Scene, path: Path) -> Path:
    """Writes a scene in the format of the path's suffix."""
    kind = path.suffix[1:]
    if kind == "glb":
        with_y_up(scene).export(path)
    elif kind == "gltf":
        for name, data in with_y_up(scene).export(file_type="gltf").items():
            (path.parent / (path.name if name == "model.gltf" else name)).write_bytes(data)
    elif kind == "dae":
        path.write_bytes(trimesh.exchange.dae.export_collada(scene.dump()))
        text = path.read_text()
        assert "Y_UP" in text
        path.write_text(text.replace("Y_UP", "Z_UP"))
    else:
        scene.to_mesh().export(path)
    return path


@pytest.mark.parametrize("kind", ["obj", "stl", "ply", "gltf", "dae"])
def test_a_house_is_the_same_in_all_formats(kind, tmp_path):
    world = World.from_file(saved(house(), tmp_path / f"house.{kind}"))
    assert world.name == "house"
    assert len(world.obstacles) == 7
    assert world.terrain.heights.abs().max() < 1e-6
    assert world.spawn_range == (pytest.approx((-5.45, 5.45), abs=0.12), pytest.approx((-4.45, 4.45), abs=0.12))
    # In the inner wall, beside it, under the table, in the table, and in the roof.
    points = [(1.0, -2.0, 0.5), (1.2, -2.0, 0.5), (-2.0, 2.0, 0.5), (-2.0, 2.0, 0.76), (0.0, 0.0, 2.6)]
    assert inside(world, *points) == [True, False, False, True, True]


def test_heights_and_outlines_are_those_of_the_mesh(tmp_path):
    world = World.from_file(saved(yard(), tmp_path / "yard.glb"))
    x, y = np.random.default_rng(0).uniform(-7.9, 7.9, (2, 5000))
    ours = world.height_at(torch.from_numpy(np.stack((x, y), -1))).numpy()
    # The mesh itself is off the sines by at most 3 mm.
    assert np.abs(ours - hill_height(x, y)).max() < 0.01
    assert any("error 0.0 cm for 99 %" in note for note in world.notes)
    corner = [(-2.0 + u, -4.0 + v, 0.3) for u, v in ((1.98, 0.28), (0.28, 1.98), (0.35, 0.35), (1.0, 1.0))]
    assert inside(world, *corner) == [True, True, False, False]


def test_the_unit_and_the_axis_of_collada_count(tmp_path):
    scaled = with_y_up(house())
    scaled.apply_scale(100.0)
    path = tmp_path / "centimeters.dae"
    text = trimesh.exchange.dae.export_collada(scaled.dump()).decode()
    assert "<up_axis>Y_UP</up_axis>" in text
    path.write_text(text.replace("<up_axis>", '<unit name="centimeter" meter="0.01"/><up_axis>'))
    centimeters = World.from_file(path)
    assert np.allclose(centimeters.terrain.extent, ((-6, 6), (-5, 5)), atol=1e-5)
    assert len(centimeters.obstacles) == 7


def test_up_and_scale_are_options(tmp_path):
    with_y_up(house()).to_mesh().apply_scale(1000).export(tmp_path / "house.obj")
    world = World.from_file(tmp_path / "house.obj", up="y", scale=0.001)
    assert (len(world.obstacles), world.terrain.extent[0]) == (7, pytest.approx((-6, 6), abs=1e-5))


def test_node_transforms_of_gltf_may_mirror_and_scale(tmp_path):
    path = saved(house(), tmp_path / "mirrored.gltf")
    data = json.loads(path.read_text().replace('"world"', '"house"'))
    roots = data["scenes"][0]["nodes"]
    data["nodes"].append({"name": "mirror", "children": roots, "scale": [-2.0, 2.0, 2.0]})
    data["scenes"][0]["nodes"] = [len(data["nodes"]) - 1]
    path.write_text(json.dumps(data))
    world = World.from_file(path)
    assert len(world.obstacles) == 7
    # The inner wall was at x = 1.
    assert inside(world, (-2.0, -4.0, 1.0), (2.0, -4.0, 1.0)) == [True, False]


def test_ground_can_be_named_or_denied(tmp_path):
    path = saved(yard(), tmp_path / "yard.glb")
    assert len(World.from_file(path, ground="hi*").obstacles) == len(World.from_file(path).obstacles)
    assert heights_at(World.from_file(path, ground="hills,crate"), (3.0, 0.0)) == pytest.approx([1.35], abs=0.01)
    with pytest.raises(ValueError, match=r"ground='sea' matches no piece .*'ball', 'corner', 'crate', 'hills'"):
        World.from_file(path, ground="sea")
    scene = yard()
    scene.delete_geometry(["geometry_0"])
    bare = World.from_file(saved(scene, tmp_path / "bare.glb"), ground="none")
    assert bare.terrain.is_flat
    assert heights_at(bare, (0.0, 0.0)) == pytest.approx([-0.4], abs=0.02)


def test_a_path_is_a_name_of_a_world(tmp_path):
    path = saved(house(), tmp_path / "house.stl")
    world = get_world(str(path))
    assert get_world(str(path)) is world
    FLOOR.export(path)
    assert get_world(str(path)).obstacles.shapes == ()
    with pytest.raises(FileNotFoundError, match="there is no world file"):
        get_world(str(tmp_path / "other.sdf"))


def test_missing_materials_and_pictures_do_not_matter(tmp_path):
    house().to_mesh().export(tmp_path / "house.obj")
    text = (tmp_path / "house.obj").read_text()
    (tmp_path / "house.obj").write_text("mtllib ../../no.mtl\nusemtl paint\n" + text)
    assert len(World.from_file(tmp_path / "house.obj").obstacles) == 7
    material = trimesh.visual.material.SimpleMaterial(image=Image.new("RGB", (4, 4), "red"))
    textured = FLOOR.copy()
    textured.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(textured.vertices), 2)), material=material)
    path = saved(trimesh.Scene([textured]), tmp_path / "floor.gltf")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"images": [{"uri": "../textures/no.png"}]}))
    assert World.from_file(path).terrain.extent[0] == pytest.approx((-5, 5), abs=1e-5)
    images = '<library_images><image id="i"><init_from>../no.jpg</init_from></image></library_images>'
    path = saved(trimesh.Scene([FLOOR]), tmp_path / "floor.dae")
    path.write_text(path.read_text().replace("<library_geometries>", images + "<library_geometries>"))
    assert World.from_file(path).terrain.extent[0] == pytest.approx((-5, 5), abs=1e-5)
