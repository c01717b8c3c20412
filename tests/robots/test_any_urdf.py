"""Any URDF of a wheeled robot as a robot: its wheels, drive, masses and mounts, and why others are refused."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rover_rl.robots import Robot, RobotOptions, get_robot
from rover_rl.robots.drives import Ackermann, Mecanum, SkidSteer, effective_track
from rover_rl.robots.urdf.description import Description
from tests.robots.public_urdfs import Machine, box, car, inertial, joint, link, shape
from tests.sims.driven import FLAT, drive, placed


def read(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return Robot.from_urdf(path, options=RobotOptions(**options))


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    height=st.floats(-0.2, 0.4),
    radius=st.floats(0.05, 0.3),
    half=st.floats(0.15, 0.5),
    pairs=st.integers(2, 3),
    sign=st.sampled_from((1, -1)),
    mass=st.floats(2.0, 80.0),
)
def test_a_skid_steer_robot_is_read_from_any_base_frame(tmp_path, height, radius, half, pairs, sign, mass):
    machine = Machine(height, radius, 0.3 * radius, 0.05 * mass, sign).body(mass)
    xs = [1.1 * radius * (2 * k + 1 - pairs) for k in range(pairs)]
    path = machine.wheels(xs, half).write(tmp_path)
    robot = read(path)
    assert isinstance(robot.drive, SkidSteer)
    assert sorted(robot.drive.left) == [f"left_{k}" for k in range(pairs)]
    assert sorted(robot.drive.right) == [f"right_{k}" for k in range(pairs)]
    assert (robot.wheels.radius, robot.wheels.width) == pytest.approx((radius, 0.3 * radius), abs=1e-6)
    hubs = np.array(sorted(robot.wheels.hubs))
    np.testing.assert_allclose(hubs, sorted((x, y, radius) for x in xs for y in (half, -half)), atol=1e-6)
    urdf = Description(path)
    assert robot.mass == pytest.approx(urdf.mass(urdf.links).mass, rel=1e-6)


def test_the_mass_stays_where_it_is_and_the_base_frame_is_below_the_middle_of_the_wheels(tmp_path):
    arm = [
        link("arm", inertial(2.0)),
        joint("shoulder", "revolute", "base_link", "arm", "0.1 0.05 0.3", '<axis xyz="0 1 0"/><limit upper="1"/>'),
    ]
    robot = read(Machine(height=0.3).body().wheels((0.5, 0.1)).add(*arm).write(tmp_path))
    assert {round(x, 6) for x, _, _ in robot.wheels.hubs} == {0.2, -0.2}
    assert (robot.footprint.back, robot.footprint.front) == pytest.approx((-0.6, 0.3))
    assert robot.chassis.mass == pytest.approx(12.0)
    # The base link, 10 kg, is 0.3 m above the ground and behind the middle; the arm, 2 kg, 0.3 m above it.
    np.testing.assert_allclose(robot.chassis.center, (-0.3 + 0.2 / 12, 0.1 / 12, (3.0 + 1.2) / 12), atol=1e-6)


def rover_with(*parts, more=""):
    return Machine().body(more=more).wheels((0.2, -0.2)).add(*parts)


def fixed(child, xyz, more="", content=""):
    return [link(child, inertial(0.05) + content), joint(f"{child}_joint", "fixed", "base_link", child, xyz, more)]


LEFT_OUT = {
    "link imu_link is left out.*optenv IMU_XYZ 0 0 0": rover_with(*fixed("imu_link", "$(optenv IMU_XYZ 0 0 0)")),
    "link cam, lens is": rover_with(
        *fixed("cam", "$(arg x) 0 0"), link("lens"), joint("lens_joint", "fixed", "cam", "lens")
    ),
    "the visual of link base_link": rover_with(more=shape("visual", '<box size="1 1 ${h}"/>')),
    "the material of link base_link": rover_with(
        more='<visual><geometry><box size="1 1 1"/></geometry><material name="$(arg m)"/></visual>'
    ),
    "the material m is left out": rover_with('<material name="m"><color rgba="$(arg rgba)"/></material>'),
    "the dynamics of joint gps_joint": rover_with(*fixed("gps", "0 0 0.2", '<dynamics damping="$(arg d)"/>')),
    "the effort of joint arm_joint": rover_with(
        link("arm", inertial(0.2)),
        joint("arm_joint", "revolute", "base_link", "arm", more='<limit lower="0" upper="1" effort="$(arg e)"/>'),
    ),
}


@pytest.mark.parametrize("named", LEFT_OUT)
def test_expressions_of_xacro_where_a_robot_drives_without_them_are_left_out_and_named(tmp_path, named):
    with pytest.warns(UserWarning, match=named):
        robot = Robot.from_urdf(LEFT_OUT[named].write(tmp_path), options=RobotOptions())
    assert len(robot.wheels.hubs) == 4


@pytest.mark.parametrize(
    "machine",
    [
        Machine().body().wheels((0.2, -0.2)).wheel("extra", "$(optenv X 0.3)", 0.2),
        rover_with(more=shape("collision", '<box size="1 1 ${h}"/>')),
        rover_with(link("battery", inertial(20.0)), joint("b", "fixed", "base_link", "battery", "$(arg x) 0 0")),
        rover_with(link("arm", inertial(0.1)), joint("a", "revolute", "base_link", "arm", "$(arg x) 0 0")),
        rover_with(
            link("a", '<inertial><mass value="$(arg m)"/><inertia/></inertial>'), joint("j", "fixed", "base_link", "a")
        ),
        rover_with('<gazebo reference="a"/>', "<xacro:include/>"),
    ],
    ids=["wheel", "collision", "heavy", "movable", "mass", "macro"],
)
def test_expressions_of_xacro_that_matter_are_refused_with_the_command(tmp_path, machine):
    path = machine.write(tmp_path)
    with pytest.raises(ValueError, match=r"it is a xacro file, with .*; expand it first: xacro FILE > robot.urdf$"):
        read(path)


def test_topics_and_plugins_may_have_expressions(tmp_path):
    plugin = '<gazebo reference="$(arg l)"><sensor name="s"><topic name="$(arg t)">$(arg t)</topic></sensor></gazebo>'
    assert len(read(rover_with(plugin).write(tmp_path)).wheels.hubs) == 4


def test_a_package_that_xacro_would_find_is_found(tmp_path):
    (tmp_path / "my_robot" / "meshes").mkdir(parents=True)
    trimesh.creation.box((0.5, 0.3, 0.2)).export(tmp_path / "my_robot" / "meshes" / "top.stl")
    mesh = shape("collision", '<mesh filename="file://$(find my_robot)/meshes/top.stl"/>', "0 0 0.5")
    outline = read(rover_with(more=mesh).write(tmp_path)).footprint
    assert outline.front == pytest.approx(0.3)


@pytest.mark.parametrize("kind", ["dae", "obj"])
def test_a_mesh_without_its_pictures_is_read_and_the_loss_is_named_once(tmp_path, capfd, kind):
    box_mesh, path = trimesh.creation.box((0.5, 0.3, 0.2)), tmp_path / f"body.{kind}"
    if kind == "obj":
        text = "mtllib body.mtl\nusemtl paint\n"
        text += "".join(f"v {x} {y} {z}\n" for x, y, z in box_mesh.vertices)
        path.write_text(text + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in box_mesh.faces))
    else:
        path.write_bytes(trimesh.exchange.dae.export_collada([box_mesh]))
        effect = (
            '<library_images><image id="i"><init_from>no.png</init_from></image></library_images><library_effects>'
            '<effect id="e"><profile_COMMON><newparam sid="s"><surface type="2D"><init_from>i</init_from></surface>'
            '</newparam><newparam sid="t"><sampler2D><source>s</source></sampler2D></newparam><technique sid="c">'
            '<lambert><diffuse><texture texture="t" texcoord="U"/></diffuse></lambert><extra>'
            '<technique profile="FCOLLADA"><bump><texture texture="t" texcoord="U"/></bump></technique></extra>'
            "</technique></profile_COMMON></effect></library_effects><library_materials>"
            '<material id="m"><instance_effect url="#e"/></material></library_materials>'
        )
        path.write_text(path.read_text().replace("<library_geometries>", effect + "<library_geometries>"))
        (tmp_path / "no.png").write_bytes(b"no picture")
    bodies = [shape("collision", f'<mesh filename="{path.name}"/>', f"0 0 {z}") for z in (0.1, 0.3)]
    with pytest.warns(UserWarning, match=f"^machine.urdf: .*the mesh {path.name} is read without") as caught:
        Robot.from_urdf(rover_with(more="".join(bodies)).write(tmp_path), options=RobotOptions())
    assert str(caught[0].message).count(path.name) == 1
    assert caught[0].filename == __file__
    assert "Traceback" not in capfd.readouterr().err


def test_wheels_of_meshes_become_cylinders(tmp_path):
    (tmp_path / "my_robot" / "meshes").mkdir(parents=True)
    trimesh.creation.cylinder(80, 40, sections=48).export(tmp_path / "my_robot" / "meshes" / "wheel.stl")
    mesh = '<mesh filename="package://my_robot/meshes/wheel.stl" scale="0.001 0.001 0.001"/>'
    machine = Machine().body()
    for k, (x, y) in enumerate(((0.2, 0.2), (0.2, -0.2), (-0.2, 0.2), (-0.2, -0.2))):
        machine.wheel(f"wheel_{k}", x, y, content=shape("visual", mesh, "0 0 0.01"))
    robot = read(machine.write(tmp_path))
    assert (robot.wheels.radius, robot.wheels.width) == pytest.approx((0.08, 0.04), abs=1e-4)
    # The meshes are 1 cm beside the joints, along the axle.
    assert {round(abs(y), 6) for _, y, _ in robot.wheels.hubs} == {0.2}


def test_a_car_steers_as_far_as_its_joints(tmp_path):
    robot = read(car(height=0.35).write(tmp_path))
    drive = robot.drive
    assert isinstance(drive, Ackermann)
    assert drive.front == ("left_wheel", "right_wheel")
    assert drive.rear == ("rear_left", "rear_right")
    assert drive.knuckles == ("left_steering", "right_steering")
    # The inner wheel reaches the limit of its joint.
    radius = drive.min_radius(robot.wheels)
    assert math.atan(0.5 / (radius - 0.2)) == pytest.approx(0.6, abs=1e-3)
    assert robot.mass == pytest.approx(10 + 4 * 0.6 + 2 * 0.1)


def test_steering_joints_about_the_axle_are_told_by_their_names(tmp_path):
    path = car().write(tmp_path)
    wrong = '<axis xyz="0 1 0"/><limit lower="0" upper="0" effort="1" velocity="1"/>'
    stated = '<axis xyz="0 0 -1"/><limit lower="-0.6" upper="0.6" effort="1" velocity="1"/>'
    assert path.read_text().count(stated) == 2
    path.write_text(path.read_text().replace(stated, wrong))
    drive = read(path).drive
    assert isinstance(drive, Ackermann)
    assert drive.max_steering == pytest.approx(0.5)
    path.write_text(path.read_text().replace("_steering", "_rocker"))
    assert isinstance(read(path).drive, SkidSteer)


def test_a_robot_with_two_wheels_stands_on_its_casters(tmp_path):
    machine = Machine().body().wheels((0.0,)).ball("rear_caster", -0.2).ball("front_caster", 0.2)
    robot = read(machine.write(tmp_path))
    drive = robot.drive
    assert isinstance(drive, SkidSteer)
    assert (drive.left, drive.right) == (("left_0",), ("right_0",))
    # Wheels of a width turn about their outer parts.
    assert drive.separation == pytest.approx(0.4 + 0.05 / math.sqrt(3), abs=1e-3)
    places = dict(zip(drive.wheels, robot.wheels.hubs, strict=True))
    casters = sorted(places[name] for name in drive.casters)
    np.testing.assert_allclose(casters, [(-0.2, 0, 0.1), (0.2, 0, 0.1)], atol=1e-6)
    assert robot.mass == pytest.approx(10 + 2 * 0.6 + 2 * 0.05)


def test_casters_in_the_shape_of_the_body_are_at_its_ends(tmp_path):
    low = box("0.5 0.2 0.05", "0 0 -0.07")
    robot = read(Machine().body(more=low).wheels((0.05,)).write(tmp_path))
    np.testing.assert_allclose(sorted(robot.wheels.hubs[2:]), [(-0.3, 0, 0.1), (0.2, 0, 0.1)], atol=1e-6)


def test_a_wheel_behind_a_free_swivel_is_a_caster(tmp_path):
    machine = Machine().body().wheels((0.1,))
    small = Machine(height=machine.height, radius=0.04, width=0.02, wheel_mass=0.1)
    small.add(
        link("fork", inertial(0.1, 1e-4)),
        joint("pivot", "continuous", "base_link", "fork", "-0.2 0 -0.03", '<axis xyz="0 0 1"/>'),
    ).wheel("roller", -0.03, 0.0, "fork")
    machine.add(*small.parts[:2])
    machine.add(small.parts[2], small.parts[3].replace('xyz="-0.03 0.0 0.0"', 'xyz="-0.03 0 -0.03"'))
    robot = read(machine.write(tmp_path))
    assert isinstance(robot.drive, SkidSteer)
    assert len(robot.drive.casters) == 1
    assert robot.wheels.hubs[-1][0] == pytest.approx(-0.33)
    assert robot.wheels.radius == pytest.approx(0.1)


def test_mecanum_wheels_are_told_by_the_word_or_the_option(tmp_path):
    machine = Machine().body().wheels((0.2, -0.2))
    assert isinstance(read(machine.write(tmp_path)).drive, SkidSteer)
    assert isinstance(read(machine.write(tmp_path), drive="mecanum").drive, Mecanum)
    machine.add(link("mecanum_frame"), joint("frame", "fixed", "base_link", "mecanum_frame"))
    assert isinstance(read(machine.write(tmp_path)).drive, Mecanum)


def test_wheels_that_roll_along_y_turn_the_base_frame(tmp_path):
    machine = Machine().body(size="0.3 0.6 0.1")
    for k, (x, y) in enumerate(((0.2, 0.25), (-0.2, 0.25), (0.2, -0.25), (-0.2, -0.25))):
        disc = shape("collision", '<cylinder radius="0.1" length="0.05"/>', rpy="0 1.5707963267948966 0")
        place = f"{x} {y} 0"
        machine.add(
            link(f"w{k}_link", inertial(0.5, 0.002) + disc),
            joint(f"w{k}", "continuous", "base_link", f"w{k}_link", place, '<axis xyz="1 0 0"/>'),
        )
    robot = read(machine.write(tmp_path))
    np.testing.assert_allclose(sorted({round(abs(x), 6) for x, _, _ in robot.wheels.hubs}), [0.25])
    # +y of the file is ahead, so that +x is on the right.
    assert set(robot.drive.right) == {"w0", "w2"}


def test_lidar_and_imu_are_where_links_of_such_names_are(tmp_path):
    mounts = [
        link("laser_mount"),
        joint("mount", "fixed", "base_link", "laser_mount", "0.1 0 0.2"),
        link("laser"),
        joint("laser_joint", "fixed", "laser_mount", "laser", "0.05 0 0.02"),
        link("imu_link"),
        joint("imu_joint", "fixed", "base_link", "imu_link", "0 0 0.05"),
    ]
    machine = Machine(height=0.2).body().wheels((0.2, -0.2)).add(*mounts)
    robot = read(machine.write(tmp_path))
    assert robot.lidar_position == pytest.approx((0.15, 0, 0.42))
    assert robot.imu_position == pytest.approx((0, 0, 0.25))
    assert read(machine.write(tmp_path), lidar="laser_mount").lidar_position == pytest.approx((0.1, 0, 0.4))
    assert read(machine.write(tmp_path), lidar="0.1 0 0.5").lidar_position == pytest.approx((0.1, 0, 0.5))


def test_options_replace_what_is_assumed_and_are_settings_of_the_name(tmp_path):
    path = Machine().body().wheels((0.2, -0.2)).write(tmp_path)
    name = f"{path}(max_speed=2.0, torque=4.0, separation=0.7, max_acceleration=1.5, lidar='0.1 0 0.5', lidar_range=5)"
    with pytest.warns(UserWarning, match="'machine' is read as skid-steer with 4 wheels"):
        robot = get_robot(name)
    drive = robot.drive
    assert (drive.max_speed, drive.torque, drive.separation, robot.lidar_range) == (2.0, 4.0, 0.7, 5.0)
    assert (drive.max_linear_acceleration, robot.lidar_position) == (1.5, (0.1, 0, 0.5))
    assert drive.max_yaw_rate == pytest.approx(2 * 2.0 / 0.7, rel=0.01)
    assert get_robot(name) is robot
    with pytest.warns(UserWarning, match="'machine' is read as skid-steer with 4 wheels; .*torque is not known.*lidar"):
        before = get_robot(str(path))
    # A file that changes is read again.
    Machine().body(19.0).wheels((0.2, -0.2)).write(tmp_path)
    assert read(path).mass == pytest.approx(before.mass + 9.0)


@pytest.mark.parametrize("robot", ["a kilogram", "a ton"])
def test_light_and_heavy_robots_stand_and_drive(backend, tmp_path, robot):
    light = Machine(0.03, 0.03, 0.01, 0.03).body(0.9, "0.15 0.1 0.03").wheels((0.05, -0.05), 0.07)
    heavy = Machine(0.4, 0.4, 0.2, 30.0).body(1000.0, "2 1 0.4").wheels((0.8, -0.8), 0.7)
    robot = read((light if robot == "a kilogram" else heavy).write(tmp_path))
    simulator = placed(backend, FLAT, torch.zeros(1, 3), robot)
    states = drive(simulator, [[0.4, 0.0]], 30)
    simulator.close()
    assert -0.01 < states[-1].position[0, 2] < 0.001
    assert states[-1].position[0, 0] - states[19].position[0, 0] == pytest.approx(0.2, abs=0.01)


def test_named_robots_take_limits_and_mounts():
    robot = get_robot("rover_zero(max_speed=0.5, lidar='0.1 0 0.4', lidar_range=6.0)")
    assert (robot.drive.max_speed, robot.lidar_position, robot.lidar_range) == (0.5, (0.1, 0.0, 0.4), 6.0)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("rover_zero(speed=1)", r"robot 'rover_zero' has no option 'speed'; use some of \['drive', "),
        ("rover_zero(max_speed=fast)", "max_speed must be a number or None, got 'fast'"),
        ("rover_zero(max_speed=-1)", "max_speed of a robot must be a positive number"),
        ("rover_zero(max_speed)", r"settings are NAME\(setting=value, ...\)"),
        ("rover_zero(max_steering=0.5)", "option max_steering does not fit robot 'rover_zero'"),
        ("rover_zero(drive=ackermann)", "option drive does not fit"),
        ("rover_zero(lidar=mast)", "lidar of robot 'rover_zero' must be \"x y z\""),
        ("a.urdf(drive=tracks)", r"drive of a robot must be one of \['skid_steer', .*got 'tracks'"),
    ],
)
def test_options_that_are_wrong_are_refused(name, message):
    with pytest.raises(ValueError, match=message):
        get_robot(name)


def test_inertias_of_no_rigid_body_are_replaced(tmp_path):
    path = rover_with().write(tmp_path)
    path.write_text(path.read_text().replace('ixx="0.2"', 'ixx="9000"'))
    with pytest.warns(UserWarning, match="the inertia of its body is not that of a rigid body of its size"):
        robot = Robot.from_urdf(path)
    assert np.linalg.eigvalsh(robot.chassis.inertia)[-1] < 2.0


def test_the_body_is_made_of_a_few_boxes(tmp_path):
    more = "".join(
        box("0.02 0.02 0.02", f"{0.03 * k - 0.25} {0.01 * (k % 3)} {0.2 + 0.01 * (k % 5)}") for k in range(15)
    )
    robot = read(Machine().body(more=more).wheels((0.2, -0.2)).write(tmp_path))
    assert 2 <= len(robot.boxes) <= 6
    assert max(center[2] + size[2] / 2 for center, size, _ in robot.boxes) == pytest.approx(0.1 + 0.25)


def test_the_effective_track_follows_the_wheelbase():
    for base, track in ((0.512, 0.571), (0.262, 0.376), (0.3, 1.0)):
        corners = np.array([(x, y) for x in (base / 2, -base / 2) for y in (track / 2, -track / 2)])
        expected = track * (1 + (base / track) ** 2)
        assert effective_track(corners, (1, -1, 1, -1), (0.0, 0.0)) == pytest.approx(expected, rel=1e-3)


def omni(machine: Machine, *angles: int) -> Machine:
    """Adds wheels at angles (degrees) around the middle of the base, whose axles point there."""
    disc = shape("collision", '<cylinder radius="0.1" length="0.03"/>', rpy="0 1.5707963267948966 0")
    for name, angle in ((f"omni_{angle}", math.radians(angle)) for angle in angles):
        place, axis = f"{0.2 * math.cos(angle)} {0.2 * math.sin(angle)} 0", '<axis xyz="1 0 0"/>'
        machine.add(link(f"{name}_link", inertial(0.5, 0.002) + disc))
        machine.add(joint(name, "continuous", "base_link", f"{name}_link", place, axis, f"0 0 {angle}"))
    return machine


FOUR = (0.2, -0.2)
LOOP = joint("loop", "fixed", "left_0_link", "left_1_link", "0 0 0.1")
REFUSED = {
    "it has no wheels: none of its joints turns without end, they are fixed": Machine().body(),
    "it has two wheels and nothing else touches the ground": Machine().body().wheels((0.0,)),
    r"3 wheels on the ground, 1 on the left, 1 on the right and \['third'\] between them": (
        Machine().body().wheels((0.2,)).wheel("third", -0.2, 0.0)
    ),
    "it has three wheels, of which 'front_wheel' steers": Machine().body().wheels((-0.2,)).knuckle("front", 0.2, 0.0),
    "its 3 wheels have axles at 0, 120, 60 degrees to its direction": omni(Machine().body(), 0, 120, 240),
    "wheel link 'left_0_link' must have a positive mass": Machine(wheel_mass=0.0).body().wheels(FOUR),
    "all links besides the wheels must have a positive mass": Machine().body(0.0).wheels(FOUR),
    "its links have no mass": Machine(wheel_mass=0.0).body(0.0).wheels(FOUR),
    "its links have 1e[+]06 kg in all": Machine().body(1e6).wheels(FOUR),
    "it is 440 m large; lengths of a URDF are in meters, perhaps these are millimeters": (
        Machine(100.0, 100.0, 50.0).body(size="400 300 100").wheels((120.0, -120.0), 200.0)
    ),
    "mm large; lengths of a URDF are in meters": (
        Machine(4e-4, 4e-4, 1e-4).body(size="0.002 0.001 0.0001").wheels((5e-4, -5e-4), 5e-4)
    ),
    "the mesh 'package://my/body.stl' does not exist.*--robot.missing skip": (
        Machine().body(more=shape("collision", '<mesh filename="package://my/body.stl"/>')).wheels(FOUR)
    ),
    "it has 6 wheels, of which 4 steer": car().knuckle("l", -0.5, 0.2).knuckle("r", -0.5, -0.2),
    "link 'left_1_link' is the child of joints 'left_1' and 'loop'": Machine().body().wheels(FOUR).add(LOOP),
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_no_drive_fits_is_refused_with_a_reason(tmp_path, message):
    path = REFUSED[message].write(tmp_path)
    with pytest.raises(ValueError, match=f"^robot 'machine.urdf' cannot be read from .*machine.urdf: .*{message}"):
        read(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no robot at .*nowhere.urdf: the file does not exist"):
        get_robot(str(tmp_path / "nowhere.urdf"))


def test_missing_meshes_of_the_body_can_be_skipped(tmp_path):
    mesh = shape("collision", '<mesh filename="package://my/body.stl"/>')
    assert read(rover_with(more=mesh).write(tmp_path), missing="skip").wheels.radius == pytest.approx(0.1)
