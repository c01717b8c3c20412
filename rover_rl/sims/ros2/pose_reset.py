"""Ways to move a live rover to the start of an episode: Gazebo's command, a topic, a person, or none."""

from __future__ import annotations

import logging
import math
import shutil
import subprocess
import time
from typing import NamedTuple, Protocol, get_args

from rover_rl.sims.ros2.errors import PoseResetError
from rover_rl.sims.ros2.messages import Header, Point, Pose, PoseStamped, Quaternion
from rover_rl.sims.ros2.settings import PoseReset, Ros2Settings
from rover_rl.sims.ros2.transport import Transport

_log = logging.getLogger(__name__)

_FAILURES = ("ERROR", "Unable", "timed out", "failed")
"""Words in the output of a failed Gazebo service call, whose exit code is 0 as well."""
_SUBSCRIBER_TIMEOUT = 5.0
"""Time to wait for a subscriber of the reset topic, s."""
_DISCOVERY_TIMEOUT = 1.0
"""Time to wait for a subscriber in automatic selection, after the rover's sensors have been received, s."""
_SERVICE_TIMEOUT_MS = 2000
"""Timeout of a Gazebo service call, ms."""


class TargetPose(NamedTuple):
    """Pose to move the rover to.

    Attributes:
        x: position along the world's x axis, m.
        y: position along the world's y axis, m.
        z: height, m.
        yaw: heading, counter-clockwise from the world's x axis, rad.
    """

    x: float
    y: float
    z: float
    yaw: float

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Heading as a quaternion (x, y, z, w)."""
        return 0.0, 0.0, math.sin(self.yaw / 2), math.cos(self.yaw / 2)


class Placer(Protocol):
    """Moves the rover to a pose."""

    @property
    def moves(self) -> bool:
        """Whether the placer moves the rover at all."""
        ...

    def place(self, target: TargetPose) -> None:
        """Requests the move. The topic of the pose shows its completion.

        Raises:
            PoseResetError: if the request fails.
        """
        ...


class GazeboPlacer:
    """Moves the rover by Gazebo's service ``/world/<world>/set_pose``, through Gazebo's command.

    Args:
        command: ``"ign"`` (Fortress) or ``"gz"`` (Harmonic).
        world: name of the world in Gazebo.
        model: name of the rover in Gazebo.

    Raises:
        FileNotFoundError: if the command is not installed.
    """

    moves = True
    MESSAGES = {"ign": "ignition.msgs", "gz": "gz.msgs"}  # noqa: RUF012
    """Message package of each command."""

    def __init__(self, command: str, world: str, model: str) -> None:
        program = shutil.which(command)
        if program is None:
            others = [choice for choice in get_args(PoseReset) if choice != command]
            raise FileNotFoundError(
                f"reset={command!r} needs Gazebo's command {command!r}, which is not on the PATH; install it, or "
                f"choose another backend=Ros2Settings(reset=...): {', '.join(map(repr, others))}"
            )
        self._program, self._package, self._world, self._model = program, self.MESSAGES[command], world, model

    def place(self, target: TargetPose) -> None:
        """Calls Gazebo's service: see :meth:`Placer.place`."""
        if not all(map(math.isfinite, target)):
            raise PoseResetError(f"a pose must be finite numbers, got {tuple(target)}")
        _, _, z, w = target.quaternion
        request = (
            f'name: "{self._model}", position: {{x: {target.x!r}, y: {target.y!r}, z: {target.z!r}}}, '
            f"orientation: {{x: 0.0, y: 0.0, z: {z!r}, w: {w!r}}}"
        )
        arguments = [self._program, "service", "-s", f"/world/{self._world}/set_pose"]
        arguments += ["--reqtype", f"{self._package}.Pose", "--reptype", f"{self._package}.Boolean"]
        arguments += ["--timeout", str(_SERVICE_TIMEOUT_MS), "--req", request]
        try:
            answer = subprocess.run(
                arguments,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=2 * _SERVICE_TIMEOUT_MS / 1000,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise PoseResetError(f"{self._program} did not finish within {error.timeout:g} s") from error
        if not succeeded(answer.stdout, answer.stderr):
            output = (answer.stdout + answer.stderr).strip() or "nothing"
            raise PoseResetError(f"{' '.join(arguments[:4])} did not move {self._model!r}; its output: {output}")


def succeeded(output: str, errors: str) -> bool:
    """Whether a Gazebo service call succeeded: its answer is ``data: true``, and it prints no failure.

    Args:
        output: standard output of the call.
        errors: standard error of the call.
    """
    printed = output + "\n" + errors
    return "data: true" in map(str.strip, output.splitlines()) and not any(word in printed for word in _FAILURES)


class TopicPlacer:
    """Moves the rover by a ``geometry_msgs/PoseStamped`` to a node that subscribes to it, such as ``rover-rl robot``.

    Args:
        transport: transport to publish on.
        topic: topic of the pose.
    """

    moves = True

    def __init__(self, transport: Transport, topic: str) -> None:
        self._publish = transport.publisher(topic, PoseStamped, reliable=True)
        self._transport, self._topic = transport, topic

    def wait_for_subscriber(self, timeout: float) -> bool:
        """Waits at most ``timeout`` (s) for a node that subscribes to the topic; returns whether there is one."""
        deadline = time.monotonic() + timeout
        while not self._transport.subscribers(self._topic):
            if time.monotonic() > deadline:
                return False
            time.sleep(0.01)
        return True

    def place(self, target: TargetPose) -> None:
        """Publishes the pose once a node subscribes: see :meth:`Placer.place`."""
        if not self.wait_for_subscriber(_SUBSCRIBER_TIMEOUT):
            raise PoseResetError(f"no node subscribes to {self._topic}, so the rover cannot be moved to the start")
        pose = Pose(Point(target.x, target.y, target.z), Quaternion(*target.quaternion))
        self._publish(PoseStamped(Header(frame_id="world"), pose))


class ManualPlacer:
    """Asks a person on the terminal to move the rover, and waits for the person's answer."""

    moves = True

    def place(self, target: TargetPose) -> None:
        """Shows the pose, and waits for an answer: see :meth:`Placer.place`."""
        where = f"x {target.x:.2f} m, y {target.y:.2f} m, heading {math.degrees(target.yaw):.0f} degrees"
        try:
            input(f"Put the rover at {where}, and press Enter: ")
        except EOFError as error:
            raise PoseResetError(
                f"nobody answers the prompt to put the rover at {where}: standard input is closed"
            ) from error


class NoPlacer:
    """Leaves the rover where it is."""

    moves = False

    def place(self, target: TargetPose) -> None:
        """Does nothing: see :meth:`Placer.place`."""


class AutoPlacer:
    """Selects a placer at the first reset, and keeps it.

    The order is: the reset topic if a node subscribes to it, Gazebo's command if it is installed, none.

    Args:
        settings: settings of the connection.
        world: name of the world in Gazebo.
        transport: transport to publish on.
    """

    def __init__(self, settings: Ros2Settings, world: str, transport: Transport) -> None:
        self._settings, self._world, self._transport = settings, world, transport
        self._topic = TopicPlacer(transport, settings.reset_topic)
        self._selected: Placer | None = None

    @property
    def moves(self) -> bool:
        """Whether the selected placer moves the rover; False before the first reset."""
        return self._selected is not None and self._selected.moves

    def place(self, target: TargetPose) -> None:
        """Moves the rover by the selected placer: see :meth:`Placer.place`."""
        if self._selected is None:
            self._selected = self._select()
        self._selected.place(target)

    def _select(self) -> Placer:
        if self._topic.wait_for_subscriber(_DISCOVERY_TIMEOUT):
            return self._topic
        for command in GazeboPlacer.MESSAGES:
            if shutil.which(command):
                return GazeboPlacer(command, self._world, self._settings.model)
        _log.warning(
            "no node subscribes to %s, and neither ign nor gz is installed: episodes start where the rover is; "
            "choose another way to move it with Ros2Settings(reset=...)",
            self._settings.reset_topic,
        )
        return NoPlacer()


def make_placer(settings: Ros2Settings, world: str, transport: Transport) -> Placer:
    """Creates the placer that the settings select.

    Args:
        settings: settings of the connection.
        world: name of the world in Gazebo.
        transport: transport to publish on.
    """
    if settings.reset == "auto":
        return AutoPlacer(settings, world, transport)
    if settings.reset in GazeboPlacer.MESSAGES:
        return GazeboPlacer(settings.reset, world, settings.model)
    if settings.reset == "topic":
        return TopicPlacer(transport, settings.reset_topic)
    return ManualPlacer() if settings.reset == "manual" else NoPlacer()
