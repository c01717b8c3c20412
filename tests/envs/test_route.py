"""The sensor ``route``, and ``RouteReward``."""

from __future__ import annotations

import torch
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import check_env_specs

from rover_rl import RoverEnv
from rover_rl.envs.seen_map.seen_map import SeenMap
from rover_rl.envs.sensors.route import Route
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from rover_rl.envs.transforms.path_reward import RouteReward


def routed(num_envs: int | None = 4, seed: int = 0, repeat: int = 4) -> EnvBase:
    sensors = [Route(period=repeat)]
    rovers = RoverEnv(world_n="maze", num_envs=num_envs, seed=seed, backend="warp", sensors=sensors)
    return TransformedEnv(rovers, ActionRepeat(repeat))


def driven(env: EnvBase, decisions: int) -> torch.Tensor:
    """The routes of rovers that drive straight ahead, slowly enough that none of them reaches a wall."""
    observation = env.reset()
    routes = [observation["route"]]
    action = torch.tensor([0.1, 0.0]).expand(*env.batch_size, 2)
    for _ in range(decisions):
        observation = env.step(observation.set("action", action))["next"]
        routes.append(observation["route"])
    return torch.stack(routes, -2)


def test_it_keeps_the_specs_and_an_unbatched_rover_has_the_route_of_a_batch_of_one() -> None:
    check_env_specs(routed())
    assert torch.equal(driven(routed(None), 3), driven(routed(1), 3)[0])


def test_a_partial_reset_forgets_the_map_of_the_rows_that_it_resets_only() -> None:
    env = routed()
    observation = env.reset()
    action = torch.tensor([0.1, 0.0]).expand(4, 2)
    for _ in range(3):
        observation = env.step(observation.set("action", action))["next"]
    rows = torch.tensor([True, False, False, False])
    after = env.reset(observation.clone().set("_reset", rows[:, None]))
    assert torch.equal(after["route"][1:], observation["route"][1:])
    # The first row's map holds the scan of its new start only.
    fresh = SeenMap(env.base_env.fleet, env.base_env.config.lidar)
    assert torch.equal(after["route"][0], fresh(after)[0])


def test_the_route_is_held_between_its_readings() -> None:
    env = RoverEnv(world_n="maze", num_envs=2, seed=1, backend="warp", sensors=[Route(period=3)])
    routes = env.rollout(9, lambda td: td.set("action", torch.tensor([[0.3, 0.2]] * 2)))["route"].unbind(1)
    assert all(torch.equal(routes[k], routes[k - k % 3]) for k in range(9))
    assert not torch.equal(routes[3], routes[2])


def test_the_reward_pays_for_meters_of_the_route_except_at_goals() -> None:
    env = routed(64).append_transform(RouteReward(2.0))
    observation = env.reset()
    action = torch.tensor([1.0, 0.0]).expand(64, 2)
    reached = paid = 0
    for _ in range(12):
        following = env.step(observation.clone().set("action", action))["next"]
        before, after = observation["route"][:, 4:], following["route"][:, 4:]
        goals = following["outcome", "goals"]
        counts = (goals == 0) & (before >= 0) & (after >= 0)
        expected = torch.where(counts, 2.0 * (before - after), 0.0)
        # The bare task pays 1 for each goal.
        torch.testing.assert_close(following["reward"], expected + goals)
        reached, paid = reached + int(goals.sum()), paid + int((expected != 0).sum())
        observation = following
    assert reached > 0
    assert paid > 50
