"""Domain randomisation: rovers, sensors and delays that differ from episode to episode and from rover to rover.

What a policy meets on a robot is not what one simulator says, and two honest simulators differ, too: one that has
learned among many rovers minds less (J. Tobin et al., "Domain randomization for transferring deep neural networks from
simulation to the real world", IROS 2017; X. B. Peng et al., "Sim-to-real transfer of robotic control with dynamics
randomization", ICRA 2018). Every draw is a function of the row's seed, its episode and the step, as all others are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from rover_rl.envs.rng import random_bits, to_index, to_unit
from rover_rl.sims import RoverState
from rover_rl.sims.base import Dynamics
from rover_rl.sims.rotations import quaternion_product

_DYNAMICS, _LATENCY, _RANGES, _ODOMETRY, _IMU = 2, 3, 4, 5, 6
"""Streams of random draws, beside those of placement."""

_NONE = (1.0, 1.0)


@dataclass(frozen=True)
class Randomization:
    """What varies, and how much; by itself, nothing.

    Factors are drawn evenly from their range at each reset, noise anew in each step.

    Args:
        friction: factor of all friction.
        chassis_mass: factor of the mass of the chassis, and of its inertia.
        motor_torque: factor of the most torque that the motors give.
        latency: control steps by which commands come late, least and most.
        range_noise: standard deviation of the lidar's ranges, m.
        dropout: share of beams that return nothing.
        odometry_noise: standard deviation of the wheel odometry's speeds, relative.
        imu_noise: standard deviation of roll, pitch and yaw, rad.

    Raises:
        ValueError: for a range that is not one, a negative deviation, or a share that is none.

    Example:
        >>> env = RoverEnv(world_n="maze", randomization=Randomization(friction=(0.7, 1.3), range_noise=0.01))
    """

    friction: tuple[float, float] = _NONE
    chassis_mass: tuple[float, float] = _NONE
    motor_torque: tuple[float, float] = _NONE
    latency: tuple[int, int] = (0, 0)
    range_noise: float = 0.0
    dropout: float = 0.0
    odometry_noise: float = 0.0
    imu_noise: float = 0.0

    def __post_init__(self) -> None:
        for name in ("friction", "chassis_mass", "motor_torque"):
            low, high = getattr(self, name)
            if not 0 < low <= high < math.inf:
                raise ValueError(f"{name} must be a range of positive factors (low, high), got {getattr(self, name)}")
        low, high = self.latency
        if not 0 <= low <= high or not (isinstance(low, int) and isinstance(high, int)):
            raise ValueError(f"latency must be a range of control steps (least, most), got {self.latency}")
        for name in ("range_noise", "odometry_noise", "imu_noise"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout must be at least 0 and less than 1, got {self.dropout}")

    @classmethod
    def typical(cls) -> Randomization:
        """What a skid-steer rover with hobby-grade sensors may be off by."""
        return cls(
            friction=(0.7, 1.3),
            chassis_mass=(0.9, 1.3),
            motor_torque=(0.7, 1.0),
            latency=(0, 2),
            range_noise=0.01,
            dropout=0.01,
            odometry_noise=0.02,
            imu_noise=0.01,
        )

    @property
    def varies_dynamics(self) -> bool:
        """Whether the simulator has to do with it."""
        return any(getattr(self, field.name) != _NONE for field in fields(Dynamics))

    def draw_dynamics(self, keys: Tensor) -> Dynamics:
        """Factors of each row's rover, from episode keys ``[N, 1]``."""
        names = [field.name for field in fields(Dynamics)]
        shares = to_unit(random_bits(keys, _DYNAMICS, 0, len(names))).unbind(-1)
        ranges = {name: getattr(self, name) for name in names}
        pairs = zip(shares, ranges.items(), strict=True)
        return Dynamics(**{name: low + share * (high - low) for share, (name, (low, high)) in pairs})

    def sense(self, rover: RoverState, keys: Tensor, step: Tensor) -> RoverState:
        """What the sensors of ``rover`` tell: its state with noise.

        Args:
            rover: the truth.
            keys: of the episodes, ``[N, 1]``.
            step: number of the step in its episode, ``[N, 1]``.
        """
        sensed: dict[str, Tensor] = {}
        if self.range_noise or self.dropout:
            sensed["ranges"] = self._scan(rover.ranges, keys, step)
        if self.odometry_noise:
            linear, angular = (1 + self.odometry_noise * _normal(keys, _ODOMETRY, step, 2)).split(1, -1)
            sensed["linear_velocity"] = rover.linear_velocity * linear
            sensed["angular_velocity"] = rover.angular_velocity * angular
        if self.imu_noise:
            # A small turn about a random axis: half of it is the vector part of its quaternion.
            turn = 0.5 * self.imu_noise * _normal(keys, _IMU, step, 3)
            turn = torch.cat((turn, torch.ones_like(turn[:, :1])), -1)
            sensed["orientation"] = quaternion_product(rover.orientation, turn / turn.norm(dim=-1, keepdim=True))
        return RoverState.pack(**(dict(rover.items()) | sensed)) if sensed else rover

    def _scan(self, ranges: Tensor, keys: Tensor, step: Tensor) -> Tensor:
        bits = random_bits(keys, _RANGES, step, ranges.shape[-1])
        if self.range_noise:
            # Nothing that is seen comes to be inside the lidar, and nothing that is not comes to be seen.
            ranges = torch.where(ranges > 0, (ranges + self.range_noise * _to_normal(bits)).clamp_min(0.001), ranges)
        if self.dropout:
            # The upper bits, which the noise leaves alone.
            lost = (bits >> 48 & 0xFFFF) < round(self.dropout * 0x10000)
            ranges = ranges.masked_fill(lost, math.inf)
        return ranges


class CommandDelay:
    """Hands on each row's commands some control steps late.

    Args:
        latency: least and most steps.
        num_envs: rows.
        device: of the commands.
    """

    def __init__(self, latency: tuple[int, int], num_envs: int, device: torch.device) -> None:
        self._least, self._most = latency
        self._late = torch.zeros(num_envs, 1, dtype=torch.int64, device=device)
        # The latest command comes first.
        self._waiting = torch.zeros(num_envs, self._most + 1, 2, device=device)

    def reset(self, mask: Tensor, keys: Tensor) -> None:
        """Draws the delay of the rows of ``mask`` (bool ``[N, 1]``) anew; nothing is on its way to them."""
        if not self._most:
            return
        span = torch.full_like(self._late, self._most - self._least + 1)
        drawn = self._least + to_index(random_bits(keys, _LATENCY, 0, 1), span)
        self._late = torch.where(mask, drawn, self._late)
        self._waiting = self._waiting.masked_fill(mask[..., None], 0.0)

    def __call__(self, command: Tensor, active: Tensor | None) -> Tensor:
        """The command that arrives when ``command [N, 2]`` is given.

        For rows that are not ``active`` (bool ``[N, 1]``) no time passes.
        """
        if not self._most:
            return command
        waiting = torch.cat((command[:, None], self._waiting[:, :-1]), 1)
        self._waiting = waiting if active is None else torch.where(active[..., None], waiting, self._waiting)
        return waiting.gather(1, self._late[..., None].expand(-1, 1, 2)).squeeze(1)


def _normal(keys: Tensor, stream: int, draw: Tensor, count: int) -> Tensor:
    return _to_normal(random_bits(keys, stream, draw, count))


def _to_normal(bits: Tensor) -> Tensor:
    """Standard normal numbers from the lower 48 bits (Box and Muller, 1958): float32."""
    radius = torch.sqrt(-2 * torch.log(1 - to_unit(bits)))
    return radius * torch.cos(2 * math.pi * to_unit(bits >> 24))
