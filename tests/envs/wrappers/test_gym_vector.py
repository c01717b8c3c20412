"""The Gymnasium vector environment, ``GymVectorWrapper``."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from torchrl.envs import RewardSum

from rover_rl import GymVectorWrapper, TaskConfig, make_env
from rover_rl import RoverEnv as BatchedRoverEnv
from rover_rl.envs.gym import RoverEnv

ROWS = 3
# Episodes that end at a goal, at different times in different rows, and episodes that end together at a time limit.
ENDING_APART = {"length": 12, "end_on_goal": True, "task": TaskConfig(success_distance=2.5)}
ENDING_TOGETHER = {"length": 3}


def native(mode=AutoresetMode.NEXT_STEP, rows=ROWS, time_limit="terminated", **kwargs) -> GymVectorWrapper:
    env = BatchedRoverEnv(world_n="maze", num_envs=rows, seed=0, backend="warp", **kwargs)
    return GymVectorWrapper(env, autoreset_mode=mode, time_limit=time_limit)


def one_by_one(mode, time_limit="terminated", **kwargs) -> SyncVectorEnv:
    def make():
        return RoverEnv(world_n="maze", seed=0, time_limit=time_limit, backend="warp", **kwargs)

    return SyncVectorEnv([make] * ROWS, autoreset_mode=mode)


@pytest.fixture(scope="module")
def shared():
    envs = native(length=5)
    yield envs
    envs.close()


@pytest.fixture
def envs(shared):
    shared.reset(seed=0)
    return shared


def actions(rng) -> np.ndarray:
    return rng.uniform((-1, -math.pi), (1, math.pi), (ROWS, 2)).astype(np.float32)


def trace(envs, seed, steps):
    rng = np.random.default_rng(seed)
    results = [envs.reset(seed=seed)]
    for _ in range(steps):
        results.append(envs.step(actions(rng)))
        ended = results[-1][2] | results[-1][3]
        if envs.metadata["autoreset_mode"] is AutoresetMode.DISABLED and ended.any():
            results.append(envs.reset(options={"reset_mask": ended}))
    return results


def endings(results) -> np.ndarray:
    return np.array([result[2] | result[3] for result in results if len(result) == 5])


def assert_same(a, b):
    """Asserts equality of values bit for bit, of shapes and of types."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, (tuple, list)):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif isinstance(a, np.ndarray) and a.dtype == object:
        assert_same(list(a), list(b))
    else:
        np.testing.assert_array_equal(a, b, strict=isinstance(a, np.ndarray))


def without_reward(results):
    """``results`` without the reward in their infos."""
    for *_, infos in results:
        for info in (infos, infos.get("final_info", {})):
            info.pop("reward", None)
            info.pop("_reward", None)
    return results


@pytest.mark.parametrize(
    ("mode", "settings"),
    [*((mode, ENDING_APART) for mode in AutoresetMode), (AutoresetMode.NEXT_STEP, ENDING_TOGETHER)],
)
def test_it_equals_gymnasiums_vector_environment_of_single_rovers(mode, settings):
    """Compares observations, rewards, flags and infos (except the reward) over several episodes and two seeds."""
    time_limit = "truncated" if mode is AutoresetMode.SAME_STEP else "terminated"
    batch, single = native(mode, time_limit=time_limit, **settings), one_by_one(mode, time_limit, **settings)
    for name in ("num_envs", "observation_space", "action_space", "single_observation_space", "single_action_space"):
        assert getattr(batch, name) == getattr(single, name)
    for seed in (7, 100):
        ours, theirs = trace(batch, seed, 30), trace(single, seed, 30)
        assert_same(ours, without_reward(theirs))
        ended = endings(ours)
        assert (ended.sum(0) >= 2).all()
        assert (ended.any(1) & ~ended.all(1)).any() == (settings is ENDING_APART)


def test_disabled_requires_a_reset_of_ended_rows():
    envs = native(AutoresetMode.DISABLED, length=2)
    envs.reset(seed=0)
    for _ in range(2):
        envs.step(np.zeros((ROWS, 2)))
    with pytest.raises(RuntimeError, match=r"rows \[0, 1, 2\] have ended"):
        envs.step(np.zeros((ROWS, 2)))
    envs.reset(**some_rows(True, True, False))
    with pytest.raises(RuntimeError, match=r"rows \[2\] have ended"):
        envs.step(np.zeros((ROWS, 2)))


def test_a_partial_reset_leaves_other_rows_unchanged(envs):
    before = envs.step(np.full((ROWS, 2), 0.5))[0]
    after, _ = envs.reset(**some_rows(False, True, False))
    for key in before:
        np.testing.assert_array_equal(before[key][[0, 2]], after[key][[0, 2]])
    assert (before["pose"][1] != after["pose"][1]).any()


def some_rows(*rows: bool) -> dict:
    return {"options": {"reset_mask": np.array(rows)}}


@pytest.mark.parametrize(
    ("method", "arguments", "message"),
    [
        ("reset", {"options": {"reset_mask": np.zeros(ROWS, bool)}}, "reset_mask must be 3 bools"),
        ("reset", {"options": {"reset_mask": np.ones(ROWS)}}, "reset_mask must be 3 bools"),
        ("reset", {"seed": [4, 6, 8]}, "seeds must be 3 numbers that count on"),
        ("reset", {"seed": [None, 1, 2]}, "seeds must be 3 numbers that count on"),
        ("reset", {"seed": 1, **some_rows(True, False, False)}, "a seed is for all rows"),
        ("step", {"actions": np.zeros((2, ROWS))}, r"actions must have shape \(3, 2\)"),
    ],
)
def test_wrong_arguments_are_refused(envs, method, arguments, message):
    with pytest.raises(ValueError, match=message):
        getattr(envs, method)(**arguments)


def test_step_and_a_partial_reset_need_a_reset():
    envs = native()
    for use in (lambda: envs.step(np.zeros((ROWS, 2))), lambda: envs.reset(**some_rows(True, False, False))):
        with pytest.raises(RuntimeError, match="reset"):
            use()


def test_seeds_can_be_a_list_and_starts_differ_by_row(envs):
    assert_same(envs.reset(seed=[4, 5, 6]), envs.reset(seed=4))
    start = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 0.5], [0.0, 0.0, 1.0]])
    observation, _ = envs.reset(seed=[None] * ROWS, options={"start": start})
    np.testing.assert_allclose(observation["pose"][:, :2], start[:, :2], atol=1e-5)


def test_returned_arrays_are_copies(envs):
    first = envs.step(np.full((ROWS, 2), 0.3))
    kept = envs._batch.observation()
    for value in (*first[0].values(), *first[1:4], *first[4].values()):
        value[...] = 1
    assert_same(envs._batch.observation(), kept)
    assert envs.step(np.full((ROWS, 2), 0.3))[4]["steps"].tolist() == [2] * ROWS


def test_stateful_transforms_are_reset_by_row():
    """Compares TorchRL's ``RewardSum`` with a sum computed here."""
    inner = make_env(world_n="maze", num_envs=ROWS, **ENDING_APART)
    inner.append_transform(RewardSum(in_keys=["reward"], out_keys=["sum"]))
    envs = GymVectorWrapper(inner, autoreset_mode="SameStep")
    envs.reset(seed=7)
    rng = np.random.default_rng(0)
    total, ended_once = np.zeros(ROWS), False
    for _ in range(30):
        _, reward, terminated, truncated, _ = envs.step(actions(rng))
        ended = terminated | truncated
        total = np.where(ended, 0.0, total + reward)
        ended_once |= bool(ended.any())
        np.testing.assert_allclose(envs._batch._root["sum"][:, 0], total, rtol=1e-4, atol=1e-5)
    assert ended_once


def test_render_returns_an_image_per_row():
    envs = GymVectorWrapper(BatchedRoverEnv(world_n="maze", num_envs=2), render_mode="rgb_array")
    envs.reset(seed=0)
    images = envs.render()
    assert [image.shape for image in images] == [(480, 640, 3)] * 2
    assert (images[0] != images[1]).any()


def test_make_vec_builds_it():
    options = {"world_n": "maze", "length": 3, "time_limit": "truncated", "autoreset_mode": "SameStep"}
    envs = gymnasium.make_vec("rover_rl/Rover-v0", 4, "vector_entry_point", **options)
    assert isinstance(envs, GymVectorWrapper)
    assert envs.spec.id == "rover_rl/Rover-v0"
    statistics = RecordEpisodeStatistics(envs)
    statistics.reset(seed=0)
    for _ in range(3):
        _, _, terminated, truncated, infos = statistics.step(envs.action_space.sample())
    assert truncated.all()
    assert not terminated.any()
    assert infos["episode"]["l"].tolist() == [3] * 4


@pytest.mark.parametrize(
    ("mode", "settings"),
    [
        (AutoresetMode.NEXT_STEP, {"time_limit": "truncated"}),
        (AutoresetMode.NEXT_STEP, {"length": 4}),
        (AutoresetMode.SAME_STEP, ENDING_APART),
        (AutoresetMode.SAME_STEP, {"action_repeat": 2}),
    ],
)
def test_max_episode_steps_truncates_as_one_by_one(mode, settings):
    settings = {"world_n": "maze", "seed": 0, "backend": "warp", "max_episode_steps": 4, **settings}
    settings["disable_env_checker"] = True
    apart = gymnasium.make_vec("rover_rl/Rover-v0", ROWS, "sync", {"autoreset_mode": mode}, **settings)
    envs = gymnasium.make_vec("rover_rl/Rover-v0", ROWS, "vector_entry_point", autoreset_mode=mode, **settings)
    apart.reset(seed=[0, 1, 2]), envs.reset(seed=[0, 1, 2])
    actions, ended = np.full((ROWS, 2), (1.0, 0.1), np.float32), np.zeros(ROWS, np.bool_)
    for _ in range(11):
        step, expected = envs.step(actions), apart.step(actions)
        np.testing.assert_equal(step[0], expected[0])
        np.testing.assert_equal(step[2:4], expected[2:4])
        ended |= step[3]
    assert ended.any()


def test_max_episode_steps_is_a_count_and_minus_one_is_none():
    for given, truncated in ((np.int64(1), True), (-1, False), (None, False)):
        envs = gymnasium.make_vec("rover_rl/Rover-v0", 1, max_episode_steps=given, world_n="maze", backend="warp")
        envs.reset(seed=0)
        assert envs.step(np.zeros((1, 2)))[3].tolist() == [truncated]
    with pytest.raises(ValueError, match="max_episode_steps must be a whole number of at least 1"):
        GymVectorWrapper(BatchedRoverEnv(world_n="maze", backend="warp"), max_episode_steps=0)
