"""Subscriptions to a live rover's sensors."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import torch
from torch import Tensor

from rover_rl.sims.connection import Connection
from rover_rl.sims.ros2.latest_messages import LatestMessages, ReceivedMessage
from rover_rl.sims.ros2.messages import Imu, LaserScan, Message, Odometry
from rover_rl.sims.ros2.pose_estimator import IDENTITY_ORIENTATION, ORIGIN_POSE, POSE_MESSAGES, PoseEstimator
from rover_rl.sims.ros2.readings import MeasuredPose, read_imu, read_scan, read_twist
from rover_rl.sims.ros2.scan_rate import SUPPORTED_RATES, ScanRate
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.ros2.throttle import ThrottledLogger
from rover_rl.sims.ros2.transport import Transport

_log = logging.getLogger(__name__)

Readers: TypeAlias = dict[str, Callable[[Any], Any]]
"""Functions that read values from a message, by the kind that each value is stored under."""


class Sensors:
    """Subscribes to scan, IMU, odometry and pose, and stores the latest valid values.

    Messages arrive in the transport's thread. A malformed message is ignored with a warning; the last valid value
    remains.

    Args:
        transport: transport to subscribe on.
        settings: settings of the connection.
        connection: topics of scan and IMU.
        pose_estimator: estimator that aligns poses with the IMU.

    Attributes:
        topics: topic of each kind of message: ``"scan"``, ``"imu"``, ``"odometry"``, and ``"pose"`` unless the pose
            comes from wheel odometry.
        messages: latest valid value of each kind.
        rejected_scans: number of scans that were ignored.
    """

    def __init__(
        self, transport: Transport, settings: Ros2Settings, connection: Connection, pose_estimator: PoseEstimator
    ) -> None:
        self.messages = LatestMessages()
        self.rejected_scans = 0
        self._step_timeout = settings.step_timeout
        self._pose_estimator = pose_estimator
        self._scan_rate = ScanRate()
        self._rejections: dict[str, str] = {}
        self._throttled_log = ThrottledLogger(_log)
        sources: dict[str, tuple[str, type[Message], Readers]] = {
            "imu": (connection.imu_topic, Imu, {"imu": read_imu}),
            "odometry": (settings.odometry_topic, Odometry, {"odometry": read_twist}),
        }
        pose = POSE_MESSAGES[settings.pose]
        if settings.pose == "wheels":
            sources["odometry"][2]["pose"] = pose.read
        else:
            sources["pose"] = (settings.pose_topic, pose.kind, {"pose": pose.read})
        # Last, as a rover publishes the scan last: when a scan wakes a step, the other messages have arrived.
        scan = partial(read_scan, max_invalid=settings.max_invalid)
        sources["scan"] = (connection.scan_topic, LaserScan, {"scan": scan})
        self._readers = {kind: readers for kind, (_, _, readers) in sources.items()}
        self.topics = {kind: topic for kind, (topic, _, _) in sources.items()}
        for kind, (topic, message, _) in sources.items():
            transport.subscribe(topic, message, partial(self.receive, kind))

    @property
    def scan(self) -> ReceivedMessage | None:
        """Latest usable scan; ``None`` before the first one."""
        return self.messages.latest("scan")

    @property
    def has_recent_scan(self) -> bool:
        """Whether the latest usable scan is younger than the step timeout."""
        scan = self.scan
        return scan is not None and scan.age < self._step_timeout

    @property
    def pose(self) -> MeasuredPose:
        """Latest pose; the origin before the first one."""
        message = self.messages.latest("pose")
        return ORIGIN_POSE if message is None else message.value

    @property
    def imu_orientation(self) -> Tensor:
        """Latest orientation of the IMU, ``[4]``; the identity before the first one."""
        message = self.messages.latest("imu")
        return IDENTITY_ORIENTATION if message is None else message.value

    @property
    def wheel_velocity(self) -> Tensor:
        """Latest forward speed (m/s) and yaw rate (rad/s) by wheel odometry, ``[2]``; zeros before the first one."""
        message = self.messages.latest("odometry")
        return torch.zeros(2) if message is None else message.value

    def receive(self, kind: str, msg: Any) -> bool:
        """Processes a message: see :meth:`Ros2Simulator.receive`."""
        if kind not in self._readers:
            raise ValueError(f"kind must be one of {sorted(self._readers)}, got {kind!r}")
        try:
            values = {name: read(msg) for name, read in self._readers[kind].items()}
        except (ValueError, TypeError, AttributeError, OverflowError) as error:
            self._reject(kind, str(error))
            return False
        self._rejections.pop(kind, None)
        if "scan" in values:
            self._check_scan_rate(values["scan"].stamp)
        if "pose" in values:
            values["pose"] = self._pose_estimator.align_imu(values["pose"], self.imu_orientation)
        for name, value in values.items():
            self.messages.put(name, value)
        return True

    def describe_silence(self, kind: str) -> str:
        """Describes why there is no recent value of a kind."""
        if kind in self._rejections:
            return f"its messages cannot be used: {self._rejections[kind]}"
        message = self.messages.latest(kind)
        return "no message has arrived yet" if message is None else f"the last message is {message.age:.1f} s old"

    def _reject(self, kind: str, reason: str) -> None:
        """Stores the reason why a message was ignored, and logs a warning."""
        self._rejections[kind] = reason
        self.rejected_scans += kind == "scan"
        self._throttled_log.warning(kind, "%s: ignored a message: %s", self.topics[kind], reason)

    def _check_scan_rate(self, stamp: float) -> None:
        """Warns of a scan rate that policies do not support."""
        rate = self._scan_rate.add(stamp, time.monotonic())
        if rate is not None and not SUPPORTED_RATES[0] <= rate <= SUPPORTED_RATES[1]:
            topic, (low, high) = self.topics["scan"], SUPPORTED_RATES
            self._throttled_log.warning(
                "rate", "%s: %.1f scans per second; policies require %g to %g", topic, rate, low, high
            )
