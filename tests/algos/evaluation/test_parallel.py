"""Evaluations in several processes: the same results, and errors in words."""

from __future__ import annotations

import errno
import multiprocessing
import os
import pickle
import signal
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

from rover_rl import World
from rover_rl.algos.evaluation import parallel
from rover_rl.algos.evaluation.cores import dumps, over_cores
from rover_rl.algos.evaluation.episodes import draw_episodes, stored_episodes
from rover_rl.algos.evaluation.evaluate import (
    EndlessEvaluation,
    Evaluation,
    Policy,
    evaluate,
    evaluate_endless,
    usual_seconds,
)
from rover_rl.algos.evaluation.parallel import EndlessRequest, Request, evaluate_all
from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.envs import EnvConfig
from rover_rl.envs.config import LidarConfig, Randomization
from rover_rl.robots import get_robot
from rover_rl.worlds import Terrain
from tests.algos.evaluation.drives import assert_same
from tests.fork_server import fork_server

FIELD = World("field", Terrain.flat((6.0, 6.0)))
# Two parts, the second of which is shorter.
EPISODES = draw_episodes(FIELD, 40, seed=1, min_path=1.0)
SECONDS, STEPS = 0.5, 10
WORLD = "tests.algos.train.runs:field"


@pytest.fixture(autouse=True)
def preloaded() -> None:
    """Lets the fork server, if it does not run yet, import what other tests need, too."""
    fork_server()


def policies(checkpoint: Checkpoint) -> dict[str, Policy | None]:
    return {"scripted": ScriptedPolicy(), "random": None, "network": checkpoint.make_actor()}


def assert_equal(ours: Evaluation | EndlessEvaluation, theirs: Evaluation | EndlessEvaluation) -> None:
    """The same to the last bit, except for the number of rovers that drive at once."""
    assert replace(ours.env, num_envs=1) == replace(theirs.env, num_envs=1)
    assert ours.to_json()["episodes"] == theirs.to_json()["episodes"]
    assert ours.name == theirs.name
    assert_same(ours.trajectories, theirs.trajectories)


@pytest.mark.slow
def test_results_in_two_processes_are_those_of_one_evaluation_after_another(checkpoint: Checkpoint) -> None:
    requests: list[Request] = []
    expected: list[Evaluation | EndlessEvaluation] = []
    for name, policy in policies(checkpoint).items():
        requests += [
            Request(policy, EPISODES, {"name": name, "seconds": SECONDS}),
            EndlessRequest(policy, WORLD, {"name": name, "steps": STEPS}, rows=10, seed=3),
        ]
        expected += [
            evaluate(policy, EPISODES, name=name, seconds=SECONDS),
            evaluate_endless(policy, WORLD, name=name, rows=10, seed=3, steps=STEPS),
        ]
    before = torch.random.get_rng_state()
    for ours, theirs in zip(evaluate_all(requests, workers=2), expected, strict=True):
        assert_equal(ours, theirs)
        assert len(ours.trajectories) in (40, 10)
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.slow
def test_results_in_a_randomized_environment_do_not_depend_on_the_number_of_processes(checkpoint: Checkpoint) -> None:
    env = EnvConfig(randomization=Randomization.typical())
    requests: list[Request] = []
    for policy in policies(checkpoint).values():
        requests.append(Request(policy, EPISODES, {"seconds": SECONDS, "env": env}))
        requests.append(EndlessRequest(policy, WORLD, {"steps": STEPS, "env": env}, rows=10))
    one, two = (evaluate_all(requests, workers) for workers in (1, 2))
    for ours, theirs in zip(one, two, strict=True):
        assert_equal(ours, theirs)
    # Parts of an evaluation are randomized differently.
    (plain,) = evaluate_all([Request(ScriptedPolicy(), EPISODES, {"seconds": SECONDS})], 1)
    assert not torch.equal(one[0].trajectories[0].position, plain.trajectories[0].position)


@pytest.mark.slow
def test_results_are_in_the_order_of_the_requests() -> None:
    names = [f"policy {number}" for number in range(5)]
    requests = [Request(None, EPISODES.first(4), {"name": name, "seconds": 0.1}) for name in names]
    assert [result.name for result in evaluate_all(requests, workers=2)] == names
    assert evaluate_all([]) == []


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


def crashed(_: Any) -> None:
    os._exit(3)


def without_descriptors(_: Any) -> None:
    raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))


def call(function: Any) -> Any:
    return function(None)


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (failing, ZeroDivisionError, "^in the policy$"),
        (killed, ChildProcessError, r"ended by signal 9 \(Killed\), perhaps because the memory"),
        (crashed, ChildProcessError, "a worker process has ended with exit code 3$"),
        (without_descriptors, OSError, "Too many"),
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


def test_an_error_of_a_policy_is_raised_as_it_is() -> None:
    with pytest.raises(ZeroDivisionError, match="^in the policy$"):
        evaluate_all([Request(failing, EPISODES, {"seconds": 0.1})], workers=2)


def tensors(world: World, count: int) -> list[Any]:
    return [world, *(torch.zeros(2) for _ in range(count))]


def test_more_tensors_cross_than_there_are_file_descriptors() -> None:
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    limit = max(map(int, os.listdir("/dev/fd"))) + 32
    worlds = [World(f"field {number}", Terrain.flat((6.0, 6.0))) for number in range(20)]
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, hard))
    try:
        episodes = draw_episodes(worlds, 1, min_path=1.0, workers=2)
        (results,) = evaluate_all([Request(None, episodes, {"seconds": 0.05})], workers=2)
        one, two = over_cores(partial(tensors, count=limit), worlds[:2], "working", workers=2)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert len(results.trajectories) == 20
    assert len(one) == len(two) == limit + 1
    assert [one[0].name, two[0].name] == ["field 0", "field 1"]


def test_worlds_cross_once_and_slices_without_the_rest() -> None:
    world, whole = FIELD, torch.arange(100_000.0)
    sent = dumps({"worlds": [world, world], "part": whole[10:12], "none": None})
    assert len(sent) < len(pickle.dumps(world)) + 2000
    one, two = pickle.loads(sent), pickle.loads(dumps(world))
    assert one["worlds"][0] is one["worlds"][1] is two
    assert one["part"].tolist() == [10.0, 11.0]


def test_invalid_requests_raise(checkpoint: Checkpoint) -> None:
    points = {"env": EnvConfig(lidar=LidarConfig(points=16))}
    invalid: list[tuple[Request, str]] = [
        (Request(None, EPISODES, {"seconds": 0.01}), "seconds must be at least 0.05"),
        (EndlessRequest(checkpoint.make_actor(), WORLD, points), "made for lidar points 32, and the environment has"),
        (EndlessRequest(None, WORLD, rows=0), "rows must be at least 1"),
        (EndlessRequest(None, "mars"), "unknown world 'mars'"),
    ]
    for request, message in invalid:
        with pytest.raises(ValueError, match=message):
            evaluate_all([request], 1)
    with pytest.raises(ValueError, match="workers must be at least 1"):
        evaluate_all([Request(None, EPISODES.first(1))], workers=0)


def doubled(number: int) -> int:
    return 2 * number


@pytest.mark.parametrize("workers", [1, 2, None])
def test_work_is_shared_by_the_cores_in_order(workers: int | None) -> None:
    assert over_cores(doubled, range(5), "working", workers) == [0, 2, 4, 6, 8]
