"""Policies from files of Stable-Baselines3 act as in Stable-Baselines3."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

pytest.importorskip("stable_baselines3")

import stable_baselines3 as sb3

from rover_rl import RoverEnv
from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import evaluate, for_task
from rover_rl.algos.evaluation.evaluate import test_env as env_of_test
from rover_rl.algos.policy.names import resolve_policy
from rover_rl.algos.policy.sb3_policy import SB3Policy
from rover_rl.envs.sb3 import SB3VecEnv
from rover_rl.tasks import get_task

ON_POLICY = {"n_steps": 4}
OFF_POLICY = {"learning_starts": 4, "buffer_size": 100, "batch_size": 8}
CASES = {
    "PPO": (sb3.PPO, {**ON_POLICY, "batch_size": 8, "n_epochs": 2}, {"net_arch": [8], "activation_fn": torch.nn.ELU}),
    "A2C-sde": (sb3.A2C, {**ON_POLICY, "use_sde": True}, None),
    "SAC-vector": (sb3.SAC, {**OFF_POLICY, "use_sde": True}, {"net_arch": {"pi": [8], "qf": [4]}}),
    "TD3": (sb3.TD3, OFF_POLICY, {"net_arch": [8]}),
}


def make(lidar_points: int = 12, **options) -> SB3VecEnv:
    return SB3VecEnv(RoverEnv(world_n="maze", num_envs=2, lidar_points=lidar_points, seed=0), **options)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory):
    """A function that trains for a few steps and saves the model. Each model is made once."""
    folder, models = tmp_path_factory.mktemp("sb3"), {}

    def save(case: str):
        if case not in models:
            algorithm, settings, policy = CASES[case]
            vector = case.endswith("vector")
            envs = make(scale_observations=vector)
            name = "MlpPolicy" if vector else "MultiInputPolicy"
            model = algorithm(name, envs, policy_kwargs=policy, device="cpu", seed=0, **settings)
            model.learn(16)
            model.save(folder / case)
            models[case] = folder / f"{case}.zip", model, envs
        return models[case]

    return save


@pytest.mark.parametrize("case", CASES)
def test_it_acts_as_in_stable_baselines3(saved, case) -> None:
    path, model, envs = saved(case)
    policy = resolve_policy(str(path), ()).module
    assert policy.made_for.lidar.points == 12
    env = RoverEnv(world_n="maze", num_envs=2, lidar_points=12, seed=5)
    envs.seed(5)
    observation, now = envs.reset(), env.reset()
    for _ in range(4):
        expected, _ = model.predict(observation, deterministic=True)
        action = policy(now)["action"]
        np.testing.assert_allclose(action.numpy(), expected, rtol=0, atol=1e-6)
        observation, now = envs.step(expected)[0], env.step(now.set("action", torch.from_numpy(expected)))["next"]


def test_it_is_evaluated_beside_others_also_in_other_processes(saved) -> None:
    path, *_ = saved("PPO")
    policy = pickle.loads(pickle.dumps(SB3Policy(path)))
    evaluation = evaluate(policy, draw_episodes("maze", 2, seed=1), seconds=1.0, rows=2)
    assert evaluation.env.lidar.points == 12
    assert len(evaluation.trajectories) == 2


@pytest.mark.parametrize("options", [{"scale_observations": True}, {}])
def test_it_reads_the_observation_of_a_task(tmp_path, options) -> None:
    """The file says neither which entries the policy reads nor which sensors they need."""
    task = get_task("hills")
    rovers = RoverEnv(replace(task.env, world="maze", num_envs=2, seed=0))
    envs = SB3VecEnv(rovers, observation=task.observation, **options)
    model = sb3.PPO("MlpPolicy" if options else "MultiInputPolicy", envs, n_steps=4, batch_size=8, device="cpu")
    model.save(tmp_path / "ppo")
    policy = pickle.loads(pickle.dumps(for_task(task, SB3Policy(tmp_path / "ppo.zip"))))
    assert env_of_test(task, policy) == task.test_env
    observation, now = envs.reset(), RoverEnv(replace(task.env, world="maze", num_envs=2, seed=0)).reset()
    expected, _ = model.predict(observation, deterministic=True)
    np.testing.assert_allclose(policy(now)["action"].numpy(), expected, rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="other observations" if options else "the entries"):
        SB3Policy(tmp_path / "ppo.zip").reading(get_task("maze").env, ("lidar", "target"))(now)


def test_other_files_are_refused(tmp_path) -> None:
    with pytest.raises(FileNotFoundError, match="no policy at"):
        SB3Policy(tmp_path / "none.zip")
    (tmp_path / "text.zip").write_text("text")
    with pytest.raises(ValueError, match="is damaged, or no policy of Stable-Baselines3"):
        SB3Policy(tmp_path / "text.zip")
    sb3.PPO("MlpPolicy", "Pendulum-v1", n_steps=4, batch_size=4).save(tmp_path / "pendulum.zip")
    with pytest.raises(ValueError, match="other actions than those of rover_rl"):
        SB3Policy(tmp_path / "pendulum.zip")
