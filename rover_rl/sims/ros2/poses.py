"""Pose of a live rover in the world, from pose messages and the IMU, and ways to move it to the start of an episode.

The functions that read messages accept any object with a message's attributes, such as ROS's own classes. They raise
``ValueError`` for numbers that are not finite.
"""

from __future__ import annotations

import logging
import math
import shutil
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple, get_args

import torch
from torch import Tensor

from rover_rl import rotations
from rover_rl.sims.ros2 import PoseResetError
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.settings import PoseReset, PoseSource, Ros2Settings
from rover_rl.sims.ros2.transport import Transport

IDENTITY_ORIENTATION = torch.tensor([0.0, 0.0, 0.0, 1.0])
YAW_TOLERANCE = 0.3  # maximum yaw error of a rover that has reached its target pose, rad
GAZEBO_MESSAGES: dict[PoseReset, str] = {"ign": "ignition.msgs", "gz": "gz.msgs"}
"""Gazebo's commands, of Fortress and Harmonic, with the message package of each."""
FAILURES = ("ERROR", "Unable", "timed out", "failed")  # in the output of a failed service call, whose exit code is 0
SUBSCRIBER_TIMEOUT = 5.0  # time to wait for a subscriber of the reset topic, s
DISCOVERY_TIMEOUT = 1.0  # the same in automatic selection, after the rover's sensors have been received, s
SERVICE_TIMEOUT_MS = 2000  # timeout of a Gazebo service call, ms

_log = logging.getLogger(__name__)


class MeasuredPose(NamedTuple):
    """Position ``[3]`` (m), orientation ``[4]``, and the yaw of the IMU's frame in the frame of the pose, rad."""

    position: Tensor
    orientation: Tensor | None
    imu_yaw_offset: float = 0.0


ORIGIN_POSE = MeasuredPose(torch.zeros(3), IDENTITY_ORIENTATION)


class TargetPose(NamedTuple):
    """Pose to move the rover to in the world: x, y and z, m, and yaw, rad."""

    x: float
    y: float
    z: float
    yaw: float


def read_finite(name: str, *numbers: float) -> Tensor:
    values = torch.tensor(numbers, dtype=torch.float32)
    if not torch.isfinite(values).all():
        raise ValueError(f"a {name} must be finite, got {values.tolist()}")
    return values


def read_orientation(q: Any) -> Tensor:
    """Reads and normalizes a ``geometry_msgs/Quaternion``: float32 ``[4]`` as (x, y, z, w)."""
    quaternion = torch.tensor([q.x, q.y, q.z, q.w], dtype=torch.float64)
    norm = torch.linalg.vector_norm(quaternion)
    if not 0.0 < norm < math.inf:
        raise ValueError(f"an orientation must be a finite quaternion other than zero, got {quaternion.tolist()}")
    return (quaternion / norm).float()


def pose_in(msg: Any) -> Any:
    """Returns the ``geometry_msgs/Pose`` of a message of a pose, the first one of an array."""
    if not hasattr(msg, "poses"):
        return getattr(msg.pose, "pose", msg.pose)
    if not len(msg.poses):
        raise ValueError("a pose array must have at least one pose, got none")
    return msg.poses[0]


def read_pose(msg: Any) -> MeasuredPose:
    """Reads a message of a pose."""
    pose = pose_in(msg)
    point, turn = pose.position, read_orientation(pose.orientation)
    return MeasuredPose(read_finite("position", point.x, point.y, point.z), turn)


def read_place(msg: Any) -> MeasuredPose:
    """Reads a message of a pose whose orientation is not used and may be invalid."""
    pose, turn = pose_in(msg), None
    with suppress(ValueError, AttributeError):
        turn = read_orientation(pose.orientation)
    return MeasuredPose(read_finite("position", pose.position.x, pose.position.y, pose.position.z), turn)


POSE_MESSAGES: dict[PoseSource, tuple[Any, Callable[[Any], MeasuredPose]]] = {
    "pose_array": (ros.PoseArray, read_place),
    "pose_stamped": (ros.PoseStamped, read_pose),
    "odometry": (ros.Odometry, read_pose),
    "pose_with_covariance": (ros.PoseWithCovarianceStamped, read_pose),
    "tf": (ros.TFMessage, read_pose),  # of the pose that RobotPose makes of it
    "wheels": (ros.Odometry, read_pose),
}
"""Type of the pose message of each source, and the function that reads it."""


def yaw_of(orientation: Tensor | None) -> float:
    return 0.0 if orientation is None else rotations.quaternion_to_euler(orientation)[2].item()


def heading(yaw: float) -> tuple[float, float, float, float]:
    """Returns a level orientation as (x, y, z, w)."""
    return 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)


class PoseEstimator:
    """Combines measured poses and IMU orientations into poses in the world.

    The positions of a pose array and the IMU's heading are in the world's frame. A localizer provides the heading in
    its map; between two of its poses the IMU provides the change. Wheel odometry has a frame of its own, which is
    aligned with the world at the start of each episode. ``frame`` is the position ``[3]`` (m) and orientation ``[4]``
    in the world of the frame of the measured poses.
    """

    def __init__(self, source: PoseSource) -> None:
        self._source = source
        self.frame = torch.zeros(3), IDENTITY_ORIENTATION
        self._imu_yaw_offset = 0.0

    def align_imu(self, pose: MeasuredPose, imu_orientation: Tensor) -> MeasuredPose:
        """Adds the yaw offset of the IMU to a localizer's pose that has just arrived."""
        if self._source in ("pose_array", "wheels"):
            return pose
        return pose._replace(imu_yaw_offset=yaw_of(pose.orientation) - yaw_of(imu_orientation))

    def estimate(self, pose: MeasuredPose, imu_orientation: Tensor) -> tuple[Tensor, Tensor]:
        """Returns position ``[3]`` and orientation ``[4]`` in the world of an aligned pose."""
        (position, orientation), turn = self.frame, torch.tensor(heading(pose.imu_yaw_offset + self._imu_yaw_offset))
        in_world = position + rotations.rotate(orientation, pose.position)
        return in_world, rotations.quaternion_product(turn, imu_orientation)

    def start_episode(
        self, pose: MeasuredPose, imu_orientation: Tensor, target: TargetPose | None, ground: float
    ) -> None:
        """Aligns wheel odometry with the world at a target, if the rover was moved to one, at height ``ground``, m."""
        if self._source != "wheels":
            return
        turn = 0.0 if target is None else target.yaw - yaw_of(pose.orientation)
        orientation, position = torch.tensor(heading(turn)), torch.zeros(3)
        if target is not None:
            start = torch.tensor([target.x, target.y, ground])
            position = start - rotations.rotate(orientation, pose.position)
        self.frame = position, orientation
        self._imu_yaw_offset = yaw_of(pose.orientation) + turn - yaw_of(imu_orientation)

    def matches_target(self, pose: MeasuredPose, target: TargetPose, tolerance: float) -> bool:
        """Whether a pose is within ``tolerance`` (m) of a target."""
        if self._source == "wheels":
            return True  # they cannot tell
        x, y, _ = pose.position.tolist()
        near = math.hypot(x - target.x, y - target.y) <= tolerance
        yaw_error = 0.0 if pose.orientation is None else yaw_of(pose.orientation) - target.yaw
        return near and abs(math.remainder(yaw_error, 2 * math.pi)) <= YAW_TOLERANCE


class Placer:
    """Moves the rover to the start of an episode in the way that the settings select, in a ``world`` of Gazebo.

    Raises ``FileNotFoundError`` if Gazebo's command is selected, and is not installed.
    """

    def __init__(self, settings: Ros2Settings, world: str, transport: Transport) -> None:
        self._model, self._topic, self._way = settings.model, settings.reset_topic, settings.reset
        self._world, self._transport = world, transport
        if self._way in GAZEBO_MESSAGES and not shutil.which(self._way):
            others = [choice for choice in get_args(PoseReset) if choice != self._way]
            raise FileNotFoundError(
                f"reset={self._way!r} needs Gazebo's command {self._way!r}, which is not on the PATH; install it, or "
                f"choose another backend=Ros2Settings(reset=...): {', '.join(map(repr, others))}"
            )
        if self._way in ("auto", "topic"):
            self._publish = transport.publisher(self._topic, ros.PoseStamped)

    @property
    def moves(self) -> bool:
        """Whether the rover is moved; false before an automatic selection."""
        return self._way not in ("auto", "none")

    def place(self, target: TargetPose) -> None:
        """Requests the move, whose completion the pose shows. Raises ``PoseResetError`` if the request fails."""
        if self._way == "auto":
            self._way = self._select()
        if self._way in GAZEBO_MESSAGES:
            place_in_gazebo(self._way, self._world, self._model, target)
        elif self._way == "topic":
            if not self._has_subscriber(SUBSCRIBER_TIMEOUT):
                raise PoseResetError(f"no node subscribes to {self._topic}, so the rover cannot be moved to the start")
            pose = ros.Pose(ros.Point(target.x, target.y, target.z), ros.Quaternion(*heading(target.yaw)))
            self._publish(ros.PoseStamped(ros.Header(frame_id="world"), pose))
        elif self._way == "manual":
            where = f"x {target.x:.2f} m, y {target.y:.2f} m, heading {math.degrees(target.yaw):.0f} degrees"
            try:
                input(f"Put the rover at {where}, and press Enter: ")
            except EOFError as error:
                problem = f"nobody answers the prompt to put the rover at {where}: no standard input"
                raise PoseResetError(problem) from error

    def _select(self) -> PoseReset:
        if self._has_subscriber(DISCOVERY_TIMEOUT):
            return "topic"
        if installed := [*filter(shutil.which, GAZEBO_MESSAGES)]:
            return installed[0]
        text = "no node subscribes to %s, and neither ign nor gz is installed: episodes start where the rover is; "
        _log.warning(text + "choose another way to move it with Ros2Settings(reset=...)", self._topic)
        return "none"

    def _has_subscriber(self, timeout: float) -> bool:
        deadline = time.monotonic() + timeout
        while not (found := self._transport.subscribers(self._topic)) and time.monotonic() < deadline:
            time.sleep(0.01)
        return bool(found)


def place_in_gazebo(command: PoseReset, world: str, model: str, target: TargetPose) -> None:
    """Moves a model by Gazebo's service ``/world/<world>/set_pose``, through the command ``"ign"`` or ``"gz"``.

    Its exit code is always 0; success is ``data: true`` without a printed failure. Raises ``PoseResetError`` if it
    fails, or the pose is not finite.
    """
    if not all(map(math.isfinite, target)):
        raise PoseResetError(f"a pose must be finite numbers, got {tuple(target)}")
    (_, _, z, w), package = heading(target.yaw), GAZEBO_MESSAGES[command]
    request = f'name: "{model}", position: {{x: {target.x!r}, y: {target.y!r}, z: {target.z!r}}}, '
    request += f"orientation: {{x: 0.0, y: 0.0, z: {z!r}, w: {w!r}}}"
    arguments = [command, "service", "-s", f"/world/{world}/set_pose", "--reqtype", f"{package}.Pose", "--reptype"]
    arguments += [f"{package}.Boolean", "--timeout", str(SERVICE_TIMEOUT_MS), "--req", request]
    limit = 2 * SERVICE_TIMEOUT_MS / 1000
    try:
        answer = subprocess.run(arguments, capture_output=True, text=True, errors="replace", timeout=limit, check=False)
    except subprocess.TimeoutExpired as error:
        raise PoseResetError(f"{command} did not finish within {error.timeout:g} s") from error
    printed = answer.stdout + "\n" + answer.stderr
    if "data: true" not in map(str.strip, answer.stdout.splitlines()) or any(word in printed for word in FAILURES):
        output = printed.strip() or "nothing"
        raise PoseResetError(f"{' '.join(arguments[:4])} did not move {model!r}; its output: {output}")
