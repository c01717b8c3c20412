"""The page of a live rover: scan, pose, goal, command and latency, a stop button, and driving by hand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.algos.deploy.driving import Moment as Status
from rover_rl.algos.policy.runner import Policy, PolicyRunner
from rover_rl.algos.video.recording import Moment
from rover_rl.algos.video.session import Pose
from rover_rl.envs.rover import RoverEnv
from rover_rl.view.page import HOST, PORT, Page, Pilot
from rover_rl.view.stage import Stage

FRAMES = 15  # number of updates of the page, 1/s


class LivePage(Page):
    """Page of a live rover. A context manager.

    The stop button calls ``on_stop``, such as ``Ros2Simulator.halt``, which stops the rover at once, in the loop of the
    server, which waits for nothing else: neither for the policy nor for the thread that drives. From then on,
    :meth:`check` raises an error, and no action gets through.
    """

    def __init__(self, host: str = HOST, port: int = PORT) -> None:
        super().__init__(host, port)
        self.stopped = False
        self.on_stop: Callable[[], Any] = lambda: None
        gui = self.server.gui
        stop = gui.add_button("STOP", color="red", hint="Escape. The drive ends, and the rover stands.")
        stop.on_hold(self._stop)  # as the button goes down
        stop.on_click(self._stop)
        gui.add_command("Stop the rover", hotkey="escape").on_trigger(self._stop)
        self._status = gui.add_markdown("Waiting for the rover.")
        self.pilot = Pilot(gui)
        self._stage = Stage(self.server)
        self._stage.add_controls()
        self._latest: tuple[RoverEnv, Moment, Status] | None = None

    async def _stop(self, _: object) -> None:
        if not self.stopped:
            self.stopped = True
            self.on_stop()
            self._status.content = "**Stopped.** The drive has ended."

    def check(self) -> None:
        """Raises ``InterruptedError`` if the stop button was pressed. Call it before each command and after each."""
        if self.stopped:
            raise InterruptedError("the stop button was pressed, and the rover stands")

    def runner(self, policy: Policy, env: RoverEnv) -> PolicyRunner:
        return _StoppableRunner(policy, env, self)

    def show(self, env: RoverEnv, status: Status) -> None:
        """Lets the page show the state after a step. It takes no time of the drive."""
        none = torch.zeros(1, dtype=torch.int64)
        moment = Moment(status.seconds, env.rover_state, env.scan, env.goal, none, none)
        self._latest = env, moment, status

    def _run(self) -> None:
        while not self._closed.wait(1 / FRAMES):
            if self._latest is None or self.stopped:
                continue
            (env, moment, status), self._latest = self._latest, None
            self._stage.enter(env.worlds[0], env.robot, env.scanner.angles)
            self._stage.show(moment, 0, torch.zeros(1, dtype=torch.int64), Pose.of(moment.rover))
            speed, turn = status.command
            self._status.content = (
                f"goal {status.distance:.2f} m · {status.speed:.2f} m/s · nearest {status.nearest:.2f} m · command "
                f"{speed:.2f} m/s {turn:.2f} rad/s · latency {1000 * status.latency:.0f} ms · "
                f"{'by hand' if self.pilot.active else 'policy'}"
            )


class _StoppableRunner(PolicyRunner):
    """Runner of a policy that hands out no action after a stop, and those of a person who has taken over."""

    def __init__(self, policy: Policy, env: RoverEnv, page: LivePage) -> None:
        super().__init__(policy, env=env)
        self._page, self._limits = page, env.config.bounded_action

    def __call__(self, observation: TensorDictBase, due: Tensor | None = None, rows: Tensor | None = None) -> Tensor:
        action = super().__call__(observation, due, rows)
        self._page.check()
        return self._page.pilot.steered(action, 0, self._limits)
