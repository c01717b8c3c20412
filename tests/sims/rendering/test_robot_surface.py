"""Visual shapes of robots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from rover_rl.robots import Robot, get_robot
from rover_rl.sims.rendering.scenery import UNPAINTED
from rover_rl.sims.rendering.surfaces import Surface, robot_surface

ROVER = get_robot("rover_zero")
RED, BLUE = (0.8, 0.2, 0.2), (0.2, 0.2, 0.8)


def surface_with(folder: Path, visual: str, elsewhere: str = "") -> Surface:
    """Surface of Rover Zero with one visual shape on its base, and further elements in its URDF."""
    lines, inside = [], False
    for line in ROVER.urdf.read_text().splitlines():
        inside = inside or "<visual>" in line
        if not inside:
            lines.append(line)
        inside = inside and "</visual>" not in line
    text = "\n".join(lines).replace("<collision>", f"{visual}<collision>", 1)
    urdf = folder / "rover.urdf"
    urdf.write_text(text.replace("</robot>", f"{elsewhere}</robot>"))
    return robot_surface(Robot.from_urdf(urdf, drive=ROVER.drive))


def extent(surface: Surface) -> np.ndarray:
    return np.stack((surface.vertices.min(0), surface.vertices.max(0)))


def visual(geometry: str, rest: str = "") -> str:
    return f"<visual>{rest}<geometry>{geometry}</geometry></visual>"


def test_rover_zero_has_its_shapes_at_their_places():
    surface = robot_surface(ROVER)
    # The wheels at the zero angles of their joints are the outermost parts, the lidar the highest.
    np.testing.assert_allclose(extent(surface), ((-0.267, -0.225, 0.003), (0.2635, 0.225, 0.346)), atol=1e-3)
    colors = {tuple(color) for color in surface.colors.round(3)}
    assert colors == {(0.93, 0.55, 0.12), (0.75, 0.77, 0.8), (0.1, 0.35, 0.75), (0.12, 0.12, 0.13)}
    # Triangles face outward.
    a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
    flat = np.cross(b - a, c - a)
    assert ((flat[:, None] * surface.normals[surface.faces]).sum(-1) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(surface.normals, axis=1), 1.0)


@pytest.mark.parametrize(
    ("file", "suffix"), [("parts/block.{}", "obj"), ("package://my_rover/urdf/parts/block.{}", "stl")]
)
def test_mesh_files_are_loaded_scaled_and_placed(tmp_path, suffix, file):
    folder = tmp_path / "my_rover" / "urdf"
    (folder / "parts").mkdir(parents=True)
    trimesh.creation.box((1.0, 2.0, 3.0)).export(folder / "parts" / f"block.{suffix}")
    mesh = f'<mesh filename="{file.format(suffix)}" scale="0.1 0.2 0.3"/>'
    origin = '<origin xyz="0 0 1" rpy="0 0 1.5707963267948966"/>'
    paint = '<material name="paint"><color rgba="0.8 0.2 0.2 1"/></material>'
    surface = surface_with(folder, visual(mesh, origin + paint))
    np.testing.assert_allclose(extent(surface), ((-0.2, -0.05, 0.55), (0.2, 0.05, 1.45)), atol=1e-6)
    np.testing.assert_allclose(surface.colors, np.tile(RED, (12, 1)))


def test_a_material_may_be_defined_elsewhere(tmp_path):
    paint = '<material name="paint"><color rgba="0.2 0.2 0.8 1"/></material>'
    surface = surface_with(tmp_path, visual('<sphere radius="0.2"/>', '<material name="paint"/>'), paint)
    np.testing.assert_allclose(surface.colors, np.tile(BLUE, (len(surface.faces), 1)))
    np.testing.assert_allclose(extent(surface), ((-0.2,) * 3, (0.2,) * 3), atol=0.005)


def test_colors_of_a_mesh_file_are_used_if_the_urdf_states_none(tmp_path):
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    vertices = [f"v {x} {y} {z}" for x, y, z in box.vertices]
    faces = [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in box.faces]
    (tmp_path / "box.mtl").write_text("newmtl red\nKd 0.8 0.2 0.2\nnewmtl blue\nKd 0.2 0.2 0.8\n")
    parts = ["mtllib box.mtl", *vertices, "usemtl red", *faces[:4], "usemtl blue", *faces[4:]]
    (tmp_path / "box.obj").write_text("\n".join(parts))
    (tmp_path / "plain.obj").write_text("\n".join((*vertices, *faces)))
    colors = surface_with(tmp_path, visual('<mesh filename="box.obj"/>')).colors
    assert np.isclose(colors, RED).all(1).sum() == 4
    assert np.isclose(colors, BLUE).all(1).sum() == 8
    plain = surface_with(tmp_path, visual('<mesh filename="plain.obj"/>')).colors
    np.testing.assert_allclose(plain, np.tile(UNPAINTED, (12, 1)))


def test_a_robot_without_visual_shapes_shows_its_collision_shapes(tmp_path):
    surface = surface_with(tmp_path, "")
    np.testing.assert_allclose(extent(surface)[:, 1], (-0.225, 0.225), atol=1e-3)
    assert len(surface.faces) > 100


@pytest.mark.parametrize(
    ("geometry", "message"),
    [
        ('<mesh filename="lost.stl"/>', "the mesh 'lost.stl' does not exist"),
        ('<mesh filename="package://other/lost.stl"/>', "the mesh 'package://other/lost.stl' does not exist"),
        ('<mesh filename="rover.urdf"/>', "the mesh 'rover.urdf' has a format that cannot be read"),
        ('<capsule radius="0.1" length="1"/>', "a visual shape of link 'base_link' is a capsule"),
    ],
)
def test_shapes_that_cannot_be_drawn_are_left_out_and_named(tmp_path, geometry, message):
    with pytest.warns(UserWarning, match=message):
        surface_with(tmp_path, visual(geometry))
