"""Training takes the planar tier of Warp where all worlds and robots are level."""

from __future__ import annotations

import pytest

from rover_rl.algos.config import training_config
from rover_rl.algos.train.env import make_training_env, training_physics


@pytest.mark.parametrize(
    ("settings", "physics"),
    [
        ({"world": "maze:0-99"}, "planar"),
        ({"world": ["maze:0-99", "plaza"]}, "planar"),
        ({"world": "maze:0-99", "robot": ["jackal", "hunter"]}, "planar"),
        ({"world": "moon"}, "default"),
        ({"world": ["maze", "hills:0-9"]}, "default"),
        ({"world": "maze", "physics": "full"}, "full"),
        ({"world": "maze", "backend": "bullet"}, "default"),
        ({"world": "maze", "sensors": ("effort",)}, "default"),
        ({"world": "maze", "sensors": ("depth",), "observation": ("depth", "target")}, "default"),
    ],
)
def test_the_physics_of_a_training(settings, physics):
    assert training_physics(training_config("ppo", num_envs=8, **settings)) == physics


def test_a_training_environment_is_planar_and_its_settings_are_not():
    config = training_config("ppo", world="maze:0-9", num_envs=8)
    env = make_training_env(config)
    assert env.base_env.config.backend.planar
    assert config.env.physics == "default"
    env.close()
