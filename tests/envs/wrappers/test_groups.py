"""Groups of rovers as a multi-agent environment of TorchRL, and as a ``ParallelEnv`` of PettingZoo."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import RewardSum, StepCounter
from torchrl.envs.utils import check_env_specs

from rover_rl import RoverEnv, Terrain, World, make_env
from rover_rl.envs.wrappers.groups import GroupedRovers
from tests.extras import needs_pettingzoo

FLAT = World("flat", Terrain.flat((24.0, 24.0)))


def make(num_envs: int = 6, agents: int = 3, **settings) -> RoverEnv:
    defaults = {"world": FLAT, "backend": "warp", "lidar_beams": 64, "seed": 0}
    return make_env(num_envs=num_envs, agents=agents, **{**defaults, **settings})


@pytest.mark.parametrize("done_on_any", [False, True])
def test_specs_match(done_on_any: bool) -> None:
    check_env_specs(GroupedRovers(make(), done_on_any))
    check_env_specs(GroupedRovers(RoverEnv(world_n=FLAT, backend="warp", num_envs=4, agents=2), done_on_any))


def test_entries_of_rovers_are_in_groups() -> None:
    env = GroupedRovers(make())
    assert env.group_map == {"rovers": ["rover_0", "rover_1", "rover_2"]}
    assert (env.batch_size, env.agents) == (torch.Size([2]), 3)
    td = env.rollout(4)
    assert td["rovers", "lidar"].shape == (2, 4, 3, 32)
    assert td["rovers", "action"].shape == (2, 4, 3, 2)
    assert td["next", "rovers", "reward"].shape == (2, 4, 3, 1)
    assert td["next", "rovers", "terminated"].shape == (2, 4, 3, 1)
    assert td["next", "rovers", "outcome", "mover_distance"].shape == (2, 4, 3, 1)
    assert td["next", "done"].shape == (2, 4, 1)
    assert td["rovers", "mask"].all()


def test_values_are_those_of_the_rows() -> None:
    rows, groups = make(), GroupedRovers(make())
    td, grouped = rows.reset(), groups.reset()
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        action = 2 * torch.rand(6, 2, generator=generator) - 1
        td = rows.step(td.set("action", action))["next"]
        grouped = groups.step(grouped.set(("rovers", "action"), action.reshape(2, 3, 2)))["next"]
        for key in ("lidar", "target", "reward", ("outcome", "progress")):
            assert torch.equal(grouped["rovers"][key].flatten(0, 1), td[key])


def begun(env: GroupedRovers) -> TensorDict:
    """Resets to starts from which one rover of the first group is soon at its goal."""
    start = torch.tensor([[0.0, 0, 0], [0.0, 4.0, 0], [0.0, -4.0, 0]]).repeat(2, 1, 1)
    goal = start[..., :2] + torch.tensor([6.0, 0.0])
    goal[0, 1] = torch.tensor([0.55, 4.0])
    return env.reset(start=start, goal=goal)


def test_any_done_ends_the_group_if_asked() -> None:
    env = GroupedRovers(make(length=50, end_on_goal=True), done_on_any=True)
    td = begun(env)
    while not td["done"].any():
        td = env.step(td.set(("rovers", "action"), torch.tensor([1.0, 0.0]).expand(2, 3, 2)))["next"]
    assert td["done"].flatten().tolist() == td["terminated"].flatten().tolist() == [True, False]


def test_a_rover_that_is_done_waits_for_its_group() -> None:
    env = GroupedRovers(make(length=8, end_on_goal=True))
    td = begun(env)
    for step in range(1, 9):
        td = env.step(td.set(("rovers", "action"), torch.tensor([1.0, 0.0]).expand(2, 3, 2)))["next"]
        ended = td["rovers", "done"].squeeze(-1)
        assert torch.equal(td["rovers", "mask"], ~ended)
        if step == 7:
            assert ended.tolist() == [[False, True, False], [False] * 3]
            assert not td["done"].any()
            waiting = env.base_env.rover_state.position[1].clone()
            assert td["rovers", "reward"][0, 1] == 0
    assert torch.equal(env.base_env.rover_state.position[1], waiting)
    assert td["done"].all()
    assert td["truncated"].all()
    td = env.reset(td.set("_reset", torch.tensor([[True], [False]])))
    assert td["rovers", "mask"].tolist() == [[True] * 3, [False] * 3]
    assert td["rovers", "done"].squeeze(-1).tolist() == [[False] * 3, [True] * 3]


def test_transforms_go_inside_and_around() -> None:
    env = GroupedRovers(make(length=5).append_transform(StepCounter()))
    around = env.append_transform(RewardSum([("rovers", "reward")], [("rovers", "episode_reward")]))
    td = around.rollout(12, break_when_any_done=False)
    assert td["next", "rovers", "step_count"].flatten().max() == 5
    assert td["next", "done"].sum() == 4
    assert torch.isfinite(td["next", "rovers", "episode_reward"]).all()
    check_env_specs(around)


def test_one_rover_without_a_batch_is_refused() -> None:
    with pytest.raises(ValueError, match="GroupedRovers needs a batch of rovers"):
        GroupedRovers(RoverEnv(world_n=FLAT, backend="warp", num_envs=None))


# PettingZoo


def parallel(num_envs: int = 3, **settings):
    from rover_rl.envs.wrappers.pettingzoo import RoverParallelEnv

    defaults = {"world_n": FLAT, "agents": 3, "backend": "warp", "lidar_beams": 64, "seed": 0}
    return RoverParallelEnv(RoverEnv(num_envs=num_envs, **{**defaults, **settings}))


@needs_pettingzoo
@pytest.mark.filterwarnings("error::UserWarning")
def test_it_passes_the_test_of_pettingzoo() -> None:
    from pettingzoo.test import parallel_api_test

    parallel_api_test(parallel(length=40, end_on_goal=True), num_cycles=100)


@needs_pettingzoo
def test_seeds_repeat_and_rovers_leave_when_they_are_done() -> None:
    env = parallel(length=30, end_on_goal=True)
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
        parallel(6)
    env = parallel()
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
