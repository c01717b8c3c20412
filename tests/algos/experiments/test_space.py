from __future__ import annotations

import pytest

from rover_rl.algos.config import training_config
from rover_rl.algos.experiments.space import Choice, Interval, read_space, with_varied

CONFIG = training_config("ppo")


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("learning_rate=1e-4..3e-3", "learning_rate: from 0.0001 to 0.003, log-uniform"),
        ("--learning-rate=1e-4..1e-3", "learning_rate: from 0.0001 to 0.001, log-uniform"),
        ("gamma=0.9..0.99", "gamma: from 0.9 to 0.99, uniform"),
        ("entropy_coef=0..1", "entropy_coef: from 0 to 1, uniform"),
        ("epochs=2..8", "epochs: from 2 to 8, whole numbers, uniform"),
        ("rollout_length=8..128", "rollout_length: from 8 to 128, whole numbers, log-uniform"),
        ("gamma=0.95,0.97", "gamma: 0.95 or 0.97"),
        ("hidden=[64,64],[128]", "hidden: [64,64] or [128]"),
        ("lidar.points=16,32", "lidar.points: 16 or 32"),
    ],
)
def test_settings_are_read(word: str, expected: str) -> None:
    assert str(*read_space([word], CONFIG)) == expected


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("gama=0.9,0.95", "ppo has no setting 'gama' to vary, perhaps gamma"),
        ("tau=0.1,0.2", "ppo has no setting 'tau' to vary"),
        ("seed=0,1", "ppo has no setting 'seed' to vary"),
        ("gamma", "--vary takes NAME=LOW..HIGH or NAME=A,B,C, got 'gamma'"),
        ("gamma=0.99..0.9", "must be numbers, the smaller one first"),
        ("gamma=a..b", "must be numbers, the smaller one first"),
        ("hidden=3..4", "hidden is no number: vary it as hidden=A,B,C"),
        ("num_envs=1.5..4", "num_envs is a whole number, got 1.5..4"),
        ("gamma=0.5,2", "gamma must be between 0 and 1, got 2.0"),
        ("gamma=0.5..2", "gamma must be between 0 and 1, got 2.0"),
        ("memory=gru,xlstm", "memory in network in --vary: one of"),
        ("clip=a,b", "clip in algorithm in --vary: a value of type float is needed, got 'a'"),
    ],
)
def test_what_cannot_be_varied_is_refused_in_a_sentence(word: str, expected: str) -> None:
    with pytest.raises(ValueError) as error:
        read_space([word], CONFIG)
    assert expected in str(error.value)


def test_each_setting_is_varied_once() -> None:
    with pytest.raises(ValueError, match="name the settings to vary"):
        read_space([], CONFIG)
    with pytest.raises(ValueError, match="vary each setting once"):
        read_space(["gamma=0.9,0.95", "gamma=0.9..0.99"], CONFIG)


def test_values_are_put_into_the_settings() -> None:
    numbers, layers, points = read_space(
        ["learning_rate=1e-4..3e-3", "hidden=[64,64],[128]", "lidar.points=16,32"], CONFIG
    )
    assert isinstance(numbers, Interval)
    assert isinstance(layers, Choice)
    assert isinstance(points, Choice)
    drawn = {"learning_rate": numbers.value(0.00123456), "hidden": layers.value("[64,64]"), "lidar.points": 16}
    config = with_varied(CONFIG, drawn)
    assert (config.algorithm.learning_rate, config.network.hidden, config.env.lidar.points) == (0.00123, (64, 64), 16)
    assert with_varied(CONFIG, {}) == CONFIG
    assert numbers.value(0.0029999) == 0.003
