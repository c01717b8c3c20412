"""SDF worlds: shapes, poses and frames, includes, actors."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from rover_rl.worlds import World
from rover_rl.worlds.movers import Person
from tests.extras import needs_worlds
from tests.worlds.files.scenes import heights_at, inside

pytestmark = needs_worlds

PLANE = (
    "<model name='ground'><static>true</static><link name='l'><collision name='c'><geometry>"
    "<plane><normal>0 0 1</normal><size>{size}</size></plane></geometry></collision></link></model>"
)
POST = "<box><size>0.2 0.2 4</size></box>"


def model(body: str, name: str = "m", extra: str = "<static>true</static>") -> str:
    return f"<model name='{name}'>{extra}{body}</model>"


def link(shape: str, pose: str = "", name: str = "l", attributes: str = "") -> str:
    pose = f"<pose {attributes}>{pose}</pose>" if pose else ""
    return f"<link name='{name}'>{pose}<collision name='c'><geometry>{shape}</geometry></collision></link>"


def world_of(tmp_path: Path, body: str, version: str = "1.9", size: str = "20 20", **options) -> World:
    path = tmp_path / "test.sdf"
    plane = PLANE.format(size=size)
    path.write_text(f"<sdf version='{version}'><world name='w'>{plane}{body}</world></sdf>")
    return World.from_file(path, **options)


@pytest.mark.parametrize(
    ("shape", "within", "outside"),
    [
        ("<box><size>2 1 1</size></box>", (0.99, 0.49, 0.9), (1.01, 0.0, 0.5)),
        ("<cylinder><radius>1</radius><length>1</length></cylinder>", (0.7, 0.7, 0.9), (0.71, 0.71, 0.5)),
        ("<sphere><radius>1</radius></sphere>", (0.56, 0.56, 1.05), (0.6, 0.6, 1.1)),
        ("<capsule><radius>0.3</radius><length>1</length></capsule>", (0.0, 0.0, 1.28), (0.2, 0.2, 1.25)),
        ("<ellipsoid><radii>2 1 0.5</radii></ellipsoid>", (1.95, 0.0, 0.5), (1.9, 0.0, 0.7)),
        ("<cone><radius>1</radius><length>1</length></cone>", (0.9, 0.0, 0.05), (0.3, 0.0, 0.8)),
        (
            "<polyline><point>0 0</point><point>3 0</point><point>3 0.3</point><point>0.3 0.3</point>"
            "<point>0.3 3</point><point>0 3</point><height>1</height></polyline>",
            (0.15, 2.9, 0.6),
            (0.4, 0.4, 0.6),
        ),
    ],
)
def test_shapes(tmp_path, shape, within, outside):
    world = world_of(tmp_path, model(link(shape, "0 0 0.5 0 0 0")))
    assert inside(world, within, outside) == [True, False]


def test_round_shapes_are_within_half_a_centimeter(tmp_path):
    for radius in (0.075, 1.0, 4.0):
        shape = f"<cylinder><radius>{radius}</radius><length>1</length></cylinder>"
        (post,) = world_of(tmp_path, model(link(shape, "0 0 0.5 0 0 0"))).obstacles
        outline = post.footprint
        middles = (outline + outline.roll(-1, 0)) / 2
        assert outline.norm(dim=1).max().item() == pytest.approx(radius)
        assert middles.norm(dim=1).min().item() > radius - 0.005


STATIC = "<static>1</static>"
POSES = {
    "link": model(link(POST, "3 2 0 0 0 0")),
    "model": model(link(POST, "2 -3 0 0 0 0"), extra=f"{STATIC}<pose>0 0 0 0 0 1.5707963268</pose>"),
    "degrees": model(link(POST, "2 -3 0 0 0 0"), extra=f"{STATIC}<pose degrees='true'>0 0 0 0 0 90</pose>"),
    "quaternion": model(
        link(POST, "2 -3 0 0 0 0"),
        extra=f"{STATIC}<pose rotation_format='quat_xyzw'>0 0 0 0 0 0.70710678 0.70710678</pose>",
    ),
    "two": model(
        link(POST, "1 0 0 0 0 0") + "<frame name='f'><pose>1 1 0 0 0 0</pose></frame>",
        extra=f"{STATIC}<pose>2 2 0 0 0 0</pose>",
    ),
    "relative": model(
        link(POST, "1 1 0 0 0 0", attributes="relative_to='f'") + "<frame name='f'><pose>2 1 0 0 0 0</pose></frame>"
    ),
    "chain": model(
        link(POST, "0 1 0 0 0 0", attributes="relative_to='g'")
        + "<frame name='g' attached_to='f'><pose>1 0 0 0 0 0</pose></frame>"
        + "<frame name='f'><pose>2 1 0 0 0 0</pose></frame>"
    ),
    "world": model(link(POST), extra=f"{STATIC}<pose relative_to='far'>1 0 0 0 0 0</pose>")
    + "<frame name='far'><pose>2 2 0 0 0 0</pose></frame>",
    "nested": model(model(link(POST, "1 1 0 0 0 0"), "inner", "<pose>2 1 0 0 0 0</pose>")),
    "nested frame": model(
        model(link("<empty/>", "9 9 0 0 0 0", name="x"), "inner", "<pose>-6 -7 0 0 0 0</pose>")
        + link(POST, "0 0 0 0 0 0", attributes="relative_to='inner::x'")
    ),
    "placement": model(link(POST) + "<frame name='f'><pose>-3 -2 0 0 0 0</pose></frame>").replace(
        "<model name='m'>", "<model name='m' placement_frame='f'>"
    ),
    "state": "<state world_name='w'><model name='m'><pose>3 2 0 0 0 0</pose></model></state>" + model(link(POST)),
}


@pytest.mark.parametrize("body", POSES.values(), ids=POSES)
def test_poses_and_frames(tmp_path, body):
    world = world_of(tmp_path, body)
    assert len(world.obstacles) == 1
    assert world.obstacles[0].vertices.mean(0)[:2].tolist() == pytest.approx([3.0, 2.0], abs=1e-6)


def test_the_supported_versions_and_no_others(tmp_path):
    for minor in (4, 12):
        assert len(world_of(tmp_path, model(link(POST)), version=f"1.{minor}").obstacles) == 1
    for version in ("1.3", "2.0", "x"):
        with pytest.raises(ValueError, match=r"has the SDF version .*; 1.4 to 1.12 are supported"):
            world_of(tmp_path, "", version=version)


def included(folder: Path, body: str, name: str = "post", file: str = "model.sdf") -> None:
    (folder / name).mkdir(parents=True, exist_ok=True)
    (folder / name / file).write_text(f"<sdf version='1.7'>{body}</sdf>")


@pytest.mark.parametrize("place", ["beside", "models", "sibling", "option", "variable", "name"])
def test_includes_are_found(tmp_path, monkeypatch, place):
    home = tmp_path / "worlds"
    home.mkdir()
    elsewhere = tmp_path / "elsewhere"
    folders = {"beside": home, "models": home / "models", "sibling": tmp_path / "models", "name": home / "deep/down"}
    included(folders.get(place, elsewhere), model(link(POST)))
    if place == "variable":
        monkeypatch.setenv("GAZEBO_MODEL_PATH", f"/nowhere:{elsewhere}")
    options = {"model_paths": [str(elsewhere)]} if place == "option" else {}
    uri = "file:///opt/other/models/post" if place == "name" else "model://post"
    body = f"<include><uri>{uri}</uri><pose>3 2 0 0 0 0</pose></include>"
    world = world_of(home, body, **options)
    assert inside(world, (3.0, 2.0, 1.0), (0.0, 0.0, 1.0)) == [True, False]


def test_includes_have_names_poses_and_frames_of_their_own(tmp_path):
    included(
        tmp_path,
        model(link(POST) + "<frame name='f'><pose>0 1 0 0 0 0</pose></frame>", extra="<pose>9 9 0 0 0 0</pose>"),
    )
    body = (
        "<include><uri>post</uri><name>a</name><static>1</static><pose>3 0 0 0 0 0</pose></include>"
        "<include><uri>file://post/model.sdf</uri><name>b</name><static>1</static>"
        "<pose relative_to='a'>0 3 0 0 0 0</pose></include>"
        "<include><uri>model://post/model.sdf</uri><name>c</name><static>1</static></include>"
        "<include><uri>post</uri><name>d</name><static>1</static>"
        "<placement_frame>f</placement_frame><pose>-3 0 0 0 0 0</pose></include>"
    )
    centers = [obstacle.vertices.mean(0)[:2].tolist() for obstacle in world_of(tmp_path, body).obstacles]
    for center, expected in zip(centers, [(3, 0), (3, 3), (9, 9), (-3, -1)], strict=True):
        assert center == pytest.approx(expected, abs=1e-9)


def test_the_newest_file_of_a_model_config_counts(tmp_path):
    included(tmp_path, model(link(POST, "1 0 0 0 0 0")), file="old.sdf")
    included(tmp_path, model(link(POST, "2 0 0 0 0 0")), file="new.sdf")
    config = "<model><sdf version='1.5'>old.sdf</sdf><sdf version='1.10'>new.sdf</sdf></model>"
    (tmp_path / "post" / "model.config").write_text(config)
    world = world_of(tmp_path, "<include><uri>model://post</uri></include>")
    assert inside(world, (2.0, 0.0, 1.0)) == [True]


def test_everything_that_is_missing_is_in_one_error(tmp_path):
    body = (
        "<include><uri>https://fuel.gazebosim.org/1.0/OpenRobotics/models/Cave</uri></include>"
        "<include><uri>model://nowhere</uri></include>"
        + model(link("<mesh><uri>model://post/meshes/no.dae</uri></mesh>"))
        + model(link(POST), "post")
    )
    with pytest.raises(ValueError, match="needs what is not here") as error:
        world_of(tmp_path, body)
    for name in ("fuel.gazebosim.org/1.0/OpenRobotics/models/Cave", "model://nowhere", "model://post/meshes/no.dae"):
        assert name in str(error.value)
    with pytest.warns(UserWarning, match=r"left out.*Cave.*model://nowhere.*no\.dae"):
        world = world_of(tmp_path, body, missing="skip")
    assert len(world.obstacles) == 1
    assert any("Cave" in note for note in world.notes)


def test_models_that_are_not_static_stand_still_and_robots_are_left_out(tmp_path):
    robot = link(POST, "5 5 0 0 0 0", "a") + link(POST, "5 6 0 0 0 0", "b")
    joint = "<joint name='j' type='revolute'><parent>a</parent><child>b</child></joint>"
    body = model(link(POST), "crate", "") + model(robot + joint, "robot", "")
    with pytest.warns(UserWarning, match="models that are not static") as warned:
        world = world_of(tmp_path, body)
    assert inside(world, (0.0, 0.0, 1.0), (5.0, 5.0, 1.0), (5.0, 6.0, 1.0)) == [True, False, False]
    told = " ".join(str(warning.message) for warning in warned)
    assert "do not move: crate" in told
    assert "left out: robot" in told


def test_visual_geometry_counts_where_a_link_has_no_other(tmp_path):
    seen = link(POST, "2 0 0 0 0 0", "a").replace("collision", "visual")
    both = link(POST, "-2 0 0 0 0 0", "b").replace(
        "</link>", "<visual name='v'><geometry><box><size>3 3 3</size></box></geometry></visual></link>"
    )
    body = model(seen + both)
    world = world_of(tmp_path, body)
    assert inside(world, (2.0, 0.0, 1.0), (-2.0, 0.0, 1.0), (-3.0, 0.0, 1.0)) == [True, True, False]
    assert inside(world_of(tmp_path, body, visuals=False), (2.0, 0.0, 1.0), (-2.0, 0.0, 1.0)) == [False, True]


def test_actors_are_people_who_walk_from_waypoint_to_waypoint(tmp_path):
    actor = """<actor name='walker'><pose>1 0 0 0 0 1.5707963268</pose><skin><filename>https://x/walk.dae</filename></skin>
    <script><loop>false</loop><delay_start>2</delay_start><trajectory id='0' type='walk'>
    <waypoint><time>3</time><pose>1 0 1 0 0 0</pose></waypoint>
    <waypoint><time>0</time><pose>0 0 1 0 0 0</pose></waypoint>
    </trajectory></script></actor>"""
    (found,) = world_of(tmp_path, actor).movers
    assert (found.name, found.shape, found.motion.repeat, found.motion.delay) == ("walker", Person(), "once", 2.0)
    assert found.motion.keys[0] == pytest.approx((0, 1, 0, math.pi / 2), abs=1e-6)
    assert found.motion.keys[1] == pytest.approx((3, 1, 1, math.pi / 2), abs=1e-6)


def test_an_actor_that_does_not_start_by_itself_stands_at_its_first_waypoint(tmp_path):
    points = "".join(f"<waypoint><time>{t}</time><pose>{2 + t} 1 0 0 0 0</pose></waypoint>" for t in (0, 3))
    actor = f"<actor name='guard'><script><auto_start>0</auto_start><trajectory>{points}</trajectory></script></actor>"
    (found,) = world_of(tmp_path, actor).movers
    assert (found.motion.keys, found.motion.repeat) == (((0.0, 2.0, 1.0, 0.0),), "once")


def test_meshes_have_scales_and_submeshes(tmp_path):
    scene = trimesh.Scene()
    for name, x in (("one", 0.0), ("two", 4.0)):
        cube = trimesh.creation.box(bounds=[(x - 0.5, -0.5, 0), (x + 0.5, 0.5, 1)])
        scene.add_geometry(cube, node_name=name)
    (tmp_path / "meshes").mkdir()
    scene.export(tmp_path / "meshes" / "two.glb")
    shape = "<mesh><uri>meshes/two.glb</uri><scale>1 -2 1</scale></mesh>"
    world = world_of(tmp_path, model(link(shape)))
    assert inside(world, (0.0, 0.9, 0.5), (4.0, 0.9, 0.5), (0.9, 0.0, 0.5)) == [True, True, False]
    one = "<mesh><uri>meshes/two.glb</uri><submesh><name>two</name><center>{center}</center></submesh></mesh>"
    assert inside(world_of(tmp_path, model(link(one.format(center="true"), "0 0 1 0 0 0"))), (0.0, 0.0, 1.4)) == [True]
    apart = world_of(tmp_path, model(link(one.format(center="false"))))
    assert inside(apart, (0.0, 0.0, 0.5), (4.0, 0.0, 0.5)) == [False, True]


def test_a_heightmap_is_as_high_and_wide_as_gazebo_makes_it(tmp_path):
    rows, columns = np.mgrid[0:9, 0:9]
    Image.fromarray((20 * columns + 4 * rows).astype(np.uint8)).save(tmp_path / "map.png")
    shape = "<heightmap><uri>map.png</uri><size>16 16 3</size><pos>0 0 0.5</pos></heightmap>"
    world = world_of(tmp_path, model(link(shape), extra="<static>1</static><pose>1 0 0 0 0 0</pose>"))
    assert world.terrain.extent == ((-7.0, 9.0), (-8.0, 8.0))
    # The brightest pixel, 192, is in the southeast: the first row is in the north.
    corners = [(9.0, -8.0), (-7.0, 8.0), (-7.0, -8.0), (9.0, 8.0)]
    expected = [3.5, 0.5, 0.5 + 3 * 32 / 192, 0.5 + 3 * 160 / 192]
    assert heights_at(world, *corners) == pytest.approx(expected, abs=1e-5)
    # A quarter turn counter-clockwise: x becomes y.
    turned = world_of(tmp_path, model(link(shape), extra=f"{STATIC}<pose degrees='1'>0 0 0 0 0 90</pose>"))
    corners = [(8.0, 8.0), (-8.0, -8.0), (8.0, -8.0), (-8.0, 8.0)]
    assert heights_at(turned, *corners) == pytest.approx([3.5, 0.5, expected[2], expected[3]], abs=1e-5)


def test_an_inclined_plane_is_ground(tmp_path):
    inclined = "<plane><normal>-0.2 0 1</normal><size>10 10</size></plane>"
    world = world_of(tmp_path, model(link(inclined)), size="10 10")
    assert heights_at(world, (-3.0, 0.0), (3.0, 0.0)) == pytest.approx([0.0, 0.6], abs=0.01)


def test_merged_includes_share_their_frames(tmp_path):
    included(tmp_path, model(link("<empty/>", "1 0 0 0 0 0", "inner")))
    body = model(
        "<include merge='true'><uri>post</uri><pose>2 0 0 0 0 0</pose></include>"
        + link(POST, "0 2 0 0 0 0", "own", "relative_to='inner'")
    )
    assert inside(world_of(tmp_path, body), (3.0, 2.0, 1.0)) == [True]


@pytest.mark.parametrize(
    ("uri", "place"),
    [("model://gone/meshes/post.stl", "worlds"), ("file:///home/other/ws/src/pkg/meshes/post.stl", "elsewhere")],
)
def test_meshes_are_found_by_their_name(tmp_path, uri, place):
    home, elsewhere = tmp_path / "worlds", tmp_path / "elsewhere"
    folder = tmp_path / place / "package" / "meshes"
    folder.mkdir(parents=True)
    home.mkdir(exist_ok=True)
    trimesh.creation.box((0.2, 0.2, 4)).export(folder / "post.stl")
    # A file of the same name whose folders are other ones is not taken.
    (folder.parent / "old").mkdir()
    trimesh.creation.box((2, 2, 4)).export(folder.parent / "old" / "post.stl")
    world = world_of(home, model(link(f"<mesh><uri>{uri}</uri></mesh>")), model_paths=[str(elsewhere)])
    assert inside(world, (0.0, 0.0, 1.0), (0.5, 0.5, 1.0)) == [True, False]
    assert any(f"{uri} is taken from" in note for note in world.notes)


def test_movers_that_stand_still_are_told(tmp_path):
    plugins = (
        "<plugin filename='gz-sim-velocity-control-system' name='gz::sim::systems::VelocityControl'/>"
        "<plugin filename='libcamera.so' name='camera'/>"
    )
    with pytest.warns(UserWarning, match="plugins move in Gazebo stand still: cart .VelocityControl.$"):
        world_of(tmp_path, model(link(POST), "cart", STATIC + plugins) + model(link(POST, "3 0 0 0 0 0"), "crate"))


@pytest.mark.parametrize("head", ["\n<?xml version='1.0'?>", "<!-- ---- --><?xml version='1.0' encoding='UTF-16'?>"])
def test_worlds_are_read_with_the_rules_of_tinyxml(tmp_path, head):
    body = model(link(POST) + "<plugin name='R&D' filename='f?a&b'><gz:x/></plugin>")
    text = f"{head}<sdf version='1.6'><world name='w'>{PLANE.format(size='9 9')}{body}</world></sdf>"
    (tmp_path / "text.sdf").write_text(text)
    assert len(World.from_file(tmp_path / "text.sdf").obstacles) == 1


def collada(path: Path, size: tuple[float, float, float], asset: str) -> None:
    """A box on z = 0 of the coordinates in the file, with XML that TinyXML accepts."""
    cube = trimesh.creation.box(bounds=[(-size[0] / 2, -size[1] / 2, 0), (size[0] / 2, size[1] / 2, size[2])])
    text = trimesh.exchange.dae.export_collada(cube).decode().partition("<COLLADA")[2]
    for tag in ("unit", "up_axis"):
        text = re.sub(rf"<{tag}[^>]*/>|<{tag}.*?</{tag}>", "", text)
    path.write_text(f"\n<?xml version='1.0'?><!-- ---- --><COLLADA{text.replace('</asset>', f'{asset}</asset>')}")


@pytest.mark.parametrize(
    ("asset", "scale", "factor"),
    [
        ("", "", (1, 1, 1)),
        ("<up_axis>Y_UP</up_axis><max:x max:y='1'/>", "<scale>2 1 1</scale>", (2, 1, 1)),
        ("<up_axis>X_UP</up_axis>", "<scale>1 -2 1</scale>", (1, 2, 1)),
        ("<unit meter='0.0254' name='inch'/><up_axis>Y_UP</up_axis>", "", (0.0254,) * 3),
        ("<unit meter='0.01'/>", "<scale>100 100 50</scale>", (1, 1, 0.5)),
    ],
)
def test_meshes_of_collada_keep_their_axes_and_take_their_unit_as_in_gazebo(tmp_path, asset, scale, factor):
    collada(tmp_path / "box.dae", (2, 1, 3), asset)
    (box,) = world_of(tmp_path, model(link(f"<mesh><uri>box.dae</uri>{scale}</mesh>"))).obstacles
    low, high = box.vertices.min(0).values.numpy(), box.vertices.max(0).values.numpy()
    np.testing.assert_allclose(high - low, np.array((2, 1, 3)) * factor, atol=1e-6)
    assert low[2] == pytest.approx(0)


@pytest.mark.parametrize("kind", ["obj", "glb"])
def test_meshes_of_worlds_keep_their_axes_as_in_gazebo(tmp_path, kind):
    trimesh.creation.box(bounds=[(-1, -0.5, 0), (1, 0.5, 3)]).export(tmp_path / f"box.{kind}")
    (box,) = world_of(tmp_path, model(link(f"<mesh><uri>box.{kind}</uri></mesh>"))).obstacles
    assert box.vertices.max(0).values.tolist() == pytest.approx([1, 0.5, 3])


BAD_PIECES = {
    "no number": (link("<box><size>1 one 1</size></box>"), "the size of the box of bad/l/c must be 3 finite numbers"),
    "no size": (link("<sphere/>"), "the radius of the sphere of bad/l/c must be 1 finite number"),
    "size of 0": (link("<box><size>1 0 1</size></box>"), "the size of the box of bad/l/c must be positive"),
    "far up": (link(POST, "1 1 343582 0 0 0"), "bad/l/c reaches 3.44e[+]05 m from the origin"),
    "pose of three numbers": (link(POST, "1 1 1"), "the pose of 'l' in the model 'bad' must be 6 finite numbers"),
    "no quaternion": (
        link(POST, "0 0 0 0 0 0 0", attributes="rotation_format='quat_xyzw'"),
        "a quaternion of length 0",
    ),
    "no frame": (link(POST, "1 1 0 0 0 0", attributes="relative_to='x'"), "the model 'bad' has no frame 'x'"),
    "no mesh": (link("<mesh><uri>text.stl</uri></mesh>"), "bad/l/c: .*text.stl holds no triangles"),
    "no kind of mesh": (link("<mesh><uri>text.txt</uri></mesh>"), "bad/l/c: .*text.txt is no mesh"),
    "no uri": (link("<mesh/>"), "the mesh of bad/l/c has no uri"),
    "scale of 0": (link("<mesh><uri>cube.stl</uri><scale>1 0 1</scale></mesh>"), "the scale of bad/l/c must not be 0"),
    "no submesh": (link("<mesh><uri>cube.stl</uri><submesh><name>x</name></submesh></mesh>"), "has no submesh 'x'"),
    "no normal": (link("<plane><normal>0 0 0</normal></plane>"), "the normal of bad/l/c must not be 0"),
    "polyline of two points": (
        link("<polyline><point>0 0</point><point>1 0</point><height>1</height></polyline>"),
        "the polyline of bad/l/c must have at least 3 points",
    ),
    "no heightmap": (
        link("<heightmap><uri>text.png</uri><size>9 9 1</size></heightmap>"),
        "no picture that can be read",
    ),
    "include without a uri": ("<include/>", "an <include> in .*test.sdf has no uri"),
    "include of no XML": ("<include><uri>broken</uri></include>", "is not valid XML"),
    "include in a circle": ("<include><uri>circle</uri></include>", "includes itself"),
    "include of an old version": ("<include><uri>old</uri></include>", "has the SDF version '1.2'"),
}


@pytest.mark.parametrize(("bad", "why"), BAD_PIECES.values(), ids=BAD_PIECES)
def test_a_bad_piece_is_left_out_and_named_beside_the_good_ones(tmp_path, bad, why):
    for name in ("text.stl", "text.txt", "text.png"):
        (tmp_path / name).write_text("words")
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "cube.stl")
    for name, content in (
        ("broken", "<sdf version='1.6'><model"),
        ("circle", "<sdf version='1.6'><model name='m'><include><uri>model://circle</uri></include></model></sdf>"),
        ("old", "<sdf version='1.2'/>"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / "model.sdf").write_text(content)
    body = bad if bad.startswith("<include") else model(bad, "bad")
    with pytest.warns(UserWarning, match=f"left out, as they are wrong: .*{why}"):
        world = world_of(tmp_path, body + model(link(POST, "3 2 0 0 0 0"), "good"))
    assert len(world.obstacles) == 1
    assert inside(world, (3.0, 2.0, 1.0)) == [True]
    assert any(re.search(why, note) for note in world.notes)
    with pytest.raises(ValueError, match=why):
        world_of(tmp_path, body)


def test_a_wrong_link_leaves_the_others_of_its_model_and_a_wrong_actor_the_others(tmp_path):
    actor = "<actor name='{}'><script><trajectory><waypoint><time>{}</time></waypoint></trajectory></script></actor>"
    joint = "<joint name='j' type='fixed'><pose>1 2</pose><parent>a</parent><child>b</child></joint>"
    body = model(link(POST, "nan 0 0 0 0 0", "a") + link(POST, "2 0 0 0 0 0", "b") + joint)
    with pytest.warns(UserWarning, match="'a' in the model 'm'.*a waypoint's time of 'two' must be"):
        world = world_of(tmp_path, body + actor.format("one", 0) + actor.format("two", "soon"))
    assert inside(world, (2.0, 0.0, 1.0)) == [True]
    assert [mover.name for mover in world.movers] == ["one"]


GROUND = "https://fuel.gazebosim.org/1.0/OpenRobotics/models/Ground Plane"


@pytest.mark.parametrize(
    "uri",
    [
        "model://ground_plane/model.sdf",
        f"{GROUND}/tip".replace(" ", "%20"),
        "https://fuel.ignitionrobotics.org/1.0/openrobotics/models/ground plane/1/",
    ],
)
def test_the_ground_plane_and_the_sun_of_gazebo_need_no_files(tmp_path, uri):
    ground = f"<include><uri>{uri}</uri><pose>0 0 0.5 0 0 0</pose></include>"
    sun = f"<include><uri>{re.sub('(?i)ground(.*)plane', 'sun', uri)}</uri></include>"
    path = tmp_path / "text.sdf"
    path.write_text(f"<sdf version='1.6'><world>{sun}{ground}{model(link(POST, '3 2 9 0 0 0'))}</world></sdf>")
    world = World.from_file(path)
    assert (world.terrain.is_flat, heights_at(world, (0.0, 0.0))) == (True, [0.5])
    assert len(world.obstacles) == 1
    # A file of that name counts.
    included(tmp_path, model(link("<plane/>", "0 0 2 0 0 0")), "ground_plane")
    if uri.startswith("model"):
        assert heights_at(World.from_file(path), (0.0, 0.0)) == [2.5]


@pytest.mark.parametrize(
    ("contact", "count"),
    [
        ("<collide_bitmask>\n 0x00 </collide_bitmask>", 0),
        ("<collide_bitmask>65536</collide_bitmask>", 0),  # 16 bits count
        ("<collide_bitmask>0</collide_bitmask><category_bitmask>0</category_bitmask>", 0),
        ("<collide_bitmask>0</collide_bitmask><category_bitmask>2</category_bitmask>", 1),
        ("<collide_bitmask>010</collide_bitmask>", 1),
        ("<collide_bitmask/>", 1),
        ("<collide_without_contact> True </collide_without_contact>", 0),
        ("<collide_without_contact>false</collide_without_contact>", 1),
    ],
)
def test_collisions_that_stop_nothing_are_left_out(tmp_path, contact, count):
    off = link(POST).replace("</collision>", f"<surface><contact>{contact}</contact></surface></collision>")
    # A visual does not take the place of a collision that is off.
    off = off.replace("</link>", f"<visual name='v'><geometry>{POST}</geometry></visual></link>")
    world = world_of(tmp_path, model(off, "off") + model(link(POST, "3 2 0 0 0 0")))
    assert len(world.obstacles) == 1 + count
    assert any("off/l/c" in note for note in world.notes) == (count == 0)


def test_the_saved_state_of_a_world_counts(tmp_path):
    inner = model(link(POST, name="x"), "inner", "")
    body = model(link(POST, "1 1 0 0 0 0", "a") + link(POST, "5 5 0 0 0 0", "b") + inner, "m") + model(
        link(POST), "gone"
    )
    new = model(link(POST, "0 -4 0 0 0 0"), "new")
    state = (
        f"<state world_name='w'><insertions>{new}</insertions><deletions><name>gone</name></deletions><model name='m'>"
        "<pose>2 0 0 0 0 1.5707963</pose><scale>2 3 1</scale><link name='b'><pose>-3 0 0 0 0 0</pose></link>"
        "<model name='inner'><pose>0 4 0 0 0 0</pose></model></model></state>"
    )
    world = world_of(tmp_path, body + state)
    found = [[*o.vertices.mean(0)[:2].tolist(), *np.ptp(o.vertices.numpy(), axis=0)[:2]] for o in world.obstacles]
    expected = [[0, 4, 0.2, 0.2], [1, 1, 0.6, 0.4], [-3, 0, 0.4, 0.6], [0, -4, 0.2, 0.2]]
    np.testing.assert_allclose(found, expected, atol=1e-6)


WALLS = "".join(
    model(link(f"<box><size>{size} 1</size></box>", f"{place} 0.5 0 0 0"), name)
    for name, size, place in (
        ("n", "20 .2", "0 10"),
        ("s", "20 .2", "0 -10"),
        ("e", ".2 20", "10 0"),
        ("w", ".2 20", "-10 0"),
    )
)


def slab(top: float, size: tuple[float, float, float], x: float = 0.0, y: float = 0.0, name: str = "slab") -> str:
    shape = f"<box><size>{size[0]} {size[1]} {size[2]}</size></box>"
    return model(link(shape, f"{x} {y} {top - size[2] / 2} 0 0 0"), name)


@pytest.mark.parametrize(
    ("floors", "top"),
    [
        (slab(-0.02, (8, 8, 0.1)), 0.0),
        (slab(0.01, (3, 2, 0.01)), 0.0),
        (slab(0.02, (3, 2, 0.02)), 0.02),
        (slab(0.05, (8, 8, 0.3)), 0.05),
        ("".join(slab(0.05, (4, 4, 0.1), x, y, f"t{x}{y}") for x in (-2, 2) for y in (-2, 2)), 0.05),
        (slab(0.2, (18, 18, 0.4)) + slab(0.23, (2, 2, 0.03), name="carpet"), 0.23),
    ],
    ids=["below", "thin carpet", "carpet", "slab", "tiles", "carpet on a slab"],
)
def test_floors_on_other_ground_carry_the_wheels(tmp_path, floors, top):
    world = world_of(tmp_path, WALLS + floors, spawn_range=((-0.9, 0.9), (-0.9, 0.9)))
    assert len(world.obstacles) == 4
    assert heights_at(world, (0.0, 0.0)) == pytest.approx([top], abs=1e-6)


def test_what_is_higher_or_narrower_than_a_floor_is_an_obstacle_and_may_be_named_as_ground(tmp_path):
    sill = slab(0.03, (0.2, 2, 0.03), 5, name="sill")
    foot = slab(0.04, (0.6, 0.6, 0.04), 5, name="foot")
    assert [len(world_of(tmp_path, WALLS + low).obstacles) for low in (sill, foot)] == [5, 5]
    areas = {"spawn_range": ((-1, 1), (-1, 1)), "goal_range": ((-3, 3), (-3, 3))}
    with pytest.raises(ValueError, match=r"no free ground .* slab/l/c are ground, name them, .* ground=.slab\*."):
        world_of(tmp_path, WALLS + slab(0.08, (8, 8, 0.1)), **areas)
    world = world_of(tmp_path, WALLS + slab(0.08, (8, 8, 0.1)), ground="slab*", **areas)
    assert (len(world.obstacles), heights_at(world, (0.0, 0.0))) == (4, pytest.approx([0.08]))


@pytest.mark.parametrize(
    ("uri", "x"),
    [
        ("https://fuel.gazebosim.org/1.0/OpenRobotics/models/Brick%20Wall/tip", 10.0),
        ("https://fuel.gazebosim.org/1.0/OpenRobotics/models/Brick Wall/2", 2.0),
        ("model://brick wall", 10.0),
    ],
)
def test_models_of_fuel_that_were_downloaded_are_found_in_the_folders_of_models(tmp_path, uri, x):
    home, cache = tmp_path / "worlds", tmp_path / "fuel" / "fuel.gazebosim.org" / "openrobotics" / "models"
    home.mkdir()
    for version in (2, 10):
        included(cache / "brick wall", model(link(POST, f"{version} 0 0 0 0 0")), str(version))
    body = f"<include><uri>{uri}</uri></include>"
    with pytest.raises(ValueError, match="name their folders with model_paths, download them"):
        world_of(home, body)
    (post,) = world_of(home, body, model_paths=[str(tmp_path / "fuel")]).obstacles
    assert post.vertices.mean(0)[0].item() == pytest.approx(x)


def test_submeshes_of_collada_have_the_names_of_their_nodes(tmp_path):
    boxes = [trimesh.creation.box(bounds=[(x, 0, 0), (x + 1, 1, 1)]) for x in (0, 3)]
    nodes = iter(("Wheel", "Body"))
    text = trimesh.exchange.dae.export_collada(boxes).decode()
    (tmp_path / "two.dae").write_text(re.sub(r"<node[^>]*>", lambda _: f'<node name="{next(nodes)}">', text))
    (body,) = world_of(
        tmp_path, model(link("<mesh><uri>two.dae</uri><submesh><name>Body</name></submesh></mesh>"))
    ).obstacles
    assert body.vertices.min(0).values.tolist() == pytest.approx([3, 0, 0])


def test_polylines_within_one_another_are_holes_as_in_gazebo(tmp_path):
    def ring(half: float, x: float = 0.0) -> str:
        corners = ((x - half, -half), (x + half, -half), (x + half, half), (x - half, half), (x - half, -half))
        return f"<polyline>{''.join(f'<point>{a} {b}</point>' for a, b in corners)}<height>1</height></polyline>"

    world = world_of(tmp_path, model(link(ring(2) + ring(3) + ring(1) + ring(0.5, 6.0))))
    points = [(x, 0.0, 0.5) for x in (0.0, 1.5, 2.5, -2.5, 3.5, 6.0)]
    assert inside(world, *points) == [True, False, True, True, False, True]


@pytest.mark.parametrize("pose", ["7000 7000 0 0 0 0", "1 1 -3000 0 0 0"])
def test_a_model_that_is_far_from_all_others_is_left_out_and_named(tmp_path, pose):
    near = model(link(POST, "3 2 0 0 0 0"))
    with pytest.warns(UserWarning, match="left out, as they are more than 1 km from all others: far/l/c"):
        world = world_of(tmp_path, model(link(POST, pose), "far") + near)
    assert len(world.obstacles) == 1
    assert inside(world, (3.0, 2.0, 1.0)) == [True]
