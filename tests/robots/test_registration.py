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


@pytest.mark.parametrize(
    ("name", "part", "kind"), [("registered-number", 4, "int"), ("registered-none", lambda: None, "NoneType")]
)
def test_anything_else_than_a_robot_raises(name, part, kind):
    register_robot(name, part)
    message = f"^robot '{name}' must be a Robot or a function that returns one, got {kind}$"
    with pytest.raises(ValueError, match=message):
        get_robot(name)


def test_the_name_of_the_built_in_robot_is_taken():
    with pytest.raises(ValueError, match="^a robot named 'rover_zero' already exists; choose another name$"):
        register_robot("rover_zero", SLOW_ROVER)
    assert get_robot("rover_zero") is ROVER


def test_an_unknown_robot_raises_with_the_known_names():
    message = r"^unknown robot 'tank'; use one of \[.*'rover_zero'.*\], a URDF file, a Robot, or 'module:"
    with pytest.raises(ValueError, match=message):
        get_robot("tank")
