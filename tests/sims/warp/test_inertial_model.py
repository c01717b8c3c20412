"""What Warp's physics knows of a robot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rover_rl.sims import make_simulator
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import Terrain, World

pytest.importorskip("warp", reason="needs rover_rl[warp]")

from rover_rl.sims.native.bullet import pybullet
from rover_rl.sims.warp.inertial_model import read_inertial_model

ROVER = get_robot("rover_zero")
FLAT = World("flat", Terrain.flat((20, 20)))


def test_mass_and_centre_are_those_that_bullet_reads():
    client = pybullet.connect(pybullet.DIRECT)
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE
    body = pybullet.loadURDF(str(ROVER.urdf), flags=flags, physicsClientId=client)
    links = range(-1, pybullet.getNumJoints(body, physicsClientId=client))
    masses = [pybullet.getDynamicsInfo(body, link, physicsClientId=client)[0] for link in links]
    base = np.array(pybullet.getDynamicsInfo(body, -1, physicsClientId=client)[3])
    others = [np.array(pybullet.getLinkState(body, link, physicsClientId=client)[0]) for link in links if link >= 0]
    # Bullet loads the base's centre of mass to the origin less its offset.
    start = np.array(pybullet.getBasePositionAndOrientation(body, physicsClientId=client)[0])
    centers = [base, *(other - start + base for other in others)]
    model = read_inertial_model(ROVER)
    mass, center, _ = model.total(torch.tensor([model.chassis_mass], dtype=torch.float64))
    assert mass[0].item() == pytest.approx(sum(masses))
    np.testing.assert_allclose(center[0], np.average(centers, axis=0, weights=masses), atol=2e-4)
    pybullet.disconnect(client)


def test_inertia_is_that_of_all_parts_about_the_common_centre():
    model = read_inertial_model(ROVER)
    _, center, inertia = model.total(torch.tensor([model.chassis_mass], dtype=torch.float64))
    # About the vertical axis, by hand: each part's own and its mass times its distance squared.
    chassis = 0.1567 + 7.486 * ((-0.004 - center[0, 0]) ** 2)
    wheels = sum(0.005645 + 1.25 * ((x - center[0, 0]) ** 2 + y**2) for x, y, _ in ROVER.wheel_positions)
    assert inertia[0, 2, 2].item() == pytest.approx(float(chassis + wheels))
    np.testing.assert_allclose(inertia[0], inertia[0].T)
    assert (np.linalg.eigvalsh(inertia[0]) > 0).all()


def test_a_heavier_chassis_moves_the_centre_of_mass_up():
    model = read_inertial_model(ROVER)
    mass, center, _ = model.total(model.chassis_mass * torch.tensor([1.0, 1.5], dtype=torch.float64))
    assert (mass[1] - mass[0]).item() == pytest.approx(0.5 * model.chassis_mass)
    assert center[1, 2] > center[0, 2]


def test_points_are_on_the_boxes_and_none_is_inside_another():
    model = read_inertial_model(ROVER)
    points = model.points()
    low = model.box_centers - model.box_halves
    high = model.box_centers + model.box_halves
    within = ((points[:, None] > low + 1e-6) & (points[:, None] < high - 1e-6)).all(-1)
    assert not within.any()
    # All four lower corners of the chassis are among them.
    for x in (-0.2, 0.2):
        for y in (-0.13, 0.13):
            assert (np.abs(points - (x, y, 0.065)).max(1) < 1e-9).any()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            '<box size="0.40 0.26 0.14"/></geometry>\n    </collision>',
            '<sphere radius="0.2"/></geometry></collision>',
            "no geometry/box",
        ),
        ('<origin xyz="0.012 0 0.275"/>', '<origin xyz="0.012 0 0.275" rpy="0 0.1 0"/>', "boxes that are not turned"),
        ('<mass value="0"/>', '<mass value="1"/>', "the mass of 'payload_link' must be that of 'base_link'"),
        (
            '<origin xyz="0.1415 0.18 0.125"/>',
            '<origin xyz="0.1415 0.18 0.125" rpy="0 0.5 0"/>',
            r"wheel joint 'front_left_wheel' must turn about \+y of an upright frame",
        ),
        ('<origin xyz="-0.004 0 0.163"/>', '<origin xyz="-0.004 0 0.163" rpy="0 0 1"/>', "must be along its own axes"),
    ],
)
def test_what_it_cannot_drive_is_refused_with_a_reason(tmp_path, old, new, message):
    urdf = tmp_path / "rover.urdf"
    text = ROVER.urdf.read_text()
    assert old in text
    urdf.write_text(text.replace(old, new, 1))
    with pytest.raises(ValueError, match=f"the warp backend cannot drive .*rover.urdf: .*{message}"):
        make_simulator("warp", worlds=[FLAT], robot=replace(ROVER, urdf=urdf), lidar_beams=1)
