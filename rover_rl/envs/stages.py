"""State of a step, and the stages between policy and physics: what commands and readings pass.

Every row has its own delays and errors, drawn at each reset. Random numbers depend on the row's seed, its episode and
the step alone. Before the first value of an episode has arrived, a sensor tells what it told at the start, where the
rover stood, and a command is 0.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from rover_rl import rng
from rover_rl.envs.chosen_rows import EVERY_ROW, ChosenRows
from rover_rl.envs.config import HeadingGains, LimitsConfig, PoseConfig, Randomization
from rover_rl.robots.fleet import Fleet
from rover_rl.rotations import quaternion_to_euler, wrap_angle
from rover_rl.sims.base import RoverState
from rover_rl.sims.command_limiter import CommandLimiter, CommandLimits

_LATENCY, _SCAN_LATENCY, _STATE_LATENCY, _SCAN_PERIOD, _LOST_SCANS = 3, 18, 19, 20, 21
_DRIFT, _JUMP, _JUMPS, _YAW_BIAS, _SOURCE, _LIMITS = 7, 8, 9, 23, 24, 26
"""Streams of random numbers."""


class Perception:
    """State of the rovers and a raw lidar scan, and what follows from both.

    ``ranges`` are the raw scan, ``[N, beams]``, m; ``inf`` for no return, 0 for a beam that starts inside a solid. From
    them follow ``readings``, the pooled scan, ``[N, lidar_points]``, m; from the state, ``euler``, roll, pitch and yaw,
    ``[N, 3]``, ``yaw``, ``[N, 1]`` (rad), and ``position``, x and y, ``[N, 2]``, m.

    ``scan`` is called when the ranges are first read, which must be before the next step. If only some ``rows`` differ
    from the ``last`` state and scan, what follows is computed for these alone.
    """

    def __init__(
        self,
        rover: RoverState,
        scan: Callable[[], Tensor],
        pooling: Callable[[Tensor], Tensor],
        rows: ChosenRows = EVERY_ROW,
        last: Perception | None = None,
        to_euler: Callable[[Tensor], Tensor] = quaternion_to_euler,
    ) -> None:
        self.rover, self._scan, self._pooling = rover, scan, pooling
        # Without the readings of a scan that nobody has read.
        known: Mapping[str, Tensor] = vars(last) if last is not None and rows.are_selected else {}
        self._rows, self._last = rows, known.get("readings")
        self.euler = to_euler(rows.of(rover.orientation) if known else rover.orientation)
        self.euler = rows.into(known["euler"], self.euler) if known else self.euler
        self.yaw, self.position = self.euler[:, 2:], rover.position[:, :2]

    @cached_property
    def ranges(self) -> Tensor:
        return self._scan()

    @cached_property
    def readings(self) -> Tensor:
        if self._last is None:
            return self._pooling(self.ranges)
        return self._rows.into(self._last, self._pooling(self._rows.of(self.ranges)))


class SensedPose(NamedTuple):
    """Pose as the sensors report it: position ``[N, 3]`` (m) and heading ``[N, 1]`` (rad)."""

    position: Tensor
    yaw: Tensor


class StepState:
    """State of the environment between two steps. Tensors are int64 or bool ``[N, 1]``, unless stated otherwise.

    This is a plain object because ``EnvBase`` is a ``torch.nn.Module``, in which assigning attributes is slow.
    """

    keys: Tensor  #: Random keys of the episodes.
    active: Tensor | None = None  #: Rows that take the step. ``None``: all.
    moved: Tensor | None = None  #: Rows that have moved or begun since the last observation. ``None``: all.
    is_observed = True  #: Whether the observation has been made since the last step.
    truth: Perception  #: True state of the rovers.
    sensed: Perception  #: State by their sensors: that of ``truth`` if there is no sensor noise.
    reference: Perception  #: The one of ``truth`` and ``sensed`` that events and rewards are computed from.
    pose: SensedPose  #: Pose by the sensors, without delay.
    known: SensedPose  #: Pose that the robot knows, which may be late, or predicted.
    scan_pose: Tensor | None = None
    """Where the last known scan was taken, ``[N, 6]``, relative to the known pose. ``None`` if nothing reads it."""
    predicted: Mapping[str, Tensor] = {}  #: Entries of the observation that are predicted and not read.
    goal: Tensor  #: Position of the goal, ``[N, 2]``, m.
    target: Tensor  #: Distance (m) and relative angle (rad) of the goal from ``reference``, ``[N, 2]``, unclipped.
    goals: Tensor  #: Number of goals set in the episode.
    collision_steps: Tensor  #: Number of consecutive steps in collision.
    steps: Tensor  #: Number of steps in the episode.
    total_steps: Tensor  #: Number of steps of the row since it was last seeded.
    world: Tensor | None = None  #: Index of each row's world in the pool. ``None`` if there is only one.
    world_steps: Tensor | None = None
    """Number of steps since the worlds of groups changed, at which episodes are truncated. ``None``: ``steps``."""
    movers: Mapping[str, Tensor] = {}  #: Entries of ``outcome`` on movers. Empty if no world has any.
    events: Tensor  #: Events of the last step, ``[N, 7]``: see :data:`~rover_rl.envs.task.EVENTS`.
    phase: Tensor  #: Event that decides the last step: a :class:`~rover_rl.envs.task.StepEvent`.
    progress: Tensor  #: Decrease of the distance to the goal in the last step, m.
    alignment: Tensor  #: See :func:`~rover_rl.envs.task.heading_alignment`.
    terminated: Tensor  #: Whether the last step ended the episode by an event.
    truncated: Tensor  #: Whether it did so by the length of the episode.

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self.steps = self.total_steps = self.goals = torch.zeros(num_envs, 1, dtype=torch.int64, device=device)
        self.collision_steps = self.phase = self.steps
        self.goal = self.target = torch.zeros(num_envs, 2, device=device)
        self.progress = self.alignment = self.goal[:, :1]
        self.events = torch.zeros(num_envs, 7, dtype=torch.bool, device=device)
        self.terminated = self.truncated = self.events[:, :1]

    def take(self, **values: Tensor) -> None:
        """Sets values of the active rows, by name."""
        for name, value in values.items():
            setattr(self, name, value if self.active is None else torch.where(self.active, value, getattr(self, name)))

    def move(self, rows: Tensor | None) -> None:
        """Adds rows to those that have moved since the last observation."""
        if not self.is_observed:
            rows = None if rows is None or self.moved is None else rows | self.moved
        self.moved, self.is_observed = rows, False


class Stage:
    """What commands pass on their way to the simulator, or readings on their way to the observation."""

    def begin(self, mask: Tensor, keys: Tensor) -> None:
        """Begins episodes in the rows of ``mask`` (bool ``[N, 1]``). ``keys`` ``[N, 1]`` are those of all rows."""

    def command(self, command: Tensor, state: StepState) -> Tensor:
        """Returns the command ``[N, A]`` for the next stage: speed (m/s), yaw rate (rad/s), perhaps speed to the left.

        The state is that before the step.
        """
        return command

    def read(self, state: StepState) -> None:
        """Changes the readings in the state after a step or reset."""


def checked_action(action: Tensor, batch_size: Sequence[int], bounds: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Clips actions ``[*batch_size, A]`` to ``bounds``, and returns them ``[N, A]``, and rows that are not finite.

    A wrong shape raises ``ValueError``, and so do values that are not finite, but only on the CPU: on an accelerator,
    this would require synchronization with the device.
    """
    expected = (*batch_size, len(bounds[0]))
    if action.shape != expected:
        raise ValueError(f"action must have shape {expected}, got {tuple(action.shape)}")
    # A policy may have another precision, and gradients, which end here.
    action = action.detach().reshape(-1, len(bounds[0])).to(bounds[0].dtype)
    finite = torch.isfinite(action)
    if action.device.type != "cpu":
        return torch.clamp(action, *bounds), ~finite.all(-1, keepdim=True)
    if not finite.all():
        rows = (~finite).any(-1).nonzero().squeeze(-1).tolist()
        raise ValueError(f"action must be finite numbers, got NaN or infinity in rows {rows}")
    return torch.clamp(action, *bounds), torch.zeros(len(action), 1, dtype=torch.bool)


class HeadingController:
    """PID controller per row that turns the rover toward a heading."""

    def __init__(
        self, num_envs: int, gains: HeadingGains | None = None, device: torch.device | str | None = None
    ) -> None:
        self.gains = gains or HeadingGains()
        self._error = self._integral = torch.zeros(num_envs, 1, device=device)

    def reset(self, mask: Tensor) -> None:
        self._error = self._error.masked_fill(mask, 0.0)
        self._integral = self._integral.masked_fill(mask, 0.0)

    def __call__(self, desired: Tensor, current: Tensor, dt: Tensor, active: Tensor | None = None) -> Tensor:
        """Returns the yaw rate that turns the rovers to their desired heading, ``[N, 1]``, rad/s.

        Headings are in rad, and ``dt`` is the time since the previous call, s, ``[N, 1]`` each. Rows that are not
        ``active`` keep their error and integral.
        """
        error = wrap_angle(desired - current)
        integral = torch.addcmul(self._integral, error, dt)
        change = (error - self._error) / dt
        gains = self.gains
        rate = gains.kp * error + gains.ki * integral + gains.kd * change
        self._error = error if active is None else torch.where(active, error, self._error)
        self._integral = integral if active is None else torch.where(active, integral, self._integral)
        return rate.clamp(-gains.max_output, gains.max_output)


class DriveBounds(Stage):
    """Limits commands to what the drive of each robot can do."""

    def __init__(self, fleet: Fleet) -> None:
        names = ("max_speed", "max_yaw_rate", "max_speed")
        self._fleet, self._limits = fleet, fleet.table(lambda robot: [getattr(robot.drive, name) for name in names])

    def command(self, command: Tensor, state: StepState) -> Tensor:
        limits = self._limits[self._fleet.index, : command.shape[-1]]
        return torch.clamp(command, -limits, limits)


class RowLimits(Stage):
    """Limits commands as ``rover-rl drive`` does for a live rover, by ``config`` and else the limits of the robots.

    Each episode draws a factor of all limits from the range ``factors``.
    """

    def __init__(self, config: LimitsConfig, factors: tuple[float, float], fleet: Fleet) -> None:
        self._factors, self._fleet = factors, fleet
        self._table = fleet.table(lambda robot: [*CommandLimits.of(robot, config)])
        self._limiter = CommandLimiter(config.min_reversal, len(fleet), fleet.index.device)
        self._last: Tensor | None = None
        self._factor: Tensor | float = 1.0

    def begin(self, mask: Tensor, keys: Tensor) -> None:
        self._limiter.reset(mask)
        if self._last is not None:
            self._last = self._last.masked_fill(mask, 0.0)
        if self._factors != (1.0, 1.0):
            self._factor = rng.between(rng.random_bits(keys, _LIMITS, 0, 1), self._factors)

    def command(self, command: Tensor, state: StepState) -> Tensor:
        last, active = torch.zeros_like(command) if self._last is None else self._last, state.active
        limits = self._table[self._fleet.index] * self._factor
        limited = self._limiter(last, command, state.sensed.rover.dt, limits, active)
        self._last = limited if active is None else torch.where(active, limited, last)
        return limited


class DelayLine:
    """Values of the last steps of each row, by name, from which those up to ``most`` steps late are taken."""

    def __init__(self, most: int) -> None:
        self._size = most + 1
        self._rings: dict[str, Tensor] = {}

    def __call__(self, name: str, value: Tensor, steps: Tensor, delay: Tensor) -> Tensor:
        """Stores the value ``[N, k]`` of this step, and returns that of ``delay`` steps ago, or of step 0.

        ``steps`` and ``delay`` are int64 ``[N, 1]``. A row may store its value of a step again.
        """
        if name not in self._rings:
            self._rings[name] = value.new_zeros(len(value), self._size, value.shape[-1])
        ring, rows, now = self._rings[name], torch.arange(len(value), device=value.device), steps.squeeze(-1)
        ring[rows, now % self._size] = value
        return ring[rows, (now - torch.minimum(delay.squeeze(-1), now)) % self._size]


class CommandDelay(Stage):
    """Delays each row's commands by ``steps``, int64 ``[N, 1]``, drawn from a range of numbers of control steps."""

    def __init__(self, latency: tuple[int, int], num_envs: int, device: torch.device) -> None:
        self._latency, self._line = latency, DelayLine(latency[1])
        self.steps = torch.zeros(num_envs, 1, dtype=torch.int64, device=device)

    def begin(self, mask: Tensor, keys: Tensor) -> None:
        self.steps = rng.whole_between(rng.random_bits(keys, _LATENCY, 0, 1), self._latency)

    def command(self, command: Tensor, state: StepState) -> Tensor:
        return self.delayed(command, state.steps)

    def delayed(self, command: Tensor, steps: Tensor) -> Tensor:
        return self._line("command", command, steps, self.steps).masked_fill(steps < self.steps, 0.0)


class Localization(Stage):
    """Sets the pose that the sensors report.

    The error of a localization is the sum of two parts. One drifts: an Ornstein-Uhlenbeck process, exact in discrete
    time, ``e' = a e + s sqrt(1 - a^2) n`` with ``a = exp(-dt / drift_time)``, the standard deviation ``s`` and a
    standard normal number ``n`` (C. Gardiner, *Stochastic Methods*, 2009, section 3.8.4). The other is constant until a
    jump draws it anew; jumps are a Poisson process.
    """

    def __init__(self, config: PoseConfig, randomization: Randomization) -> None:
        self._config, self._randomization = config, randomization
        self._steps: Tensor | None = None
        # Position and heading of dead reckoning.
        self._pose: tuple[Tensor, Tensor] | None = None
        # Error of a localization that drifts, and the one that jumps: x, y and heading.
        self._error: tuple[Tensor, Tensor] | None = None

    def read(self, state: StepState) -> None:
        state.pose = state.known = self._sensed(state)

    def _sensed(self, state: StepState) -> SensedPose:
        sensed, steps, source = state.sensed, state.steps, self._config.source
        if source == "truth":
            return SensedPose(sensed.rover.position, sensed.yaw)
        begins = steps == 0
        # A row whose number of steps is that of the last call keeps its pose.
        moves = torch.ones_like(begins) if self._steps is None else (steps != self._steps) & ~begins
        self._steps = steps
        if source == "odometry":
            return self._dead_reckoning(state, begins, moves)
        localized = self._localized(state, begins, moves)
        if source == "localized":
            return localized
        odometry = self._dead_reckoning(state, begins, moves)
        by_odometry = rng.random_bits(state.keys, _SOURCE, 0, 1) < 0
        return SensedPose(*(torch.where(by_odometry, *pair) for pair in zip(odometry, localized, strict=True)))

    def _dead_reckoning(self, state: StepState, begins: Tensor, moves: Tensor) -> SensedPose:
        """Adds the path of the wheels since the last step, along the mean of the headings at its start and its end."""
        truth, rover = state.truth.rover, state.sensed.rover
        pitch, yaw = state.sensed.euler[:, 1:2], state.sensed.yaw
        if any(self._randomization.yaw_bias):
            bias = rng.between(rng.random_bits(state.keys, _YAW_BIAS, 0, 1), self._randomization.yaw_bias)
            yaw = wrap_angle(yaw + bias * truth.dt * state.steps)
        last, last_yaw = self._pose or (truth.position, yaw)
        heading = last_yaw + wrap_angle(yaw - last_yaw) / 2
        forward = rover.dt * rover.linear_velocity
        cos, sin = heading.cos(), heading.sin()
        way = torch.cat((forward * pitch.cos() * cos, forward * pitch.cos() * sin, -forward * pitch.sin()), -1)
        if rover.lateral_velocity is not None:
            left = rover.dt * rover.lateral_velocity
            way = way + torch.cat((-left * sin, left * cos, torch.zeros_like(left)), -1)
        position = torch.where(begins, truth.position, torch.where(moves, last + way, last))
        self._pose = position, torch.where(begins | moves, yaw, last_yaw)
        return SensedPose(position, yaw)

    def _localized(self, state: StepState, begins: Tensor, moves: Tensor) -> SensedPose:
        config, dt, keys, steps = self._config, state.truth.rover.dt, state.keys, state.steps
        deviations = dt.new_tensor((config.drift, config.drift, config.drift_heading))
        severity = self._randomization.severity_of(keys)
        drawn = severity * deviations * rng.to_normal(rng.random_bits(keys, _DRIFT, steps, 3))
        jumps_by = dt.new_tensor((config.jump, config.jump, config.jump_heading))
        offset = severity * jumps_by * rng.to_normal(rng.random_bits(keys, _JUMP, steps, 3))
        last_drift, last_offset = self._error or (drawn, offset)
        kept = (-dt / config.drift_time).exp()
        drift = torch.where(moves, kept * last_drift + (1 - kept.square()).sqrt() * drawn, last_drift)
        jumps = rng.to_unit(rng.random_bits(keys, _JUMPS, steps, 1)) < 1 - (-config.jump_rate * dt).exp()
        drift = torch.where(begins, drawn, drift)
        offset = torch.where(begins | (moves & jumps), offset, last_offset)
        self._error, error = (drift, offset), drift + offset
        shift = pad(error[:, :2], (0, 1))
        return SensedPose(state.sensed.rover.position + shift, wrap_angle(state.sensed.yaw + error[:, 2:]))


class SensorDelays(Stage):
    """Tells when lidars scan, and how late scans, poses and other sensors arrive.

    A scan has a stamp, and so has a pose. So the robot knows where it was when it scanned, as with ROS's tf: a scan
    waits for the pose of its time, and is never newer than the pose. Scans are timed so that they arrive at steps that
    are multiples of their period, at which policies decide.

    ``period`` is that of the lidar, if the randomization does not say. The stamps of a ``live`` rover tell where scans
    were taken.

    Attributes:
        scan: delays of the scans, control steps, int64 ``[N, 1]``.
        state: delays of the other sensors, control steps, int64 ``[N, 1]``.
        scan_step: step at which the last scan was taken that is not lost, int64 ``[N, 1]``.
        known: pose that is known: x, y and z (m), pitch, roll and yaw (rad), ``[N, 6]``.
    """

    known: Tensor

    def __init__(
        self, randomization: Randomization, period: int, rows: int, device: torch.device, live: Any = None
    ) -> None:
        self._randomization, self._live = randomization, live
        self._line = DelayLine(max(randomization.scan_latency[1], randomization.state_latency[1]))
        self._periods = randomization.scan_period or (period, period)
        self.scan = self.state = self.scan_step = torch.zeros(rows, 1, dtype=torch.int64, device=device)
        self._period = self.scan + period
        self._scan_pose = torch.zeros(rows, 6, device=device)

    def begin(self, mask: Tensor, keys: Tensor) -> None:
        def drawn(stream: int, ends: tuple[int, int]) -> Tensor:
            return rng.whole_between(rng.random_bits(keys, stream, 0, 1), ends)

        self.state = drawn(_STATE_LATENCY, self._randomization.state_latency)
        self.scan = torch.maximum(drawn(_SCAN_LATENCY, self._randomization.scan_latency), self.state)
        self._period = drawn(_SCAN_PERIOD, self._periods)

    def scans(self, keys: Tensor, steps: Tensor) -> Tensor:
        """Returns which rows scan after ``steps`` steps of their episodes, int64 ``[N, 1]``: bool ``[N]``."""
        share = self._randomization.lost_scans * self._randomization.severity_of(keys)
        lost = rng.to_unit(rng.random_bits(keys, _LOST_SCANS, steps, 1)) < share
        taken = ((steps + self.scan) % self._period == 0) & ~lost | (steps == 0)
        self.scan_step = torch.where(taken, steps, self.scan_step)
        return taken.squeeze(-1)

    def read(self, state: StepState) -> None:
        euler, steps = state.sensed.euler, state.steps
        now = torch.cat((state.pose.position, euler[:, 1:2], euler[:, :1], state.pose.yaw), -1)
        if self._live is None:
            self._scan_pose = torch.where(self.scan_step == steps, now, self._scan_pose)
        else:
            position, orientation = self._live.scan_pose()
            roll, pitch, yaw = quaternion_to_euler(orientation).split(1, -1)
            self._scan_pose = torch.cat((position, pitch, roll, yaw), -1)
        self.known = self.late("known pose", now, steps, self.state)
        self._scan = self.late("pose of the scan", self._scan_pose, steps, self.scan)
        self.tell(self.known, state)

    def tell(self, known: Tensor, state: StepState) -> None:
        """Writes a pose ``[N, 6]`` as the known one, and the pose of the scan relative to it.

        That is ahead, left and up (m), pitch and roll of the scan, and the turn (rad).
        """
        state.known, scan = SensedPose(known[:, :3], known[:, 5:]), self._scan
        (dx, dy, dz), turn = (scan[:, :3] - known[:, :3]).split(1, -1), scan[:, 5:] - known[:, 5:]
        cos, sin = known[:, 5:].cos(), known[:, 5:].sin()
        ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
        state.scan_pose = torch.cat((ahead, left, dz, scan[:, 3:5], wrap_angle(turn)), -1)

    def late(self, name: str, value: Tensor, steps: Tensor, delay: Tensor) -> Tensor:
        return self._line(name, value, steps, delay)
