"""The URDF parser."""

from __future__ import annotations

import numpy as np
import pytest

from rover_rl.native.bullet import disconnect, pybullet
from rover_rl.robots.urdf.description import Description

CHAIN = """<?xml version="1.0"?>
<robot name="chain">
  <link name="end"/>
  <link name="base"/>
  <link name="middle"/>
  <joint name="second" type="fixed">
    <parent link="middle"/><child link="end"/><origin xyz="0.1 0.2 0.3" rpy="0.4 -0.5 0.6"/>
  </joint>
  <joint name="first" type="fixed">
    <parent link="base"/><child link="middle"/><origin xyz="1 2 3" rpy="-0.7 0.8 0.9"/>
  </joint>
</robot>
"""


def test_poses_of_fixed_links_agree_with_bullet(tmp_path):
    path = tmp_path / "chain.urdf"
    path.write_text(CHAIN)
    description = Description(path)
    assert description.base == "base"
    client = pybullet.connect(pybullet.DIRECT)
    body = pybullet.loadURDF(str(path), physicsClientId=client)
    for link in range(pybullet.getNumJoints(body, physicsClientId=client)):
        name = pybullet.getJointInfo(body, link, physicsClientId=client)[12].decode()
        position, orientation = pybullet.getLinkState(body, link, physicsClientId=client)[4:6]
        frame = description.frames[name]
        np.testing.assert_allclose(frame.position, position, atol=1e-6)
        np.testing.assert_allclose(frame.rotation.ravel(), pybullet.getMatrixFromQuaternion(orientation), atol=1e-6)
    disconnect([client])


def test_a_urdf_is_read_with_the_rules_of_tinyxml(tmp_path):
    path = tmp_path / "robot.urdf"
    path.write_text("\n<?xml version='1.0'?>\n<robot><!-- ---- --><link name='a'/><gz:x/></robot>")
    assert [*Description(path).links] == ["a"]


A = "<robot><link name='a'/>"
INVALID = [
    ("", r"it is not XML \(no element found"),
    ("<robot/>", "it has no links"),
    ("<sdf><model><link name='a'/></model></sdf>", "it is an SDF model; a URDF is needed"),
    ("<html/>", "it is XML with the root element 'html'; a URDF is needed"),
    ("<robot><link/></robot>", "link has no name"),
    (f"{A}<link name='a'/></robot>", "two links are named 'a'"),
    (f"{A}<link name='b'/></robot>", r"one link must be the child of no joint, it has \['a', 'b'\]"),
    (
        f"{A}<joint name='j' type='fixed'><parent link='a'/><child link='b'/></joint></robot>",
        r"a joint names link 'b', its links are \['a'\]",
    ),
    (f"{A}<joint name='j' type='fixed'><parent link='a'/></joint></robot>", "joint 'j': joint has no child"),
    (
        "<robot><link name='a'><inertial><mass value='1'/><inertia/><origin xyz='1 nan'/></inertial></link></robot>",
        "link 'a': xyz of origin must be 3 finite numbers, got '1 nan'",
    ),
    (
        "<robot><link name='a'><collision><geometry/></collision></link></robot>",
        "link 'a': a collision shape has an empty geometry",
    ),
    (
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:wheel name="a"/><link name="a"/></robot>',
        "it is a xacro file, with xacro:wheel; expand it first: xacro FILE > robot.urdf",
    ),
    ('<robot><xacro:include filename="a"></robot>', "it is a xacro file; expand it first"),
]


@pytest.mark.parametrize(("text", "message"), INVALID)
def test_an_invalid_urdf_raises(tmp_path, text, message):
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"^{message}"):
        Description(path)
