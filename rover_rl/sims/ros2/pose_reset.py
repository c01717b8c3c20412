"""Putting a live rover where an episode starts: by Gazebo's command, by a topic, by a person, or not at all."""

from __future__ import annotations

import logging
import math
import shutil
import subprocess
import time
from collections.abc import Callable
from typing import NamedTuple, Protocol, get_args

from rover_rl.sims.ros2.errors import PoseResetError
from rover_rl.sims.ros2.messages import Header, Point, Pose, PoseStamped, Quaternion
from rover_rl.sims.ros2.settings import PoseReset, Ros2Settings
from rover_rl.sims.ros2.transport import Transport

_log = logging.getLogger(__name__)

_FAILURES = ("ERROR", "Unable", "timed out", "failed")
"""What a Gazebo service call prints when it did not work; its exit code is 0 all the same."""
_LISTENER_TIMEOUT = 5.0
"""Seconds to wait for somebody who listens to a topic."""
_DISCOVERY_TIMEOUT = 1.0
"""Seconds in which a node that listens is discovered, once the rover's sensors are heard."""
_ANSWER_MS = 2000
"""Milliseconds that a Gazebo service call waits for its answer."""


class Target(NamedTuple):
    """Where the rover is to be: m, and rad counter-clockwise from the world's x axis."""

    x: float
    y: float
    z: float
    yaw: float

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Its heading as (x, y, z, w)."""
        return 0.0, 0.0, math.sin(self.yaw / 2), math.cos(self.yaw / 2)


class Placer(Protocol):
    """Puts the rover somewhere."""

    @property
    def moves(self) -> bool:
        """Whether the rover is put anywhere at all."""
        ...

    def place(self, target: Target) -> None:
        """Asks for it. That it was done shows on the pose's topic.

        Raises:
            PoseResetError: if it was refused.
        """
        ...


class GazeboPlacer:
    """Gazebo's service ``/world/<world>/set_pose``, by its command line.

    Args:
        command: ``"ign"`` (Fortress) or ``"gz"`` (Harmonic).
        world: name of the world in Gazebo.
        model: name of the rover in it.

    Raises:
        FileNotFoundError: if the command is not installed.
    """

    moves = True
    MESSAGES = {"ign": "ignition.msgs", "gz": "gz.msgs"}  # noqa: RUF012
    """Where each command's messages are."""

    def __init__(self, command: str, world: str, model: str) -> None:
        found = shutil.which(command)
        if found is None:
            others = [way for way in get_args(PoseReset) if way != command]
            raise FileNotFoundError(
                f"reset={command!r} needs Gazebo's command {command!r}, which is not on the PATH; install it, or "
                f"choose another backend=Ros2Settings(reset=...): {', '.join(map(repr, others))}"
            )
        self._program, self._package, self._world, self._model = found, self.MESSAGES[command], world, model

    def place(self, target: Target) -> None:
        """Calls the service: see :meth:`Placer.place`."""
        if not all(map(math.isfinite, target)):
            raise PoseResetError(f"a pose must be finite numbers, got {tuple(target)}")
        _, _, z, w = target.quaternion
        request = (
            f'name: "{self._model}", position: {{x: {target.x!r}, y: {target.y!r}, z: {target.z!r}}}, '
            f"orientation: {{x: 0.0, y: 0.0, z: {z!r}, w: {w!r}}}"
        )
        arguments = [self._program, "service", "-s", f"/world/{self._world}/set_pose"]
        arguments += ["--reqtype", f"{self._package}.Pose", "--reptype", f"{self._package}.Boolean"]
        arguments += ["--timeout", str(_ANSWER_MS), "--req", request]
        try:
            answer = subprocess.run(
                arguments, capture_output=True, text=True, errors="replace", timeout=2 * _ANSWER_MS / 1000, check=False
            )
        except subprocess.TimeoutExpired as error:
            raise PoseResetError(f"{self._program} did not come back in {error.timeout:g} s") from error
        if not succeeded(answer.stdout, answer.stderr):
            told = (answer.stdout + answer.stderr).strip() or "nothing"
            raise PoseResetError(f"{' '.join(arguments[:4])} did not put {self._model!r} back; it said: {told}")


def succeeded(output: str, errors: str) -> bool:
    """Whether a Gazebo service call worked: its answer is ``data: true``, and it complained of nothing."""
    said = output + "\n" + errors
    return "data: true" in map(str.strip, output.splitlines()) and not any(word in said for word in _FAILURES)


class TopicPlacer:
    """A ``geometry_msgs/PoseStamped`` that somebody listens to, as ``rover-rl robot`` does.

    Args:
        transport: to publish on.
        topic: that it listens on.
        frame_id: of the pose.
    """

    moves = True

    def __init__(self, transport: Transport, topic: str, frame_id: str = "world") -> None:
        self._publish = transport.publisher(topic, PoseStamped, reliable=True)
        self._transport, self._topic = transport, topic
        self._frame_id = frame_id

    def heard(self, timeout: float) -> bool:
        """Whether a node listens, or begins to within ``timeout`` (s)."""
        deadline = time.monotonic() + timeout
        while not self._transport.subscribers(self._topic):
            if time.monotonic() > deadline:
                return False
            time.sleep(0.01)
        return True

    def place(self, target: Target) -> None:
        """Publishes the pose, once a node listens: see :meth:`Placer.place`."""
        if not self.heard(_LISTENER_TIMEOUT):
            raise PoseResetError(f"nobody listens to {self._topic}, so the rover cannot be put back")
        pose = Pose(Point(target.x, target.y, target.z), Quaternion(*target.quaternion))
        self._publish(PoseStamped(Header(frame_id=self._frame_id), pose))


class ManualPlacer:
    """A person, who is told where to put the rover, and says when it is there.

    Args:
        ask: shows a text to that person, and comes back when it is answered; ``None`` asks on the terminal.
    """

    moves = True

    def __init__(self, ask: Callable[[str], object] | None = None) -> None:
        self._ask = ask or input

    def place(self, target: Target) -> None:
        """Tells where to, and waits: see :meth:`Placer.place`."""
        where = f"x {target.x:.2f} m, y {target.y:.2f} m, heading {math.degrees(target.yaw):.0f} degrees"
        try:
            self._ask(f"Put the rover at {where}, and press Enter: ")
        except EOFError as error:
            raise PoseResetError(f"the rover is to be put at {where}, and there is nobody to ask") from error


class NoPlacer:
    """Leaves the rover where it is."""

    moves = False

    def place(self, target: Target) -> None:
        """Does nothing."""


class AutoPlacer:
    """Chooses a way when the rover is first put somewhere, and keeps it.

    A node that listens to the reset topic goes first, then Gazebo's command, then nothing.

    Args:
        settings: of the connection.
        world: name of the world in Gazebo.
        transport: to publish on.
    """

    def __init__(self, settings: Ros2Settings, world: str, transport: Transport) -> None:
        self._settings, self._world, self._transport = settings, world, transport
        self._topic = TopicPlacer(transport, settings.reset_topic)
        self._chosen: Placer | None = None

    @property
    def moves(self) -> bool:
        """Whether the way that was chosen puts the rover anywhere."""
        return self._chosen is not None and self._chosen.moves

    def place(self, target: Target) -> None:
        """Puts the rover there in the way that was chosen: see :meth:`Placer.place`."""
        if self._chosen is None:
            self._chosen = self._choose()
        self._chosen.place(target)

    def _choose(self) -> Placer:
        if self._topic.heard(_DISCOVERY_TIMEOUT):
            return self._topic
        for command in GazeboPlacer.MESSAGES:
            if shutil.which(command):
                return GazeboPlacer(command, self._world, self._settings.model)
        _log.warning(
            "no node listens to %s, and neither ign nor gz is installed: episodes start where the rover is "
            "(Ros2Settings(reset=...) has other ways)",
            self._settings.reset_topic,
        )
        return NoPlacer()


def make_placer(settings: Ros2Settings, world: str, transport: Transport) -> Placer:
    """The placer that the settings ask for."""
    if settings.reset == "auto":
        return AutoPlacer(settings, world, transport)
    if settings.reset in GazeboPlacer.MESSAGES:
        return GazeboPlacer(settings.reset, world, settings.model)
    if settings.reset == "topic":
        return TopicPlacer(transport, settings.reset_topic)
    return ManualPlacer() if settings.reset == "manual" else NoPlacer()
