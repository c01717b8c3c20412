"""A group of rovers as a ``ParallelEnv`` of PettingZoo."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from rover_rl import RoverEnv, Terrain, World
from tests.extras import needs_pettingzoo

FLAT = World("flat", Terrain.flat((24.0, 24.0)))


def make(num_envs: int = 3, agents: int = 3, options: dict | None = None, **settings):
    from rover_rl.envs.wrappers.pettingzoo import RoverParallelEnv

    defaults = {"world_n": FLAT, "backend": "warp", "lidar_beams": 64, "seed": 0}
    env = RoverEnv(num_envs=num_envs, agents=agents, **{**defaults, **settings})
    return RoverParallelEnv(env, **(options or {}))


@needs_pettingzoo
@pytest.mark.filterwarnings("error::UserWarning")
def test_it_passes_the_test_of_pettingzoo() -> None:
    from pettingzoo.test import parallel_api_test

    parallel_api_test(make(length=40, end_on_goal=True), num_cycles=100)


@needs_pettingzoo
def test_seeds_repeat_and_rovers_leave_when_they_are_done() -> None:
    env = make(length=30, end_on_goal=True)
    places = {
        "start": np.array([[0.0, 0, 0], [0.0, 4.0, 0], [0.0, -4.0, 0]]),
        "goal": np.array([[6.0, 0], [0.55, 4.0], [6, -4]]),
    }
    first, _ = env.reset(seed=3)
    again, _ = env.reset(seed=3)
    assert all(np.array_equal(first[agent]["lidar"], again[agent]["lidar"]) for agent in env.possible_agents)
    env.reset(options=places)
    sizes = []
    while env.agents:
        driving = env.agents
        observations, rewards, terminated, truncated, infos = env.step({agent: [1.0, 0.0] for agent in driving})
        assert [*observations] == [*rewards] == [*terminated] == [*truncated] == [*infos] == driving
        if terminated.get("rover_1"):
            assert infos["rover_1"]["is_success"]
            assert rewards["rover_1"] > 50
        sizes.append(len(env.agents))
    assert sizes[0] == 3
    assert 2 in sizes
    assert len(sizes) == 30
    assert all(truncated.values())
    assert env.step({}) == ({}, {}, {}, {}, {})


@needs_pettingzoo
def test_wrong_use_is_told() -> None:
    with pytest.raises(ValueError, match="one group, got num_envs=6 and agents=3"):
        make(6, 3)
    env = make()
    env.reset()
    with pytest.raises(ValueError, match=r"each agent needs an action, \['rover_1', 'rover_2'\] have none"):
        env.step({"rover_0": [1.0, 0.0]})
    with pytest.raises(ValueError, match="the action of 'rover_0' must have shape"):
        env.step({agent: [1.0] for agent in env.agents})


def test_without_pettingzoo_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pettingzoo", None)
    monkeypatch.delitem(sys.modules, "rover_rl.envs.wrappers.pettingzoo", raising=False)
    with pytest.raises(ImportError, match="multiagent"):
        import rover_rl.envs.wrappers.pettingzoo  # noqa: F401
