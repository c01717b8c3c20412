"""Names of worlds, robots and sensors."""

from __future__ import annotations

from itertools import pairwise

import pytest

from rover_rl.names import Name, check_training_seed, unseen


@pytest.mark.parametrize(
    ("text", "part", "settings"),
    [
        ("maze", "maze", {}),
        ("maze:12@.3", "maze", {"seed": 12, "difficulty": 0.3}),
        ("my_package.worlds:canyon", "my_package.worlds:canyon", {}),
        ("my_package.worlds:canyon:7@0*1.6", "my_package.worlds:canyon", {"seed": 7, "difficulty": 0.0, "scale": 1.6}),
        ("maze:**1.6", "maze", {"seed": (0, 9999), "scale": 1.6}),
        ("maze+walkers:0-99@0.2-0.8", "maze", {"walkers": True, "seed": (0, 99), "difficulty": (0.2, 0.8)}),
        ("maze:x", "maze:x", {}),
        ("maps@home/lab (2).yaml", "maps@home/lab (2).yaml", {}),
        ("maps@home/lab (2).yaml+walkers:3", "maps@home/lab (2).yaml", {"walkers": True, "seed": 3}),
        ("scout.urdf(drive=ackermann, lidar='0 0 1')", "scout.urdf", {"drive": "ackermann", "lidar": "0 0 1"}),
        ("any:0-255(max_speed=1.5)", "any", {"seed": (0, 255), "max_speed": 1.5}),
        ("depth(size=(24, 32), period=2)", "depth", {"size": (24, 32), "period": 2}),
    ],
)
def test_a_name_is_a_part_with_settings_and_text_again(text, part, settings):
    name = Name.parse(text)
    assert name == Name(part, settings)
    assert Name.parse(str(name)) == name


def test_short_forms_are_the_same_as_settings_in_parentheses():
    assert Name.parse("maze(difficulty=0.5, seed=7)") == Name.parse("maze:7@0.5")
    assert hash(Name.parse("maze(difficulty=0.5, seed=7)")) == hash(Name.parse("maze:7@0.5"))
    assert str(Name.parse("maze(seed=(0, 9999), scale=1.50)")) == "maze:**1.5"


@pytest.mark.parametrize("level", ["", "x", "1.01", "-0.1", "nan", "inf", "0,5", "0.5@0.5", " 0.5", "²", "1.", "0.5:7"])
def test_a_malformed_difficulty_raises(level):
    with pytest.raises(ValueError, match=r"^the difficulty of 'maze:3@.*' must be a number from 0 to 1, got '"):
        Name.parse(f"maze:3@{level}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("maze:9-3", "the ends of 'maze:9-3' must be in order, as in 'maze:0-99@0.2-0.8'"),
        ("maze:*@0.8-0.2", "the ends of 'maze:.*@0.8-0.2' must be in order"),
        ("maze(seed=-1)", "the seed of .* must be a whole number, got '-1'"),
        ("maze:3*0.1", "the scale of 'maze:3.0.1' must be a number from 0.5 to 10, got '0.1'"),
        ("maze:3*wide", "the scale of 'maze:3.wide' must be a number from 0.5 to 10, got 'wide'"),
        ("maze:*1.6", "lacks a '.': that of all seeds, and that of the scale, as in 'maze:..1.6'"),
        ("depth(24)", r"settings are NAME\(setting=value, ...\) with numbers, texts and tuples, got 'depth\(24\)'"),
        ("depth(size=print(1))", "settings are NAME"),
    ],
)
def test_a_wrong_name_raises(text, message):
    with pytest.raises(ValueError, match=message):
        Name.parse(text)


def test_the_difficulties_of_a_range_are_spread_evenly() -> None:
    seeds = Name.parse("maze:100-199@0.2-0.6*1.6")
    assert str(seeds[7]) == "maze:107@0.252*1.6"
    levels = sorted(name.settings["difficulty"] for name in seeds)
    assert 0.2 <= levels[0] < 0.22
    assert 0.58 < levels[-1] <= 0.6
    assert max(b - a for a, b in pairwise(levels)) < 0.02


@pytest.mark.parametrize(
    ("trained", "expected"),
    [
        ("maze:*", "maze:10000"),
        ("maze:0-99@0.5*1.6", "maze:10000@0.5*1.6"),
        ("maze:0-20000", "maze:20001"),
        ("maze:7", "maze:7"),
    ],
)
def test_a_policy_is_tested_in_a_world_that_was_not_in_its_training(trained: str, expected: str) -> None:
    assert unseen(trained) == expected


def test_seeds_for_evaluation_are_refused_for_training() -> None:
    for name in ("maze:10000", "maze:0-10000", "maze:12345@0.5"):
        with pytest.raises(ValueError, match=r"seeds from 10000 up are for evaluation.*'maze:\*'.*got 'maze:"):
            check_training_seed(name)
    for name in ("maze", "maze:9999", "maze:*", "my_package:canyon"):
        check_training_seed(name)
