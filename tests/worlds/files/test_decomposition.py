"""Obstacles in place of meshes: thin walls, sheets, copies, and pieces that are left out."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import ConvexHull
from trimesh.creation import extrude_triangulation

from rover_rl.worlds.files.contents import Piece
from rover_rl.worlds.files.convex import obstacles_of
from rover_rl.worlds.files.triangles import distances, is_closed, random_points, simplify, split
from tests.extras import needs_worlds
from tests.worlds.files.test_sdf import link, model, world_of

pytestmark = needs_worlds


def parts_of(mesh, error=0.02, pose=None):
    """The obstacles that replace a mesh."""
    pose = np.eye(4) if pose is None else pose
    pieces = split(Piece("mesh", np.asarray(mesh.vertices), np.asarray(mesh.faces), pose))
    return [solid for piece in pieces for solid in obstacles_of(piece, error)]


def volume_of(solids):
    return sum(ConvexHull(solid.vertices.numpy()).volume for solid in solids)


def holds(solids, *points):
    return [any(bool(solid.contains(torch.tensor(point))) for solid in solids) for point in points]


def frame(outer, t):
    """The outline of a U, whose walls are ``t`` thick, with its triangles."""
    a, b = outer
    outline = [(0, 0), (a, 0), (a, b), (a - t, b), (a - t, t), (t, t), (t, b), (0, b)]
    return outline, [(0, 1, 5), (1, 4, 5), (1, 2, 4), (2, 3, 4), (0, 5, 7), (5, 6, 7)]


def cells(axes, solid):
    """The closed surface of the cells of a grid whose middles are solid."""
    middles = [(np.array(axis[1:]) + axis[:-1]) / 2 for axis in axes]
    full = np.pad(np.vectorize(solid)(*np.meshgrid(*middles, indexing="ij")), 1)
    corners, faces = [], []
    for axis in range(3):
        ahead = np.roll(full, -1, axis)
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for cell in np.argwhere(full != ahead):
            quad = []
            for du, dv in ((0, 0), (1, 0), (1, 1), (0, 1)):
                index = cell - 1
                index[axis] += 1
                index[u] += du
                index[v] += dv
                quad.append([axes[k][index[k]] for k in range(3)])
            start = len(corners)
            corners += quad if full[tuple(cell)] else quad[::-1]
            faces += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
    mesh = trimesh.Trimesh(corners, faces, process=False)
    mesh.merge_vertices()
    return mesh


def hut(t):
    """A room of 4 m with a roof and a door of 1 m at y = 0."""
    return cells(
        ([0, t, 1.5, 2.5, 4 - t, 4], [0, t, 4 - t, 4], [0, 2, 2.5 - t, 2.5]),
        lambda x, y, z: (
            z > 2.5 - t or ((x < t or x > 4 - t or y < t or y > 4 - t) and not (1.5 < x < 2.5 and y < t and z < 2))
        ),
    )


def hollow(outer, inner):
    inner.invert()
    return trimesh.util.concatenate([outer, inner])


@pytest.mark.parametrize(("t", "error"), [(0.001, 0.02), (0.02, 1.0), (0.15, 0.2)])
def test_a_room_with_thin_walls_stays_empty_and_its_door_open(t, error):
    mesh = hut(t)
    assert mesh.is_watertight
    solids = parts_of(mesh, error)
    assert holds(solids, (2.0, t / 2, 1.0), (2.0, 2.0, 1.0)) == [False, False]
    assert holds(solids, (t / 2, 2.0, 1.0), (2.0, t / 2, 2.2), (2.0, 2.0, 2.5 - t / 2)) == [True, True, True]
    assert 0.99 * mesh.volume <= volume_of(solids) <= 1.1 * mesh.volume
    assert len(solids) <= 12


@pytest.mark.parametrize(
    ("mesh", "inside"),
    [
        (extrude_triangulation(*frame((2, 1), 0.02), 0.5), (1.0, 0.5, 0.2)),
        (trimesh.creation.annulus(r_min=0.48, r_max=0.5, height=1, sections=32), (0.0, 0.0, 0.0)),
        (hollow(trimesh.creation.box((2, 2, 2)), trimesh.creation.box((1.9, 1.9, 1.9))), (0.0, 0.0, 0.0)),
        (
            # A grating of bars of 5 cm, with gaps of 10 cm, in a frame.
            cells(
                (np.linspace(0, 1.95, 40), [0, 0.02], [0, 0.05, 0.95, 1]),
                lambda x, y, z: z < 0.05 or z > 0.95 or int(x / 0.05) % 3 == 0,
            ),
            (0.1, 0.01, 0.5),
        ),
    ],
    ids=["U", "tube", "hollow box", "grating"],
)
def test_thin_solids_have_their_volume(mesh, inside):
    pose = trimesh.transformations.rotation_matrix(0.7, (1, 2, 3), (4, 5, 6))
    solids = parts_of(mesh, pose=pose)
    assert holds(solids, tuple(pose[:3, :3] @ inside + pose[:3, 3])) == [False]
    assert volume_of(solids) == pytest.approx(mesh.volume, rel=0.2)


def test_convex_and_nearly_convex_meshes_are_one_hull():
    rounded = trimesh.creation.icosphere(2, 0.3)
    rounded.vertices = np.sign(rounded.vertices) * 0.2 + rounded.vertices
    dented = trimesh.creation.icosphere(3, 0.5)
    dented.vertices[0] *= 0.97
    for mesh in (trimesh.creation.box((1, 2, 0.001)), rounded, dented):
        assert len(parts_of(mesh)) == 1


Q = [(0, 0, 0), (2, 0, 0), (2, 0, 1), (0, 0, 1)]
H = [(0, 0, 0), (1, 0, 0), (2, 0, 0), (2, 0, 1), (1, 0, 1), (0, 0, 1)]
L = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 0, 1), (2, 0, 1), (2, 2, 1)]
SHEETS = {
    # Vertices, triangles, and the largest number of plates: what shares no edges with the front is a piece of its own.
    "one side": (Q, [(0, 1, 2), (0, 2, 3)], 1),
    "two sides": (Q, [(0, 1, 2), (0, 2, 3), (0, 2, 1), (0, 3, 2)], 1),
    "two diagonals": (Q, [(0, 1, 2), (0, 2, 3), (1, 0, 3), (1, 3, 2)], 1),
    "one triangle turned over": (Q, [(0, 1, 2), (0, 3, 2)], 1),
    "two quads": (H, [(0, 1, 4), (0, 4, 5), (1, 2, 3), (1, 3, 4), (1, 0, 5), (1, 5, 4), (2, 1, 4), (2, 4, 3)], 2),
    "a vertex on an edge": (H, [(0, 1, 4), (0, 4, 5), (1, 2, 3), (1, 3, 4), (2, 0, 5), (2, 5, 3)], 2),
    "a corner": (L, [(0, 1, 4), (0, 4, 3), (1, 2, 5), (1, 5, 4), (1, 0, 3), (1, 3, 4), (2, 1, 4), (2, 4, 5)], 2),
    "a triangle": (Q, [(0, 1, 2)], 1),
}


@pytest.mark.parametrize("name", SHEETS)
def test_sheets_become_plates_of_2_cm(name):
    vertices, faces, most = SHEETS[name]
    solids = parts_of(trimesh.Trimesh(vertices, faces, process=False))
    assert 0 < len(solids) <= most
    for solid in solids:
        extent = np.ptp(solid.vertices.numpy(), axis=0)
        assert min(extent[:2]) == pytest.approx(0.02, abs=1e-6)


def test_open_rooms_stay_empty_whatever_side_their_walls_face():
    room = trimesh.creation.box((4, 4, 2))
    for open_sides in ((0, 0, -1), (0, -1, 0)), ((0, 0, 1), (0, 0, -1)), ((0, 0, 1),):
        shut = [not any(normal @ np.array(side) > 0.9 for side in open_sides) for normal in room.face_normals]
        for faces in (room.faces[shut], room.faces[shut][:, ::-1]):
            assert holds(parts_of(trimesh.Trimesh(room.vertices, faces, process=False)), (0.0, 0.0, 0.0)) == [False]
    # A crate without a bottom is solid.
    crate = trimesh.creation.box((1, 1, 1))
    bottomless = trimesh.Trimesh(crate.vertices, crate.faces[crate.face_normals[:, 2] > -0.5], process=False)
    assert holds(parts_of(bottomless), (0.0, 0.0, 0.0)) == [True]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_bowl_becomes_plates_and_stays_hollow():
    radius, off = 0.5, 0.02
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    mesh.update_faces(mesh.triangles_center[:, 2] < 0)
    solids = parts_of(mesh)
    assert 1 < len(solids) <= 400
    reach = torch.cat([solid.vertices for solid in solids]).norm(dim=1)
    assert radius - off - 0.02 <= reach.min() <= reach.max() <= radius + off + 0.02
    assert holds(solids, (0.0, 0.0, -0.5 * radius)) == [False]


def test_pieces_without_volume_or_area_are_left_out_and_named(tmp_path):
    (tmp_path / "line.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    (tmp_path / "point.obj").write_text("v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n")
    shapes = {
        "good": ("<box><size>1 1 1</size></box>", "3 0 0.5 0 0 0"),
        "line": ("<mesh><uri>line.obj</uri></mesh>", ""),
        "point": ("<mesh><uri>point.obj</uri></mesh>", ""),
        "foil": ("<box><size>1 1 1e-9</size></box>", "0 3 0.5 0 0 0"),
        "poster": ("<box><size>1 1 0.001</size></box>", "0 -3 0.5 0 0 0"),
    }
    with pytest.warns(UserWarning, match="left out"):
        world = world_of(tmp_path, "".join(model(link(*shape), name) for name, shape in shapes.items()))
    assert len(world.obstacles) == 2
    (areas,) = [note for note in world.notes if "no area" in note]
    assert "line/l/c" in areas
    assert "point/l/c" in areas
    assert [note for note in world.notes if "foil/l/c has no volume" in note]


def test_a_mesh_is_decomposed_once_for_all_its_copies_and_readings(tmp_path, own_cache, monkeypatch):
    mesh = extrude_triangulation(*frame((1, 0.6), 0.1), 0.4)
    mesh.export(tmp_path / "u.stl")
    places = [("1 1 1", f"{3 * k} {k} 0 {0.3 * k} 0.1 {k}") for k in range(3)]
    places += [("-1 1 1", "0 6 0 0 0 0"), *(("1 2 3", f"{3 * k} -6 0 0 0 {k}") for k in range(2))]
    shape = "<mesh><uri>u.stl</uri><scale>{}</scale></mesh>"
    body = "".join(model(link(shape.format(scale), pose), f"m{k}") for k, (scale, pose) in enumerate(places))
    world = world_of(tmp_path, body)
    assert len([*(own_cache / "convex_parts").rglob("*.npz")]) == 2
    assert len(world.obstacles) == 6 * 3
    assert volume_of(world.obstacles) == pytest.approx((4 + 2 * 6) * mesh.volume, rel=1e-3)
    # In the middle of the bottom of the U and in its gap, of the mirror image and of a stretched copy.
    points = [(-0.5, 6.05, 0.2), (-0.5, 6.3, 0.2), (0.5, 6.05, 0.2), (0.5, -5.9, 0.6), (0.5, -5.4, 0.6)]
    assert world.inside(torch.tensor(points, dtype=torch.float64)).tolist() == [True, False, False, True, False]
    monkeypatch.setattr("rover_rl.worlds.files.convex._attempt", lambda *_: pytest.fail("decomposed again"))
    assert torch.equal(world_of(tmp_path, body).obstacles.vertices, world.obstacles.vertices)


def test_large_meshes_are_simplified_within_the_error_and_stay_closed():
    mesh = trimesh.creation.torus(0.5, 0.15, major_sections=48, minor_sections=24)
    vertices, faces = simplify(np.asarray(mesh.vertices), np.asarray(mesh.faces), 0.01)
    assert is_closed(faces)
    assert len(faces) < len(mesh.faces) / 2
    for one, other in (
        ((vertices, faces), (mesh.vertices, mesh.faces)),
        ((mesh.vertices, mesh.faces), (vertices, faces)),
    ):
        points, _ = random_points(*map(np.asarray, one), 1000)
        assert distances(points, *map(np.asarray, other)).max() < 0.03
