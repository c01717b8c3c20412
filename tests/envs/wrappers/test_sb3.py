"""The Stable-Baselines3 vector environment, ``SB3VecEnv``."""

from __future__ import annotations

import importlib
import sys

import numpy as np
import pytest

pytest.importorskip("stable_baselines3")

from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from rover_rl import RoverEnv as BatchedRoverEnv
from rover_rl.envs.config import TaskConfig
from rover_rl.envs.gym import RoverEnv
from rover_rl.envs.sb3 import SB3VecEnv

ROWS = 3


def make(rows: int = ROWS, length: int = 5, time_limit: str = "truncated", **kwargs) -> SB3VecEnv:
    env = BatchedRoverEnv(world_n="maze", num_envs=rows, length=length, seed=0, backend="warp")
    return SB3VecEnv(env, time_limit=time_limit, **kwargs)


@pytest.fixture(scope="module")
def shared():
    envs = make()
    yield envs
    envs.close()


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized.*")
def test_sb3_check_env():
    check_env(RoverEnv(world_n="maze"))


def test_it_equals_sb3s_vector_environment_of_single_rovers(shared):
    """Compares observations, rewards, dones and the infos of ended rows over several episodes."""

    def single():
        return RoverEnv(world_n="maze", length=5, time_limit="truncated", backend="warp")

    single_envs = DummyVecEnv([single] * ROWS)
    rng = np.random.default_rng(0)
    for envs in (shared, single_envs):
        envs.seed(7)
    np.testing.assert_equal(shared.reset(), dict(single_envs.reset()))
    for _ in range(12):
        actions = rng.uniform(-1, 1, (ROWS, 2)).astype(np.float32)
        ours, theirs = shared.step(actions), single_envs.step(actions)
        np.testing.assert_equal(ours[0], dict(theirs[0]))
        for a, b in zip(ours[1:3], theirs[1:3], strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)
        for row, (info, expected) in enumerate(zip(ours[3], theirs[3], strict=True)):
            np.testing.assert_equal(info, expected if ours[2][row] else {})
    single_envs.close()


@pytest.mark.parametrize(
    ("time_limit", "threshold"), [("truncated", 0.0), ("terminated", 1.48)], ids=["flip", "contract"]
)
def test_a_termination_in_the_last_step_is_no_time_limit(time_limit, threshold):
    settings = {"num_envs": ROWS, "length": 1, "seed": 0, "backend": "warp"}
    tilted = BatchedRoverEnv(world_n="moon", task=TaskConfig(flip_threshold=threshold), **settings)
    envs = SB3VecEnv(tilted, time_limit=time_limit)
    envs.reset()
    _, _, dones, infos = envs.step(np.zeros((ROWS, 2)))
    assert dones.all()
    assert not any(info["TimeLimit.truncated"] for info in infos)


def test_episodes_are_counted_by_vec_monitor(shared):
    monitored = VecMonitor(shared, info_keywords=("is_success",))
    monitored.reset()
    total = np.zeros(ROWS)
    for _ in range(5):
        _, rewards, _, infos = monitored.step(np.full((ROWS, 2), 0.3))
        total += rewards
    for row in range(ROWS):
        assert infos[row]["episode"]["l"] == 5
        assert infos[row]["episode"]["r"] == pytest.approx(total[row], rel=1e-5)
        assert infos[row]["episode"]["is_success"] in (True, False)


def test_seeds_and_options_apply_to_one_reset(shared):
    shared.seed(3)
    first, second = shared.reset(), shared.reset()
    shared.seed(3)
    np.testing.assert_equal(shared.reset(), first)
    assert (first["pose"] != second["pose"]).any()
    shared.set_options({"start": (0.0, 0.0, 0.5), "goal": (2.0, 0.0)})
    np.testing.assert_allclose(shared.reset()["target"], [(2.0, -0.5)] * ROWS, atol=1e-5)
    assert (shared.reset()["target"][:, 0] != 2.0).any()


def test_wrong_options_and_seeds_are_refused(shared):
    shared.set_options([{"goal": (2.0, 0.0)}, {}, {}])
    with pytest.raises(ValueError, match="every row must have the same options"):
        shared.reset()
    shared.set_options()
    shared.seed(-1)
    with pytest.raises(ValueError, match="seed must be a whole number from 0 to"):
        shared.reset()
    shared.seed(0)


def test_attributes_are_those_of_the_batched_environment(shared):
    assert shared.get_attr("length") == [5] * ROWS
    assert shared.get_attr("length", indices=1) == [5]
    assert shared.has_attr("config")
    assert not shared.has_attr("no_such_thing")
    shared.set_attr("length", 6)
    assert shared.base_env.length == 6
    shared.set_attr("length", 5)
    assert shared.env_method("extra_repr") == [shared.base_env.extra_repr()] * ROWS
    assert shared.env_is_wrapped(object) == [False] * ROWS
    with pytest.raises(ValueError, match="share one RoverEnv"):
        shared.set_attr("length", 6, indices=[0])
    with pytest.raises(ValueError, match="share one RoverEnv"):
        shared.env_method("extra_repr", indices=0)


def test_render_tiles_the_rows(tmp_path):
    envs = make(rows=2, render_mode="rgb_array")
    envs.reset()
    assert envs.render().shape == (480 * 2, 640, 3)


def test_a_missing_library_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "stable_baselines3.common.vec_env", None)
    monkeypatch.delitem(sys.modules, "rover_rl.envs.sb3")
    with pytest.raises(ImportError, match=r"pip install \"rover_rl\[sb3\]\""):
        importlib.import_module("rover_rl.envs.sb3")
