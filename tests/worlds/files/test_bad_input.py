"""Bad world files: each gets one sentence, and nothing is executed."""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from rover_rl.worlds import Terrain, World
from tests.extras import needs_worlds
from tests.worlds.files.test_maps import ROOM, write_map
from tests.worlds.files.test_sdf import PLANE, POST, link, model

pytestmark = needs_worlds

Case = tuple[Callable[[Path], Path], str]


def file(name: str, content: str | bytes) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
        return folder / name

    return write


def sdf(body: str, plane: bool = True) -> Callable[[Path], Path]:
    ground = PLANE.format(size="20 20") if plane else ""
    return file("bad.sdf", f"<sdf version='1.9'><world name='w'>{ground}{body}</world></sdf>")


def shape(content: str, pose: str = "") -> Callable[[Path], Path]:
    return sdf(model(link(content, pose)))


def yaml(**changes: object) -> Callable[[Path], Path]:
    return lambda folder: write_map(folder, **changes)


def mesh(name: str, found: trimesh.Trimesh | trimesh.Scene) -> Callable[[Path], Path]:
    content = found.export(file_type=name.rpartition(".")[2])
    return file(name, content)


def array(values: np.ndarray) -> Callable[[Path], Path]:
    content = io.BytesIO()
    np.save(content, values, allow_pickle=True)
    return file("bad.npy", content.getvalue())


def map_without_picture(folder: Path) -> Path:
    path = write_map(folder, image="no.pgm")
    path.with_suffix(".pgm").unlink()
    return path


def archive(**changes: object) -> Callable[[Path], Path]:
    """A world file of which arrays or parts of the description are replaced, or left out (``None``)."""

    def write(folder: Path) -> Path:
        path = folder / "bad.world.npz"
        World("plain", Terrain.flat((10, 10))).save(path)
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(arrays["about"].tobytes())
        for key, value in changes.items():
            (arrays if key in arrays else about)[key] = value
        if "about" not in changes:
            arrays["about"] = np.frombuffer(json.dumps(about).encode(), dtype="u1")
        kept = {name: value for name, value in arrays.items() if value is not None}
        np.savez_compressed(path, **kept)
        return path

    return write


def cut(write: Callable[[Path], Path], share: float) -> Callable[[Path], Path]:
    """The first part of a file."""

    def write_part(folder: Path) -> Path:
        path = write(folder)
        os.truncate(path, int(share * path.stat().st_size))
        return path

    return write_part


BOMB = "<!DOCTYPE x [<!ENTITY a 'aaaaaaaaaa'>" + "".join(
    f"<!ENTITY {b} '{('&' + a + ';') * 10}'>" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
BOX = trimesh.creation.box((10, 10, 0.1))
FLAT_TRIANGLES = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)], process=False)

CASES: dict[str, Case] = {
    # XML
    "xml bomb": (file("bad.sdf", f"{BOMB}]><sdf version='1.9'>&i;</sdf>"), "declares XML entities"),
    "cut off sdf": (file("bad.sdf", "<sdf version='1.9'><world>"), "is not valid XML"),
    "urdf": (file("bad.sdf", "<robot name='r'/>"), "is not SDF: its root is <robot>"),
    # SDF
    "nothing in it": (sdf("", plane=False), "holds no ground and no obstacles"),
    "absurd size": (shape("<box><size>1e9 1 1</size></box>"), "must be positive and at most 20000 m"),
    "frames in a circle": (
        sdf(
            model(link(POST) + "<frame name='f' attached_to='g'/><frame name='g' attached_to='f'/>").replace(
                "<link name='l'>", "<link name='l'><pose relative_to='f'/>"
            )
        ),
        "is relative to itself",
    ),
    "tilted heightmap": (
        lambda folder: (
            np.save(folder / "h.npy", np.eye(4)),
            shape("<heightmap><uri>h.npy</uri><size>9 9 1</size></heightmap>", "0 0 0 0.1 0 0")(folder),
        )[1],
        "is tilted",
    ),
    # Meshes
    "empty mesh": (file("bad.obj", b""), "cannot be read as a mesh|holds no triangles"),
    "nan vertex": (file("bad.obj", "v 0 0 0\nv 1 nan 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"), "NaN or infinite"),
    "absurd mesh": (mesh("bad.stl", BOX.copy().apply_scale(1e7)), "from the origin; at most 10000 m"),
    "flat mesh": (mesh("bad.ply", FLAT_TRIANGLES), "holds no ground and no obstacles"),
    "no collada": (file("bad.dae", "<html/>"), "cannot be read as a mesh"),
    "bad unit": (file("bad.dae", "<COLLADA><asset><unit meter='-1'/></asset></COLLADA>"), "must be a positive number"),
    # Elevation models
    "pickle": (array(np.array([[len, len], [len, len]], dtype=object)), "no array of numbers"),
    "one row": (array(np.zeros((1, 8))), "a grid of at least 2 x 2"),
    "absurd heights": (array(np.full((8, 8), 1e9)), "check pixel and height"),
    "steep": (array(20.0 * np.mgrid[0:64, 0:64][0]), "no free ground: .* too steep"),
    "picture of nothing": (file("bad.png", b"no picture"), "is no picture that can be read"),
    "cut off tiff": (file("bad.tif", b"II*\0\x08\0\0\0"), "TIFF"),
    # Maps
    "yaml code": (file("bad.yaml", "image: !!python/object/apply:os.system ['true']\n"), "is no map"),
    "broken yaml": (file("bad.yaml", "image: [\n"), "is not valid YAML"),
    "no picture": (map_without_picture, "names the picture no.pgm"),
    "thresholds": (yaml(occupied_thresh=0.2, free_thresh=0.6), "free_thresh in .* must be below occupied_thresh"),
    "short origin": (yaml(origin="[1]"), r"origin in .* must be \[x, y, yaw\]"),
    "mode": (yaml(mode="binary"), "mode in .* must be one of"),
    "negate": (yaml(negate="often"), "negate in .* must be 0 or 1"),
    "all walls": (lambda folder: write_map(folder, np.zeros(ROOM.shape)), "has no free cell"),
    # World files
    "cut off archive": (cut(archive(), 0.7), "is no world file, or a damaged one"),
    "missing array": (archive(heights=None), "has no heights"),
    "pickled array": (archive(heights=np.array([[None]], dtype=object)), "is no world file"),
    "other format": (archive(format="x"), "is a world file of the format 'x'; this version of rover_rl reads "),
    "nan in heights": (archive(heights=np.full((3, 3), np.nan, dtype="<f4")), "heights must be finite"),
    "ends": (archive(ends=np.array([5], dtype="<i8")), "obstacles do not match their vertices"),
    "no cell": (archive(cell=None), "is a damaged world file"),
    # Names
    "suffix": (file("bad.txt", "x"), "is no world file; use one of"),
}


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_bad_files_get_one_sentence(tmp_path, case):
    write, expected = case
    path = write(tmp_path)
    options = {"pixel": 0.5, "height": 1.0} if path.suffix in (".npy", ".png", ".tif") else {}
    with pytest.raises((ValueError, FileNotFoundError), match=expected) as error:
        World.from_file(path, **options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"sell": 1}, r"unknown options of a world file: \['sell'\]"),
        ({"missing": "ignore"}, "missing must be one of"),
        ({"cell": 0}, "cell must be from 0.005 to 100, got 0"),
        ({"cell": "fine"}, "cell must be a number, got 'fine'"),
        ({"cell": 0.005}, "2001 x 2001 heights at a cell of 0.005 m; use a cell of at least"),
        ({"spawn_range": ((1, 0), (0, 1))}, "spawn_range must be"),
        ({"goal_range": 3}, "goal_range must be"),
        ({"spawn_range": ((50, 60), (50, 60))}, "has no free ground in spawn_range"),
        ({"obstacle_error": float("nan")}, "obstacle_error must be from"),
    ],
)
def test_bad_options_get_one_sentence(tmp_path, options, expected):
    trimesh.Scene([BOX]).export(tmp_path / "floor.stl")
    with pytest.raises(ValueError, match=expected):
        World.from_file(tmp_path / "floor.stl", **options)


@pytest.mark.parametrize(
    ("module", "write"),
    [
        ("coacd", mesh("bad.stl", trimesh.Scene([BOX, trimesh.creation.torus(0.5, 0.15, 12, 8)]).to_mesh())),
        ("collada", file("bad.dae", "<COLLADA/>")),
        ("tifffile", file("bad.tif", b"")),
    ],
)
def test_a_missing_package_of_the_extra_is_named(tmp_path, monkeypatch, module, write):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=rf'needs the package {module}: pip install "rover_rl\[worlds\]"'):
        World.from_file(write(tmp_path))
