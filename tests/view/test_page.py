"""The page in a real browser."""

from __future__ import annotations

import threading
from io import BytesIO
from typing import Any

import imageio.v3 as imageio
import pytest
import torch
from PIL import Image

from rover_rl.algos.experiments.runs import RunFiles
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.view.live import LivePage
from tests.sims.ros2.processes import until
from tests.view.conftest import settle, training_in

pytestmark = pytest.mark.slow
TINY: Any = {"width": 40, "height": 40}  # size of a page that software draws soon, which leaves time for another one


def test_a_person_watches_and_pauses(open_viewer, open_page):
    viewer = open_viewer()
    page = open_page(viewer.address)
    page.get_by_text("m/s · goal").wait_for()
    page.get_by_role("button", name="Pause").click()
    until(lambda: not viewer.playing)
    settle(viewer)
    seconds = viewer.session.seconds
    page.get_by_role("button", name="Step", exact=True).click()
    until(lambda: viewer.session.seconds > seconds)
    settle(viewer)
    assert viewer.session.seconds == pytest.approx(seconds + viewer.session.rovers.control_dt)
    page.keyboard.press("Space")
    until(lambda: viewer.playing)


def test_a_click_on_the_ground_sets_the_goal(open_viewer, open_page):
    viewer = open_viewer()
    viewer.play(False)
    page = open_page(viewer.address)
    before = viewer.session.rovers.goal.clone()
    page.locator("canvas").first.wait_for()

    def moved() -> bool:
        # The page hears clicks some time after it is there.
        page.mouse.click(160, 300)
        page.wait_for_timeout(300)
        return not viewer.session.rovers.goal.equal(before)

    until(moved)
    # The click is in front of the camera, which is behind the rover.
    assert torch.dist(viewer.session.rovers.goal[0], viewer.session.rovers.rover_state.position[0, :2]) < 5


def test_keys_take_over_and_the_rover_stops_when_they_are_released_or_the_page_is_lost(open_viewer, open_page):
    viewer = open_viewer()
    page = open_page(viewer.address)
    page.locator("canvas").first.wait_for()
    page.keyboard.down("w")
    page.keyboard.down("ArrowLeft")
    until(lambda: viewer.pilot.command() == (1.0, 1.0))
    assert viewer.pilot.active
    page.keyboard.up("ArrowLeft")
    until(lambda: viewer.pilot.command() == (1.0, 0.0))
    until(lambda: viewer.session.rovers.rover_state.linear_velocity.item() > 0.3)
    page.close()
    until(lambda: viewer.pilot.command() == (0.0, 0.0))
    until(lambda: abs(viewer.session.rovers.rover_state.linear_velocity.item()) < 0.1)


def test_a_person_gives_back_and_changes_to_the_policy_of_a_run(open_viewer, open_page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    load_pretrained("anywhere").save(tmp_path / "runs" / "mine" / "checkpoint.pt")
    viewer = open_viewer()
    page = open_page(viewer.address)
    page.get_by_role("button", name="Take over").click()
    until(lambda: viewer.pilot.active)
    page.get_by_role("button", name="Give back to the policy").click()
    until(lambda: not viewer.pilot.active)
    page.get_by_role("textbox", name="Policy").or_(page.locator("input[value='scripted']")).first.click()
    page.get_by_role("option", name="pretrained:moon-sac").wait_for()
    page.get_by_role("option", name="runs/mine").click()
    # This one was trained with other lidar readings.
    until(lambda: viewer.session.rovers.config.lidar.points == 128 or viewer.error)
    assert not viewer.error


def test_two_pages_and_one_that_comes_back(open_viewer, open_page):
    viewer = open_viewer()
    first = open_page(viewer.address)
    first.set_viewport_size(TINY)
    second = open_page(viewer.address)
    first.close()
    second.get_by_role("button", name="Pause").click()
    until(lambda: not viewer.playing)
    second.set_viewport_size(TINY)
    open_page(viewer.address).get_by_role("button", name="Run").wait_for()


def test_the_stop_button_of_a_live_rover_works_as_it_goes_down(open_page):
    stopped: list[bool] = []
    with LivePage(port=0) as live:
        live.on_stop = lambda: stopped.append(True)
        page = open_page(live.address)
        button = page.get_by_role("button", name="STOP")
        button.wait_for()
        button.dispatch_event("pointerdown", {"button": 0})
        until(lambda: stopped)
        with pytest.raises(InterruptedError, match="the stop button was pressed"):
            live.check()


def test_a_replay_opens_without_a_server(new_page, tmp_path):
    from rover_rl.algos.policy.baselines import ScriptedPolicy
    from rover_rl.algos.video.recording import record_endless
    from rover_rl.view.replay import write_replay

    drive = record_endless(ScriptedPolicy(), "moon", seconds=1, rows=2, seed=0, env=None)
    write_replay([drive], tmp_path / "drive.html")
    page = new_page()
    requests: list[str] = []
    page.on("request", lambda request: requests.append(request.url))
    page.goto((tmp_path / "drive.html").as_uri())
    page.locator("canvas").first.wait_for()
    assert not [url for url in requests if url.startswith("http")]


def test_what_the_page_shows_is_saved_as_a_picture_and_as_a_film(open_viewer, open_page, monkeypatch):
    page = open_page(open_viewer().address)
    page.get_by_role("tab", name="Show").click()
    with page.expect_download() as saved:
        page.get_by_role("button", name="Save a picture").click()
    picture = Image.open(BytesIO(saved.value.path().read_bytes()))
    assert picture.size == (960, 540)
    # Not of one color.
    assert len(picture.convert("RGB").resize((32, 18)).getcolors(32 * 18)) > 20
    # Software draws small films soon.
    monkeypatch.setattr("rover_rl.view.page.SIZE", (96, 160))
    page.get_by_role("button", name="Record a film").click()
    button = page.get_by_role("button", name="Stop and save the film")
    button.wait_for()
    page.wait_for_timeout(1500)
    with page.expect_download() as saved:
        button.click()
    assert saved.value.suggested_filename == "rover.mp4"
    frames = imageio.imread(saved.value.path().read_bytes(), extension=".mp4")
    assert len(frames) > 10
    assert frames.shape[1:] == (96, 160, 3)


def test_the_rovers_of_a_training_are_on_the_page_until_a_person_drives(tmp_path, open_viewer, open_page):
    batches, ended = training_in(tmp_path), threading.Event()
    next(batches)

    def train() -> None:
        while not ended.is_set():
            next(batches)

    thread = threading.Thread(target=train)
    thread.start()
    try:
        viewer = open_viewer(None, run=RunFiles.find(tmp_path / "run"))
        page = open_page(viewer.address)
        page.get_by_text("maze · training").wait_for()
        seconds = viewer.session.seconds
        page.wait_for_timeout(300)
        assert viewer.session.seconds == seconds
        page.get_by_role("button", name="Step", exact=True).click()
        until(lambda: viewer.session.seconds > seconds)
        # The page leaves the training's rovers for good.
        assert viewer._training.live() is None
    finally:
        ended.set()
        thread.join()
        batches.close()
