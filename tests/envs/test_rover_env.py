"""RoverEnv: custom worlds and robots, starts and goals, seeding, input validation, closing."""

from __future__ import annotations

import copy
import pickle
import warnings

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from rover_rl import GymWrapper, RoverEnv, Terrain, World, make_env
from tests.extras import needs_mujoco
from tests.traced import files_that

FLAT = World("flat", Terrain.flat((20, 20)), spawn_range=((-3, 3), (-3, 3)))


@pytest.fixture(scope="module")
def env():
    return RoverEnv(world_n="maze", num_envs=3, seed=0, backend="warp", lidar_beams=32)


def test_a_step_passes_few_files():
    env = make_env(world="moon", backend="warp", num_envs=2, seed=0)
    td = env.rand_action(env.reset())
    files = files_that(lambda: env.step(td))
    assert "envs/rover.py" in files
    assert len(files) <= 12, sorted(files)


def test_reset_takes_start_and_goal_as_arguments_and_through_transforms():
    start = torch.tensor([[0.5, 0.5, 1.0], [-2.0, 3.0, -1.0]])
    goal = torch.tensor([[3.0, 3.0], [1.0, -1.0]])
    for env in (make_env(world_n=FLAT, num_envs=2, lidar_beams=32), RoverEnv(world_n=FLAT, num_envs=2)):
        td = env.reset(start=start, goal=goal)
        torch.testing.assert_close(td["pose"][:, :2], start[:, :2], atol=1e-3, rtol=0)
        torch.testing.assert_close(td["imu"][:, 2], start[:, 2], atol=1e-3, rtol=0)
        torch.testing.assert_close(td["target"][:, 0], (goal - start[:, :2]).norm(dim=-1), atol=1e-3, rtol=0)
    td = env.reset(TensorDict({"start": start, "goal": goal}, batch_size=[2]))
    torch.testing.assert_close(td["pose"][:, :2], start[:, :2], atol=1e-3, rtol=0)


def test_render_returns_an_image(env):
    env.reset()
    assert env.render(row=2, view="top", width=40, height=30).shape == (30, 40, 3)
    with pytest.raises(ValueError, match="row must be between 0 and 2, got 3"):
        env.render(row=3)


def test_none_draws_a_random_seed_and_the_global_generators_are_not_used():
    state, numpy_state = torch.random.get_rng_state(), np.random.get_state()[1].copy()
    a, b = (RoverEnv(world_n="maze", backend="warp", lidar_beams=32) for _ in range(2))
    assert not torch.equal(a.reset()["pose"], b.reset()["pose"])
    a.step(a.reset().set("action", torch.zeros(1, 2)))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert (np.random.get_state()[1] == numpy_state).all()


@pytest.mark.parametrize(
    "settings",
    [
        {"backend": "bullet", "world_n": "maze:0-99"},
        pytest.param({"backend": "mujoco", "world_n": "maze+walkers"}, marks=needs_mujoco),
        {"backend": "warp", "world_n": "maze:0-99", "sensors": ["route", "past_scans"]},
        {"backend": "warp", "agents": 2},
    ],
    ids=str,
)
def test_a_seed_begins_anew_after_any_history_as_a_fresh_environment_does(settings):
    def make(seed: int):
        return make_env(**{"world_n": "maze", "num_envs": 2, "seed": seed, "length": 3, **settings})

    def drive(env) -> TensorDict:
        action = torch.tensor([[0.5, 1.0], [-1.0, 0.2]])
        return env.rollout(5, lambda td: td.set("action", action), break_when_any_done=False)

    fresh, env = drive(make(5)), make(77)
    drive(env)
    env.set_seed(5)
    again = drive(env)
    for key, value in fresh.items(True, True):
        assert torch.equal(again[key], value), key


def test_copies_are_refused_with_what_helps():
    env = make_env(world_n="maze", num_envs=1, seed=3, backend="warp")
    gym_env = GymWrapper(RoverEnv(world_n="maze", seed=3, backend="warp"))
    for given in (env, env.base_env, gym_env):
        for make_copy in (copy.deepcopy, pickle.dumps):
            with pytest.raises(TypeError, match=r"environment cannot be copied .* make_env\(env.config\)"):
                make_copy(given)
    twin = make_env(env.config)
    assert torch.equal(twin.reset()["pose"], env.reset()["pose"])
    assert twin.reward_keys == env.reward_keys


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"world_n": "mars"}, "unknown world 'mars'.*inspect.*maze.*moon"),
        ({"backend": "unity"}, "unknown backend 'unity'.*bullet"),
        ({"robot": "tank"}, "unknown robot 'tank'.*rover_zero"),
        ({"num_envs": 0}, "num_envs must be a whole number of at least 1 and at most 1000000, got 0"),
        ({"length": 0}, "length must be a whole number of at least 1 and at most 1000000000000, got 0"),
        ({"lidar_beams": 16}, "lidar_beams must be at least lidar_points, got 16 beams for 32 points"),
        ({"lidar_points": 0}, "lidar_points must be at least 1, got 0"),
        ({"max_lidar_range": 0.0}, "max_lidar_range must be a positive number"),
        ({"world_n": ["maze", "moon"]}, "between 1 and num_envs=1 worlds, got 2"),
        ({"world_n": []}, "between 1 and num_envs=1 worlds, got 0"),
    ],
)
def test_invalid_settings_are_refused_with_a_message(settings, message):
    with pytest.raises(ValueError, match=message):
        RoverEnv(**{"world_n": "maze", **settings})


def test_actions_and_starts_that_are_not_finite_or_of_another_shape_are_refused(env):
    td = env.reset()
    for value in (float("nan"), float("inf")):
        action = torch.zeros(3, 2)
        action[1, 0] = value
        with pytest.raises(ValueError, match=r"finite numbers.*rows \[1\]"):
            env.step(td.set("action", action))
    with pytest.raises(ValueError, match=r"action must have shape \(3, 2\), got \(3, 3\)"):
        env.step(td.set("action", torch.zeros(3, 3)))
    with pytest.raises(ValueError, match=r"start must be finite numbers of shape \(3, 3\), got shape \(3, 2\)"):
        env.reset(start=torch.zeros(3, 2))
    for places in ({"start": torch.full((3, 3), torch.nan)}, {"goal": torch.zeros(2, 2)}):
        with pytest.raises(ValueError, match=f"{next(iter(places))} must be finite"):
            env.reset(**places)


def test_stepping_before_reset_and_after_close_is_refused_and_a_reset_builds_another_simulator():
    env = RoverEnv(world_n="maze", lidar_beams=32)
    first, td = env.simulator, TensorDict({"action": torch.zeros(1, 2)}, batch_size=[1])
    with pytest.raises(RuntimeError, match=r"call reset\(\) first"):
        env.step(td)
    env.reset()
    env.close()
    env.close()
    assert env.simulator is first
    for name, call in (("step", lambda: env.step(td)), ("render", env.render)):
        with pytest.raises(RuntimeError, match=rf"{name}\(\) was called on a closed RoverEnv; call reset\(\) first"):
            call()
    env.reset()
    assert env.simulator is not first
    assert env.render(width=8, height=8).shape == (8, 8, 3)
    env.step(td)
    env.close()


def test_a_world_in_which_pose_is_clipped_is_told():
    far = World("far", Terrain.flat((90, 20)), spawn_range=((-3, 3), (-3, 3)))
    with pytest.warns(UserWarning, match="'far' reaches 45 m from the origin, and .* clipped at 30 m"):
        RoverEnv(world_n=far, backend="warp").close()
    near = World("near", far.terrain, spawn_range=far.spawn_range, bounds=((-30, 30), (-10, 10)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        RoverEnv(world_n=near, backend="warp").close()


@pytest.mark.parametrize("world", ["inspect", "moon"])
def test_rovers_stand_still_and_clear_of_obstacles_after_a_reset(world: str) -> None:
    env = RoverEnv(world_n=world, num_envs=8, seed=11, lidar_beams=32)
    td = env.reset()
    assert (td["lidar"] >= 0.4).all()
    before = td["pose"].clone()
    for _ in range(10):
        td = env.step(td.set("action", torch.zeros(8, 2)))["next"]
        assert not td["done"].any()
        assert not td["outcome", "collision"].any()
    assert (td["pose"] - before).norm(dim=-1).max() < 0.02
