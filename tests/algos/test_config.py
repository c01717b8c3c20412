from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from rover_rl.algos.config import (
    CONFIGS,
    PPOConfig,
    SACConfig,
    TrainingConfig,
    config_from,
    default_workers,
    experiments,
    plain,
    read_config,
    run_config,
    write_config,
)


@pytest.mark.parametrize("config", [PPOConfig(max_minutes=3.0), SACConfig(hidden=(8,), world="maze:7", mirror=False)])
def test_settings_come_back_from_yaml_as_they_were(config: TrainingConfig, tmp_path: Path) -> None:
    write_config(tmp_path / "config.yaml", config)
    assert read_config(tmp_path / "config.yaml") == config
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["algo"] == config.algo


def test_what_a_file_leaves_out_has_its_default(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("algo: sac\nworld: moon\ngamma: 1\n")
    assert read_config(tmp_path / "mine.yaml") == SACConfig(world="moon", gamma=1.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("world: maze", "must name an algo"),
        ("algo: dqn", r"must name an algo, one of \['ppo', 'sac'\]"),
        ("[1, 2]", "must name an algo"),
        ("algo: ppo\nsped: 3", r"settings that ppo does not know: \['sped'\]"),
        ("algo: ppo\ntau: 0.1", r"settings that ppo does not know: \['tau'\]"),
        ("algo: ppo\nseed: x", "seed in .* must be of type int"),
        ("algo: ppo\nworkers: true", "workers in .* must be of type int"),
        ("algo: ppo\nhidden: [8, x]", "hidden in .* must be of type tuple"),
        ("algo: ppo\nworld: null", "world in .* must be of type str"),
        ("algo: {", "is no YAML"),
        ("algo: !!python/object/apply:os.getcwd []", "is no YAML"),
    ],
)
def test_files_that_are_no_settings_are_refused(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_config(tmp_path / "config.yaml")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no settings at .*none\.yaml"):
        read_config(tmp_path / "none.yaml")


@given(st.data())
def test_plain_data_is_the_inverse_of_reading(data: st.DataObject) -> None:
    kind = data.draw(st.sampled_from(list(CONFIGS.values())))
    given_settings = {}
    for field in fields(kind):
        if isinstance(field.default, bool):
            given_settings[field.name] = data.draw(st.booleans())
        elif isinstance(field.default, int):
            given_settings[field.name] = data.draw(st.integers())
        elif isinstance(field.default, float):
            given_settings[field.name] = data.draw(st.floats(allow_nan=False))
    config = kind(**given_settings)
    assert config_from(yaml.safe_load(yaml.safe_dump(plain(config))), "text") == config


def test_a_run_is_found_where_its_folder_is_now(tmp_path: Path) -> None:
    write_config(tmp_path / "moved" / "config.yaml", PPOConfig(runs="elsewhere", name="old", gamma=0.5))
    assert run_config(tmp_path / "moved") == PPOConfig(runs=str(tmp_path), name="moved", gamma=0.5)


@pytest.mark.parametrize(
    ("config", "field", "value"),
    [
        (PPOConfig(), "total_steps", 0),
        (PPOConfig(), "learning_rate", 0.0),
        (PPOConfig(), "gamma", 1.1),
        (PPOConfig(), "entropy", -1.0),
        (PPOConfig(), "max_minutes", 0.0),
        (PPOConfig(), "checkpoint_minutes", 0.0),
        (PPOConfig(), "snapshots", -1),
        (PPOConfig(), "workers", 3),
        (PPOConfig(), "hidden", ()),
        (PPOConfig(), "hidden", (0,)),
        (PPOConfig(), "observation", ()),
        (PPOConfig(), "observation", ("lidar", "camera")),
        (PPOConfig(), "observation", ("lidar", "lidar")),
        (SACConfig(), "tau", 0.0),
        (SACConfig(), "tau", 1.5),
        (SACConfig(), "warmup", 0),
        (SACConfig(), "buffer", 10),
    ],
)
def test_settings_out_of_range_are_refused_by_name(config: TrainingConfig, field: str, value: object) -> None:
    config.check()
    with pytest.raises(ValueError, match=field):
        replace(config, **{field: value}).check()


def test_warp_is_in_one_process_by_default_and_has_no_presets_of_bullets() -> None:
    assert PPOConfig(backend="warp").processes == 1
    assert PPOConfig(backend="warp", workers=2).processes == 2
    PPOConfig(backend="warp").check()
    with pytest.raises(ValueError, match="presets of the physics are Bullet's"):
        PPOConfig(backend="warp", physics="fast").check()


def test_a_gpu_is_for_warp_in_one_process():
    for device in ("cuda", "cuda:1"):
        config = PPOConfig(backend="warp", device=device)
        config.check()
        assert config.on_gpu
    assert not PPOConfig().on_gpu
    for wrong in (PPOConfig(device="cuda"), PPOConfig(backend="warp", device="cuda", workers=2)):
        with pytest.raises(ValueError, match=r"device='cuda' needs backend='warp' and workers=1"):
            wrong.check()
    for device in ("gpu", "cuda:", "cuda:x", ""):
        with pytest.raises(ValueError, match="device must be cpu, cuda or cuda: and a number"):
            PPOConfig(backend="warp", device=device).check()


def test_default_workers_share_the_rovers_equally() -> None:
    assert default_workers(1) == 1
    assert 64 % default_workers(64) == 0


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (PPOConfig(north_up=True), "mirror cannot be had with north_up"),
        (SACConfig(observation=("target", "pose")), "mirror cannot be had with north_up or pose"),
        (
            PPOConfig(north_up=True, mirror=False, observation=("lidar", "target")),
            "north_up needs lidar, imu and target",
        ),
        (PPOConfig(spread=0.0), "spread must be positive"),
    ],
)
def test_what_a_policy_sees_must_go_together(config: TrainingConfig, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        config.check()
    PPOConfig(north_up=True, mirror=False).check()


def test_runs_are_called_by_what_they_do_not_have_in_common() -> None:
    runs = [
        PPOConfig(seed=1, name="a"),
        PPOConfig(workers=2),
        SACConfig(),
        SACConfig(gamma=0.9),
        SACConfig(world="maze"),
    ]
    names = ["PPO in moon", "PPO in moon", "SAC in moon, gamma=0.96", "SAC in moon, gamma=0.9", "SAC in maze"]
    assert experiments(runs) == names
