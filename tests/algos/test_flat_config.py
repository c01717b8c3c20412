"""Settings and checkpoints of version 0.1, which had no parts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from rover_rl.algos.config import AlgorithmConfig, NetworkConfig, PPOConfig, SACConfig, training_config
from rover_rl.algos.config_files import config_from, read_config, run_config
from rover_rl.algos.flat_config import RENAMED
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import ObservationEncoder, make_actor
from rover_rl.envs.config import ActionConfig, Randomization

VALUES: dict[str, Any] = {
    "decisions": 3,
    "repeat": 2,
    "episode_steps": 70,
    "warmup": 11,
    "buffer": 5000,
    "entropy": 0.5,
    "mirror": False,
    "spread": 0.6,
}
"""A value of each renamed setting that is not its default."""
FLAT = {
    "algo": "ppo",
    "world": "maze",
    "hidden": [8],
    "observation": ["lidar", "imu", "target", "velocities"],
    "decisions": 8,
    "repeat": 2,
    "episode_steps": 70,
    "entropy": 0.01,
    "mirror": False,
    "spread": 0.6,
    "reverse": False,
    "randomize": True,
    "backend": "bullet",
    "physics": "fast",
    "device": "cpu",
    "workers": None,
    "gamma": 0.9,
    "seed": 5,
}
"""Settings as version 0.1 wrote them."""
TODAY = training_config(
    "ppo",
    backend="bullet",
    world="maze",
    hidden=(8,),
    rollout_length=8,
    action_repeat=2,
    length=70,
    entropy_coef=0.01,
    mirror_augmentation=False,
    max_std=0.6,
    action=ActionConfig(min_speed=0.0),
    randomization=Randomization.typical(),
    physics="fast",
    gamma=0.9,
    seed=5,
)


def test_every_renamed_setting_is_tested() -> None:
    assert VALUES.keys() == RENAMED.keys()


@pytest.mark.parametrize("old", VALUES)
def test_an_old_name_sets_the_setting_of_its_new_name(old: str) -> None:
    algo = "sac" if old in ("warmup", "buffer") else "ppo"
    config = config_from({"algo": algo, old: VALUES[old]}, "text")
    assert config == training_config(algo, **{RENAMED[old]: VALUES[old]})
    assert config != training_config(algo)


@pytest.mark.parametrize("old", VALUES)
def test_new_names_are_read_without_parts_too(old: str) -> None:
    algo, new = "sac" if old in ("warmup", "buffer") else "ppo", RENAMED[old]
    assert config_from({"algo": algo, new: VALUES[old]}, "text") == training_config(algo, **{new: VALUES[old]})


@pytest.mark.parametrize("value", [True, False])
def test_reverse_is_the_lowest_speed(value: bool) -> None:
    action = ActionConfig() if value else ActionConfig(min_speed=0.0)
    assert config_from({"algo": "sac", "reverse": value}, "text") == training_config("sac", action=action)


@pytest.mark.parametrize("value", [True, False])
def test_randomize_is_the_typical_randomization(value: bool) -> None:
    randomization = Randomization.typical() if value else Randomization()
    expected = training_config("sac", randomization=randomization)
    assert config_from({"algo": "sac", "randomize": value}, "text") == expected


def test_the_backend_ray_is_a_collector() -> None:
    assert config_from({"algo": "ppo", "backend": "ray"}, "text") == training_config(
        "ppo", collector="ray", backend="bullet"
    )


def test_the_cpu_is_the_default_device() -> None:
    assert config_from({"algo": "ppo", "device": "cpu"}, "text") == training_config("ppo")


def test_an_old_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(FLAT))
    assert read_config(tmp_path / "config.yaml") == TODAY
    run = run_config(tmp_path)
    assert (run.run.runs, run.run.name) == (str(tmp_path.parent), tmp_path.name)
    assert run.env == TODAY.env


@pytest.mark.parametrize(("algo", "kind"), [("ppo", PPOConfig), ("sac", SACConfig)])
def test_an_old_file_gets_the_defaults_of_its_algorithm(algo: str, kind: type[AlgorithmConfig]) -> None:
    config = config_from({"algo": algo}, "text")
    assert (config.algorithm, config.network) == (kind(), NetworkConfig())
    assert config == training_config(algo)


def test_an_old_name_in_a_part_raises() -> None:
    with pytest.raises(ValueError, match="algorithm in text: there is no setting decisions; use some of "):
        config_from({"algo": "ppo", "algorithm": {"decisions": 3}}, "text")


def test_an_old_checkpoint_is_converted(tmp_path: Path) -> None:
    encoder = ObservationEncoder(lidar_points=16)
    actor = make_actor(encoder, (8,), ActionConfig(min_speed=0.0), max_std=0.6)
    path = tmp_path / "checkpoint.pt"
    old = {"format": "rover_rl checkpoint, version 3", "config": FLAT, "lidar_points": 16, "steps": 1}
    torch.save({**old, "actor": actor.state_dict()}, path)
    checkpoint = Checkpoint.load(path)
    assert (checkpoint.steps, checkpoint.env.lidar.points) == (1, 16)
    assert checkpoint.config.network == TODAY.network
    assert checkpoint.config.algorithm == TODAY.algorithm
    converted = checkpoint.make_actor()
    weights = converted.state_dict()
    assert all(torch.equal(weights[name], value) for name, value in actor.state_dict().items())
    assert converted.spec["action"].space.low.tolist() == pytest.approx([0.0, -torch.pi])
    checkpoint.save(tmp_path / "today.pt")
    assert Checkpoint.load(tmp_path / "today.pt").config == checkpoint.config


def test_an_old_checkpoint_without_its_lidar_points_raises(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    torch.save({"format": "rover_rl checkpoint, version 3", "config": FLAT, "steps": 1, "actor": {}}, path)
    with pytest.raises(ValueError, match=r"checkpoint\.pt is a damaged checkpoint"):
        Checkpoint.load(path)
