"""The viewer without a browser."""

from __future__ import annotations

import json
import math
import shutil
import socket
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensordict import TensorDictBase

from rover_rl import ActionConfig, RoverEnv, Terrain, World, make_env
from rover_rl.algos.config import default_config
from rover_rl.algos.config_files import write_config
from rover_rl.algos.experiments.runs import RunFiles
from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.algos.pretrained import FOLDER
from rover_rl.algos.video.recording import Recording, record_endless
from rover_rl.algos.video.session import Pose
from rover_rl.cli import main, training_page
from rover_rl.cli.training_page import TrainingPage, open_viewer
from rover_rl.envs.sensors.cameras import ColorCamera
from rover_rl.envs.sensors.heights import HeightScan
from rover_rl.view import Viewer
from rover_rl.view.live import LivePage
from rover_rl.view.page import check_address
from rover_rl.view.panels import lidar_picture, reward_bars, sensor_picture, spread_bars, watch_training
from rover_rl.view.replay import ReplayPage, write_replay
from rover_rl.view.stage import CUT, without_high_walls
from rover_rl.worlds import box, get_world
from tests.sims.ros2.processes import until
from tests.view.conftest import settle, training_in


def paused(viewer: Viewer) -> Viewer:
    viewer.play(False)
    settle(viewer)
    return viewer


def test_rovers_drive_until_the_viewer_is_closed_and_errors_pause_them(open_viewer):
    viewer = open_viewer(num_envs=3)
    until(lambda: viewer.session.seconds > 0.2)
    assert viewer.address == f"http://localhost:{viewer.server.get_port()}"

    def fail(observation: TensorDictBase) -> TensorDictBase:
        raise ArithmeticError("no idea")

    viewer.request(lambda: viewer.session.set_policy(fail))
    until(lambda: viewer.error)
    assert viewer.error == "ArithmeticError: no idea"
    assert not viewer.playing
    # An unknown policy or world is one sentence, and the old one stays.
    viewer.request(lambda: viewer.set_policy("scripted"))
    until(lambda: not viewer.error)
    viewer.request(lambda: viewer.set_policy("pretrained:anywere"))
    until(lambda: "perhaps 'anywhere'" in viewer.error)
    viewer.request(lambda: viewer._change(world="mooon"))
    until(lambda: "mooon" in viewer.error)
    viewer.play(True)
    seconds = viewer.session.seconds
    until(lambda: viewer.session.seconds > seconds)
    viewer.close()
    seconds = viewer.session.seconds
    viewer.close()
    assert viewer.session.seconds == seconds


def test_policies_worlds_and_robots_are_chosen(open_viewer):
    viewer = paused(open_viewer("gridplanner", num_envs=2))
    session, stage = viewer.session, viewer.stage
    viewer.request(lambda: viewer._change(world="rooms"))
    settle(viewer)
    assert stage.world.name == "rooms"
    viewer.request(lambda: viewer.set_robot("jackal"), viewer._step_once)
    settle(viewer)
    assert not viewer.error
    assert session.rovers.robot.name == "jackal"
    # The planner's map of what it has seen, around the rover, and its route.
    cells, route = session.seen_map()
    rover = session.rovers.rover_state.position[0, :2]
    assert len(cells) > 20
    assert (cells[:, :2] - rover).norm(dim=-1).max() < 20
    assert route[0].equal(rover)
    stage.show_map((cells, route), torch.zeros(0, 5))
    # A policy brings the environment that it was made for, and is for one robot.
    viewer.request(lambda: viewer.set_policy("pretrained:anywhere"))
    settle(viewer)
    assert (session.rovers.config.lidar.points, session.rovers.num_envs) == (128, 2)
    viewer.request(lambda: viewer.set_robot("husky"))
    until(lambda: "the policy was made for the robot" in viewer.error)


def test_goals_are_set_and_rovers_put_and_dragged(open_viewer):
    viewer = paused(open_viewer(num_envs=2))
    session = viewer.session
    other = session.rovers.goal[1].clone()
    viewer.request(lambda: session.set_goal(0, (1.0, 2.0)))
    viewer.request(viewer._step_once)
    settle(viewer)
    assert session.rovers.goal[0].tolist() == [1.0, 2.0]
    assert session.rovers.goal[1].equal(other)
    distance = torch.dist(session.rovers.rover_state.position[0, :2], torch.tensor([1.0, 2.0]))
    assert session.history["distance"][-1] == pytest.approx(distance.item(), abs=1e-4)
    viewer.request(lambda: session.put(0, (-1.0, 0.5)))
    settle(viewer)
    assert session.rovers.rover_state.position[0, 0] == -1.0
    assert session.rovers.goal[0].tolist() == [1.0, 2.0]
    before = session.rovers.rover_state.position.clone()
    viewer._on_drag(SimpleNamespace(phase="start", instance_index=1))
    # The last step may still be shown after the first wait. Then the follow camera rests.
    settle(viewer)
    assert session.rovers.rover_state.position.equal(before)
    # The camera is above the point, and the world is where the follow camera has moved it.
    above = viewer.stage.cameras._offset + np.array((1.0, -2.0, 20.0))
    client = SimpleNamespace(camera=SimpleNamespace(position=above))
    event = {"instance_index": 1, "client": client, "end_position": above - np.array((0.0, 0.0, 1.0))}
    viewer._on_drag(SimpleNamespace(phase="end", **event))
    settle(viewer)
    assert session.rovers.rover_state.position[1, :2].tolist() == pytest.approx([1.0, -2.0])
    assert session.rovers.rover_state.position[0].equal(before[0])


def test_the_movers_that_a_policy_tracks_are_where_they_are(open_viewer):
    viewer = paused(open_viewer("gridplanner-moving", "plaza:3@1"))
    viewer.request(*[viewer._step_once] * 30)
    settle(viewer)
    tracked, parts = viewer.session.tracked(), viewer.session.moment().movers
    assert len(tracked) >= 2
    nearest = torch.cdist(tracked[:, :2], parts.position[0, :, :2]).amin(-1)
    assert (nearest < 0.6).float().mean() >= 0.8
    assert (tracked[:, 2:4].norm(dim=-1) > 0.3).any()
    viewer.stage.show_map(viewer.session.seen_map(), tracked)


def test_a_person_drives_one_rover_and_nobody_after_a_stop(open_viewer):
    viewer = paused(open_viewer(num_envs=2))
    action = torch.ones(2, 2)
    limits = ActionConfig(max_speed=0.5).for_robot("rover_zero")
    assert viewer.pilot.steered(action, 1, limits).equal(action)
    viewer.pilot.take_over()
    assert viewer.pilot.steered(action, 1, limits).tolist() == [[1, 1], [0, 0]]
    viewer.pilot._pressed |= {"▲": float("inf"), "▶": float("inf")}
    assert viewer.pilot.steered(action, 1, limits)[1].tolist() == pytest.approx([0.5, -math.radians(60)])
    for kind, expected in {"twist": [0.5, -7.0], "wheels": [0.5, 0.25]}.items():
        others = replace(limits, kind=kind).for_robot("rover_zero")
        assert viewer.pilot.steered(action, 1, others)[1].tolist() == pytest.approx(expected)
    viewer.pilot.give_back()
    assert viewer.pilot.steered(action, 1, limits).equal(action)
    with LivePage(port=0) as page:
        runner = page.runner(viewer.session._policy, viewer.session.rovers)
        assert runner(viewer.session.observation).shape == (2, 2)
        page.stopped = True
        with pytest.raises(InterruptedError, match="the rover stands"):
            runner(viewer.session.observation)


def test_an_environment_without_a_batch_and_a_taken_port_are_one_sentence(capsys, tmp_path):
    with pytest.raises(ValueError, match="num_envs=1, not None"):
        Viewer(RoverEnv(world="maze", num_envs=None, backend="warp"), port=0)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(OSError, match=f"cannot open a page on 127.0.0.1:{port}"):
            check_address("127.0.0.1", port)
        assert main(["view", "scripted", "--port", str(port)]) == 2
        # Before the training begins.
        assert main(["train", "--view", "--port", str(port), "--runs", str(tmp_path)]) == 2
    assert capsys.readouterr().err.count("choose another --port\n") == 2
    assert not [*tmp_path.iterdir()]


def test_poses_between_two_steps():
    start = Pose(torch.zeros(2, 3), torch.tensor([[0.0, 0, 0, 1]] * 2))
    end = Pose(torch.tensor([[0.1, 0, 0], [5, 0, 0]]), torch.tensor([[0.0, 0, 1, 0], [0, 0, 1, 0]]))
    middle = start.toward(end, 0.5)
    # The second rover was put elsewhere.
    assert middle.position[:, 0].tolist() == pytest.approx([0.05, 5])
    assert middle.orientation[0].tolist() == pytest.approx([0, 0, 0.5**0.5, 0.5**0.5])
    assert middle.orientation[1].tolist() == [0, 0, 1, 0]


def test_pictures_of_readings_rewards_and_actions():
    picture = lidar_picture(np.array([0.2, 30.0, 1.0]), 12.0)
    assert picture.count("<path") == 4
    assert "3 readings up to 12 m" in picture
    text = reward_bars({"goal": 100.0, "idle": 0.0, "turn": -1.0}, {"norm of state": 2.0})
    assert "goal" in text
    assert "idle" not in text
    assert "norm of state: 2" in text
    # The center of the second part is that of its bounds.
    bar = spread_bars(torch.tensor([[-1.0, -0.5, 0.0, 0.5, 1.0], [0.0, 0.5, 1.0, 1.5, 2.0]]))
    assert bar.count('x="49.5"') == 2
    assert bar.count('width="50.0"') == 2
    picture = sensor_picture(HeightScan(size=(2, 2)), torch.tensor([-1.0, 1.0, 0.0, 0.0]))
    assert picture[0, [0, -1]].tolist() == [[68, 1, 84], [253, 231, 36]]
    assert (picture[96:] == picture[96, 0]).all()
    red_and_green = torch.tensor([1.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    colors = sensor_picture(ColorCamera(size=(1, 2)), red_and_green)
    assert colors[0, [0, -1]].tolist() == [[255, 0, 0], [0, 255, 0]]


def test_a_page_shows_what_a_camera_sees():
    env = make_env(world="maze", num_envs=1, seed=0, backend="warp", sensors=["heights"])
    with closing(Viewer(env, port=0)) as viewer:
        until(lambda: "heights" in viewer.panels.images or viewer.error)
        assert viewer.panels.images["heights"].image.shape == (192, 192, 3)


def test_the_distribution_of_the_action_is_within_its_bounds(open_viewer):
    session = paused(open_viewer("pretrained:anywhere")).session
    session.decide()
    spread = session.action_spread()
    assert (spread.diff(dim=-1) >= 0).all()
    center = session.decide()[0].tolist()
    assert spread[:, 2].tolist() == pytest.approx(center, abs=1e-5)
    session.exploring = True
    # An action is held for some steps.
    assert [session.decide() for _ in range(session._drive.runner.action_repeat)][-1][0].tolist() != center
    session.set_policy(ScriptedPolicy())
    session.decide()
    assert session.action_spread() is None


# --- runs


@pytest.fixture
def run(tmp_path) -> RunFiles:
    """A run that was killed while it wrote its table."""
    folder = tmp_path / "ppo-moon"
    folder.mkdir()
    write_config(folder / "config.yaml", default_config("ppo", "warp"))
    header = "steps,minutes,attempts,attempts_reached,goals_per_2000_steps\n"
    (folder / "progress.csv").write_text(header + "1000,0.1,4,1,2.0\n2000,0.2,4,3,6.0\n3000,0.3,")
    found = RunFiles.find(folder)
    assert found is not None
    return found


def test_a_killed_run_shows_what_it_has_written_and_its_newest_policy_drives(run, open_viewer):
    steps, curves = run.curves()
    assert steps.tolist() == [1000, 2000]
    assert curves["success rate"].tolist() == [0.25, 0.75]
    assert curves["goals in 2000 steps"].tolist() == [2, 6]
    assert (run.critic(), run.policies()) == (None, [])
    assert RunFiles.find(run.folder / "nothing") is None
    (run.folder / "progress.csv").unlink()
    steps, curves = run.curves()
    assert (len(steps), curves) == (0, {})
    viewer = open_viewer(None, run=run)
    (run.folder / "snapshots").mkdir()
    shutil.copy(FOLDER / "anywhere.pt", run.folder / "snapshots" / "000001000.pt")
    until(lambda: viewer.session.rovers.config.lidar.points == 128 or viewer.error)
    assert not viewer.error
    Path(run.folder / "checkpoint.pt").write_bytes(b"damaged")
    until(lambda: viewer.error)
    # It stays.
    time.sleep(0.2)
    assert "checkpoint" in viewer.error


def test_the_page_of_a_training_rests_until_somebody_looks(run):
    with closing(open_viewer(run.folder, "127.0.0.1", 0)) as viewer:
        assert viewer.session.rovers.num_envs == 4
        assert viewer.session.rovers.config.world == run.env.world
        time.sleep(0.3)
        assert (viewer.frames, viewer.session.seconds) == (0, 0)


@pytest.mark.parametrize("collection", [{"workers": 1}, {"workers": 2, "collector": "processes"}])
def test_rovers_of_a_training_are_written_while_somebody_watches(tmp_path, collection):
    batches, folder = training_in(tmp_path, **collection), tmp_path / "run"
    next(batches)
    assert not (folder / "live" / "rovers.pt").exists()
    assert watch_training(folder) is None
    until(lambda: next(batches, True) or watch_training(folder) is not None)
    live = watch_training(folder)
    world, moment, rows = live.of(1)
    assert world is get_world("maze")
    assert rows.tolist() == [0, 1, 2, 3]
    assert (moment.goal.shape, moment.rover[rows].position.shape, len(moment.scan)) == ((4, 2), (4, 3), 4)
    position = moment.rover.position
    until(lambda: next(batches, True) or not watch_training(folder).moment.rover.position.equal(position))
    batches.close()
    assert not (folder / "live").exists()
    assert watch_training(folder) is None


def test_a_training_goes_on_without_its_page(run, monkeypatch):
    # The page ends at once, as one that is killed.
    monkeypatch.setattr(training_page, "_PROGRAM", "")
    with TrainingPage("127.0.0.1", 0) as page:
        page._process.wait()
        page.show(run.folder)
        page.show(run.folder)
    # A page ends when its training does, of which it knows by its input.
    monkeypatch.setattr(training_page, "_PROGRAM", "import sys; sys.exit(len(sys.stdin.readlines()))")
    with TrainingPage("127.0.0.1", 0) as page:
        page.show(run.folder)
    assert page._process.returncode == 1


# --- replays


def _missing() -> Recording:
    raise FileNotFoundError("no such world")


def test_drives_are_replayed_in_a_file_and_on_a_page(tmp_path):
    drive = record_endless(ScriptedPolicy(), "maze", seconds=0.5, rows=1, seed=0, env=None)
    write_replay([drive, drive.last(0.2)], tmp_path / "drives.html", ["first", "second"])
    page = (tmp_path / "drives.html").read_text()
    captions = json.loads(page.partition("const captions = ")[2].partition("];")[0] + "]")
    assert [caption.split(" ")[0] for caption in captions] == ["first"] * 6 + ["second"] * 3
    drives = {"one": lambda: drive, "two": lambda: replace(drive, dt=0.1), "none": _missing}
    with closing(ReplayPage(drives, port=0)) as replay:
        replay._seek(0.2)
        assert not replay.playing
        assert replay.projector.stage._path
        until(lambda: replay._status.content.startswith("0.2 s"))
        replay._choose("two")
        assert replay._time.max == pytest.approx(1.0)
        replay._choose("none")
        assert replay._status.content == "**none**: no such world"
        replay.play(True)
        until(lambda: replay.seconds > 0.2)


def test_high_walls_are_cut_and_what_hangs_above_is_left_out_at_any_angle():
    turn = math.radians(30)
    wall = box((2.0, 1.0, 1.25), (4.0, 0.15, 2.5), yaw=turn)
    lintel, roof = box((0.0, -2.0, 2.2), (1.2, 0.15, 0.6)), box((0.0, 0.0, 2.6), (8.0, 8.0, 0.2))
    table, rock, trunk = box((3, 0, 0.4), (2, 1, 0.8)), box((-3, 0, 1), (2, 2, 2)), box((0, 3, 2), (0.4, 0.4, 4))
    world = World("house", Terrain.flat((10.0, 10.0)), [wall, lintel, roof, table, rock, trunk])
    shown = without_high_walls(world).obstacles
    assert [one.vertices[:, 2].max().item() for one in shown] == pytest.approx([CUT, 0.8, 2.0, 4.0])
    assert shown[0].vertices[:, :2].unique(dim=0).shape == wall.vertices[:, :2].unique(dim=0).shape
    assert len(world.obstacles) == 6
