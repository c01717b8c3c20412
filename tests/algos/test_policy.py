from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.policy import ObservationEncoder, make_actor, make_critic
from rover_rl.envs.specs import ACTION, observation_bounds

LOW, HIGH = torch.tensor(ACTION.low), torch.tensor(ACTION.high)


def observations(*shape: int) -> TensorDict:
    bounds = observation_bounds(32, 12.0)
    generator = torch.Generator().manual_seed(0)
    values = {}
    for key, bound in bounds.items():
        low, high = torch.tensor(bound.low), torch.tensor(bound.high)
        values[key] = low + (high - low) * torch.rand(*shape, len(low), generator=generator)
    return TensorDict(values, batch_size=shape)


def test_encoding_is_what_the_task_needs() -> None:
    features = ObservationEncoder()(
        lidar=torch.tensor([[0.0, 12.0]]),
        imu=torch.tensor([[0.1, -0.2, 3.0]]),
        target=torch.tensor([[5.0, math.pi / 2]]),
        velocities=torch.tensor([[0.5, 1.5]]),
    )
    lidar = [-1.0, math.log(13) / 1.3 - 1]
    expected = torch.tensor([[*lidar, 0.0, math.log(6) - 1, 1.0, 0.0, 0.1, -0.2, 0.5, 0.5]])
    torch.testing.assert_close(features, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("shape", [(), (3,), (3, 5)])
def test_actor_and_critic_take_any_batch(shape: tuple[int, ...]) -> None:
    td = make_critic(32)(make_actor(32)(observations(*shape)))
    assert td["action"].shape == (*shape, 2)
    assert td["action_log_prob"].shape == shape
    assert td["state_value"].shape == (*shape, 1)


def test_actions_lie_within_their_bounds_and_reach_far() -> None:
    torch.manual_seed(0)
    with set_exploration_type(ExplorationType.RANDOM):
        action = make_actor(32)(observations(4000))["action"]
    assert ((action >= LOW) & (action <= HIGH)).all()
    assert (action.amin(0) < 0.9 * LOW).all()
    assert (action.amax(0) > 0.9 * HIGH).all()


def test_without_exploration_the_action_is_the_middle_of_the_distribution() -> None:
    actor, td = make_actor(32), observations(8)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        first, second = actor(td.clone())["action"], actor(td.clone())["action"]
    assert torch.equal(first, second)
    torch.testing.assert_close(first, actor(td.clone())["loc"].tanh() * HIGH)


def test_pose_and_yaw_are_not_seen() -> None:
    actor, td = make_actor(32), observations(8)
    moved = td.clone()
    moved["pose"] += 5.0
    moved["imu"][:, 2] += 1.0
    assert torch.equal(actor(td)["loc"], actor(moved)["loc"])
