"""``action_repeat``, ``reward_scale`` and ``scale_observations`` of the classes for other libraries."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from gymnasium.utils.env_checker import check_env

from rover_rl import LEARNING_ENV_ID, GymVectorWrapper, TaskConfig, make_env
from rover_rl import RoverEnv as BatchedRoverEnv
from rover_rl.envs.encoding import EncodedObservation, ObservationEncoder

OPTIONS = {"action_repeat": 4, "reward_scale": 0.05, "scale_observations": True}
ROWS = 3


def make_vec(id_: str = "rover_rl/Rover-v0", rows: int = ROWS, **kwargs):
    kwargs = {"world_n": "maze", "seed": 0, "backend": "warp", **kwargs}
    return gymnasium.make_vec(id_, num_envs=rows, vectorization_mode="vector_entry_point", **kwargs)


def test_a_step_is_several_steps_with_the_sum_of_their_rewards() -> None:
    plain, repeated = make_vec(length=200), make_vec(length=200, action_repeat=4, reward_scale=0.05)
    plain.reset(seed=3), repeated.reset(seed=3)
    actions = np.array([[1.0, 0.3], [0.5, -1.0], [-0.5, 0.0]], np.float32)
    for _ in range(3):
        total = sum(plain.step(actions)[1] for _ in range(3))
        observations, reward, *_, infos = plain.step(actions)
        expected, scaled, *_, expected_infos = repeated.step(actions)
        np.testing.assert_allclose(scaled, 0.05 * (total + reward), rtol=1e-5)
        np.testing.assert_equal(observations, expected)
        np.testing.assert_array_equal(infos["steps"], expected_infos["steps"])
    assert repeated.metadata["render_fps"] == 5


def test_scaled_observations_are_one_vector_with_the_features_of_the_encoder() -> None:
    envs, plain = make_vec(scale_observations=True), make_vec()
    vector, entries = envs.reset(seed=1)[0], plain.reset(seed=1)[0]
    encoder = ObservationEncoder()
    expected = encoder(*(torch.from_numpy(entries[key]) for key in encoder.keys))
    np.testing.assert_array_equal(vector, expected)
    assert envs.single_observation_space == Box(-np.inf, np.inf, (encoder.features,), np.float32)
    assert vector in envs.observation_space


def test_rows_equal_single_rovers_also_after_they_end() -> None:
    ending = {"length": 24, "end_on_goal": True, "task": TaskConfig(success_distance=2.5), "time_limit": "truncated"}
    envs = make_vec(LEARNING_ENV_ID, autoreset_mode="SameStep", **ending)
    ending |= {"world_n": "maze"}
    single = [gymnasium.make(LEARNING_ENV_ID, seed=row, **ending) for row in range(ROWS)]
    np.testing.assert_array_equal(envs.reset(seed=0)[0], [env.reset(seed=i)[0] for i, env in enumerate(single)])
    rng, endings = np.random.default_rng(0), 0
    for _ in range(12):
        actions = rng.uniform(-1, 1, (ROWS, 2)).astype(np.float32)
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        for row, env in enumerate(single):
            observation, *rest, _ = env.step(actions[row])
            assert rest == [rewards[row], terminated[row], truncated[row]]
            if terminated[row] or truncated[row]:
                np.testing.assert_array_equal(infos["final_obs"][row], observation)
                observation, _ = env.reset()
                endings += 1
            np.testing.assert_array_equal(observations[row], observation)
    assert endings >= ROWS


def test_a_program_needs_only_the_name_of_the_environment() -> None:
    """``module:id`` imports the package; an action every 0.2 s, Warp, and ``truncated`` are settings of the name."""
    env = gymnasium.make(f"rover_rl:{LEARNING_ENV_ID}", world_n="maze", length=8)
    check_env(env.unwrapped, skip_render_check=True)
    assert isinstance(env.observation_space, Box)
    assert env.unwrapped.base_env.config.backend == "warp"
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[3] is False
    assert env.step(env.action_space.sample())[2:4] == (False, True)


def test_other_lidars_and_environments_with_transforms() -> None:
    env = make_env(world_n="maze", num_envs=2, lidar_points=16, seed=0)
    envs = GymVectorWrapper(env, **OPTIONS)
    assert envs.reset()[0].shape == (2, ObservationEncoder(lidar_points=16).features)
    encoder = ObservationEncoder(("lidar", "target"), lidar_points=16)
    rollout = make_env(world_n="maze", num_envs=2, lidar_points=16).append_transform(EncodedObservation(encoder))
    assert rollout.rollout(2)["next", "observation"].shape == (2, 2, encoder.features)


def test_sb3_takes_vectors() -> None:
    pytest.importorskip("stable_baselines3")
    from rover_rl.envs.sb3 import SB3VecEnv

    envs = SB3VecEnv(BatchedRoverEnv(world_n="maze", num_envs=2, length=8, seed=0), **OPTIONS)
    assert envs.reset() in Box(-np.inf, np.inf, (2, 41), np.float32)
    for _ in range(2):
        _, _, dones, infos = envs.step(np.zeros((2, 2)))
    assert dones.all()
    assert infos[0]["terminal_observation"].shape == (41,)


def test_the_transform_without_an_encoder_reads_the_sensors_of_its_environment() -> None:
    """As ``scale_observations`` does, in the order in which they are named."""
    settings = {"world_n": "maze", "num_envs": 2, "backend": "warp", "seed": 0}
    for sensors, features in (([], 41), (["route"], 54), (["depth(size=(4, 6))", "route"], 78), (["robot"], 53)):
        env = make_env(**settings, sensors=sensors).append_transform(EncodedObservation())
        envs = GymVectorWrapper(BatchedRoverEnv(**settings, sensors=sensors), scale_observations=True)
        observation = env.reset()["observation"]
        assert observation.shape == (2, features) == env.observation_spec["observation"].shape
        np.testing.assert_array_equal(observation, envs.reset(seed=0)[0])
    with pytest.raises(ValueError, match="append EncodedObservation"):
        _ = EncodedObservation().encoder
    env = make_env(**settings).append_transform(EncodedObservation(ObservationEncoder(("target", "route"))))
    with pytest.raises(ValueError, match=r"the encoder reads \['route'\]"):
        env.reset()
