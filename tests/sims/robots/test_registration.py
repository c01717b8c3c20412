"""Registration of custom robots."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rover_rl.sims.robots import get_robot, register_robot, robot_names

ROVER = get_robot("rover_zero")
SLOW_ROVER = replace(ROVER, name="slow", drive=replace(ROVER.drive, max_speed=0.2))

pytestmark = pytest.mark.usefixtures("own_registries")


@pytest.mark.parametrize("part", [SLOW_ROVER, lambda: SLOW_ROVER])
def test_a_registered_robot_or_function(part):
    register_robot("registered-robot", part)
    assert "registered-robot" in robot_names()
    assert get_robot("registered-robot") is get_robot(SLOW_ROVER) is SLOW_ROVER


def test_robots_by_import_path(tmp_path, monkeypatch):
    source = (
        "from dataclasses import replace\n"
        "from rover_rl.sims.robots import get_robot\n"
        "rover = get_robot('rover_zero')\n"
        "fast = replace(rover, name='fast', drive=replace(rover.drive, max_speed=2.0))\n"
        "def make():\n    return fast\n"
    )
    (tmp_path / "registration_test_robots.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    register_robot("registered-robot-path", "registration_test_robots:make")
    for name in ("registration_test_robots:fast", "registration_test_robots:make", "registered-robot-path"):
        assert get_robot(name).name == "fast"


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
    message = r"^unknown robot 'tank'; use one of \[.*'rover_zero'.*\], a Robot, or 'module:"
    with pytest.raises(ValueError, match=message):
        get_robot("tank")
