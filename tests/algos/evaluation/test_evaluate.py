"""Evaluations: what is driven, in one process and in several, and the command."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from collections.abc import Callable
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import pytest
import torch
from matplotlib.image import imread
from tensordict import TensorDictBase

from rover_rl import World
from rover_rl.algos.config import training_config, with_settings
from rover_rl.algos.evaluation.cores import over_cores
from rover_rl.algos.evaluation.episodes import EpisodeSet, draw_episodes, endless_episodes, stored_episodes
from rover_rl.algos.evaluation.evaluate import SMALL, Evaluation, Request, evaluate, evaluate_all, usual_seconds
from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import ObservationEncoder, make_actor
from rover_rl.cli import main
from rover_rl.cli.evaluate import split_task
from rover_rl.envs.config import ActionConfig, EnvConfig, LidarConfig, Randomization
from rover_rl.robots import get_robot
from rover_rl.tasks import get_task
from rover_rl.worlds import Terrain, box
from rover_rl.worlds.pool import WorldPool
from tests.algos.drivers import ahead, straight
from tests.algos.evaluation.drives import EPISODES, FIELD, WALL, WARP, assert_same
from tests.algos.policy.memories import CountingPolicy, recurrent_checkpoint
from tests.fork_server import fork_server

THREE = EPISODES.part(0, 3).with_used_worlds()
SLIPPERY = "tests.algos.evaluation.slippery:Slippery"


# --- what is driven


def test_driving_at_the_goal_reaches_it_on_open_ground() -> None:
    driven = evaluate(straight, THREE, name="straight")
    assert driven.endings == ["goal"] * 3
    assert driven.success_rate == 1
    assert driven.env.backend == "bullet"
    assert driven.metrics["mean_time_to_traverse"].value > THREE.shortest.mean()
    lengths = map(len, driven.trajectories)
    for path, start, goal, steps in zip(driven.paths, THREE.start, THREE.goal, lengths, strict=True):
        assert len(path) == steps + 1
        torch.testing.assert_close(path[0], start[:2], atol=0.02, rtol=0)
        assert torch.dist(path[-1], goal) < 0.5


@pytest.mark.parametrize("kind", ["random", "gru"])
def test_an_episode_depends_neither_on_the_rows_nor_on_its_place(kind: str) -> None:
    many = draw_episodes(FIELD, count=9, seed=1)
    policy = None if kind == "random" else recurrent_checkpoint().make_actor()
    before = torch.random.get_rng_state()
    together = evaluate(policy, many, seconds=0.6, rows=9, env=WARP)
    assert torch.equal(before, torch.random.get_rng_state())
    assert together.name == {"random": "random"}.get(kind, "policy")
    for rows in (1, 4):
        assert_same(evaluate(policy, many, seconds=0.6, rows=rows, env=WARP).trajectories, together.trajectories)
    if kind != "random":  # which draws for the number of an episode
        turned = EpisodeSet("field", FIELD, 1, many.start.flip(0), many.goal.flip(0), many.shortest.flip(0))
        backwards = evaluate(policy, turned, seconds=0.6, rows=8, env=WARP)
        assert_same(backwards.trajectories[::-1], together.trajectories)


@pytest.mark.parametrize("backend", ["bullet", "warp"])
def test_results_are_those_of_each_world_alone_for_any_number_of_rows(backend: str) -> None:
    options = {"seconds": 0.3, "env": EnvConfig(backend=backend)}
    alone = [evaluate(straight, EPISODES.part(first, first + 3), **options).trajectories for first in (0, 3, 6)]
    for rows in (2, 5):
        assert_same(evaluate(straight, EPISODES, rows=rows, **options).trajectories, [*chain(*alone)])


def test_a_policy_with_memory_decides_as_often_as_in_training() -> None:
    policy = CountingPolicy()
    driven = evaluate(policy, THREE, seconds=2.0, rows=1, env=WARP)
    assert (driven.action_repeat, policy.calls) == (4, 3 * 10)
    every_step = evaluate(policy, endless_episodes(FIELD, 2), seconds=0.5, action_repeat=1, env=WARP)
    assert (every_step.action_repeat, policy.calls) == (1, 3 * 10 + 10)
    # It drives faster the more decisions it has taken in an episode, and starts anew in each.
    assert_same(evaluate(policy, THREE, seconds=2.0, rows=3, env=WARP).trajectories, driven.trajectories)
    assert all(0.05 < trajectory.speed.max() < 0.15 for trajectory in driven.trajectories)


def test_driving_into_a_wall_jams_and_touches_it() -> None:
    room = World("room", Terrain.flat((12.0, 12.0)), [box((3.0, 0.0, 0.5), (1.0, 8.0, 1.0))])
    behind = EpisodeSet("room", room, 0, torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[5.0, 0.0]]), torch.ones(1))
    jammed = evaluate(ahead, behind, seconds=10, env=WARP)
    assert jammed.endings == ["jammed"]
    assert jammed.metrics["collisions"].value == 1
    assert jammed.metrics["body_contacts"].value >= 1
    assert jammed.metrics["ending_jammed"].value == 1
    assert jammed.trajectories[0].collision[-16:].all()


def test_goals_keep_coming_and_the_jam_ending_can_be_left_out() -> None:
    endless = evaluate(straight, endless_episodes(FIELD, 2, 1), seconds=14, env=WARP)
    goals = [int(trajectory.goal.sum()) for trajectory in endless.trajectories]
    assert [len(trajectory) for trajectory in endless.trajectories] == [280, 280]
    assert max(goals) >= 2
    assert endless.metrics["goals_per_episode"].value == sum(goals) / 2
    assert endless.metrics["seconds_per_goal"].value == pytest.approx(28 / sum(goals))
    assert endless.metrics["ended_early"].value == 0
    first = {"goals": goals[0], "ending": "time limit", "seconds": 14.0, "contacts": 0, "collisions": 0}
    assert endless.to_json()["episodes"][0] == first
    episodes = endless_episodes("maze", 1, 1)
    with_jam, without = (evaluate(ahead, episodes, seconds=5, jam=jam, env=WARP) for jam in (True, False))
    assert (with_jam.endings, without.endings) == (["jammed"], ["time limit"])
    ours, theirs = with_jam.trajectories[0], without.trajectories[0]
    assert torch.equal(ours.position, theirs.position[: len(ours) + 1])


def test_the_time_limit_follows_the_longest_path_of_the_set() -> None:
    hall = World("hall", Terrain.flat((44.0, 4.0)), spawn_range=((-21, -10), (-1, 1)), goal_range=((20, 21), (-1, 1)))
    episodes = draw_episodes(hall, 40)
    limit = round(4 * float(episodes.shortest.max()))
    assert 150 < limit < 168
    assert usual_seconds(WARP, episodes) == limit
    assert usual_seconds(WARP, EPISODES) == usual_seconds(WARP, stored_episodes("maze")) == 60
    zero = get_robot("rover_zero")
    slow = replace(WARP, robot=replace(zero, drive=replace(zero.drive, max_speed=0.5)))
    assert usual_seconds(slow, episodes) == round(8 * float(episodes.shortest.max()))
    for given, expected in ((None, limit), (7.0, 7.0)):
        parts = Request(None, episodes, {"env": WARP, "seconds": given}).parts()
        assert [part.options["seconds"] for part in parts] == [expected] * 2


def test_what_cannot_be_driven_raises(checkpoint: Checkpoint) -> None:
    for setting in ({"action_repeat": 0}, {"rows": 0}, {"seconds": 0.01}):
        with pytest.raises(ValueError, match=f"{next(iter(setting))} must be at least"):
            evaluate(straight, THREE, **setting)  # type: ignore[arg-type]
    points = {"env": EnvConfig(lidar=LidarConfig(points=16))}
    message = "^the policy was made for lidar points 32, and the environment has 16$"
    with pytest.raises(ValueError, match=message):
        evaluate_all([Request(checkpoint.make_actor(), THREE, points)], 1)
    with pytest.raises(ValueError, match="workers must be at least 1"):
        evaluate_all([Request(None, THREE)], workers=0)


def test_a_checkpoint_drives_in_the_environment_that_it_was_made_for(checkpoint: Checkpoint) -> None:
    config = with_settings(checkpoint.config, lidar=LidarConfig(points=16), world="maze")
    config = with_settings(config, randomization=Randomization.typical(), action=ActionConfig(min_speed=0.0))
    actor = Checkpoint(config, 1, make_actor(ObservationEncoder(lidar_points=16), (8,)).state_dict()).make_actor()
    # Policies are compared without randomization.
    assert evaluate(actor, THREE, seconds=0.2).env == EnvConfig(
        world=THREE.name, num_envs=3, seed=1, end_on_goal=True, lidar=config.env.lidar, action=config.env.action
    )


# --- processes


@pytest.fixture
def preloaded() -> None:
    """Lets the fork server, if it does not run yet, import what other tests need, too."""
    fork_server()


def in_this_process(td: TensorDictBase) -> TensorDictBase:
    assert multiprocessing.parent_process() is None
    return td.set("action", torch.zeros(len(td), 2))


def in_another_process(td: TensorDictBase) -> TensorDictBase:
    assert multiprocessing.parent_process() is not None
    return td.set("action", torch.zeros(len(td), 2))


def assert_equal(ours: Evaluation, theirs: Evaluation) -> None:
    """The same to the last bit, except for the number of rovers that drive at once."""
    assert replace(ours.env, num_envs=1) == replace(theirs.env, num_envs=1)
    assert ours.to_json()["episodes"] == theirs.to_json()["episodes"]
    assert ours.name == theirs.name
    assert_same(ours.trajectories, theirs.trajectories)


@pytest.mark.slow
@pytest.mark.usefixtures("preloaded")
def test_results_in_two_processes_are_those_of_one(checkpoint: Checkpoint) -> None:
    # Two parts, the second of which is shorter.
    many, actor = draw_episodes(FIELD, 40, seed=1, min_path=1.0), checkpoint.make_actor()
    several = draw_episodes(WorldPool("maze:10000", FIELD, WALL), 3, seed=2, min_path=1.0)
    randomized = replace(WARP, randomization=Randomization.typical())
    requests = [
        Request(None, many, {"name": "random", "seconds": 0.3, "env": WARP}),
        Request(actor, many, {"name": "network", "seconds": 0.3, "env": WARP}),
        Request(actor, endless_episodes("tests.algos.train.runs:field", 10, 3), {"name": "endless", "seconds": 0.3}),
        Request(ScriptedPolicy(), several, {"name": "worlds", "seconds": 0.3, "env": randomized}),
        Request(in_another_process, many.first(SMALL), {"name": "elsewhere", "seconds": 0.1, "env": WARP}),
    ]
    parallel = evaluate_all(requests, workers=2)
    for ours, request in zip(parallel[:3], requests[:3], strict=True):
        assert_equal(ours, evaluate(request.policy, request.episodes, **request.options))
    # The random numbers of a randomized environment depend on the episodes that are driven with it.
    assert_equal(parallel[3], evaluate_all(requests[3:4], 1)[0])
    # Small evaluations stay in this process.
    evaluate_all([Request(in_this_process, many.first(SMALL - 1), {"seconds": 0.1, "env": WARP})], workers=2)


def failing(_: Any) -> None:
    raise ZeroDivisionError("in the policy")


def endless(_: Any) -> None:
    signal.pause()


def killed(_: Any) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def call(function: Any) -> Any:
    return function(None)


@pytest.mark.usefixtures("preloaded")
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


# --- the command


@pytest.fixture
def run(tmp_path: Path) -> Path:
    config = training_config("ppo", world="maze", hidden=(8,))
    actor = make_actor(hidden=config.network.hidden)
    checkpoint = Checkpoint(config=config, steps=0, actor=actor.state_dict())
    for seed in (1, 2):
        checkpoint.save(tmp_path / f"run-{seed}" / "checkpoint.pt")
    return tmp_path


def test_the_command_drives_checkpoints_beside_baselines(capsys: pytest.CaptureFixture[str], run: Path) -> None:
    first, second = run / "run-1", run / "run-2" / "checkpoint.pt"
    given = ["evaluate", str(first), str(second), "scripted", "random", "--count", "2", "--seconds", "0.5"]
    assert main([*given, "--workers", "1"]) == 0
    assert {"evaluation.json", "evaluation.csv", "paths.png"} <= {file.name for file in first.iterdir()}
    written = json.loads((first / "evaluation.json").read_text())
    assert [entry["policy"] for entry in written] == ["run-1", "run-2", "scripted", "random"]
    assert {(entry["world"], entry["seed"], entry["count"]) for entry in written} == {("maze", 20_000, 2)}
    assert "PPO in maze" in capsys.readouterr().out


def test_the_command_takes_ranges_and_imperfections(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    given = ["evaluate", "scripted", "--world", "maze:10000-10001@0.2", "--imperfect", "late", "all"]
    short = ["--seconds", "0.5", "--episodes", "2", "--workers", "1", "--backend", "warp"]
    assert main([*given, *short, "--out", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "2 episodes in each of 2 worlds" in text
    assert "Lowest success rates of scripted in maze:10000-10001@0.2, warp, exact: maze:10000@0.2 0%" in text
    assert "Success, and its change against exact" in text
    results = json.loads((tmp_path / "evaluation.json").read_text())
    assert [(one["imperfection"], one["world"], one["count"]) for one in results] == [
        (kind, "maze:10000-10001@0.2", 4) for kind in ("exact", "late", "all")
    ]
    assert results[1]["worlds"][1]["name"] == "maze:10001@0.2"
    delays = [one["env"]["randomization"]["scan_latency"] for one in results]
    assert delays == [[0, 0], [3, 3], [1, 2]]
    assert min(imread(path).std() for path in tmp_path.glob("paths*.png")) > 0.05


def test_the_command_drives_the_same_episodes_in_each_backend(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    given = ["evaluate", "scripted", "--world", "maze", "--backend", "bullet", SLIPPERY, "--count", "1"]
    assert main([*given, "--seconds", "5", "--out", str(tmp_path)]) == 0
    results = json.loads((tmp_path / "evaluation.json").read_text())
    assert [entry["backend"] for entry in results] == ["bullet", SLIPPERY]
    starts = [[(episode["start"], episode["goal"]) for episode in entry["episodes"]] for entry in results]
    assert starts[0] == starts[1]
    reached = [{n for n, one in enumerate(entry["episodes"]) if one["ending"] == "goal"} for entry in results]
    assert reached[0] > reached[1]
    pictures = {path.name for path in tmp_path.glob("*.png")}
    assert pictures == {"paths-bullet.png", f"paths-{SLIPPERY.replace(':', '-')}.png"}
    assert "in one backend and not in another" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("random", "say which --world to drive in"),
        ("scripted --world maze mars", "unknown world 'mars'"),
        ("RUN/run-1 RUN/none.pt", "no checkpoint at"),
        ("RUN/run-1 --count 0", "count must be"),
        ("scripted --world maze --imperfect latte", "unknown imperfection 'latte', perhaps 'late'"),
        ("scripted --world maze --backend bullet gazebo --out RUN/new", "unknown backend 'gazebo'"),
        (f"scripted --world maze --backend bullet {SLIPPERY[:-8]}NotInstalled --out RUN/new", "needs a library"),
    ],
)
def test_the_command_refuses_in_one_line_before_anything_is_driven(
    failed: Callable[..., str], run: Path, monkeypatch: pytest.MonkeyPatch, given: str, message: str
) -> None:
    monkeypatch.setattr("rover_rl.algos.evaluation.evaluate.evaluate", None)
    assert message in failed("evaluate", *given.replace("RUN", str(run)).split())
    assert not (run / "new").exists()


def test_the_first_word_names_a_task_unless_it_names_a_policy_or_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert split_task(("mazes", "scripted")) == (get_task("mazes"), ("scripted",))
    assert split_task(("rover_rl.tasks.field:FIELD",)) == (get_task("field"), ())
    policies = ("pretrained:anywhere", "scripted"), ("rover_rl.algos.policy.dwa:DynamicWindowPolicy", "scripted"), ()
    assert all(split_task(words) == (None, words) for words in policies)
    (tmp_path / "mazes").mkdir()
    assert split_task(("mazes",)) == (None, ("mazes",))
