"""The vector environment of rsl_rl, with a stand-in for the library's base class and its runner's calls."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

import pytest
import torch

from rover_rl import RoverEnv, TaskConfig, make_env
from rover_rl.envs.transforms.action_repeat import ActionRepeat

ROWS = 3
OPTIONS = {"action_repeat": 4, "reward_scale": 0.05, "scale_observations": True}


@pytest.fixture
def adapter(monkeypatch: pytest.MonkeyPatch):
    """The class, on a base class without behavior, as that of rsl_rl is."""
    library, package = ModuleType("rsl_rl.env"), ModuleType("rsl_rl")
    library.VecEnv = type("VecEnv", (), {})
    monkeypatch.setitem(sys.modules, "rsl_rl", package)
    monkeypatch.setitem(sys.modules, "rsl_rl.env", library)
    monkeypatch.delitem(sys.modules, "rover_rl.envs.wrappers.rsl_rl", raising=False)
    yield importlib.import_module("rover_rl.envs.wrappers.rsl_rl").RslRlVecEnv
    sys.modules.pop("rover_rl.envs.wrappers.rsl_rl", None)


def make(adapter, length: int = 40, **kwargs):
    return adapter(RoverEnv(world_n="maze", num_envs=ROWS, length=length, seed=0, backend="warp", **kwargs), **OPTIONS)


def test_it_equals_the_environment_with_transforms(adapter) -> None:
    ending = {"task": TaskConfig(success_distance=2.0), "end_on_goal": True}
    envs = make(adapter, **ending)
    same = make_env(world_n="maze", num_envs=ROWS, length=40, seed=0, backend="warp", **ending)
    same = same.append_transform(ActionRepeat(4))
    root, generator, ended = same.reset(), torch.Generator().manual_seed(0), 0
    for _ in range(25):
        actions = torch.rand(ROWS, 2, generator=generator) * 2 - 1
        step, root = same.step_and_maybe_reset(root.set("action", actions))
        observations, rewards, dones, extras = envs.step(actions)
        torch.testing.assert_close(rewards, 0.05 * step["next", "reward"].squeeze(-1))
        assert dones.tolist() == step["next", "done"].squeeze(-1).tolist()
        assert extras["time_outs"].tolist() == step["next", "truncated"].squeeze(-1).tolist()
        assert ("log" in extras) == bool(dones.any())
        for key in ("lidar", "target"):
            torch.testing.assert_close(observations[key], root[key], rtol=0, atol=0)
        ended += int(dones.sum())
    assert ended > ROWS


def test_groups_are_the_entries_and_the_vector(adapter) -> None:
    envs = make(adapter)
    observations = envs.get_observations()
    assert {"lidar", "imu", "target", "velocities", "pose", "observation"} == set(observations.keys())
    assert observations["observation"].shape == (ROWS, 41)
    assert (envs.num_envs, envs.num_actions, envs.max_episode_length) == (ROWS, 2, 10)


def test_a_runner_may_begin_at_random_lengths(adapter) -> None:
    """Rows end when their counter reaches the maximum, as a time limit."""
    envs = make(adapter)
    envs.episode_length_buf = torch.tensor([9, 0, 7])
    dones = [envs.step(torch.zeros(ROWS, 2))[2:] for _ in range(3)]
    assert [done.tolist() for done, _ in dones] == [[True, False, False], [False, False, False], [False, False, True]]
    assert dones[0][1]["time_outs"].tolist() == [True, False, False]
    assert envs.episode_length_buf.tolist() == [2, 3, 0]


def test_it_runs_in_inference_mode_and_after_it(adapter) -> None:
    """The runner collects in inference mode, whose tensors cannot be changed outside of it."""
    envs = make(adapter, length=8)
    with torch.inference_mode():
        for _ in range(5):
            envs.step(torch.full((ROWS, 2), 5.0))
    envs.step(torch.zeros(ROWS, 2))
    observations, _ = envs.reset()
    assert torch.isfinite(observations["observation"]).all()
    assert envs.episode_length_buf.tolist() == [0] * ROWS


def test_observations_do_not_change_later(adapter) -> None:
    envs = make(adapter)
    before = envs.get_observations()
    copy = before.clone()
    envs.step(torch.ones(ROWS, 2))
    assert (before == copy).all()


def test_a_batch_is_needed(adapter) -> None:
    with pytest.raises(ValueError, match="rsl_rl needs a batch of rovers"):
        adapter(RoverEnv(world_n="maze", num_envs=None))


def test_without_the_library_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rsl_rl.env", None)
    monkeypatch.delitem(sys.modules, "rover_rl.envs.wrappers.rsl_rl", raising=False)
    with pytest.raises(ImportError, match="pip install rsl-rl-lib"):
        importlib.import_module("rover_rl.envs.wrappers.rsl_rl")
