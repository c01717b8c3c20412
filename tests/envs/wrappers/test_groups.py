"""Groups of rovers as a multi-agent environment of TorchRL."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import RewardSum, StepCounter
from torchrl.envs.utils import check_env_specs

from rover_rl import RoverEnv, Terrain, World, make_env
from rover_rl.envs.wrappers.groups import GroupedRovers

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
