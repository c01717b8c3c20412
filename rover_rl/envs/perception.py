"""State of the rovers, as it is and as their sensors report it, and the sensed pose.

The error of a localization is the sum of two parts. One drifts: an Ornstein-Uhlenbeck process, exact in discrete time,
``e' = a e + s sqrt(1 - a^2) n`` with ``a = exp(-dt / drift_time)``, the standard deviation ``s`` and a standard normal
number ``n`` (C. Gardiner, *Stochastic Methods*, 2009, section 3.8.4). The other is constant until a jump draws it anew;
jumps are a Poisson process. Random numbers depend on the row's seed, its episode and the step alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.envs.config import PoseConfig, Randomization
from rover_rl.rng import between, random_bits, to_normal, to_unit
from rover_rl.rotations import quaternion_to_euler, wrap_angle
from rover_rl.sims.rover_state import RoverState
from rover_rl.worlds.movers import Rovers

_DRIFT, _JUMP, _JUMPS, _YAW_BIAS, _SOURCE = 7, 8, 9, 23, 24
"""Streams of random numbers."""


class Perception:
    """State of the rovers with the attitude, heading, position and pooled lidar scan derived from it.

    Attributes:
        rover: state of the rovers, ``[N]``.
        ranges: raw lidar scan, ``[N, beams]``, m; ``inf`` for no return, 0 for a beam that starts inside a solid.
        euler: roll, pitch and yaw, ``[N, 3]``, rad.
        yaw: heading, ``[N, 1]``, rad.
        position: horizontal position (x, y), ``[N, 2]``, m.
        readings: pooled lidar scan, ``[N, lidar_points]``, m.
    """

    def __init__(self, rover: RoverState, ranges: Tensor, pooling: Callable[[Tensor], Tensor]) -> None:
        self.rover, self.ranges = rover, ranges
        self.euler = quaternion_to_euler(rover.orientation)
        self.yaw = self.euler[:, 2:]
        self.position = rover.position[:, :2]
        self.readings = pooling(ranges)


def rovers_of(truth: Perception, radius: float) -> Rovers:
    """Returns the rovers as movers see them, with the velocity of their wheels."""
    heading = torch.cat((truth.yaw.cos(), truth.yaw.sin()), -1)
    return Rovers(truth.position[:, None], (truth.rover.linear_velocity * heading)[:, None], radius)


class SensedPose(NamedTuple):
    """Pose as the sensors report it.

    Attributes:
        position: position, ``[N, 3]``, m.
        yaw: heading, ``[N, 1]``, rad.
    """

    position: Tensor
    yaw: Tensor


class Localization:
    """Sensed poses of a batch of rovers, from step to step.

    Args:
        config: where the pose comes from.
        randomization: range of the yaw bias of dead reckoning, and of the factor of the errors of a localization.
    """

    def __init__(self, config: PoseConfig, randomization: Randomization) -> None:
        self._config, self._randomization = config, randomization
        self._steps: Tensor | None = None
        # Position and heading of dead reckoning.
        self._pose: tuple[Tensor, Tensor] | None = None
        # Error of a localization that drifts, and the one that jumps: x, y and heading.
        self._error: tuple[Tensor, Tensor] | None = None

    def __call__(self, truth: Perception, sensed: Perception, keys: Tensor, steps: Tensor) -> SensedPose:
        """Returns the sensed poses.

        Args:
            truth: true state of the rovers, ``[N]``.
            sensed: their state as the other sensors report it, ``[N]``.
            keys: random keys of the episodes, int64 ``[N, 1]``.
            steps: number of steps of each row's episode, int64 ``[N, 1]``. A row whose number is that of the last call
                keeps its pose, and 0 begins an episode.
        """
        if self._config.source == "truth":
            return SensedPose(sensed.rover.position, sensed.yaw)
        begins = steps == 0
        moves = torch.ones_like(begins) if self._steps is None else (steps != self._steps) & ~begins
        self._steps = steps.clone()
        given = keys, steps, begins, moves
        if self._config.source == "odometry":
            return self._dead_reckoning(truth, sensed, *given)
        localized = self._localized(truth, sensed, *given)
        if self._config.source == "localized":
            return localized
        odometry, by_odometry = self._dead_reckoning(truth, sensed, *given), random_bits(keys, _SOURCE, 0, 1) < 0
        return SensedPose(*(torch.where(by_odometry, *pair) for pair in zip(odometry, localized, strict=True)))

    def _dead_reckoning(
        self, truth: Perception, sensed: Perception, keys: Tensor, steps: Tensor, begins: Tensor, moves: Tensor
    ) -> SensedPose:
        """Adds the path of the wheels since the last step, along the mean of the headings at its start and its end."""
        rover = sensed.rover
        pitch, yaw = sensed.euler[:, 1:2], sensed.yaw
        if any(self._randomization.yaw_bias):
            bias = between(random_bits(keys, _YAW_BIAS, 0, 1), self._randomization.yaw_bias)
            yaw = wrap_angle(yaw + bias * truth.rover.dt * steps)
        last, last_yaw = self._pose or (truth.rover.position, yaw)
        heading = last_yaw + wrap_angle(yaw - last_yaw) / 2
        forward = rover.dt * rover.linear_velocity
        cos, sin = heading.cos(), heading.sin()
        way = torch.cat((forward * pitch.cos() * cos, forward * pitch.cos() * sin, -forward * pitch.sin()), -1)
        if rover.lateral_velocity is not None:
            left = rover.dt * rover.lateral_velocity
            way = way + torch.cat((-left * sin, left * cos, torch.zeros_like(left)), -1)
        position = torch.where(begins, truth.rover.position, torch.where(moves, last + way, last))
        self._pose = position, torch.where(begins | moves, yaw, last_yaw)
        return SensedPose(position, yaw)

    def _localized(
        self, truth: Perception, sensed: Perception, keys: Tensor, steps: Tensor, begins: Tensor, moves: Tensor
    ) -> SensedPose:
        """Adds the drifting error, and the one that jumps."""
        config, dt = self._config, truth.rover.dt
        deviations = dt.new_tensor((config.drift, config.drift, config.drift_heading))
        severity = self._randomization.severity_of(keys)
        drawn = severity * deviations * to_normal(random_bits(keys, _DRIFT, steps, 3))
        jumps_by = dt.new_tensor((config.jump, config.jump, config.jump_heading))
        offset = severity * jumps_by * to_normal(random_bits(keys, _JUMP, steps, 3))
        last_drift, last_offset = self._error or (drawn, offset)
        kept = (-dt / config.drift_time).exp()
        drift = torch.where(moves, kept * last_drift + (1 - kept.square()).sqrt() * drawn, last_drift)
        jumps = to_unit(random_bits(keys, _JUMPS, steps, 1)) < 1 - (-config.jump_rate * dt).exp()
        drift = torch.where(begins, drawn, drift)
        offset = torch.where(begins | (moves & jumps), offset, last_offset)
        self._error = drift, offset
        error = drift + offset
        shift = pad(error[:, :2], (0, 1))
        return SensedPose(sensed.rover.position + shift, wrap_angle(sensed.yaw + error[:, 2:]))
