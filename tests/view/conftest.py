from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from rover_rl import make_env
from rover_rl.algos.config import training_config
from rover_rl.algos.train.ppo import PPOLearner
from rover_rl.algos.train.run import TrainingRun, prepare
from tests.fork_server import quick_workers

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

    from rover_rl.view import Viewer

# The tests need rover_rl[view].
collect_ignore_glob = [] if find_spec("viser") else ["test_*.py"]
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SOFTWARE = ("--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""Options of a browser that draws without a GPU."""
SLOW_SCREEN = """
window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 250);
window.cancelAnimationFrame = clearTimeout;
"""
"""Lets a page draw four times a second. Software draws as often as it is asked to, on all cores."""


def settle(viewer: Viewer) -> None:
    """Waits until the simulation has ended the step that it is in, and has done what was requested before."""
    done = threading.Event()
    viewer.request(done.set)
    assert done.wait(60.0), "the simulation does not answer"


def training_in(runs: Path, **settings: Any) -> Iterator[None]:
    """Trains in the folder ``run``, and yields in each batch."""
    given = {"world": "maze", "num_envs": 8, "backend": "warp", "seed": 0, "runs": str(runs), "name": "run"}
    config = prepare(training_config("ppo", **given, rollout_length=2, hidden=(8,), minibatch=16, **settings))
    with quick_workers(), TrainingRun(config, PPOLearner(config)) as training:
        for batch in training.batches():
            yield
            training.record(training.learner.update(batch, 0.0, training.stopwatch))


@pytest.fixture
def open_viewer() -> Iterator[Callable[..., Viewer]]:
    """Opens a viewer of a small environment on a free port, and closes it at the end."""
    from rover_rl.view import Viewer

    opened: list[Viewer] = []

    def start(policy: object = "scripted", world: str = "maze", num_envs: int = 1, **options: object) -> Viewer:
        env = make_env(world=world, num_envs=num_envs, seed=0, backend="warp")
        opened.append(Viewer(env, policy, port=0, **options))
        return opened[-1]

    yield start
    for viewer in opened:
        viewer.close()


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    if CHROMIUM is None or find_spec("playwright") is None:
        pytest.skip("needs Chromium and playwright")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(SOFTWARE))
        yield browser
        browser.close()


@pytest.fixture
def new_page(browser: Browser) -> Iterator[Callable[[], Page]]:
    """Opens empty pages of a small window, which software draws fast enough."""
    pages: list[Page] = []

    def start() -> Page:
        page = browser.new_page(viewport={"width": 640, "height": 420})
        pages.append(page)
        # Software draws slowly beside other tests.
        page.set_default_timeout(180_000)
        page.add_init_script(SLOW_SCREEN)
        return page

    yield start
    for page in pages:
        page.close()


@pytest.fixture
def open_page(new_page: Callable[[], Page]) -> Callable[[str], Page]:
    """Opens pages of a viewer."""

    def start(address: str) -> Page:
        page = new_page()
        page.goto(address)
        page.get_by_role("button", name="▲").wait_for()
        # From here on, the page hears keys.
        page.wait_for_function("window.roverKeys")
        return page

    return start
