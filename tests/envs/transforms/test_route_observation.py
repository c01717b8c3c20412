"""``RouteObservation`` and ``RouteReward``."""

from __future__ import annotations

import torch
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import check_env_specs

from rover_rl import RoverEnv
from rover_rl.envs.seen_map.seen_map import SeenMap
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from rover_rl.envs.transforms.path_reward import RouteReward
from rover_rl.envs.transforms.route_observation import RouteObservation


def routed(rovers: RoverEnv, repeat: int = 4) -> EnvBase:
    return TransformedEnv(rovers, ActionRepeat(repeat)).append_transform(RouteObservation(rovers, action_repeat=repeat))


def maze(num_envs: int | None = 4, seed: int = 0) -> RoverEnv:
    return RoverEnv(world_n="maze", num_envs=num_envs, seed=seed, backend="warp")


def driven(env: EnvBase, decisions: int) -> torch.Tensor:
    """The routes of rovers that drive straight ahead, slowly enough that none of them reaches a wall."""
    observation = env.reset()
    routes = [observation["route"]]
    action = torch.tensor([0.1, 0.0]).expand(*env.batch_size, 2)
    for _ in range(decisions):
        observation = env.step(observation.set("action", action))["next"]
        routes.append(observation["route"])
    return torch.stack(routes, -2)


def test_it_keeps_the_specs() -> None:
    check_env_specs(routed(maze()))


def test_an_unbatched_rover_has_the_route_of_a_batch_of_one() -> None:
    assert torch.equal(driven(routed(maze(None)), 3), driven(routed(maze(1)), 3)[0])


def test_a_rows_route_does_not_depend_on_the_other_rows() -> None:
    together, alone = driven(routed(maze(4)), 5), driven(routed(maze(1, seed=2)), 5)
    assert torch.equal(together[2], alone[0])


def test_a_partial_reset_forgets_the_map_of_the_rows_that_it_resets_only() -> None:
    env = routed(maze())
    observation = env.reset()
    action = torch.tensor([0.1, 0.0]).expand(4, 2)
    for _ in range(3):
        observation = env.step(observation.set("action", action))["next"]
    rows = torch.tensor([True, False, False, False])
    after = env.reset(observation.clone().set("_reset", rows[:, None]))
    assert torch.equal(after["route"][1:], observation["route"][1:])
    # The first row's map holds the scan of its new start only.
    fresh = SeenMap(4, env.base_env.config.lidar)
    assert torch.equal(after["route"][0], fresh(after)[0])


def test_the_reward_pays_for_meters_of_the_route_except_at_goals() -> None:
    rovers = maze(64)
    env = routed(rovers).append_transform(RouteReward(2.0))
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
    assert paid > 100
