from __future__ import annotations

from typing import Any

import pytest

from rover_rl.algos.config import TrainingConfig, training_config, with_settings
from rover_rl.algos.workers import default_workers
from rover_rl.sims.warp import WarpSettings

PPO, SAC = training_config("ppo"), training_config("sac")
ROUTE = ("lidar", "imu", "route")


@pytest.mark.parametrize(
    ("config", "field", "value"),
    [
        (PPO, "total_steps", 0),
        (PPO, "learning_rate", 0.0),
        (PPO, "gamma", 1.1),
        (PPO, "path_reward", float("nan")),
        (PPO, "entropy_coef", -1.0),
        (PPO, "memory", "rnn"),
        (PPO, "snapshots", -1),
        (PPO, "workers", 3),
        (PPO, "hidden", (0,)),
        (PPO, "logger", ("csb",)),
        (PPO, "prior_share", 1.0),
        (PPO, "observation", ()),
        (PPO, "observation", ("lidar", "camera")),
        (PPO, "observation", ("lidar", "lidar")),
        (SAC, "tau", 1.5),
        (SAC, "buffer_size", 10),
    ],
)
def test_settings_out_of_range_raise_by_name(config: TrainingConfig, field: str, value: object) -> None:
    config.check()
    with pytest.raises(ValueError, match=field):
        with_settings(config, **{field: value}).check()


@pytest.mark.parametrize(
    ("algo", "settings", "message"),
    [
        ("ppo", {"north_up": True}, "mirror_augmentation does not go with north_up"),
        ("sac", {"observation": ("target", "pose")}, "mirror_augmentation does not go with .*, nor with pose"),
        (
            "ppo",
            {"north_up": True, "mirror_augmentation": False, "observation": ("lidar", "target")},
            "north_up needs lidar, imu and target",
        ),
        ("ppo", {"prior": "route"}, "prior='route' needs lidar, imu and route in observation"),
        ("ppo", {"prior": "route", "robot": ("leo", "husky")}, "prior='route' is for one robot, got 2"),
        ("ppo", {"prior": "route", "memory": "gru", "observation": ROUTE}, "needs .* memory='none', got .* 'gru'"),
        ("ppo", {"route_reward": 1.0}, 'need "route" in observation'),
        ("sac", {"prior": "route", "observation": ROUTE}, "prior and .* are for PPO, and the algorithm is SAC"),
        ("sac", {"privileged_critic": True}, "privileged_critic are for PPO"),
        ("ppo", {"curriculum": "learnability", "backend": "bullet"}, "curriculum needs backend='warp'"),
        ("ppo", {"physics": "fast"}, "unknown physics 'fast'"),
        ("ppo", {"device": "cuda", "workers": 2}, "device='cuda' needs backend='warp' and workers=1"),
        ("ppo", {"device": "cuda:"}, "device must be cpu, cuda or cuda: and a"),
    ],
)
def test_settings_that_do_not_go_together_raise(algo: str, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        training_config(algo, **settings).check()


def test_settings_are_put_into_their_parts() -> None:
    config = training_config("sac", world="maze", hidden=(8,), workers=2, tau=0.1, max_minutes=5)
    assert (config.algo, config.env.world, config.network.hidden) == ("sac", "maze", (8,))
    assert (config.collection.workers, config.algorithm.tau, config.run.max_minutes) == (2, 0.1, 5)
    assert TrainingConfig() == PPO
    assert (PPO.workers, 64 % default_workers(64)) == (1, 0)


@pytest.mark.parametrize(
    ("algo", "given", "expected"),
    [
        ("ppo", {}, ("warp", 512, 1024, 3_000_000)),
        ("ppo", {"backend": "bullet"}, ("bullet", 64, 256, 600_000)),
        ("ppo", {"backend": WarpSettings(), "num_envs": 8}, (WarpSettings(), 8, 1024, 3_000_000)),
        ("ppo", {"backend": "mujoco", "minibatch": 32}, ("mujoco", 64, 32, 600_000)),
        ("sac", {}, ("warp", 64, 256, 400_000)),
        ("sac", {"backend": "bullet"}, ("bullet", 64, 256, 400_000)),
    ],
)
def test_training_is_in_warp_and_other_simulators_have_fewer_rovers(
    algo: str, given: dict[str, Any], expected: tuple[Any, ...]
) -> None:
    config = training_config(algo, **given)
    assert (config.env.backend, config.num_envs, config.algorithm.minibatch, config.run.total_steps) == expected


def test_unknown_algorithms_and_settings_raise() -> None:
    with pytest.raises(ValueError, match=r"algo must be one of \['ppo', 'sac'\], got 'dqn'"):
        training_config("dqn")
    with pytest.raises(ValueError, match=r"ppo does not know the settings \['sped', 'tau'\]"):
        training_config("ppo", tau=0.1, sped=3)
