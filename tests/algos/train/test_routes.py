"""Training of policies that read the route on the map of what has been seen."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
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


@pytest.mark.parametrize(
    "settings", [{"prior": "route"}, {"imitation": 1.0, "expert": "route"}, {"memory": "gru", "memory_size": 8}]
)
def test_a_policy_with_routes_trains_and_drives_as_it_was_saved(tmp_path: Path, settings: dict[str, object]) -> None:
    summary = train(config(tmp_path, **settings))
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


def test_no_weights_take_back_what_the_driver_decides(observation: TensorDictBase) -> None:
    driver, changes = GridPlanner()(observation.clone())["action"], []
    for seed in range(4):
        torch.manual_seed(seed)
        actor = PPOLearner(config(Path(), prior="route")).actor
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            for weight in actor.parameters():
                weight *= 100.0
            action = actor(observation.clone())["action"]
        space = actor.spec["action"].space
        middle, half = (space.low + space.high) / 2, (space.high - space.low) / 2
        # tanh(atanh(0.9) - 1) = 0.4
        decided = (driver - middle).abs() > 0.9 * half
        assert decided.sum() > 5
        assert ((action - middle).sign() == (driver - middle).sign())[decided].all()
        changes.append((action - driver).abs()[decided].max())
    assert max(changes) > 0.2, "the weights change the action"


def test_the_prior_of_a_mirror_image_is_the_mirror_image_of_the_prior(observation: TensorDictBase) -> None:
    every = torch.ones(observation.batch_size, dtype=torch.bool)
    image = GridPlanner()(mirrored(observation, every))["action"]
    expected = GridPlanner()(observation.clone())["action"] * torch.tensor([1.0, -1.0])
    torch.testing.assert_close(image, expected)


@pytest.mark.slow
def test_the_imitated_actions_are_those_of_the_driver(tmp_path: Path) -> None:
    """Imitation alone makes the policy similar to the driver that follows the route."""
    summary = train(config(tmp_path, imitation=1.0, expert="route", learning_rate=3e-3, total_steps=4096))
    actor = Checkpoint.load(summary.checkpoint).make_actor()
    angles = torch.linspace(-1.0, 1.0, 9)
    seen = TensorDict(
        {
            "lidar": torch.full((9, 32), 12.0),
            "imu": torch.zeros(9, 3),
            "target": torch.stack((torch.full((9,), 4.0), angles), -1),
            "velocities": torch.zeros(9, 2),
            "route": torch.stack(
                (torch.full((9,), 4.0), angles, torch.full((9,), 4.0), angles, torch.full((9,), 4.0)), -1
            ),
        },
        batch_size=[9],
    )
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        turn = actor(seen)["action"][:, 1]
    assert torch.corrcoef(torch.stack((turn, angles)))[0, 1] > 0.8
