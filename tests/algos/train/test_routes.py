"""Training of policies that read the route on the map of what has been seen."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl import RoverEnv
from rover_rl.algos.config import TrainingConfig, training_config
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.grid_planner import GridPlanner
from rover_rl.algos.policy.networks import mirrored
from rover_rl.algos.policy.runner import PolicyRunner, sensors_for
from rover_rl.algos.train import train
from rover_rl.algos.train.env import make_training_env
from rover_rl.algos.train.ppo import PPOLearner
from rover_rl.envs.config import EnvConfig

SENSES = ("lidar", "imu", "target", "velocities", "route")


def config(folder: Path, **settings: object) -> TrainingConfig:
    small = {"num_envs": 8, "rollout_length": 8, "minibatch": 32, "epochs": 2, "hidden": (16,), "total_steps": 512}
    route = {"observation": SENSES, "route_reward": 10.0}
    return training_config("ppo", world="maze:0-3", backend="warp", runs=str(folder), **{**small, **route, **settings})


def test_a_policy_with_routes_trains_and_drives_as_it_was_saved(tmp_path: Path) -> None:
    summary = train(config(tmp_path, prior="route", imitation=0.5, expert="route"))
    first, second = (Checkpoint.load(summary.checkpoint).make_actor() for _ in range(2))
    assert "route" in first.in_keys
    actions = []
    for actor in (first, second):
        described = EnvConfig(world="maze:10000", num_envs=2, seed=0, backend="warp", action=actor.made_for.action)
        env = RoverEnv(sensors_for(actor, described))
        runner, observation = PolicyRunner(actor, env=env), env.reset()
        assert runner.action_repeat == 4
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            for _ in range(6):
                action = runner(observation)
                observation = env.step(observation.set("action", action))["next"]
        actions.append(action)
    assert torch.equal(*actions)


@pytest.fixture(scope="module")
def observation() -> TensorDictBase:
    """What eight rovers see in four steps."""
    torch.manual_seed(0)
    env = make_training_env(config(Path(), prior="route"))
    return env.rollout(4, break_when_any_done=False).select(*SENSES)


def test_a_policy_with_a_prior_begins_as_the_driver_that_follows_the_route(observation: TensorDictBase) -> None:
    actor = PPOLearner(config(Path(), prior="route")).actor
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        action = actor(observation.clone())["action"]
    expected = GridPlanner()(observation.clone())["action"]
    # Except at the bounds, which a squashed mean does not reach, and for the first weights, which are small.
    low, high = actor.spec["action"].space.low, actor.spec["action"].space.high
    inside = (expected - (low + high) / 2).abs() < 0.9 * (high - low) / 2
    assert inside.sum() > 10
    torch.testing.assert_close(action[inside], expected[inside], atol=0.2, rtol=0)


def test_the_prior_of_a_mirror_image_is_the_mirror_image_of_the_prior(observation: TensorDictBase) -> None:
    every = torch.ones(observation.batch_size, dtype=torch.bool)
    image = GridPlanner()(mirrored(observation, every))["action"]
    expected = GridPlanner()(observation.clone())["action"] * torch.tensor([1.0, -1.0])
    torch.testing.assert_close(image, expected)
