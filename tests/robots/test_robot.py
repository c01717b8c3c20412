"""Validation of a robot's parameters, its footprint, and registration."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest
import torch

from rover_rl.robots import Robot, get_robot, register_robot, robot_names
from rover_rl.robots.drives import SkidSteer
from rover_rl.robots.fleet import MassTable
from rover_rl.robots.footprint import covering_discs

ROVER = get_robot("rover_zero")
DRIVE = ROVER.drive


def test_a_robot_is_read_from_its_urdf():
    robot = Robot.from_urdf(ROVER.urdf, drive=DRIVE, collision_range=0.3)
    assert robot == ROVER
    assert robot.name == "rover_zero"
    assert (robot.wheels.radius, robot.wheels.width) == (0.122, 0.09)
    assert robot.wheels.hubs[:2] == ((0.1415, 0.18, 0.125), (-0.145, 0.18, 0.125))
    assert robot.lidar_position == (0.174, 0.0, 0.321)
    assert robot.imu_position == (0.0, 0.0, 0.221)
    # The corners of the wheels are 0.349 m from the origin.
    assert (robot.lidar_range, robot.radius) == (12.0, 0.35)
    assert (DRIVE.separation, DRIVE.max_linear_acceleration, DRIVE.max_angular_acceleration) == (0.24, 5.0, 4.0)


@pytest.mark.parametrize("value", [0.0, inf])
def test_lengths_and_limits_must_be_positive(value):
    for field in ("lidar_range", "radius"):
        with pytest.raises(ValueError, match=f"^{field} of robot 'rover_zero' must be a positive number, got {value}$"):
            replace(ROVER, **{field: value})
    for field in ("torque", "max_yaw_rate", "separation"):
        with pytest.raises(ValueError, match=f"^{field} of a drive must be a positive number, got {value}$"):
            replace(DRIVE, **{field: value})


@pytest.mark.parametrize("value", [(0.1, nan, 0.2), (0.1, 0.2)])
def test_sensor_positions_must_be_finite_or_links(value):
    with pytest.raises(ValueError, match="imu_position must have finite coordinates .*, got "):
        replace(ROVER, imu_position=value)
    with pytest.raises(ValueError, match="lidar must be .* one of its links .*'lidar_link'.*, got 'mast'"):
        Robot.from_urdf(ROVER.urdf, drive=DRIVE, lidar="mast")


@pytest.mark.parametrize(
    "wheels",
    [{"left": (), "right": ("a", "b")}, {"left": ("a", "a"), "right": ("b",)}, {"left": ("a",), "right": ("a",)}],
)
def test_each_motor_must_have_separate_wheels(wheels):
    with pytest.raises(ValueError, match="each motor .* must have a wheel, and each joint must be named once, got"):
        SkidSteer(torque=1.0, **wheels)


WEAK = replace(DRIVE, torque=0.1)
REFUSED = [
    ({"radius": 0.2}, r"^radius of robot 'rover_zero' is 0.2 m, and its body and wheels reach 0.267 m .* 0.349 m"),
    ({"lidar_position": (0.6, 0.0, 0.3)}, r"is at x = 0.6, y = 0 m, 0.337 m outside of its body and outside of its"),
    ({"lidar_position": (0.1, 0.0, -0.1)}, r"^the lidar of robot 'rover_zero' is at z = -0.1 m; it must be above"),
    ({"drive": WEAK}, r"push with 3.28 N \(4 x 0.1 N m on a radius of 0.122 m\), and it has .* kg: it cannot"),
]


@pytest.mark.parametrize(("changes", "message"), REFUSED)
def test_a_robot_that_cannot_drive_is_refused_with_numbers(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(ROVER, **changes)


UNUSUAL = [
    ({"radius": 0.3}, r"radius of robot 'rover_zero' is 0.3 m, and its corners are 0.349 m from the origin"),
    ({"lidar_position": (0.3, 0.0, 0.3)}, r"0.0365 m outside of its body: check lidar_position"),
    ({"drive": replace(DRIVE, torque=0.5)}, r"push with 16.4 N .* it cannot climb a slope of more than \d+ degrees"),
]


@pytest.mark.parametrize(("changes", "message"), UNUSUAL)
def test_an_unusual_robot_is_warned_of_with_numbers(changes, message):
    with pytest.warns(UserWarning, match=message) as warned:
        replace(ROVER, **changes)
    assert len(warned) == 1


def test_the_footprint_is_the_rectangle_around_the_wheels_within_the_turning_circle():
    outline = ROVER.footprint
    assert outline == pytest.approx((-0.267, 0.2635, -0.225, 0.225))
    assert np.hypot(outline.half_length, outline.half_width) <= ROVER.radius


@pytest.mark.parametrize("excess", [0.005, 0.1])
def test_discs_cover_the_footprint(excess):
    centers, radius = covering_discs(ROVER, excess)
    outline = ROVER.footprint
    x, y = np.meshgrid(np.linspace(outline.back, outline.front, 60), np.linspace(outline.right, outline.left, 60))
    away = np.hypot(x[..., None] - centers, y[..., None]).min(-1)
    assert away.max() <= radius + 1e-9
    assert outline.half_width < radius <= outline.half_width + excess + 1e-9


WHEEL = '<cylinder radius="0.122" length="0.09"/></geometry>\n    </collision>'
AXIS, MASS = '<axis xyz="0 1 0"/>', '<mass value="1.25"/>'
INVALID = [
    ('type="continuous"', 'type="revolute"', "wheel joint 'front_left_wheel' is revolute, it must be continuous"),
    (AXIS, "", "wheel joint 'front_left_wheel' must turn about y"),
    (
        '<origin xyz="0.1415 0.18 0.125"/>',
        "",
        "left wheel 'front_left_wheel' is at y = 0 m; left wheels must be at y > 0",
    ),
    (WHEEL, WHEEL.replace("0.122", "0.125"), "its wheels are not alike: the radius is from 0.122 to 0.125"),
    (MASS, '<mass value="0"/>', "wheel link 'front_left_wheel_link' must have a positive mass, its URDF states none"),
    (MASS, '<mass value="1.5"/>', "its wheels are not alike: the mass is from 1.25 to 1.5"),
    ('"7.486"', '"0"', "the body must have a positive mass"),
    ('ixx="0.0629"', 'ixx="0.01"', "the inertia of the body is not that of a rigid body"),
    ("</robot>", "", "it is not XML .no element found"),
]


@pytest.mark.parametrize(("old", "new", "message"), INVALID)
def test_a_urdf_that_the_drive_cannot_move_is_refused(edited, old, new, message):
    path = edited((old, new))
    with pytest.raises(ValueError, match=rf"(?s)(cannot be read from .*rover.urdf: .*)?{message}"):
        Robot.from_urdf(path, drive=DRIVE)


def test_joints_that_the_urdf_does_not_have_are_named():
    with pytest.raises(ValueError, match=r"the drive names joint 'x', the URDF has the joints \['front_left_wheel', "):
        Robot.from_urdf(ROVER.urdf, drive=replace(DRIVE, left=("x",)))


def test_masses_of_fixed_links_and_turned_inertias_belong_to_the_chassis(edited):
    light = '<inertial>\n      <mass value="0"/>\n      <inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>'
    heavy = '<inertial><mass value="2"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.03"/>'
    loaded, plain = Robot.from_urdf(edited((light, heavy)), drive=DRIVE).chassis, ROVER.chassis
    assert loaded.mass == pytest.approx(plain.mass + 2)
    payload = np.array((0.012, 0, 0.275))
    expected = (plain.mass * np.array(plain.center) + 2 * payload) / loaded.mass
    np.testing.assert_allclose(loaded.center, expected)
    offsets = zip((plain.mass, 2), (np.array(plain.center) - expected, payload - expected), strict=True)
    roll = plain.inertia[0][0] + 0.01 + sum(m * (d[1] ** 2 + d[2] ** 2) for m, d in offsets)
    assert loaded.inertia[0][0] == pytest.approx(roll)
    turned = ('<origin xyz="-0.004 0 0.163"/>', '<origin xyz="-0.004 0 0.163" rpy="0 0 1.5707963267948966"/>')
    across = Robot.from_urdf(edited(turned), drive=DRIVE).chassis.inertia
    assert (across[0][0], across[1][1]) == pytest.approx((plain.inertia[1][1], plain.inertia[0][0]))


def test_mass_and_inertia_of_all_parts_are_about_the_common_center():
    table, index = MassTable([ROVER]), torch.zeros(2, dtype=torch.int64)
    mass, center, inertia = table.total(table.chassis_mass * torch.tensor([1.0, 1.5], dtype=torch.float64), index)
    assert mass.tolist() == pytest.approx([ROVER.mass, ROVER.mass + 0.5 * 7.486])
    assert center[0].tolist() == pytest.approx(ROVER.center_of_mass)
    assert center[1, 2] > center[0, 2]
    # About the vertical axis: inertia of each part plus mass times squared distance.
    chassis = 0.1567 + 7.486 * ((-0.004 - center[0, 0]) ** 2)
    wheels = sum(0.005645 + 1.25 * ((x - center[0, 0]) ** 2 + y**2) for x, y, _ in ROVER.wheels.hubs)
    assert inertia[0, 2, 2].item() == pytest.approx(float(chassis + wheels))


# Registration


SLOW_ROVER = replace(ROVER, name="slow", drive=replace(ROVER.drive, max_speed=0.2))
registers = pytest.mark.usefixtures("own_registries")


def make_slow():
    return SLOW_ROVER


@registers
@pytest.mark.parametrize("part", [SLOW_ROVER, make_slow, f"{__name__}:SLOW_ROVER", f"{__name__}:make_slow"])
def test_a_registered_robot_function_or_import_path(part):
    register_robot("registered-robot", part)
    assert "registered-robot" in robot_names()
    assert get_robot("registered-robot") == get_robot(SLOW_ROVER) == SLOW_ROVER
    if isinstance(part, str):
        assert get_robot(part) == SLOW_ROVER


@registers
def test_anything_else_than_a_robot_and_other_names_raise():
    register_robot("registered-number", 4)
    with pytest.raises(ValueError, match="^robot 'registered-number' must be a Robot or a function .*, got int$"):
        get_robot("registered-number")
    with pytest.raises(
        ValueError, match=r"^unknown robot 'tank'; use one of \[.*'rover_zero'.*\], a URDF file, a Robot"
    ):
        get_robot("tank")
    with pytest.raises(ValueError, match="^a robot named 'rover_zero' already exists"):
        register_robot("rover_zero", SLOW_ROVER)
