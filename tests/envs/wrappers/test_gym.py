"""The Gymnasium environment with one rover: ``rover_rl.envs.gym.RoverEnv`` and ``GymWrapper``."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from functools import partial
from types import SimpleNamespace as Message

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from torchrl.envs import CatTensors, TransformedEnv

from rover_rl import GymWrapper, RewardConfig, TaskConfig, contract_reward, make_env
from rover_rl import RoverEnv as BatchedRoverEnv
from rover_rl.envs.gym import RoverEnv
from tests.envs.contract.test_interface import ARGUMENTS, REWARD, TASK
from tests.envs.transcription import HeadingPid


@pytest.fixture(scope="module")
def shared():
    """One environment for tests that do not change it or that begin with a reset."""
    env = RoverEnv(world_n="maze", seed=0, render_mode="rgb_array")
    yield env
    env.close()


@pytest.fixture
def env(shared):
    shared.reset(seed=0)
    return shared


def make(**kwargs) -> RoverEnv:
    return RoverEnv(world_n="maze", seed=0, **kwargs)


def rollout(env, seed, steps, before_each_step=lambda: None):
    rng = np.random.default_rng(1)
    trace = [env.reset(seed=seed)]
    for _ in range(steps):
        before_each_step()
        trace.append(env.step(rng.uniform((-1, -math.pi), (1, math.pi)).astype(np.float32)))
        if trace[-1][2] or trace[-1][3]:
            trace.append(env.reset())
    return trace


# Constructor and spaces


def test_the_spaces_are_the_contracts(shared):
    def space(low, high):
        return gymnasium.spaces.Box(np.float32(low), np.float32(high), dtype=np.float32)

    pi = np.pi
    boxes = {"lidar": space(np.zeros(32), np.full(32, 12.0)), "pose": space([-30, -30, -10], [30, 30, 10])}
    boxes |= {"imu": space([-pi] * 3, [pi] * 3), "target": space([0, -pi], [100, pi])}
    boxes["velocities"] = space([-10, -10], [10, 10])
    assert shared.observation_space == gymnasium.spaces.Dict(boxes)
    assert shared.action_space == space([-1, -pi], [1, pi])


@pytest.mark.filterwarnings("ignore:.*we recommend using a symmetric and normalized space.*")
def test_gymnasium_check_env():
    env = gymnasium.make("rover_rl/Rover-v0", world_n="maze", render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*normalized space.*")
        check_env(env.unwrapped)


# Reset and step


def test_a_seed_reproduces_everything():
    env = make(length=7)
    first = rollout(env, 5, 30)
    np.testing.assert_equal(rollout(env, 5, 30), first)


def test_a_seed_gives_the_episode_of_the_batched_environment_and_no_seed_another_one(env):
    first, _ = env.reset(seed=11)
    expected = BatchedRoverEnv(world_n="maze", num_envs=3, seed=10).reset()
    for key, value in first.items():
        np.testing.assert_array_equal(value, expected[key][1])
    second, info = env.reset()
    assert info == {}
    assert (first["pose"] != second["pose"]).any()


def test_reset_takes_start_and_goal(env):
    observation, _ = env.reset(options={"start": (1.0, 2.0, 0.5), "goal": (3.0, 2.0)})
    np.testing.assert_allclose(observation["pose"][:2], (1, 2), atol=1e-5)
    np.testing.assert_allclose(observation["imu"][2], 0.5, atol=1e-5)
    np.testing.assert_allclose(observation["target"], (2.0, -0.5), atol=1e-5)
    assert (env.target_positions_x, env.target_positions_y) == (3.0, 2.0)


@pytest.mark.parametrize(
    ("method", "arguments", "message"),
    [
        ("reset", {"options": {"strat": (0, 0, 0)}}, "strat.*use 'start' and 'goal'"),
        ("reset", {"options": {"start": (0, 0)}}, "start must be"),
        ("reset", {"options": {"goal": (math.nan, 0)}}, "goal must be"),
        ("step", {"action": [1.0]}, r"action must have shape \(2,\)"),
        ("step", {"action": [[1.0, 0.0]]}, r"action must have shape \(2,\)"),
        ("step", {"action": 1.0}, r"action must have shape \(2,\)"),
    ],
)
def test_wrong_arguments_are_refused(env, method, arguments, message):
    with pytest.raises(ValueError, match=message):
        getattr(env, method)(**arguments)


def test_step_returns_the_types_of_gymnasium(env):
    observation, reward, terminated, truncated, info = env.step([1.0, 0.0])
    assert observation in env.observation_space
    assert type(reward) is float
    assert (terminated, truncated) == (False, False)
    assert (info["steps"], info["total_steps"], info["reward"]) == (1, 1, reward)
    assert all(type(value) in (int, float, bool) for value in info.values())


def test_observations_and_actions_are_copied(env):
    for call in (lambda: env.reset(seed=0)[0], lambda: env.step([0.5, 0.1])[0], env.get_observation):
        observation = call()
        kept = env.get_observation()
        for value in observation.values():
            value[:] = 77
        np.testing.assert_equal(env.get_observation(), kept)
    action = np.float32([0.3, 0.2])
    env.step(action)
    action[:] = math.nan
    env.step([0.3, 0.2])


def test_use_before_a_reset_and_after_close_raises():
    env = make(render_mode="rgb_array")
    for use in (env.get_observation, env.is_robot_flipped, lambda: env.step([0.0, 0.0])):
        with pytest.raises(RuntimeError, match="reset"):
            use()
    assert env.task_reward() == 0.0
    env.reset()
    env.close()
    env.close()
    for use in (env.reset, env.render, lambda: env.step([0.0, 0.0])):
        with pytest.raises(RuntimeError, match="closed"):
            use()


@pytest.mark.parametrize(("time_limit", "flags"), [("terminated", (True, False)), ("truncated", (False, True))])
def test_the_time_limit_sets_the_configured_flag_and_total_steps_continue(time_limit, flags):
    env = make(length=3, time_limit=time_limit)
    for episode in range(2):
        env.reset()
        for step in range(1, 4):
            *_, terminated, truncated, info = env.step([0.0, 0.0])
            assert (terminated, truncated) == (flags if step == 3 else (False, False))
            assert info["total_steps"] == env.total_steps == 3 * episode + step
            assert info["steps"] == env._step == step


@pytest.mark.parametrize("end_on_goal", [False, True])
def test_a_goal_pays_and_is_a_success_whether_the_episode_goes_on_or_ends(end_on_goal):
    env = make(end_on_goal=end_on_goal)
    env.reset(options={"start": (0.0, 0.0, 0.0), "goal": (0.6, 0.0)})
    for _ in range(20):
        observation, reward, ended, _, info = env.step([1.0, 0.0])
        if info["goal_reached"]:
            break
    assert (reward, ended, info["goals"], info["is_success"]) == (100.0, end_on_goal, 1, True)
    if not end_on_goal:
        assert observation["target"][0] >= 0.5
        assert env.step([0.0, 0.0])[4]["is_success"]


# The contract's methods


def test_observation_and_state_are_those_of_the_step(env):
    for act in (lambda: env.reset(seed=1)[0], lambda: env.step([0.6, 0.3])[0]):
        observation = act()
        np.testing.assert_equal(env.get_observation(), observation)
        velocities = env.current_linear_velocity, env.current_angular_velocity
        state = {
            "lidar": env.lidar_data,
            "pose": env.rover_position,
            "imu": np.float32([env.current_pitch, env.current_roll, env.current_yaw]),
            "target": env.get_target_info(),
            "velocities": np.float32(velocities),
        }
        np.testing.assert_equal(state, observation)


def test_methods_that_ask_for_something_have_no_side_effects(env):
    def ask():
        env.heading_controller(1.0, -1.0)
        rewards.append((env.task_reward(), env.task_reward()))

    rewards = []
    expected = rollout(env, 4, 10)
    np.testing.assert_equal(rollout(env, 4, 10, before_each_step=ask), expected)
    assert rewards == [(0.0, 0.0), *((step[1], step[1]) for step in expected[1:-1])]


@pytest.mark.parametrize(
    ("roll", "pitch", "expected"),
    [
        (1.5, 0, "roll_left"),
        (-1.5, 0, "roll_right"),
        (0, -1.5, "pitch_forward"),
        (0, 1.5, "pitch_backward"),
        (0.9, 0, False),
    ],
)
def test_flips_are_named(env, monkeypatch, roll, pitch, expected):
    config = replace(env.base_env.config, task=TaskConfig(flip_threshold=1.0))
    monkeypatch.setattr(env.base_env, "config", config)
    orientation = torch.tensor([[math.sin(roll / 2), math.sin(pitch / 2), 0.0, math.cos((abs(roll) + abs(pitch)) / 2)]])
    monkeypatch.setattr(BatchedRoverEnv, "rover_state", Message(orientation=orientation))
    assert env.current_roll == pytest.approx(roll, abs=1e-5)
    assert env.current_pitch == pytest.approx(pitch, abs=1e-5)
    assert env.is_robot_flipped() == expected


def test_heading_controller_is_the_contracts_pid(env):
    for desired, current in [(0.3, 0.0), (-0.2, 0.1), (3.0, -3.0), (math.pi, 0.0), (0.0, 0.0)]:
        assert env.heading_controller(desired, current) == pytest.approx(HeadingPid()(desired, current), abs=1e-4)
    env.step([0.0, 0.2])
    pid = HeadingPid()
    pid(0.2, 0.0)
    assert env.heading_controller(0.5, 0.0) == pytest.approx(pid(0.5, 0.0), abs=1e-4)
    assert type(env.heading_controller(np.float32(0.1), 0)) is float


@pytest.mark.parametrize(("x", "y", "outside"), [(30, 0, False), (30.1, 0, True), (0, -30.1, True)])
def test_too_far_away_is_outside_of_the_worlds_bounds(env, monkeypatch, x, y, outside):
    monkeypatch.setattr(BatchedRoverEnv, "rover_state", Message(position=torch.tensor([[x, y, 0.0]])))
    assert env.too_far_away() is outside


def test_render_returns_an_image(env):
    image = env.render()
    assert image.shape == (480, 640, 3)
    assert image.dtype == np.uint8
    assert image.std() > 0


def test_gymnasium_shows_it_in_a_window(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame", reason="needs rover_rl[human]")
    human = gymnasium.make("rover_rl/Rover-v0", world_n="maze", render_mode="human")
    human.reset(seed=0)
    assert pygame.display.get_surface().get_size() == (640, 480)
    human.close()


def test_attributes_have_the_names_of_the_original_environment(env):
    expected = {name: ARGUMENTS[name] for name in ("size", "length", "lidar_points", "max_lidar_range")}
    expected |= {"_length": 2000, "world_n": "maze"}
    for axis in "xy":
        expected |= {f"rand_{axis}_range": (-4, 4), f"rand_goal_{axis}_range": (-4, 4)}
        expected |= {f"too_far_away_low_{axis}": -30, f"too_far_away_high_{axis}": 30}
    expected |= {"too_far_away_penilty": -10.0, "stuck_penilty": -25.0, "general_penility": -20.0}
    rewarded = ("goal_reward", "distance_delta_scale", "final_reward_multiplier", "collision_penalty")
    expected |= {name: REWARD[name] for name in rewarded}
    thresholds = ("success_distance", "collision_threshold", "collision_window", "stuck_window", "stuck_threshold")
    expected |= {name: TASK[name] for name in thresholds}
    assert {name: getattr(env, name) for name in expected} == expected


def test_callbacks_pass_messages_to_a_live_backend_alone(env, monkeypatch):
    callbacks = {"scan": env.lidar_callback, "imu": env.imu_callback, "pose": env.pose_array_callback}
    callbacks["odometry"] = env.odom_callback
    for callback in callbacks.values():
        with pytest.raises(RuntimeError, match="makes its own sensor data; callbacks are for backend='ros2'"):
            callback(Message())
    received = {}
    monkeypatch.setattr(env.base_env.simulator, "receive", received.__setitem__, raising=False)
    for kind, callback in callbacks.items():
        callback(kind)
    assert received == {kind: kind for kind in callbacks}


# Wrapped environments and rewards


flat = partial(BatchedRoverEnv, world_n="maze", backend="warp")


@pytest.mark.parametrize(
    ("make_inner", "options", "error", "message"),
    [
        (object, {}, TypeError, r"rover_rl\.RoverEnv.* is needed; got object"),
        (lambda: flat(num_envs=2), {}, ValueError, "num_envs=2; use GymVectorWrapper"),
        (lambda: make_env(world="maze", num_envs=1), {"reward": "contract"}, ValueError, "has its reward already"),
        (lambda: TransformedEnv(flat(), CatTensors(["imu"], "vector")), {}, ValueError, r"lacks \['imu'\]"),
        (flat, {"time_limit": "never"}, ValueError, "time_limit must be one of .* got 'never'"),
        (flat, {"render_mode": "film"}, ValueError, "render_mode must be one of .* got 'film'"),
        (flat, {"camera": "left"}, ValueError, "camera must be one of .* got 'left'"),
        (flat, {"action_repeat": 0}, ValueError, "repeat must be at least 1 step, got 0"),
        (flat, {"reward_scale": 0.0}, ValueError, "reward_scale"),
        (flat, {"reward_scal": 0.1}, TypeError, "unexpected keyword argument 'reward_scal'"),
    ],
)
def test_other_environments_and_options_are_refused(make_inner, options, error, message):
    with pytest.raises(error, match=message):
        GymWrapper(make_inner(), **options)


def rewards_of(wrapper):
    wrapper.reset(seed=0)
    return [wrapper.step([0.8, 0.4])[1] for _ in range(4)]


def test_wrapping_make_env_equals_wrapping_the_bare_environment(env):
    expected = rewards_of(env)
    wrapped = GymWrapper(make_env(world_n="maze"))
    assert rewards_of(wrapped) == expected
    with pytest.raises(AttributeError, match="bare RoverEnv"):
        wrapped.stuck_penilty  # noqa: B018


def test_the_reward_can_be_chosen(env):
    contract = rewards_of(env)
    assert rewards_of(make(reward="task")) == [0.0] * 4
    configured = make(reward=RewardConfig(idle_penalty=-1.0, min_progress=1e9, velocity_scale=0.0, turn_scale=0.0))
    assert rewards_of(configured) == [-1.5] * 4 != contract
    assert configured.distance_delta_scale == 0.3
    assert rewards_of(make(reward=contract_reward())) == contract
