"""Compatibility with TorchRL: nesting, closing, devices, batches of environments, and ``GymWrapper``."""

from __future__ import annotations

import warnings
from functools import partial

import gymnasium
import pytest
import torch
from gymnasium.vector import AutoresetMode
from torchrl import envs
from torchrl.collectors import Collector
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from rover_rl import Randomization, RoverEnv, make_env
from rover_rl.envs.make import RewardedEnv
from rover_rl.envs.specs import available_device

OBSERVED = ("lidar", "pose", "imu", "target", "velocities", "reward", "done", "terminated", "truncated")


def make(num_envs=3, **settings):
    return make_env(num_envs=num_envs, **{"world_n": "maze", "backend": "warp", "seed": 0, "length": 10, **settings})


def rollout(env, steps=25):
    torch.manual_seed(0)
    return env.rollout(steps, break_when_any_done=False)


def assert_same(a, b) -> None:
    assert set(a.keys(True, True)) == set(b.keys(True, True))
    for key, value in a.items(True, True):
        assert torch.equal(value, b[key]), key


@pytest.mark.parametrize("num_envs", [None, 3])
def test_nested_and_appended_transforms_are_the_same_and_nesting_does_not_warn(num_envs):
    appended = make(num_envs)
    for transform in (envs.ActionScaling(), StepCounter(), RewardSum()):
        appended = appended.append_transform(transform)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        nested = TransformedEnv(make(num_envs), Compose(envs.ActionScaling(), StepCounter(), RewardSum()))
    for env in (appended, nested):
        check_env_specs(env, break_when_any_done="both")
        env.set_seed(5)
    assert isinstance(appended, RewardedEnv)
    assert_same(rollout(appended), rollout(nested))


def test_a_clone_of_the_transforms_works_on_another_environment():
    train = TransformedEnv(make(), Compose(StepCounter(max_steps=4), RewardSum()))
    other = TransformedEnv(make(seed=50), train.transform.clone())
    other.load_state_dict(train.state_dict())
    other.set_seed(0)
    td = rollout(other)
    assert td["step_count"].max() == 3
    assert_same(td, rollout(train))


def test_transforms_for_a_single_reward_work_without_the_components():
    env = make(num_envs=None)
    components = [key for key in env.reward_keys if key != "reward"]
    env = TransformedEnv(env, Compose(envs.ExcludeTransform(*components), envs.FrameSkipTransform(4)))
    check_env_specs(env)
    assert env.rollout(2)["next", "outcome", "steps"].flatten().tolist() == [4, 8]


@pytest.mark.parametrize("num_envs", [None, 2])
def test_serial_env_takes_it(num_envs):
    env = envs.SerialEnv(2, partial(make, num_envs))
    env.set_seed(0)
    check_env_specs(env, break_when_any_done="both")
    env = TransformedEnv(env, StepCounter())
    assert rollout(env).shape == (2, *([] if num_envs is None else [num_envs]), 25)
    env.close()


@pytest.mark.filterwarnings("ignore:The env passed to Collector is missing transforms:FutureWarning")
@pytest.mark.parametrize(("build", "num_envs"), [(make_env, 3), (make_env, None), (RoverEnv, 3)])
def test_rollouts_within_and_after_a_collectors_loop(build, num_envs):
    """The collector closes its environment before it hands out the last batch."""
    env = build(world_n="maze", num_envs=num_envs, length=7, seed=0, backend="warp")
    frames = 6 * env.numel()
    batches = 0
    for batch in Collector(env, env.rand_action, frames_per_batch=frames, total_frames=3 * frames):
        assert batch.shape == (*env.batch_size, 6)
        assert env.rollout(9, break_when_any_done=False).shape == (*env.batch_size, 9)
        assert env.rollout(9, break_when_all_done=True).shape == (*env.batch_size, 7)
        batches += 1
    assert batches == 3
    assert env.rollout(9).shape == (*env.batch_size, 7)


@pytest.mark.parametrize(("num_envs", "backend"), [(None, "warp"), (3, "warp"), (3, "bullet")])
def test_a_reset_after_closing_continues_as_without_closing(num_envs, backend):
    settings = {"backend": backend, "randomization": Randomization.typical()}
    closed, open_ = make(num_envs, **settings), make(num_envs, **settings)
    for _ in range(2):
        assert_same(rollout(closed, 12), rollout(open_, 12))
        closed.close()
        assert closed.is_closed
    assert_same(closed.reset(), open_.reset())
    assert not closed.is_closed


@pytest.mark.parametrize("num_envs", [None, 3])
def test_moving_it_to_the_cpu_sets_the_device(num_envs):
    plain, moved = TransformedEnv(make(num_envs), StepCounter()), TransformedEnv(make(num_envs), StepCounter())
    assert moved.device is None
    assert moved.to("cpu") is moved
    cpu = torch.device("cpu")
    assert moved.device == moved.base_env.device == moved.base_env.base_env.device == cpu
    for spec in (moved.observation_spec, moved.full_action_spec, moved.full_reward_spec, moved.full_done_spec):
        assert spec.device == cpu
    td = rollout(moved)
    assert td.device == cpu
    assert_same(td, rollout(plain))
    check_env_specs(moved)
    with pytest.raises(ValueError, match=r"the task lives on cpu; build RoverEnv\(device='cuda'\) instead"):
        moved.to("cuda")


def test_a_collector_sets_the_device():
    env = make()
    for batch in Collector(env, None, frames_per_batch=12, total_frames=12, device="cpu"):
        assert batch.device == env.device == torch.device("cpu")


@pytest.mark.parametrize("device", ["cuda:99", "nonsense", torch.device("cuda", 99)])
def test_an_unavailable_device_is_refused_with_the_available_ones(device):
    message = rf"device='{device}' is not available: PyTorch \S+ finds cpu"
    for refuse in (available_device, lambda device: RoverEnv(device=device)):
        with pytest.raises(ValueError, match=message):
            refuse(device)


def make_vec():
    settings = {"world_n": "maze", "backend": "warp", "length": 5, "time_limit": "truncated"}
    settings |= {"vectorization_mode": "vector_entry_point", "autoreset_mode": AutoresetMode.DISABLED}
    return envs.GymWrapper(gymnasium.make_vec("rover_rl/Rover-v0", num_envs=3, **settings))


def test_torchrls_gym_wrapper_around_the_vector_environment_equals_the_native_environment():
    env, native = make_vec(), make(length=5)
    env.set_seed(0)
    # GymWrapper resets when it is seeded.
    native.reset()
    seen, expected = rollout(env), rollout(native)
    for key in OBSERVED:
        assert torch.equal(seen["next", key], expected["next", key]), key
    assert seen["next", "truncated"].any()
    for batch in Collector(env, None, frames_per_batch=15, total_frames=30):
        assert batch.shape == (3, 5)


def test_torchrls_gym_wrapper_reads_the_infos():
    env = make_vec().auto_register_info_dict()
    check_env_specs(env)
    td = rollout(env)
    assert td["next", "steps"][0].flatten().tolist() == [1, 2, 3, 4, 5] * 5
    assert td["next", "reward"].any()
