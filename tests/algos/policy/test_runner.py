"""A runner carries the memory of a policy from decision to decision."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase

from rover_rl.algos.policy.grid_planner import GridPlanner, MovingGridPlanner
from rover_rl.algos.policy.networks import make_actor
from rover_rl.algos.policy.runner import PolicyRunner, default_action_repeat, sensors_for
from rover_rl.envs.config import EnvConfig
from tests.algos.policy.memories import CountingPolicy, observations, recurrent_checkpoint


def counts(runner: PolicyRunner, seen: TensorDict, **options: torch.Tensor) -> list[int]:
    return (runner(seen, **options)[:, 0] * 100).round().int().tolist()


def test_the_memory_moves_with_each_decision_and_is_cleared_row_by_row() -> None:
    runner, (seen, *_) = PolicyRunner(CountingPolicy(), action_repeat=1), observations(3)
    assert [counts(runner, seen) for _ in range(3)] == [[0, 0, 0], [1, 1, 1], [2, 2, 2]]
    runner.reset(torch.tensor([False, True, False]))
    assert [counts(runner, seen) for _ in range(2)] == [[3, 0, 3], [4, 1, 4]]
    runner.reset()
    assert counts(runner, observations(2)[0]) == [0, 0]


def test_actions_and_memory_are_held_between_decisions() -> None:
    policy = CountingPolicy()
    runner, (seen, *_) = PolicyRunner(policy), observations(2)
    assert runner.action_repeat == 4
    assert [counts(runner, seen) for _ in range(6)] == [[0, 0]] * 4 + [[1, 1]] * 2
    assert policy.calls == 2
    runner.reset(torch.tensor([True, False]))
    # The new episode of the first row begins with a decision; the second row decides when its turn comes.
    assert [counts(runner, seen) for _ in range(5)] == [[0, 1], [0, 1], [0, 2], [0, 2], [1, 2]]


def test_the_caller_may_say_which_rows_decide_and_a_policy_of_single_rows_is_called_with_them() -> None:
    rows = []

    class SingleRows(CountingPolicy):
        row_by_row = True

        def __call__(self, td: TensorDictBase) -> TensorDictBase:
            rows.append(len(td))
            return super().__call__(td)

    seen, second = observations(3)[0], torch.tensor([False, True, False])
    for policy in (CountingPolicy(), SingleRows()):
        runner = PolicyRunner(policy)
        assert [counts(runner, seen, due=second) for _ in range(3)] == [[0, 0, 0], [0, 1, 0], [0, 2, 0]]
        assert counts(runner, seen, due=~second & second) == [0, 2, 0]
        runner.reset(torch.tensor([True, False, False]))
        assert counts(runner, seen, due=second) == [0, 3, 0]
        # Of those that are due, only some drive.
        assert counts(runner, seen, due=second | ~second, rows=second) == [0, 4, 0]
    assert rows == [3, 1, 1, 2, 1]


def test_policies_with_memory_or_a_map_decide_as_often_as_in_training_whatever_the_control_rate() -> None:
    actor, memoryless = recurrent_checkpoint().make_actor(), make_actor(hidden=(8,))
    memoryless.trained_action_repeat = 4
    for given, repeats in ((None, [4, 1, 1]), (2, [2, 2, 2])):
        assert [default_action_repeat(policy, given) for policy in (actor, memoryless, None)] == repeats
    for policy in (GridPlanner(), actor):
        assert [default_action_repeat(policy, dt=dt) for dt in (0.2, 0.1, 0.05, 0.025)] == [1, 2, 4, 8]


def test_the_environment_is_made_with_the_sensors_that_a_policy_reads() -> None:
    config = EnvConfig(sensors=("heights",), control_rate=10)
    assert sensors_for(MovingGridPlanner(), config).sensors == ("heights", "movers(period=2)", "route(period=2)")
    assert sensors_for(MovingGridPlanner(), config, 1).sensors == ("heights", "movers", "route")
    assert sensors_for(make_actor(hidden=(8,)), config) is config
    assert sensors_for(None, config) is config
    with pytest.raises(ValueError, match=r"reads \['route'\]: make the environment with sensors_for"):
        PolicyRunner(GridPlanner())(observations(2)[0])


def test_policies_without_memory_pass_through() -> None:
    actor = make_actor(hidden=(8,))
    runner = PolicyRunner(actor)
    for seen in observations(3):
        keys = set(seen.keys())
        assert torch.equal(runner(seen), actor(seen.clone())["action"])
        assert set(seen.keys()) == keys

    def hidden_state(td: TensorDictBase) -> TensorDictBase:
        assert "is_init" not in td
        return td.set("action", td["target"])

    assert torch.equal(PolicyRunner(hidden_state)(seen), seen["target"])


@torch.no_grad()
def test_rows_are_independent_to_the_last_bit() -> None:
    actor = recurrent_checkpoint().make_actor()
    few, many = (PolicyRunner(actor, action_repeat=2, min_rows=32) for _ in range(2))
    first = []
    for step, (some, more) in enumerate(zip(observations(3), observations(40), strict=True)):
        few_reset = torch.tensor([step == 4, False, step == 7])
        few.reset(few_reset)
        many.reset(torch.cat((few_reset, torch.arange(37) % 5 == step % 5)))
        first.append(few(some))
        assert torch.equal(first[-1], many(more)[:3])
    assert (first[-1] - first[0]).abs().max() > 0.01
