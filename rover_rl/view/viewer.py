"""``Viewer``: a page that shows an environment and the policy that drives in it, and takes the wheel.

Example:
    >>> from rover_rl import make_env
    >>> from rover_rl.view import Viewer
    >>> viewer = Viewer(make_env(world="moon", num_envs=4, seed=0), port=0)  # open viewer.address in a browser
    >>> viewer.close()
"""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike
from torchrl.envs import EnvBase

from rover_rl.algos.config import RunConfig
from rover_rl.algos.experiments.runs import RunFiles
from rover_rl.algos.policy.checkpoint import CHECKPOINT
from rover_rl.algos.policy.names import BASELINES, PRETRAINED, RANDOM, make_baseline, resolve_policy
from rover_rl.algos.policy.runner import Policy
from rover_rl.algos.pretrained import pretrained_names
from rover_rl.algos.train.live import INTERVAL
from rover_rl.algos.video.session import Pose, Session
from rover_rl.native.threads import single_threaded
from rover_rl.robots import ROBOTS
from rover_rl.view.page import HOST, PORT, Page, Pilot, Recorder, check_address
from rover_rl.view.panels import LiveMoment, Panels, TrainingPanel, episode_table
from rover_rl.view.replay import caption_of
from rover_rl.view.stage import MAP, Stage
from rover_rl.worlds import world_names

FRAMES = 30  # number of updates of the page, 1/s
TRAINING_FRAMES = 1 / INTERVAL  # the same for the rovers of a training
PANELS_EVERY = 6  # number of frames after which the panels change
TRAINING_EVERY = 2.0  # time after which the files of a training are read again, s
MAX_STEPPING = 0.06  # time from which on a simulation that is too slow leaves out time to keep the page smooth, s
MAX_LAG = 0.25  # time that a simulation slower than its speed setting catches up on at most, s
BACKENDS = ("bullet", "warp", "mujoco")  # simulators that the page offers


class Viewer(Page):
    """Page in the browser with the rovers of an environment. It runs in the background until :meth:`close`.

    Args:
        env: :class:`~rover_rl.RoverEnv` or :func:`~rover_rl.make_env`, with ``num_envs``.
        policy: policy that drives, or its name; ``None`` acts at random.
        name: name of the policy on the page.
        host: address of the page. ``"0.0.0.0"`` lets other machines reach it.
        port: port of the page; 0 takes a free one.
        find_policy: function that returns the policy of a name. By default: ``random``, a baseline,
            ``pretrained:NAME``, the folder of a run or a checkpoint.
        run: run whose learning curve and snapshots the page shows.

    Attributes:
        address: address of the page, to open in a browser.
        error: what went wrong last, such as an error in the policy; empty if nothing has.

    Raises:
        ImportError: if the extra ``view`` is not installed.
        OSError: if the port is taken.
        ValueError: if the environment is not a batch, or the policy was made for another one.
    """

    def __init__(
        self,
        env: EnvBase,
        policy: Policy | str | None = None,
        *,
        name: str | None = None,
        host: str = HOST,
        port: int = PORT,
        find_policy: Callable[[str], Policy | None] = lambda name: resolve_policy(name).module,
        run: RunFiles | None = None,
    ) -> None:
        check_address(host, port)
        self._find = find_policy
        if isinstance(policy, str):
            name, policy = policy, find_policy(policy)
        name = name or (RANDOM if policy is None else "given")
        self._given = {} if policy is None else {name: policy}
        self.session = Session(env, policy)
        # Those of a training stay the same whatever a person chooses.
        self._trained = self.session.rovers.robot, self.session.rovers.scanner.angles.cpu()
        super().__init__(host, port)
        self.error, self.frames, self._policy = "", 0, name
        self._requests: queue.Queue[tuple[Callable[[], Any], ...]] = queue.Queue()
        self._training: TrainingPanel | None = None
        self._watching, self._due, self._last, self._read = False, 0.0, 0.0, 0.0
        self.stage = Stage(self.server)
        self._make_page(name, run)
        self._moved()
        self.start()

    def close(self) -> None:
        """Closes the page and the environment. Idempotent."""
        if not self._closed.is_set():
            super().close()
            self.session.close()

    def request(self, *acts: Callable[[], Any]) -> None:
        """Lets the thread of the simulation call functions between two steps.

        An error in one pauses the simulation, and those after it are not called.
        """
        self._requests.put(acts)

    def _drive(self, *acts: Callable[[], Any]) -> None:
        """Does what the person wants with the rovers of the page, in place of watching those of a training."""
        if self._training is not None:
            self._training.drive()
        self.request(*acts)

    def play(self, playing: bool) -> None:
        """Runs or pauses the simulation."""
        self.error = "" if playing else self.error
        super().play(playing)

    def _make_page(self, policy: str, run: RunFiles | None) -> None:
        gui, scene = self.server.gui, self.server.scene
        self._status = gui.add_markdown("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Drive"):
            self._make_drive_tab(policy)
        with tabs.add_tab("Show"):
            self.stage.add_controls()
            Recorder(gui)
        with tabs.add_tab("Inside"):
            self.panels = Panels(gui)
        with tabs.add_tab("Episodes"):
            self._episodes = gui.add_markdown("No episode has ended yet.")
        if run is not None:
            with tabs.add_tab("Training"):
                self._training = TrainingPanel(
                    gui, run, lambda load: self.request(lambda: self.session.set_policy(*load()), self._moved)
                )
        scene.on_click()(self._on_click)
        scene.on_click(modifier="shift")(self._on_click)
        self.stage.on_drag = self._on_drag

    def _make_drive_tab(self, policy: str) -> None:
        gui, session = self.server.gui, self.session
        self._add_play()
        gui.add_button("Step").on_click(lambda _: self._drive(self._step_once))
        gui.add_button("Reset").on_click(lambda _: self._drive(session.reset, self._moved))
        explore = gui.add_checkbox("Explore", False, hint="Actions are drawn from the policy's distribution")
        explore.on_update(lambda _: setattr(session, "exploring", explore.value))
        runs = sorted(str(file.parent) for file in Path(RunConfig.runs).glob(f"*/{CHECKPOINT}"))
        names = [*self._given, *runs, *(PRETRAINED + name for name in pretrained_names()), *BASELINES, RANDOM]
        self._add_choice("Policy", policy, names, self.set_policy)
        backend, robot = session.config.backend, session.config.robot
        if session.can_change:
            world = session.rovers.worlds[0].name
            self._add_choice("World", world, world_names(), lambda name: self._change(world=name))
        if session.can_change and isinstance(backend, str):
            self._add_choice("Simulator", backend, BACKENDS, lambda name: self._change(backend=name))
        if session.can_change and isinstance(robot, str):
            self._add_choice("Robot", robot, ROBOTS, self.set_robot)
        if session.rovers.num_envs > 1:
            row = gui.add_slider("Rover", 0, session.rovers.num_envs - 1, 1, 0)
            row.on_update(lambda _: self.request(lambda: self._follow(row.value)))
        gui.add_markdown("Click on the ground: goal. Shift-click: rover. A rover can be dragged, too.")
        self.pilot = Pilot(gui)

    def _add_choice(self, label: str, value: str, names: Iterable[str], act: Callable[[str], None]) -> None:
        """Adds a list of names, at first on ``value``. A person chooses another one, and ``act`` is called with it."""
        chosen = self.server.gui.add_dropdown(label, list(dict.fromkeys((value, *names))), initial_value=value)
        chosen.on_update(lambda _: self._drive(lambda: act(chosen.value)))

    def _on_click(self, event: viser.SceneClickEvent) -> None:
        """Moves the goal of the followed rover to where the ground was clicked, or with Shift the rover."""
        self._put(self.session.row, event.ray_origin, event.ray_direction, goal=event.modifier != "shift")

    def _on_drag(self, event: viser.SceneNodeDragEvent) -> None:
        """Puts a rover that was dragged to the ground under the pointer."""
        if event.phase != "end" or event.instance_index is None:
            return
        row, eye = int(self.session.neighbors()[event.instance_index]), event.client.camera.position
        self._put(row, eye, np.array(event.end_position) - eye)

    def _put(self, row: int, eye: ArrayLike, toward: ArrayLike, goal: bool = False) -> None:
        """Puts a rover or its goal to where a line of sight meets the ground, if it does."""
        session = self.session
        place = self.stage.cameras.ground_at(session.rovers.worlds[row], eye, toward)
        if place is not None and goal:
            self._drive(lambda: session.set_goal(row, place))
        elif place is not None:
            self._drive(lambda: session.put(row, place), self._moved)

    def set_policy(self, name: str) -> None:
        """Lets another policy drive. Raises an error if there is none, or it was made for another environment."""
        self.session.set_policy(self._given.get(name) or self._find(name))
        self._policy = name
        self._moved()

    def set_robot(self, name: str) -> None:
        """Lets another robot drive. Raises an error if the policy is for one robot: a baseline drives any."""
        policy = self._given.get(self._policy) or self._find(self._policy)
        self.session.set_robot(name, make_baseline(self._policy, name) if self._policy in BASELINES else policy)
        self._moved()

    def _change(self, **changes: Any) -> None:
        self._status.content = "Loading …"
        self.session.change(**changes)
        self._moved()

    def _follow(self, row: int) -> None:
        self.session.row, self.session.history = row, {}
        self._moved()

    def _moved(self) -> None:
        """Shows a rover that is elsewhere than before, perhaps in another world."""
        rovers = self.session.rovers
        self.stage.enter(rovers.worlds[self.session.row], rovers.robot, rovers.scanner.angles.cpu())
        self.stage.forget_path()
        self._before = self._now = Pose.of(rovers.rover_state)

    @single_threaded()
    def _run(self) -> None:
        frame = time.monotonic()
        while not self._closed.is_set():
            live = None
            try:
                while not self._requests.empty():
                    for act in self._requests.get():
                        act()
                    self.error = ""
                live = self._read_training()
                if live is not None:
                    self._show_live(live)
                elif self._training is None or self.server.get_clients():
                    self._drive_on()
            except Exception as error:
                # Whatever happens in a policy, the page stays, so that one can look and choose another.
                self.error = f"{type(error).__name__}: {error}"
                self.play(False)
                self._show_status()
            # A frame that comes late does not delay those after it.
            period = 1 / (FRAMES if live is None else TRAINING_FRAMES)
            frame = max(frame + period, time.monotonic() - period)
            self._closed.wait(max(0.002, frame - time.monotonic()))

    def _read_training(self) -> LiveMoment | None:
        """Reads the files of a training. Returns its rovers, if it runs and somebody watches them."""
        if self._training is None:
            return None
        if time.monotonic() > self._read + TRAINING_EVERY:
            self._training.refresh()
            self._read = time.monotonic()
        return self._training.live() if self.server.get_clients() else None

    def _drive_on(self) -> None:
        """Steps the simulation as far as time has passed since the last call, and shows it."""
        if self._watching:
            self._watching = False
            self._moved()
        began, dt = time.monotonic(), self.session.rovers.control_dt
        due, self._last = self._due + (began - self._last) * self.speed, began
        self._due = min(due, MAX_LAG * max(1.0, self.speed)) if self.playing else 0.0
        while self._due >= dt and self.playing and not self._closed.is_set():
            self._step()
            self._due -= dt
            if time.monotonic() - began > MAX_STEPPING:
                self._due = 0.0
        self._show(self._due / dt if self.playing else 1.0)

    def _step_once(self) -> None:
        self.play(False)
        self._step()

    def _step(self) -> None:
        session, row = self.session, self.session.row
        action = self.pilot.steered(session.decide(), row, session.config.bounded_action)
        session.advance(action, row if self.pilot.active else None)
        self._before, self._now = self._now, Pose.of(session.rovers.rover_state)
        if session.rovers.worlds[row] is not self.stage.world:
            self._moved()

    def _show(self, share: float) -> None:
        """Shows the state, ``share`` of the way from the last step but one to the last."""
        session = self.session
        pose = self._before.toward(self._now, min(1.0, share))
        with self.server.atomic():
            self.stage.show(session.moment(), session.row, session.neighbors(), pose, session.route)
        self.frames += 1
        if self.frames % PANELS_EVERY == 0:
            self._show_status()
            self.panels.show(session)
            if self.stage.shown[MAP]:
                self.stage.show_map(session.seen_map(), session.tracked())
            if session.episodes:
                self._episodes.content = episode_table(session.episodes)

    def _show_live(self, live: LiveMoment) -> None:
        row = min(self.session.row, len(live.worlds) - 1)
        world, moment, rows = live.of(row)
        self.stage.enter(world, *self._trained)
        if not self._watching:
            self._watching = True
            self.stage.forget_path()
        with self.server.atomic():
            self.stage.show(moment, row, rows, Pose.of(moment.rover))
        self.frames += 1
        speed = moment.rover.linear_velocity[row].item()
        distance = (moment.goal[row] - moment.rover.position[row, :2]).norm().item()
        self._status.content = f"{world.name} · training · {speed:.2f} m/s · goal {distance:.1f} m"

    def _show_status(self) -> None:
        session = self.session
        if self.error:
            self._status.content = f"**Paused.** {self.error}"
            return
        driver, world = "by hand" if self.pilot.active else "policy", session.rovers.worlds[session.row].name
        self._status.content = f"{world} · {driver} · {caption_of(session.moment(), session.row)}"
