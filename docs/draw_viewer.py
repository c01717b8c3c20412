"""Takes the pictures of the viewer, in the docs, from the real page in a headless browser.

python docs/draw_viewer.py [NAME ...]

It needs the extra ``view``, playwright and Chromium. Without a GPU, it takes some minutes.
"""

from __future__ import annotations

import math
import shutil
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from rover_rl import make_env
from rover_rl.algos.config import training_config
from rover_rl.algos.experiments.runs import RunFiles
from rover_rl.algos.train import train
from rover_rl.rotations import quaternion_to_euler
from rover_rl.view import Viewer

IMAGES = Path(__file__).parent / "images"
SOFTWARE = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Options of a browser that draws without a GPU."""
SLOW = 600_000
"""Time to wait for a picture without a GPU, ms."""
RUN = Path("runs/viewer-pictures")
"""Folder of the run whose training is shown."""


@contextmanager
def viewer_of(policy: str, seconds: float, row: int = 0, **options: Any) -> Iterator[Viewer]:
    """Opens a viewer in which rovers have driven for a time (s), and which is paused then."""
    run = options.pop("run", None)
    env = make_env(backend="warp", **options)
    viewer = Viewer(env, policy, port=0, run=run)
    try:
        viewer.play(False)
        viewer.request(viewer.session.reset, lambda: viewer._follow(row))
        done = threading.Event()
        steps = [viewer._step_once, lambda: viewer._show(1.0)] * round(seconds / viewer.session.rovers.control_dt)
        viewer.request(*steps)
        viewer.request(done.set)
        done.wait()
        yield viewer
    finally:
        viewer.close()


@contextmanager
def page_of(browser: Browser, viewer: Viewer, size: tuple[int, int], tab: str | None = None) -> Iterator[Page]:
    """Opens the page of a viewer."""
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.set_default_timeout(SLOW)
    page.goto(viewer.address)
    page.locator("canvas").first.wait_for()
    # The note that software draws the page.
    page.locator("button.mantine-Notification-closeButton").first.click()
    if tab is not None:
        page.get_by_role("tab", name=tab).click()
    page.wait_for_timeout(8_000)
    yield page
    page.close()


def scene(viewer: Viewer, size: tuple[int, int], eye: tuple[float, ...], look_at: tuple[float, ...]) -> Image.Image:
    """Returns what the only page shows, without its panels, from a place relative to the rover and its heading."""
    (client,) = viewer.server.get_clients().values()
    yaw = quaternion_to_euler(viewer.session.rovers.rover_state.orientation)[viewer.session.row, 2].item()
    turn = np.array(((math.cos(yaw), -math.sin(yaw), 0), (math.sin(yaw), math.cos(yaw), 0), (0, 0, 1)))
    client.camera.position, client.camera.look_at = turn @ eye, turn @ look_at
    time.sleep(2.0)
    return Image.fromarray(client.get_render(size[1], size[0], transport_format="png", timeout=SLOW / 1000)[..., :3])


def save(picture: Image.Image | bytes, name: str) -> None:
    """Saves a picture."""
    image = picture if isinstance(picture, Image.Image) else Image.open(BytesIO(picture))
    path = IMAGES / name
    image = image.convert("RGB")
    if path.suffix == ".png":
        image = image.quantize(256, dither=Image.Dither.NONE)
    image.save(path, quality=85, optimize=True)
    print(f"{path}: {path.stat().st_size // 1000} kB", flush=True)


def draw_first(browser: Browser) -> None:
    """The picture of getting_started.md: a trained rover among the boulders of the moon."""
    with viewer_of("pretrained:anywhere", 6.0, world="moon", num_envs=1, seed=11) as viewer:
        viewer.stage.show_layer("lidar hits", False)
        with page_of(browser, viewer, (1200, 640)):
            save(scene(viewer, (1200, 640), (-1.55, 0.75, 0.95), (0.9, -0.15, 0.05)), "first.jpg")


def draw_follow(browser: Browser) -> None:
    """The page as it opens."""
    with (
        viewer_of("pretrained:anywhere", 6.0, world="moon", num_envs=1, seed=0) as viewer,
        page_of(browser, viewer, (1100, 700)) as page,
    ):
        save(page.screenshot(), "viewer.png")


def draw_many(browser: Browser) -> None:
    """Many rovers from above."""
    with viewer_of("pretrained:anywhere", 3.0, world="moon", num_envs=64, seed=0) as viewer:
        viewer.stage.cameras.select("top")
        with page_of(browser, viewer, (1100, 700), "Show") as page:
            save(page.screenshot(), "viewer-many.png")


def draw_inside(browser: Browser) -> None:
    """What goes on inside of a policy in a maze, with the map that it has built."""
    with viewer_of("pretrained:anywhere", 6.0, world="maze:10003", num_envs=1, seed=1) as viewer:
        viewer.stage.show_layer("map of the policy", True)
        with page_of(browser, viewer, (1100, 860), "Inside") as page:
            session = viewer.session
            viewer.request(lambda: viewer.panels.show(session))
            viewer.request(lambda: viewer.stage.show_map(session.seen_map(), session.tracked()))
            page.wait_for_timeout(4_000)
            save(page.screenshot(), "viewer-inside.png")


def draw_training(browser: Browser) -> None:
    """The learning curve of a run, and its rovers."""
    if not RUN.exists():
        train(training_config("ppo", world="moon", max_minutes=3.0, runs=str(RUN.parent), name=RUN.name, seed=0))
    run = RunFiles(RUN)
    with (
        viewer_of("random", 5.0, world="moon", num_envs=4, seed=0, run=run) as viewer,
        page_of(browser, viewer, (1100, 860), "Training") as page,
    ):
        save(page.screenshot(), "viewer-training.png")


PICTURES: dict[str, Callable[[Browser], None]] = {
    "first": draw_first,
    "follow": draw_follow,
    "many": draw_many,
    "inside": draw_inside,
    "training": draw_training,
}


def main(names: list[str]) -> None:
    """Takes the named pictures, or all."""
    with sync_playwright() as playwright:
        executable = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))))
        browser = playwright.chromium.launch(executable_path=executable, args=list(SOFTWARE))
        for name in names or PICTURES:
            PICTURES[name](browser)
        browser.close()


if __name__ == "__main__":
    main(sys.argv[1:])
