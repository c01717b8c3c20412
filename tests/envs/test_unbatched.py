"""``num_envs=None``: one rover without a batch dimension, otherwise equal to ``num_envs=1``."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose, InitTracker, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from rover_rl import GymVectorWrapper, GymWrapper, RoverEnv, Terrain, World, box, contract_reward, make_env
from rover_rl.algos.train.attempts import AttemptCounter, SpreadEnds
from rover_rl.envs.config import ActionConfig, Randomization
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from rover_rl.envs.transforms.path_reward import PathReward
from rover_rl.envs.transforms.step_clock import StepClock
from tests.envs.test_specs import Tilt

SMALL = World("small", Terrain.flat((10, 10)), [box((0, 0, 0.5), (0.4, 4, 1))])


def make(num_envs, **settings):
    reward = [*contract_reward(), Tilt()]
    settings = {"world_n": "maze", "backend": "warp", "seed": 3, "length": 15, "reward": reward, **settings}
    return make_env(num_envs=num_envs, **settings)


def rollout(env, steps=40, **options) -> TensorDictBase:
    torch.manual_seed(0)
    return env.rollout(steps, **{"break_when_any_done": False, **options})


def assert_same(single, batch) -> None:
    """Asserts that ``single`` equals the only row of ``batch``, bit for bit."""
    assert single.batch_size == batch.batch_size[1:]
    assert set(single.keys(True, True)) == set(batch.keys(True, True))
    for key, value in single.items(True, True):
        # Measured durations differ.
        if "clock" not in key:
            assert torch.equal(value, batch[key][0]), key


@pytest.mark.parametrize("settings", [{}, {"reward": "task"}], ids=["rewarded", "bare"])
def test_the_environment_matches_its_specs(settings):
    env = make(None, **settings)
    check_env_specs(env, break_when_any_done="both")
    assert (env.batch_size, env.num_envs) == ((), 1)
    shapes = [env.observation_spec["lidar"].shape, env.action_spec.shape, env.full_done_spec["done"].shape]
    assert shapes == [(32,), (2,), (1,)]
    # The only dimension of a rollout is time.
    td = env.rollout(5)
    assert [td.batch_size, td["lidar"].shape, td["action"].shape] == [(5,), (5, 32), (5, 2)]
    parts = [("reward_components", "tilt")] if "reward" not in settings else []
    assert all(td["next", key].shape == (5, 1) for key in ("reward", ("outcome", "phase"), *parts))


@pytest.mark.parametrize(
    "settings",
    [
        {"randomization": Randomization.typical()},
        {"end_on_goal": True, "lidar_beams": 64, "lidar_points": 16},
        {"backend": "bullet"},
    ],
    ids=["randomized", "ends on goal", "bullet"],
)
def test_it_equals_a_batch_of_one(settings):
    single, batch = make(None, **settings), make(1, **settings)
    assert_same(single.reset(), batch.reset())
    for options in ({}, {"break_when_all_done": True, "break_when_any_done": False}):
        assert_same(rollout(single, 20, **options), rollout(batch, 20, **options))


def test_starts_and_goals_have_no_row_dimension():
    start, goal = torch.tensor([1.0, -2.0, 0.5]), torch.tensor([2.0, 1.0])
    single, batch = make(None), make(1)
    td = single.reset(start=start, goal=goal)
    torch.testing.assert_close(td["pose"][:2], start[:2], atol=1e-3, rtol=0)
    assert_same(td, batch.reset(start=start[None], goal=goal[None]))
    assert torch.equal(single.goal, goal[None])
    td = RoverEnv(world_n="maze", num_envs=None, backend="warp").reset(TensorDict({"start": start, "goal": goal}))
    torch.testing.assert_close(td["imu"][2], start[2], atol=1e-3, rtol=0)
    with pytest.raises(ValueError, match=r"start must be finite numbers of shape \(3,\), got shape \(1, 3\)"):
        single.reset(start=start[None])
    with pytest.raises(ValueError, match=r"action must have shape \(2,\), got \(3,\)"):
        single.step(single.reset().set("action", torch.zeros(3)))


def test_it_takes_the_transforms_of_the_package():
    rollouts = []
    for num_envs, nested in ((1, False), (None, False), (None, True)):
        env = make(num_envs, world_n=SMALL, action=ActionConfig(min_speed=0.0))
        bare, ends = env.base_env, SpreadEnds(50)
        transforms = [ActionRepeat(4), PathReward(bare, 1.0), RewardSum(), StepCounter()]
        transforms += [ends, AttemptCounter(ends, 4, 200), InitTracker(), StepClock(bare)]
        if nested:
            env = TransformedEnv(env, Compose(*transforms))
        else:
            for transform in transforms:
                env = env.append_transform(transform)
        # SpreadEnds draws when it is reset for the first time.
        torch.manual_seed(0)
        check_env_specs(env)
        env.set_seed(0)
        rollouts.append((rollout(env, 8), rollout(env, break_when_all_done=True)))
    batches, *singles = rollouts
    for single in singles:
        assert_same(single[0], batches[0])
        assert_same(single[1], batches[1])
        assert (single[0]["action"][..., 0] >= 0).all()
        assert single[1].shape == (4,)


def test_the_gymnasium_wrappers_take_it():
    traces = []
    for num_envs in (None, 1):
        env = GymWrapper(make_env(world_n="maze", num_envs=num_envs, length=5, backend="warp"))
        assert env.action_space == gymnasium.spaces.Box(np.float32([-1, -np.pi]), np.float32([1, np.pi]))
        assert env.observation_space["lidar"].shape == (32,)
        env.reset(seed=1, options={"start": [0.5, 0.5, 0.0], "goal": [2.0, 2.0]})
        traces.append([env.step([0.5, 0.3]) for _ in range(4)] + [env.current_yaw, env.total_steps])
        env = make_env(world_n="maze", num_envs=num_envs, length=5, backend="warp")
        envs = GymVectorWrapper(env, autoreset_mode="Disabled")
        assert envs.observation_space["lidar"].shape == (1, 32)
        traces[-1] += [envs.reset(seed=2)] + [envs.step([[0.5, 0.3]]) for _ in range(5)]
        traces[-1] += [envs.reset(options={"reset_mask": np.array([True])})]
    np.testing.assert_equal(*traces)


def test_stable_baselines3_takes_it():
    from rover_rl.envs.sb3 import SB3VecEnv

    traces = []
    for num_envs in (None, 1):
        envs = SB3VecEnv(make_env(world_n="maze", num_envs=num_envs, seed=0, length=5, backend="warp"))
        traces.append([envs.reset()] + [envs.step(np.array([[0.5, 0.3]], np.float32)) for _ in range(8)])
    np.testing.assert_equal(*traces)
