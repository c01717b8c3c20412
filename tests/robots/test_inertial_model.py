"""Inertial model of a robot, read from its URDF."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rover_rl.native.bullet import pybullet
from rover_rl.robots import get_robot
from rover_rl.robots.inertial_model import read_inertial_model

ROVER = get_robot("rover_zero")


def test_mass_and_center_match_bullet():
    client = pybullet.connect(pybullet.DIRECT)
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE
    body = pybullet.loadURDF(str(ROVER.urdf), flags=flags, physicsClientId=client)
    links = range(-1, pybullet.getNumJoints(body, physicsClientId=client))
    masses = [pybullet.getDynamicsInfo(body, link, physicsClientId=client)[0] for link in links]
    base = np.array(pybullet.getDynamicsInfo(body, -1, physicsClientId=client)[3])
    others = [np.array(pybullet.getLinkState(body, link, physicsClientId=client)[0]) for link in links if link >= 0]
    # Bullet reports the position of the base's center of mass, which is at ``base`` in the base frame.
    start = np.array(pybullet.getBasePositionAndOrientation(body, physicsClientId=client)[0])
    centers = [base, *(other - start + base for other in others)]
    model = read_inertial_model(ROVER)
    mass, center, _ = model.total(torch.tensor([model.chassis_mass], dtype=torch.float64))
    assert mass[0].item() == pytest.approx(sum(masses))
    np.testing.assert_allclose(center[0], np.average(centers, axis=0, weights=masses), atol=2e-4)
    pybullet.disconnect(client)


def test_inertia_combines_all_parts_about_the_common_center():
    model = read_inertial_model(ROVER)
    _, center, inertia = model.total(torch.tensor([model.chassis_mass], dtype=torch.float64))
    # About the vertical axis, by the parallel axis theorem: inertia of each part plus mass times squared distance.
    chassis = 0.1567 + 7.486 * ((-0.004 - center[0, 0]) ** 2)
    wheels = sum(0.005645 + 1.25 * ((x - center[0, 0]) ** 2 + y**2) for x, y, _ in ROVER.wheels.hubs)
    assert inertia[0, 2, 2].item() == pytest.approx(float(chassis + wheels))
    np.testing.assert_allclose(inertia[0], inertia[0].T)
    assert (np.linalg.eigvalsh(inertia[0]) > 0).all()


def test_heavier_chassis_raises_center_of_mass():
    model = read_inertial_model(ROVER)
    mass, center, _ = model.total(model.chassis_mass * torch.tensor([1.0, 1.5], dtype=torch.float64))
    assert (mass[1] - mass[0]).item() == pytest.approx(0.5 * model.chassis_mass)
    assert center[1, 2] > center[0, 2]


def test_sample_points_lie_on_boxes_and_outside_other_boxes():
    model = read_inertial_model(ROVER)
    points = model.points()
    low = model.box_centers - model.box_halves
    high = model.box_centers + model.box_halves
    within = ((points[:, None] > low + 1e-6) & (points[:, None] < high - 1e-6)).all(-1)
    assert not within.any()
    # The four lower corners of the chassis are sample points.
    for x in (-0.2, 0.2):
        for y in (-0.13, 0.13):
            assert (np.abs(points - (x, y, 0.065)).max(1) < 1e-9).any()


BOX, END = '<box size="0.40 0.26 0.14"/>', "</geometry>\n    </collision>"
PAYLOAD = '<origin xyz="0.012 0 0.275"/>'
UNSUPPORTED = [
    (BOX + END, f'<sphere radius="0.2"/>{END}', "is a sphere, but the chassis must be made of boxes"),
    (PAYLOAD, '<origin xyz="0.012 0 0.275" rpy="0 0.1 0"/>', "must be aligned with the base link"),
]


@pytest.mark.parametrize(("old", "new", "message"), UNSUPPORTED)
def test_unsupported_robots_are_rejected_with_a_reason(edited, old, new, message):
    robot = replace(ROVER, urdf=edited((old, new)))
    with pytest.raises(ValueError, match=f"robot file .*rover.urdf is not supported by this backend: .*{message}"):
        read_inertial_model(robot)


def test_masses_of_fixed_links_and_turned_inertias_belong_to_the_chassis(edited):
    payload = '<inertial>\n      <mass value="0"/>\n      <inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/>'
    heavy = '<inertial><mass value="2"/><inertia ixx="0.01" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.03"/>'
    turned = ('<origin xyz="-0.004 0 0.163"/>', '<origin xyz="-0.004 0 0.163" rpy="0 0 1.5707963267948966"/>')
    plain = read_inertial_model(ROVER)
    loaded = read_inertial_model(replace(ROVER, urdf=edited((payload, heavy))))
    assert loaded.chassis_mass == pytest.approx(plain.chassis_mass + 2)
    # The payload is at (0.012, 0, 0.275).
    expected = (plain.chassis_mass * plain.chassis_center + 2 * np.array((0.012, 0, 0.275))) / loaded.chassis_mass
    np.testing.assert_allclose(loaded.chassis_center, expected)
    offsets = plain.chassis_center - expected, np.array((0.012, 0, 0.275)) - expected
    roll = plain.chassis_inertia[0, 0] + 0.01
    roll += sum(m * (d[1] ** 2 + d[2] ** 2) for m, d in zip((plain.chassis_mass, 2), offsets, strict=True))
    assert loaded.chassis_inertia[0, 0] == pytest.approx(roll)
    across = read_inertial_model(replace(ROVER, urdf=edited(turned))).chassis_inertia
    assert across[0, 0] == pytest.approx(plain.chassis_inertia[1, 1])
    assert across[1, 1] == pytest.approx(plain.chassis_inertia[0, 0])
