"""Ways to move a live rover to the start of an episode: Gazebo's command, a topic, a person, or none."""

from __future__ import annotations

import logging
import math
import shutil
import subprocess
import time
from typing import NamedTuple, get_args

from rover_rl.sims.ros2 import PoseResetError
from rover_rl.sims.ros2.messages import Header, Point, Pose, PoseStamped, Quaternion
from rover_rl.sims.ros2.settings import PoseReset, Ros2Settings
from rover_rl.sims.ros2.transport import Transport

GAZEBO_MESSAGES = {"ign": "ignition.msgs", "gz": "gz.msgs"}
"""Gazebo's commands, of Fortress and Harmonic, with the message package of each."""
FAILURES = ("ERROR", "Unable", "timed out", "failed")
"""Words in the output of a failed Gazebo service call, whose exit code is 0 as well."""
SUBSCRIBER_TIMEOUT = 5.0
"""Time to wait for a subscriber of the reset topic, s."""
DISCOVERY_TIMEOUT = 1.0
"""Time to wait for a subscriber in automatic selection, after the rover's sensors have been received, s."""
SERVICE_TIMEOUT_MS = 2000
"""Timeout of a Gazebo service call, ms."""

_log = logging.getLogger(__name__)


class TargetPose(NamedTuple):
    """Pose to move the rover to: x, y and height z in the world, m, and yaw, counter-clockwise from the x axis, rad."""

    x: float
    y: float
    z: float
    yaw: float

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Heading as a quaternion (x, y, z, w)."""
        return 0.0, 0.0, math.sin(self.yaw / 2), math.cos(self.yaw / 2)


class Placer:
    """Moves the rover to the start of an episode in the way that the settings select.

    With ``reset="auto"``, the first reset selects the way: the reset topic if a node subscribes to it, Gazebo's command
    if it is installed, none. ``world`` is the name of the world in Gazebo.

    Raises:
        FileNotFoundError: if Gazebo's command is selected and not installed.
    """

    def __init__(self, settings: Ros2Settings, world: str, transport: Transport) -> None:
        self._settings, self._world, self._transport = settings, world, transport
        self._way: PoseReset = settings.reset
        if self._way in GAZEBO_MESSAGES and not shutil.which(self._way):
            others = [choice for choice in get_args(PoseReset) if choice != self._way]
            raise FileNotFoundError(
                f"reset={self._way!r} needs Gazebo's command {self._way!r}, which is not on the PATH; install it, or "
                f"choose another backend=Ros2Settings(reset=...): {', '.join(map(repr, others))}"
            )
        if self._way in ("auto", "topic"):
            self._publish = transport.publisher(settings.reset_topic, PoseStamped, reliable=True)

    @property
    def moves(self) -> bool:
        """Whether the rover is moved at all; false before an automatic selection."""
        return self._way not in ("auto", "none")

    def place(self, target: TargetPose) -> None:
        """Requests the move, whose completion the pose shows. Raises ``PoseResetError`` if the request fails."""
        if self._way == "auto":
            self._way = self._select()
        if self._way in GAZEBO_MESSAGES:
            place_in_gazebo(self._way, self._world, self._settings.model, target)
        elif self._way == "topic":
            if not self._has_subscriber(SUBSCRIBER_TIMEOUT):
                topic = self._settings.reset_topic
                raise PoseResetError(f"no node subscribes to {topic}, so the rover cannot be moved to the start")
            pose = Pose(Point(target.x, target.y, target.z), Quaternion(*target.quaternion))
            self._publish(PoseStamped(Header(frame_id="world"), pose))
        elif self._way == "manual":
            _ask_for(target)

    def _select(self) -> PoseReset:
        if self._has_subscriber(DISCOVERY_TIMEOUT):
            return "topic"
        if shutil.which("ign"):
            return "ign"
        if shutil.which("gz"):
            return "gz"
        _log.warning(
            "no node subscribes to %s, and neither ign nor gz is installed: episodes start where the rover is; "
            "choose another way to move it with Ros2Settings(reset=...)",
            self._settings.reset_topic,
        )
        return "none"

    def _has_subscriber(self, timeout: float) -> bool:
        deadline = time.monotonic() + timeout
        while not self._transport.subscribers(self._settings.reset_topic):
            if time.monotonic() > deadline:
                return False
            time.sleep(0.01)
        return True


def place_in_gazebo(command: str, world: str, model: str, target: TargetPose) -> None:
    """Moves a model by Gazebo's service ``/world/<world>/set_pose``, through the command ``"ign"`` or ``"gz"``.

    The exit code is 0 for every outcome. A call that succeeds answers ``data: true`` and prints no failure.

    Raises:
        PoseResetError: if the pose is not finite, or the call fails.
    """
    if not all(map(math.isfinite, target)):
        raise PoseResetError(f"a pose must be finite numbers, got {tuple(target)}")
    _, _, z, w = target.quaternion
    request = (
        f'name: "{model}", position: {{x: {target.x!r}, y: {target.y!r}, z: {target.z!r}}}, '
        f"orientation: {{x: 0.0, y: 0.0, z: {z!r}, w: {w!r}}}"
    )
    package = GAZEBO_MESSAGES[command]
    arguments = [command, "service", "-s", f"/world/{world}/set_pose"]
    arguments += ["--reqtype", f"{package}.Pose", "--reptype", f"{package}.Boolean"]
    arguments += ["--timeout", str(SERVICE_TIMEOUT_MS), "--req", request]
    limit = 2 * SERVICE_TIMEOUT_MS / 1000
    try:
        answer = subprocess.run(arguments, capture_output=True, text=True, errors="replace", timeout=limit, check=False)
    except subprocess.TimeoutExpired as error:
        raise PoseResetError(f"{command} did not finish within {error.timeout:g} s") from error
    printed = answer.stdout + "\n" + answer.stderr
    if "data: true" not in map(str.strip, answer.stdout.splitlines()) or any(word in printed for word in FAILURES):
        output = printed.strip() or "nothing"
        raise PoseResetError(f"{' '.join(arguments[:4])} did not move {model!r}; its output: {output}")


def _ask_for(target: TargetPose) -> None:
    where = f"x {target.x:.2f} m, y {target.y:.2f} m, heading {math.degrees(target.yaw):.0f} degrees"
    try:
        input(f"Put the rover at {where}, and press Enter: ")
    except EOFError as error:
        raise PoseResetError(f"nobody answers the prompt to put the rover at {where}: no standard input") from error
