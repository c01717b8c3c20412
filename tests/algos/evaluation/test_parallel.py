"""Evaluations in several processes: the same results, and errors in words."""

from __future__ import annotations

import multiprocessing
import os
import signal
from dataclasses import replace
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

from rover_rl import World
from rover_rl.algos.evaluation import parallel
from rover_rl.algos.evaluation.cores import over_cores
from rover_rl.algos.evaluation.episodes import draw_episodes, endless_episodes, stored_episodes
from rover_rl.algos.evaluation.evaluate import Evaluation, Policy, evaluate, usual_seconds
from rover_rl.algos.evaluation.parallel import Request, evaluate_all
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.envs.config import EnvConfig, LidarConfig
from rover_rl.robots import get_robot
from rover_rl.worlds import Terrain
from tests.algos.evaluation.drives import assert_same
from tests.fork_server import fork_server

FIELD = World("field", Terrain.flat((6.0, 6.0)))
# Two parts, the second of which is shorter.
EPISODES = draw_episodes(FIELD, 40, seed=1, min_path=1.0)
SECONDS = 0.5
WORLD = "tests.algos.train.runs:field"


@pytest.fixture(autouse=True)
def preloaded() -> None:
    """Lets the fork server, if it does not run yet, import what other tests need, too."""
    fork_server()


def policies(checkpoint: Checkpoint) -> dict[str, Policy | None]:
    return {"random": None, "network": checkpoint.make_actor()}


def assert_equal(ours: Evaluation, theirs: Evaluation) -> None:
    """The same to the last bit, except for the number of rovers that drive at once."""
    assert replace(ours.env, num_envs=1) == replace(theirs.env, num_envs=1)
    assert ours.to_json()["episodes"] == theirs.to_json()["episodes"]
    assert ours.name == theirs.name
    assert_same(ours.trajectories, theirs.trajectories)


@pytest.mark.slow
def test_results_in_two_processes_are_those_of_one_evaluation_after_another(checkpoint: Checkpoint) -> None:
    requests: list[Request] = []
    expected: list[Evaluation] = []
    for name, policy in policies(checkpoint).items():
        requests += [
            Request(policy, EPISODES, {"name": name, "seconds": SECONDS}),
            Request(policy, endless_episodes(WORLD, 10, 3), {"name": name, "seconds": SECONDS}),
        ]
        expected += [
            evaluate(policy, EPISODES, name=name, seconds=SECONDS),
            evaluate(policy, endless_episodes(WORLD, 10, 3), name=name, seconds=SECONDS),
        ]
    before = torch.random.get_rng_state()
    for ours, theirs in zip(evaluate_all(requests, workers=2), expected, strict=True):
        assert_equal(ours, theirs)
        assert len(ours.trajectories) in (40, 10)
    assert torch.equal(torch.random.get_rng_state(), before)


def in_this_process(td: TensorDictBase) -> TensorDictBase:
    assert multiprocessing.parent_process() is None
    return td.set("action", torch.zeros(len(td), 2))


def in_another_process(td: TensorDictBase) -> TensorDictBase:
    assert multiprocessing.parent_process() is not None
    return td.set("action", torch.zeros(len(td), 2))


def test_the_time_limit_follows_the_longest_path_of_the_set() -> None:
    hall = World("hall", Terrain.flat((44.0, 4.0)), spawn_range=((-21, -10), (-1, 1)), goal_range=((20, 21), (-1, 1)))
    episodes = draw_episodes(hall, 40)
    limit = round(4 * float(episodes.shortest.max()))
    assert 150 < limit < 168
    warp = EnvConfig(backend="warp")
    assert usual_seconds(warp, episodes) == limit
    assert usual_seconds(warp, EPISODES) == usual_seconds(warp, stored_episodes("maze")) == 60
    zero = get_robot("rover_zero")
    slow = replace(warp, robot=replace(zero, drive=replace(zero.drive, max_speed=0.5)))
    assert usual_seconds(slow, episodes) == round(8 * float(episodes.shortest.max()))
    for given, expected in ((None, limit), (7.0, 7.0)):
        parts = Request(None, episodes, {"env": warp, "seconds": given}).parts()
        assert [part.options["seconds"] for part in parts] == [expected] * 2


def test_only_small_evaluations_stay_in_this_process() -> None:
    few, many = EPISODES.first(parallel.SMALL - 1), EPISODES.first(parallel.SMALL)
    evaluate_all([Request(in_this_process, few, {"seconds": 0.1})], workers=2)
    evaluate_all([Request(in_this_process, EPISODES, {"seconds": 0.1})], workers=1)
    evaluate_all([Request(in_another_process, many, {"seconds": 0.1})] * 2, workers=2)


def failing(td: TensorDictBase) -> TensorDictBase:
    raise ZeroDivisionError("in the policy")


def endless(_: Any) -> None:
    signal.pause()


def killed(_: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def call(function: Any) -> Any:
    return function(None)


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (failing, ZeroDivisionError, "^in the policy$"),
        (killed, ChildProcessError, r"ended by signal 9 \(Killed\), perhaps because the memory"),
    ],
)
def test_the_error_tells_what_happened_in_a_process_and_ends_the_others(
    function: Any, error: type[Exception], message: str
) -> None:
    before = set(multiprocessing.active_children())
    with pytest.raises(error, match=message):
        over_cores(call, [endless, function], "working", workers=2)
    for process in set(multiprocessing.active_children()) - before:
        process.join(60)
        assert process.exitcode is not None


def test_invalid_requests_raise(checkpoint: Checkpoint) -> None:
    points = {"env": EnvConfig(lidar=LidarConfig(points=16))}
    invalid: list[tuple[Request, str]] = [
        (Request(None, EPISODES, {"seconds": 0.01}), "seconds must be at least 0.05"),
        (Request(checkpoint.make_actor(), EPISODES, points), "made for lidar points 32, and the environment has"),
    ]
    for request, message in invalid:
        with pytest.raises(ValueError, match=message):
            evaluate_all([request], 1)
    with pytest.raises(ValueError, match="workers must be at least 1"):
        evaluate_all([Request(None, EPISODES.first(1))], workers=0)
