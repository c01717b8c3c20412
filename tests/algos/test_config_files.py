from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl.algos.config import ALGORITHMS, PARTS, TrainingConfig, training_config
from rover_rl.algos.config_files import config_from, experiments, plain, read_config, run_config, write_config


@pytest.mark.parametrize(
    "config",
    [
        training_config("ppo", max_minutes=3.0),
        training_config("sac", hidden=(8,), world="maze:7", mirror_augmentation=False),
    ],
)
def test_a_yaml_file_preserves_settings(config: TrainingConfig, tmp_path: Path) -> None:
    write_config(tmp_path / "config.yaml", config)
    assert read_config(tmp_path / "config.yaml") == config
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["algo"] == config.algo


@pytest.mark.parametrize(
    "text", ["algo: sac\nworld: moon\ngamma: 1\n", "algo: sac\nenv: {world: moon}\nalgorithm: {gamma: 1}\n"]
)
def test_missing_settings_have_their_defaults(text: str, tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    assert read_config(tmp_path / "mine.yaml") == training_config("sac", world="moon", gamma=1.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("algo: dqn", r"must name an algo, one of \['ppo', 'sac'\]"),
        ("[1, 2]", "must name an algo"),
        ("algo: ppo\nsped: 3", r"settings that ppo does not know: \['sped'\]"),
        ("algo: ppo\nseed: x", r"seed in env in .*: a value of type int \| None is needed, got 'x'$"),
        ("algo: ppo\nhidden: [8, x]", r"hidden\[1\] in network in .*: a value of type int is needed, got 'x'$"),
        ("algo: ppo\nworld: null", r"world in env in .*: a value of type .* is needed, got None$"),
        ("algo: ppo\nenv: 3", r"env in .* must hold settings by name, got 3$"),
        ("algo: ppo\nenv: {}\nsped: 3", r"has parts that do not exist: \['sped'\]"),
        ("algo: ppo\nalgorithm: {tau: 0.1}", r"algorithm in .*: there is no setting tau; use some of "),
        ("algo: !!python/object/apply:os.getcwd []", "is no YAML"),
    ],
)
def test_invalid_files_raise(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_config(tmp_path / "config.yaml")


@settings(deadline=None, max_examples=15)
@given(st.data())
def test_plain_data_is_the_inverse_of_reading(data: st.DataObject) -> None:
    algo = data.draw(st.sampled_from(list(ALGORITHMS)))
    settings = {}
    for kind in (PARTS | {"algorithm": ALGORITHMS[algo]}).values():
        for field in fields(kind):
            if isinstance(field.default, bool):
                settings[field.name] = data.draw(st.booleans())
            elif isinstance(field.default, int):
                settings[field.name] = data.draw(st.integers())
            elif isinstance(field.default, float):
                settings[field.name] = data.draw(st.floats(allow_nan=False))
    config = training_config(algo, **settings)
    assert config_from(yaml.safe_load(yaml.safe_dump(plain(config))), "text") == config


def test_the_folder_of_a_run_may_be_moved(tmp_path: Path) -> None:
    write_config(tmp_path / "moved" / "config.yaml", training_config("ppo", runs="elsewhere", name="old", gamma=0.5))
    assert run_config(tmp_path / "moved") == training_config("ppo", runs=str(tmp_path), name="moved", gamma=0.5)


def test_experiments_are_named_by_the_settings_that_differ() -> None:
    runs = [
        training_config("ppo", seed=1, name="a"),
        training_config("ppo", workers=2),
        training_config("sac"),
        training_config("sac", gamma=0.9),
        training_config("sac", world="maze"),
    ]
    names = ["PPO in moon", "PPO in moon", "SAC in moon, gamma=0.96", "SAC in moon, gamma=0.9", "SAC in maze"]
    assert experiments(runs) == names
