"""Registration of custom robots."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rover_rl.robots import get_robot, register_robot, robot_names

ROVER = get_robot("rover_zero")
SLOW_ROVER = replace(ROVER, name="slow", drive=replace(ROVER.drive, max_speed=0.2))

HERE = "tests.robots.test_registration"

pytestmark = pytest.mark.usefixtures("own_registries")


def make_slow():
    return SLOW_ROVER


@pytest.mark.parametrize("part", [SLOW_ROVER, make_slow, f"{HERE}:SLOW_ROVER", f"{HERE}:make_slow"])
def test_a_registered_robot_function_or_import_path(part):
    register_robot("registered-robot", part)
    assert "registered-robot" in robot_names()
    assert get_robot("registered-robot") == get_robot(SLOW_ROVER) == SLOW_ROVER
    if isinstance(part, str):
        assert get_robot(part) == SLOW_ROVER


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
