"""Delays: what sensors tell, and commands, some steps late. Lost scans, and the poses of scans.

Every row has its own delays, drawn at each reset. Ring buffers hold the values of the last steps of all rows on the
device. Before the first value of an episode has arrived, a sensor tells what it told at the start, where the rover
stood, and a command is 0.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rover_rl.envs.config import Randomization
from rover_rl.envs.perception import SensedPose
from rover_rl.rng import random_bits, to_unit, whole_between
from rover_rl.rotations import quaternion_to_euler, wrap_angle

_LATENCY, _SCAN_LATENCY, _STATE_LATENCY, _SCAN_PERIOD, _LOST_SCANS = 3, 18, 19, 20, 21
"""Streams of random numbers."""


class DelayLine:
    """Values of the last steps of each row, by name, from which late ones are taken.

    Args:
        most: longest delay, steps.
    """

    def __init__(self, most: int) -> None:
        self._size = most + 1
        self._rings: dict[str, Tensor] = {}

    def __call__(self, name: str, value: Tensor, steps: Tensor, delay: Tensor) -> Tensor:
        """Stores a value, and returns that of ``delay`` steps ago, or of step 0, ``[N, k]``.

        Args:
            name: name of the value.
            value: value at this step, ``[N, k]``. A row may store its value of a step again.
            steps: number of steps of each row's episode, int64 ``[N, 1]``.
            delay: delay of each row, steps, int64 ``[N, 1]``.
        """
        if name not in self._rings:
            self._rings[name] = value.new_zeros(len(value), self._size, value.shape[-1])
        ring, rows, now = self._rings[name], torch.arange(len(value), device=value.device), steps.squeeze(-1)
        ring[rows, now % self._size] = value
        return ring[rows, (now - torch.minimum(delay.squeeze(-1), now)) % self._size]


class CommandDelay:
    """Delays each row's commands by a number of control steps.

    Args:
        latency: range of the delay, control steps.
        num_envs: number of rows.
        device: device of the commands.

    Attributes:
        steps: current delay of each row, control steps, int64 ``[N, 1]``.
    """

    def __init__(self, latency: tuple[int, int], num_envs: int, device: torch.device) -> None:
        self._latency, self._line = latency, DelayLine(latency[1])
        self.steps = torch.zeros(num_envs, 1, dtype=torch.int64, device=device)

    def begin(self, keys: Tensor) -> None:
        """Draws the delays of the episodes from their random keys, ``[N, 1]``."""
        if self._latency[1]:
            self.steps = whole_between(random_bits(keys, _LATENCY, 0, 1), self._latency)

    def __call__(self, command: Tensor, steps: Tensor) -> Tensor:
        """Stores a command and returns the delayed command, ``[N, size]``: 0 before the first one has arrived.

        Args:
            command: forward speed (m/s), yaw rate (rad/s) and further components, ``[N, size]``.
            steps: number of steps of each row's episode before the command, int64 ``[N, 1]``.
        """
        if not self._latency[1]:
            return command
        return self._line("command", command, steps, self.steps).masked_fill(steps < self.steps, 0.0)


class SensorDelays:
    """When lidars scan, and how late scans, poses and other sensors arrive.

    A scan has a stamp, and so has a pose. So the robot knows where it was when it scanned, as with ROS's tf: a scan
    waits for the pose of its time, and is never newer than the pose.

    Scans are timed so that they arrive at steps that are multiples of their period, at which policies decide.

    Args:
        randomization: ranges of the delays and of the period, and the share of lost scans.
        period: steps from one scan to the next, if the randomization does not say.
        rows: number N of rovers.
        device: device of the readings.

    Attributes:
        scan: current delay of the scans of each row, control steps, int64 ``[N, 1]``.
        state: current delay of its other sensors, control steps, int64 ``[N, 1]``.
        scan_step: step at which the last scan was taken that is not lost, int64 ``[N, 1]``.
    """

    def __init__(self, randomization: Randomization, period: int, rows: int, device: torch.device) -> None:
        self._randomization = randomization
        most = max(randomization.scan_latency[1], randomization.state_latency[1])
        self._line = DelayLine(most)
        self._periods = randomization.scan_period or (period, period)
        zeros = torch.zeros(rows, 1, dtype=torch.int64, device=device)
        self.scan = self.state = self.scan_step = zeros
        self._period = zeros + period
        self._scan_pose = torch.zeros(rows, 6, device=device)

    def begin(self, keys: Tensor) -> None:
        """Draws delays and periods of the episodes from their random keys, ``[N, 1]``."""
        ranges = self._randomization
        self.state = whole_between(random_bits(keys, _STATE_LATENCY, 0, 1), ranges.state_latency)
        scan = whole_between(random_bits(keys, _SCAN_LATENCY, 0, 1), ranges.scan_latency)
        self.scan = torch.maximum(scan, self.state)
        self._period = whole_between(random_bits(keys, _SCAN_PERIOD, 0, 1), self._periods)

    def scans(self, keys: Tensor, steps: Tensor) -> Tensor:
        """Returns which rows scan after ``steps`` steps of their episodes, int64 ``[N, 1]``: bool ``[N]``.

        ``keys`` are the random keys of the episodes, ``[N, 1]``.
        """
        share = self._randomization.lost_scans * self._randomization.severity_of(keys)
        lost = to_unit(random_bits(keys, _LOST_SCANS, steps, 1)) < share
        due = ((steps + self.scan) % self._period == 0) & ~lost
        taken = due | (steps == 0)
        self.scan_step = torch.where(taken, steps, self.scan_step)
        return taken.squeeze(-1)

    def poses(
        self, pose: SensedPose, euler: Tensor, steps: Tensor, stamped: tuple[Tensor, Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Stores the sensed pose, and returns the one that is known, and the one at which the known scan was taken.

        Args:
            pose: pose that the sensors report, without delay.
            euler: roll, pitch and yaw of the rover by its sensors, ``[N, 3]``, rad.
            steps: number of steps of each row's episode, int64 ``[N, 1]``.
            stamped: position ``[N, 3]`` (m) and orientation ``[N, 4]`` at which the scans were taken, of a live rover,
                whose stamps tell. ``None``: those at which this object let them scan.

        Returns:
            Both poses: x, y and z (m), pitch, roll and yaw (rad), ``[N, 6]`` each.
        """
        now = torch.cat((pose.position, euler[:, 1:2], euler[:, :1], pose.yaw), -1)
        if stamped is None:
            self._scan_pose = torch.where(self.scan_step == steps, now, self._scan_pose)
        else:
            roll, pitch, yaw = quaternion_to_euler(stamped[1]).split(1, -1)
            self._scan_pose = torch.cat((stamped[0], pitch, roll, yaw), -1)
        known = self.late("known pose", now, steps, self.state)
        scan = self.late("pose of the scan", self._scan_pose, steps, self.scan)
        return known, scan

    def late(self, name: str, value: Tensor, steps: Tensor, delay: Tensor) -> Tensor:
        """Returns a value as it arrives: see :class:`DelayLine`."""
        return self._line(name, value, steps, delay)


def relative_pose(known: Tensor, scan: Tensor) -> Tensor:
    """Returns the pose of a scan relative to a known one: ahead, left and up (m), pitch, roll, and the turn (rad).

    Both are those of :meth:`SensorDelays.poses`. Pitch and roll are those of the scan.
    """
    (dx, dy, dz), turn = (scan[:, :3] - known[:, :3]).split(1, -1), scan[:, 5:] - known[:, 5:]
    pitch, roll = scan[:, 3:5].split(1, -1)
    cos, sin = known[:, 5:].cos(), known[:, 5:].sin()
    return torch.cat((cos * dx + sin * dy, cos * dy - sin * dx, dz, pitch, roll, wrap_angle(turn)), -1)
