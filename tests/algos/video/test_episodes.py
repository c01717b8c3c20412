"""Films of episodes of an evaluation, of failures and of logs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import pytest
import torch
from PIL import Image

from rover_rl import World
from rover_rl.algos.deploy.bags import DriveBag
from rover_rl.algos.deploy.recorded_drives import read_drives, recording_of_drive
from rover_rl.algos.evaluation.episodes import stored_episodes
from rover_rl.algos.evaluation.evaluate import environment_for, evaluate
from rover_rl.algos.evaluation.report import write_evaluation
from rover_rl.algos.evaluation.results import Evaluation, read_evaluation
from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.algos.video.recording import record_episodes
from rover_rl.cli.film import Film
from rover_rl.cli.main import main
from rover_rl.envs.config import EnvConfig, Randomization
from rover_rl.envs.rover import RoverEnv
from rover_rl.worlds import Terrain, box

SMALL = {"width": 64, "height": 48, "fps": 2}
EXACT = replace(environment_for(None, None), backend="warp")
RANDOMIZED = replace(EXACT, randomization=Randomization(range_noise=0.05))


@lru_cache
def driven(env: EnvConfig) -> Evaluation:
    """Drives nine episodes in the maze. The goal of number 5 is near."""
    episodes = stored_episodes("maze").first(9)
    return evaluate(ScriptedPolicy(), episodes, name="scripted", seconds=4.2, rows=9, env=env)


def evaluated(folder: Path, env: EnvConfig = EXACT) -> Evaluation:
    """Writes their results to a folder."""
    write_evaluation(folder / "evaluation.json", [driven(env)])
    return driven(env)


@pytest.mark.slow
def test_an_episode_is_driven_as_in_the_evaluation(tmp_path: Path) -> None:
    before = evaluated(tmp_path, RANDOMIZED)
    stored = read_evaluation(tmp_path, "scripted")
    assert stored.endings == before.endings
    assert {"goal", "time limit"} <= set(stored.endings)
    options = {"seconds": stored.seconds, "action_repeat": stored.action_repeat, "env": stored.env}
    wanted, episodes = (5, 8), stored.to_drive(8)
    assert len(stored.to_drive(5)) == len(episodes) == 9
    drives = record_episodes(ScriptedPolicy(), episodes, wanted, **options)
    for episode, drive in zip(wanted, drives, strict=True):
        positions = torch.cat([moment.rover.position for moment in drive.moments])
        assert torch.equal(positions, before.trajectories[episode].position)
        assert drive.ending == before.endings[episode]
        assert round(drive.seconds, 3) == stored.durations[episode]
        assert drive.moments[-1].event[0] == {"goal": "goal reached"}.get(drive.ending, drive.ending)


def test_some_episodes_are_worth_seeing(tmp_path: Path) -> None:
    evaluated(tmp_path)
    stored = replace(read_evaluation(tmp_path, "scripted"), endings=["goal", "stuck", "goal", "goal", "goal", "goal"])
    stored = replace(stored, durations=[5.0, 9.0, 1.0, 2.0, 30.0, 3.0])
    assert stored.telling(3, 2) == [1, 4, 0, 5, 3]
    assert stored.telling(9, 2) == [1, 4, 0, 5, 3, 2]
    assert replace(stored, endings=["stuck"] * 6).telling(2, 2) == [0, 1]


@pytest.mark.slow
def test_the_command_films_an_episode_or_those_that_failed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = evaluated(tmp_path)
    failed = [episode for episode, ending in enumerate(before.endings) if ending != "goal"]
    seconds = before.trajectories[5].seconds
    out = tmp_path / "film.gif"
    assert Film("scripted", out=out, episode=5, evaluation=tmp_path, view="top", **SMALL)() == 0
    ended = f"in maze, goal reached after {seconds:.1f} s"
    assert capsys.readouterr().out.endswith(f"Film: {out}: episode 5 of scripted's evaluation {ended}\n")
    with Image.open(out) as picture:
        # The last picture is shown for a second.
        assert sum(_durations(picture)) == pytest.approx(1000 * (round(2 * seconds) / 2 + 1))
    assert Film("scripted", out=out, failures=True, count=2, evaluation=tmp_path, seconds=0.5, **SMALL)() == 0
    told = capsys.readouterr().out
    assert f"{len(failed)} of 9 episodes do not reach their goal\n" in told
    assert sorted(path.name for path in tmp_path.glob("film-*.gif")) == sorted(f"film-{one}.gif" for one in failed[:2])
    assert f"Not filmed: {failed[2]} ({before.endings[failed[2]]})" in told
    assert len(failed) < 9
    # An episode that was not evaluated is one of its world.
    assert Film("scripted", out=out, episode=81, world="maze", seconds=0.5, backend="warp", **SMALL)() == 0
    assert f"Film: {out}: episode 81 of the episodes for maze in maze, " in capsys.readouterr().out


def _durations(picture: Image.Image) -> list[float]:
    """Duration of each frame, ms. Equal frames are stored as one."""
    durations = []
    for frame in range(picture.n_frames):  # type: ignore[attr-defined]
        picture.seek(frame)
        durations.append(picture.info["duration"])
    return durations


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("film scripted --failures --out x.gif", "no evaluation of scripted to take failures from"),
        ("film scripted --failures --episode 1 --out x.gif", "give --episode or --failures, not both"),
        ("film scripted --episode 1 --rovers 2 --out x.gif", "--rovers belongs to films without --episode"),
        ("film scripted --episode 300 --world maze:10000-10003 --out x.gif", "episode must be between 0 and 15"),
        ("film scripted --episode 10 --evaluation . --out x.gif", "episode must be between 0 and 9, got 10"),
        ("film random --episode 1 --evaluation . --out x.gif", "has no evaluation of random; it has scripted"),
        ("film scripted --episode 1 --evaluation x.json --out x.gif", "x.json: No such file"),
        ("film scripted --episode 1 --evaluation other.json --out x.gif", "other.json is no evaluation"),
        ("film none.mcap --out x.gif", "none.mcap: No such file"),
        ("film old.jsonl --out x.gif", "old.jsonl is a log of an older version"),
    ],
)
def test_a_wrong_request_is_one_sentence(
    given: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    if "--evaluation ." in given:
        entry = {"policy": "scripted", "mode": "one goal", "backend": "bullet", "world": "maze", "seed": 0}
        episode = {"start": [0, 0, 0], "goal": [1, 1], "shortest": 2, "ending": "goal", "seconds": 1}
        rest = {"action_repeat": 1, "time_limit": 60, "env": None, "episodes": [episode] * 10}
        (tmp_path / "evaluation.json").write_text(json.dumps([entry | rest]))
    (tmp_path / "other.json").write_text('{"mode": 1}')
    assert main(given.split()) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "x.gif").exists()


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Bag of two drives past a wall, in a world that cannot be loaded."""
    world = World("wall", Terrain.flat((12.0, 12.0)), [box((2.0, 0.0, 0.5), (0.4, 4.0, 1.0))])
    path = tmp_path / "drive.mcap"
    env = RoverEnv(world_n=world, seed=0, backend="warp")
    with DriveBag(path, "my_lab", "scripted", 60.0) as written:
        for goal in ((1.0, 3.0), (-1.0, 3.0)):
            td = env.reset(start=torch.tensor([[0.0, 0.0, 0.5]]), goal=torch.tensor([goal]))
            written.begin(env.rover_state, env.scan, goal)
            for _ in range(12):
                td = env.step(td.set("action", torch.tensor([[1.0, 0.0]])))["next"]
                written.step(env.rover_state, env.scan, td["outcome"], (1.0, 0.0), latency=0.01)
            written.end("obstacle too near")
    env.close()
    return path


def test_a_drive_of_a_bag_is_filmed_with_its_readings(
    bag: Path, capsys: pytest.CaptureFixture[str], failed: Callable[..., str]
) -> None:
    drive = recording_of_drive(read_drives(bag))
    assert (drive.episode, drive.ending, len(drive.moments)) == (1, "obstacle too near", 13)
    assert drive.world.name == "none"
    first, last = (drive.moments[step].rover for step in (0, -1))
    assert first.linear_velocity == 0
    assert 0.5 < last.linear_velocity.item() < 1.1
    scan = drive.moments[0].scan[0]
    beams = scan.isfinite()
    assert 10 < beams.sum() < len(beams)
    hits = (scan * (drive.ray_angles + 0.5).cos() + 0.174 * math.cos(0.5))[beams]
    torch.testing.assert_close(hits, torch.full_like(hits, 1.8), atol=0.05, rtol=0)
    assert recording_of_drive(read_drives(bag, world="maze"), 0).world.name == "maze"
    out = bag.with_name("bag.gif")
    assert Film(str(bag), out=out, episode=0, **SMALL)() == 0
    assert f"Film: {out}: episode 0 of {bag}, obstacle too near after 0.6 s\n" in capsys.readouterr().out
    assert main(["play", str(bag), "--no-show"]) == 0
    assert f"Film: {bag.with_suffix('.gif')}: obstacle too near after 0.6 s\n" in capsys.readouterr().out
    assert "has 2 drives: --episode must be at most 1, got 2" in failed("film", bag, "--episode", 2, "--out", "x.gif")
