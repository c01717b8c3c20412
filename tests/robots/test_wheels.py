"""A URDF whose wheels the drive cannot turn raises an error with the reason."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rover_rl.robots import get_robot

ROVER = get_robot("rover_zero")

ERROR = "robot 'rover_zero' cannot be driven with its URDF"

HUB = '<origin xyz="0.1415 0.18 0.125"/>'
"""Origin of the front left wheel's joint."""
ON_BASE = f'<parent link="base_link"/>\n    <child link="front_left_wheel_link"/>\n    {HUB}'
AXIS = '<axis xyz="0 1 0"/>'
MASS = '<mass value="1.25"/>'
INERTIA = '<inertia ixx="0.005645" ixy="0" ixz="0" iyy="0.01008" iyz="0" izz="0.005645"/>'
"""Inertia of a wheel."""
END = "</geometry>\n    </collision>"
POSE = '<collision>\n      <origin rpy="1.5707963267948966 0 0"/>'
CYLINDER = f'<cylinder radius="0.122" length="0.09"/>{END}'
SHAPE = f"{POSE}\n      <geometry>{CYLINDER}"
"""Collision shape of a wheel."""

BEAM = (
    "</robot>",
    '<link name="beam"><inertial><mass value="0"/><inertia/></inertial></link><joint name="beam" type="fixed">'
    '<parent link="base_link"/><child link="beam"/><origin xyz="0.09355745 0.09224174 0.125" rpy="0 0 -0.5"/>'
    "</joint></robot>",
)
"""Replacement that adds a beam rotated by -0.5 rad. The front left wheel's hub is at (0, 0.1, 0) of the beam."""


LEFT, RIGHT = ROVER.drive.left, ROVER.drive.right
JOINTS = [
    ((LEFT, ("x", RIGHT[1])), r"the drive names joint 'x', the URDF has the joints \['front_left_wheel', .*\]"),
    (((LEFT[0], "payload"), RIGHT), "wheel joint 'payload' is fixed, it must be continuous"),
    ((RIGHT, LEFT), "left wheel 'front_right_wheel' is at y = -0.18 m; left wheels must be at y > 0, right wheels at"),
]


@pytest.mark.parametrize(("sides", "message"), JOINTS)
def test_joints_that_the_urdf_does_not_have_raise(sides, message):
    drive = replace(ROVER.drive, left=sides[0], right=sides[1])
    with pytest.raises(ValueError, match=f"^{ERROR} .*rover_zero.urdf: {message}"):
        replace(ROVER, drive=drive)


FIRST, OTHER = "'front_left_wheel'", "that of 'rear_left_wheel'"
INVALID = [
    # Joints.
    ('type="continuous"', 'type="revolute"', f"wheel joint {FIRST} is revolute, it must be continuous"),
    (AXIS, AXIS.replace("1", "-1"), rf"wheel joint {FIRST} must turn about \+y, .* about \(0.0, -1.0, 0.0\)"),
    (AXIS, "", r"must turn about \+y, \(0, 1, 0\), of the base frame, it turns about \(1.0, 0.0, 0.0\)"),
    (HUB, f'{HUB[:-2]} rpy="0 0 0.3"/>', r"must turn about \+y, .* turns about \(-0.29552.*, 0.95533.*, 0.0\)"),
    (HUB, "", f"left wheel {FIRST} is at y = 0 m; left wheels must be at y > 0"),
    (
        ON_BASE,
        ON_BASE.replace("base_link", "rear_left_wheel_link"),
        f"wheel joint {FIRST} must be on the base link 'base_link', on a link fixed to it or on the link of a steering "
        "joint of these, it is on 'rear_left_wheel_link'",
    ),
    # Shapes.
    (
        CYLINDER,
        f'<sphere radius="0.125"/>{END}',
        f"wheels are not alike: the radius of {FIRST} is 0.125 m, {OTHER} 0.122 m; .* by 1%",
    ),
    (CYLINDER, CYLINDER.replace("0.09", "0.05"), f"the width of {FIRST} is 0.05 m, {OTHER}"),
    (CYLINDER, f'<mesh filename="a.stl"/>{END}', r"must have one collision shape, a cylinder .* it has \['mesh'\]"),
    (SHAPE, "", "'front_left_wheel_link' must have one collision shape, .* it has none"),
    (CYLINDER, f"{CYLINDER}<collision><geometry><box size='1 1 1'/></geometry></collision>", "has .'cylinder', 'box'"),
    (POSE, f'{POSE[:-2]} xyz="0 0.05 0"/>', "cylinder of wheel link .* is 0.05 m from its joint; 0.001 m is allowed"),
    (POSE, "<collision>", r"the cylinder .* must lie along y of the base frame, it lies along \(0.0, 0.0, 1.0\)"),
    # Masses.
    (MASS, '<mass value="0"/>', "wheel link 'front_left_wheel_link' must have a positive mass, its URDF states 0.0 kg"),
    (MASS, '<mass value="-1"/>', "must have a positive mass, its URDF states -1.0 kg"),
    (MASS, '<mass value="nan"/>', "link 'front_left_wheel_link': value of mass must be a finite number, got 'nan'"),
    ('"7.486"', '"0"', "base link 'base_link' must have a positive mass, .* states 0.0 kg"),
    (f"<inertial>\n      {MASS}\n      {INERTIA}\n    </inertial>", "", "positive mass, its URDF states none"),
    (MASS, '<mass value="1.5"/>', f"wheels are not alike: the mass of {FIRST} is 1.5 kg, {OTHER} 1.25 "),
    # Inertias.
    ('ixx="0.0629"', 'ixx="-0.06"', "the inertia of base link 'base_link' must be positive definite, .* are .-0.06"),
    ('ixx="0.0629"', 'ixx="0.01"', "the inertia of base link .* is not that of a rigid body: the largest of"),
    ('iyy="0.01008" iyz="0"', 'iyy="0.01008" iyz="0.008"', "wheel link .* must be positive definite"),
    ('iyy="0.01008"', 'iyy="0.1"', "inertia of wheel link 'front_left_wheel_link' is not that of a rigid body"),
    ('iyy="0.01008"', 'iyy="0.009"', f"the inertia of {FIRST} is .*0.009.* {OTHER} .*0.01008.* differ by 1%"),
    # Files.
    ("</robot>", "", "it is not XML .no element found"),
    ("</robot>", "<!-- </robot>", "it is not XML"),
]


@pytest.mark.parametrize(("old", "new", "message"), INVALID)
def test_an_invalid_or_contradicting_urdf_raises(edited, old, new, message):
    with pytest.raises(ValueError, match=f"^{ERROR} .*rover.urdf: .*{message}"):
        replace(ROVER, urdf=edited((old, new)))


def test_wheels_on_a_link_fixed_to_the_base_are_accepted(edited):
    on_beam = ON_BASE.replace("base_link", "beam").replace(HUB, '<origin xyz="0 0.1 0" rpy="0 0 0.5"/>')
    replace(ROVER, urdf=edited((ON_BASE, on_beam), BEAM))
    misaligned = on_beam.replace("0 0 0.5", "0 0 0.4")
    with pytest.raises(ValueError, match=r"'front_left_wheel' must turn about \+y"):
        replace(ROVER, urdf=edited((ON_BASE, misaligned), BEAM))


def test_wheels_rotated_about_their_axles_are_accepted(edited):
    # Half a turn changes the sign of the products of inertia with y, which must not count as a difference.
    rotated = f'{HUB[:-2]} rpy="0 3.141592653589793 0"/>'
    tilted = INERTIA.replace('ixy="0"', 'ixy="0.001"')
    mirrored = INERTIA.replace('ixy="0"', 'ixy="-0.001"')
    urdf = edited((INERTIA, tilted), count=-1)
    text = urdf.read_text().replace(tilted, mirrored, 1)
    urdf.write_text(text)
    with pytest.raises(ValueError, match="not alike"):
        replace(ROVER, urdf=urdf)
    urdf.write_text(text.replace(HUB, rotated))
    replace(ROVER, urdf=urdf)
