from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from matplotlib.image import imread

from rover_rl import World
from rover_rl.algos.config import training_config, with_settings
from rover_rl.algos.evaluation.episodes import EpisodeSet, draw_episodes, endless_episodes
from rover_rl.algos.evaluation.evaluate import Evaluation, evaluate
from rover_rl.algos.evaluation.plots import draw_paths
from rover_rl.algos.evaluation.report import print_table, write_evaluation
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import ObservationEncoder, make_actor
from rover_rl.cli import main
from rover_rl.envs.config import ActionConfig, EnvConfig, LidarConfig, Randomization
from rover_rl.worlds import Terrain, box
from tests.algos.drivers import ahead, straight
from tests.algos.evaluation.drives import FIELD, assert_same, csv_rows, printed
from tests.algos.policy.memories import CountingPolicy, recurrent_checkpoint

EPISODES = draw_episodes(FIELD, count=3, seed=1)
MANY = draw_episodes(FIELD, count=9, seed=1)


@pytest.fixture(scope="module")
def driven() -> Evaluation:
    return evaluate(straight, EPISODES, name="straight")


# --- one goal


def test_driving_at_the_goal_reaches_it_on_open_ground(driven: Evaluation) -> None:
    assert driven.endings == ["goal"] * 3
    assert driven.success_rate == 1
    for path, start, goal, steps in zip(
        driven.paths, EPISODES.start, EPISODES.goal, map(len, driven.trajectories), strict=True
    ):
        assert len(path) == steps + 1
        torch.testing.assert_close(path[0], start[:2], atol=0.02, rtol=0)
        assert torch.dist(path[-1], goal) < 0.5
    assert driven.metrics["mean_time_to_traverse"].value > EPISODES.shortest.mean()


@pytest.mark.parametrize("kind", ["random", "gru"])
def test_an_episode_depends_neither_on_the_rows_nor_on_its_place(kind: str) -> None:
    torch.manual_seed(0)
    policy = None if kind == "random" else recurrent_checkpoint(kind).make_actor()
    together = evaluate(policy, MANY, seconds=0.6, rows=9)
    for rows in (1, 4):
        assert_same(evaluate(policy, MANY, seconds=0.6, rows=rows).trajectories, together.trajectories)
    if kind != "random":  # which draws for the number of an episode
        turned = EpisodeSet("field", FIELD, 1, MANY.start.flip(0), MANY.goal.flip(0), MANY.shortest.flip(0))
        backwards = evaluate(policy, turned, seconds=0.6, rows=8)
        assert_same(backwards.trajectories[::-1], together.trajectories)


def test_a_policy_with_memory_decides_as_often_as_in_training() -> None:
    policy = CountingPolicy()
    evaluation = evaluate(policy, EPISODES, seconds=2.0, rows=1)
    assert (evaluation.action_repeat, policy.calls) == (4, 3 * 10)
    every_step = evaluate(policy, endless_episodes(FIELD, 2), seconds=0.5, action_repeat=1)
    assert (every_step.action_repeat, policy.calls) == (1, 3 * 10 + 10)
    # It drives faster the more decisions it has taken in an episode, and starts anew in each.
    assert_same(evaluate(policy, EPISODES, seconds=2.0, rows=3).trajectories, evaluation.trajectories)
    speeds = [trajectory.speed for trajectory in evaluation.trajectories]
    assert all(0.05 < speed.max() < 0.15 for speed in speeds)


def test_the_random_policy_starts_at_the_same_places_and_leaves_the_generator_alone(driven: Evaluation) -> None:
    before = torch.random.get_rng_state()
    first, second = (evaluate(None, EPISODES, action_repeat=4, seconds=1) for _ in range(2))
    assert torch.equal(before, torch.random.get_rng_state())
    assert_same(first.trajectories, second.trajectories)
    assert first.name == "random"
    for ours, theirs in zip(first.paths, driven.paths, strict=True):
        assert torch.equal(ours[0], theirs[0])


ROOM = World("room", Terrain.flat((12.0, 12.0)), [box((3.0, 0.0, 0.5), (1.0, 8.0, 1.0))])
BEHIND_A_WALL = EpisodeSet("room", ROOM, 0, torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[5.0, 0.0]]), torch.ones(1))


def test_driving_into_a_wall_jams_and_touches_it() -> None:
    jammed = evaluate(ahead, BEHIND_A_WALL, seconds=10)
    assert jammed.endings == ["jammed"]
    assert jammed.metrics["collisions"].value == 1
    assert jammed.metrics["body_contacts"].value >= 1
    assert jammed.metrics["ending_jammed"].value == 1
    assert jammed.trajectories[0].collision[-16:].all()


def test_settings_out_of_range_raise() -> None:
    for setting in ({"action_repeat": 0}, {"rows": 0}, {"seconds": 0.01}):
        with pytest.raises(ValueError, match=f"{next(iter(setting))} must be at least"):
            evaluate(straight, EPISODES, **setting)


# --- the environment that a policy was made for


def test_a_policy_made_for_another_environment_raises(checkpoint: Checkpoint) -> None:
    actor, env = checkpoint.make_actor(), EnvConfig(lidar=LidarConfig(points=16))
    message = "^the policy was made for lidar points 32, and the environment has 16$"
    with pytest.raises(ValueError, match=message):
        evaluate(actor, EPISODES, env=env, seconds=0.1)


def test_a_checkpoint_drives_in_the_environment_that_it_was_made_for(checkpoint: Checkpoint) -> None:
    config = with_settings(checkpoint.config, lidar=LidarConfig(points=16), world="maze")
    config = with_settings(config, randomization=Randomization.typical(), action=ActionConfig(min_speed=0.0))
    encoder = ObservationEncoder(lidar_points=16)
    actor = Checkpoint(config, 1, make_actor(encoder, (8,)).state_dict()).make_actor()
    evaluation = evaluate(actor, EPISODES, seconds=0.2)
    # Policies are compared without randomization.
    assert evaluation.env == EnvConfig(
        world="field", num_envs=3, seed=1, end_on_goal=True, lidar=config.env.lidar, action=config.env.action
    )


# --- goals without end


def test_goals_keep_coming() -> None:
    endless = evaluate(straight, endless_episodes(FIELD, 2, 1), seconds=18, env=EnvConfig(backend="warp"))
    goals = [int(trajectory.goal.sum()) for trajectory in endless.trajectories]
    assert [len(trajectory) for trajectory in endless.trajectories] == [360, 360]
    assert min(goals) >= 2
    assert endless.metrics["goals_per_episode"].value == sum(goals) / 2
    assert endless.metrics["seconds_per_goal"].value == pytest.approx(36 / sum(goals))
    assert endless.metrics["ended_early"].value == 0
    first = {"goals": goals[0], "ending": "time limit", "seconds": 18.0, "contacts": 0, "collisions": 0}
    assert endless.to_json()["episodes"][0] == first


def test_without_the_jam_ending_a_collision_goes_on() -> None:
    with_jam, without = (evaluate(ahead, endless_episodes("maze", 1, 1), seconds=5, jam=jam) for jam in (True, False))
    assert [trajectory.ending for trajectory in with_jam.trajectories] == ["jammed"]
    assert [trajectory.ending for trajectory in without.trajectories] == ["time limit"]
    for ours, theirs in zip(with_jam.trajectories, without.trajectories, strict=True):
        assert torch.equal(ours.position, theirs.position[: len(ours) + 1])


# --- results


def test_results_and_pictures(driven: Evaluation, tmp_path: Path) -> None:
    random = evaluate(None, EPISODES, seconds=1)
    endless = evaluate(straight, endless_episodes(FIELD, 2, 1), seconds=1)
    write_evaluation(tmp_path / "evaluation.json", [driven, random, endless])
    written = json.loads((tmp_path / "evaluation.json").read_text())
    modes = [("straight", "one goal"), ("random", "one goal"), ("policy", "endless")]
    assert [(entry["policy"], entry["mode"]) for entry in written] == modes
    assert written[0]["endings"] == {"goal": 3}
    assert [episode["ending"] for episode in written[0]["episodes"]] == ["goal"] * 3
    for episode in written[0]["episodes"]:
        assert episode["length"] >= episode["shortest"] - 0.1

    rows = csv_rows(tmp_path / "evaluation.csv")
    first = [("straight", "0"), ("straight", "1"), ("straight", "2"), ("random", "0")]
    assert [(row["policy"], row["episode"]) for row in rows[:4]] == first
    for row, episode in zip(rows, written[0]["episodes"], strict=False):
        assert [float(row[key]) for key in ("start_x", "start_y", "start_yaw")] == episode["start"]
        assert (row["ending"], row["contacts"]) == ("goal", "0")
        assert float(row["seconds"]) == episode["seconds"]
    assert len(rows) == sum(entry["count"] for entry in written)
    assert rows[-1]["goals"] == str(written[-1]["episodes"][-1]["goals"])

    rows = csv_rows(tmp_path / "evaluation-summary.csv")
    assert [row["policy"] for row in rows] == ["straight", "random", "policy"]
    for row, entry in zip(rows, written, strict=True):
        for key, estimate in entry["metrics"].items():
            for column, field in ((key, "value"), (f"{key}_low", "low"), (f"{key}_high", "high")):
                number = float(row[column])
                assert estimate[field] == (pytest.approx(number) if math.isfinite(number) else None)

    draw_paths([driven, random], tmp_path / "paths.png")
    assert imread(tmp_path / "paths.png")[..., :3].std() > 0.05


def test_the_table_has_a_row_a_policy_and_one_for_all_seeds(driven: Evaluation) -> None:
    again = Evaluation("again", *list(vars(driven).values())[1:5])
    text = printed(print_table, [driven, again], 80, groups={"straight": "both of them", "again": "both of them"})
    assert text.count("3 episodes in field: one goal within 60 s") == 1
    row = next(line for line in text.splitlines() if line.startswith(" straight"))
    assert "100.0" in row
    assert f"{driven.metrics['spl'].value:.2f}" in row
    assert all(shown in text for shown in ("44–100", "both of them", "± 0.0"))
    assert not any(hidden in text for hidden in ("nan", "jammed", "turns:"))


# --- the command


@pytest.fixture
def run(tmp_path: Path) -> Path:
    config = training_config("ppo", world="maze", hidden=(8,))
    actor = make_actor(hidden=config.network.hidden)
    checkpoint = Checkpoint(config=config, steps=0, actor=actor.state_dict())
    for seed in (1, 2):
        checkpoint.save(tmp_path / f"run-{seed}" / "checkpoint.pt")
    return tmp_path


def complaint(capsys: pytest.CaptureFixture[str], *args: object) -> str:
    assert main(["evaluate", *map(str, args)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    return captured.err


def test_the_command_drives_checkpoints_beside_baselines(capsys: pytest.CaptureFixture[str], run: Path) -> None:
    first, second = run / "run-1", run / "run-2" / "checkpoint.pt"
    assert main(["evaluate", str(first), str(second), "scripted", "random", "--count", "2", "--seconds", "0.5"]) == 0
    assert {"evaluation.json", "evaluation.csv", "paths.png"} <= {file.name for file in first.iterdir()}
    written = json.loads((first / "evaluation.json").read_text())
    assert [entry["policy"] for entry in written] == ["run-1", "run-2", "scripted", "random"]
    assert {(entry["world"], entry["seed"], entry["count"]) for entry in written} == {("maze", 20_000, 2)}
    assert "PPO in maze" in capsys.readouterr().out


def test_the_command_refuses_in_one_line(capsys: pytest.CaptureFixture[str], run: Path) -> None:
    assert "say which --world to drive in" in complaint(capsys, "random")
    assert "unknown world 'mars'" in complaint(capsys, "scripted", "--world", "maze", "mars")
    assert "no checkpoint at" in complaint(capsys, run / "run-1", run / "none.pt")
    assert "count must be" in complaint(capsys, run / "run-1", "--count", 0)
