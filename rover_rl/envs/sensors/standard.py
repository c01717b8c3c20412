"""Sensors that every rover has, lidar, pose, IMU, target and wheel odometry, and two that tell of its scans.

``lidar_mask`` tells which readings beams cover, and ``scan_pose`` where the scan was taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.envs.config import SCAN_POSE, LidarConfig, Randomization
from rover_rl.envs.sensors.base import Sensor, SensorInput, SensorSetup
from rover_rl.envs.sensors.suite import LIDAR_MASK
from rover_rl.envs.specs import Bounds
from rover_rl.envs.stages import Perception
from rover_rl.rng import between, random_bits, to_normal, to_unit, whole_between
from rover_rl.rotations import quaternion_product, wrap_angle
from rover_rl.sims.base import LiveRover
from rover_rl.sims.rays import seen
from rover_rl.sims.rover_state import beam_angles
from rover_rl.worlds import World
from rover_rl.worlds.region import overlap

Entries: TypeAlias = Mapping[str, Tensor] | TensorDictBase
_LIDAR_NOISE, _ODOMETRY_NOISE, _IMU_NOISE, _SIDEWAYS_NOISE, _ODOMETRY_SCALE = 4, 5, 6, 10, 25
_VIEW, _SECTORS, _SECTOR_WIDTHS, _SECTOR_PLACES, _MIN_RANGE = 27, 28, 29, 30, 31
"""Streams of random numbers."""
WAVELENGTHS = (64.0, 16.0, 4.0)
"""Wavelengths of the sine and cosine features of a position, m. The largest world is 64 m wide."""
WHOLE = 0.9999
"""Share of the beams from which on a reading is covered. The mean of many ones may be a little less than 1."""


@dataclass(frozen=True, kw_only=True)
class Lidar(Sensor):
    """Nearest reading of each segment of the scan, ``[N, points]``, m, at most ``max_range``."""

    name: str = "lidar"
    points: int = LidarConfig.points
    max_range: float = LidarConfig.max_range
    clips = False
    delayed = "scan"

    @property
    def bounds(self) -> Bounds:
        return Bounds((0.0,) * self.points, (self.max_range,) * self.points)

    def read(self, inputs: SensorInput) -> Tensor:
        return inputs.sensed.readings

    def sense(self, noise: Randomization, truth: Perception, keys: Tensor, step: Tensor) -> dict[str, Tensor]:
        """Changes the ranges at random, loses some of them, and hides some beams. A scan keeps its noise."""
        is_noisy = noise.range_noise or noise.dropout
        if not is_noisy and not noise.hides_beams:
            return {}
        ranges = self._noisy(noise, truth.ranges, keys, step) if is_noisy else truth.ranges
        if noise.hides_beams:
            ranges = ranges.masked_fill(hidden_beams(noise, keys, truth.ranges), math.inf)
        return {"ranges": ranges}

    def _noisy(self, noise: Randomization, ranges: Tensor, keys: Tensor, step: Tensor) -> Tensor:
        severity = noise.severity_of(keys)
        bits = random_bits(keys, _LIDAR_NOISE, step - step % self.period, ranges.shape[-1])
        if noise.range_noise:
            # A range stays positive, a 0 (beam that starts inside a solid) stays 0, and inf (no return) stays inf.
            changed = (ranges + noise.range_noise * severity * to_normal(bits)).clamp_min(0.001)
            ranges = torch.where(ranges > 0, changed, ranges)
        if noise.dropout:
            # The upper 16 bits. The noise uses the lower 48.
            share = noise.dropout * severity * 0x10000
            lost = (bits >> 48 & 0xFFFF) < (share.round() if isinstance(share, Tensor) else round(share))
            ranges = ranges.masked_fill(lost, math.inf)
        return ranges

    def encode(self, value: Tensor) -> Tensor:
        """Returns the logarithm of the readings, since centimeters matter only at short range."""
        return value.log1p() / 1.3 - 1

    def mirror(self, value: Tensor) -> Tensor:
        """Reverses the order of the readings, which is exact to one beam of the raw scan."""
        return value.flip(-1)


def hidden_beams(noise: Randomization, keys: Tensor, ranges: Tensor) -> Tensor:
    """Returns the beams that see nothing in episodes with random ``keys [N, 1]``, bool ``[N, beams]``.

    They are outside of the view of the episode, in one of its dead sectors, or their true ``ranges [N, beams]`` (m) are
    below its minimum: see :class:`Randomization`.
    """
    angles = _angles(ranges.shape[-1], keys.device)
    hidden = torch.zeros_like(ranges, dtype=torch.bool)
    if noise.lidar_view is not None:
        hidden = ~seen(angles, between(random_bits(keys, _VIEW, 0, 1), noise.lidar_view))
    if most := noise.dead_sectors:
        count = whole_between(random_bits(keys, _SECTORS, 0, 1), (0, most))
        width = between(random_bits(keys, _SECTOR_WIDTHS, 0, most), noise.dead_sector_width)
        # No direction is in a sector of a negative width.
        width = width.masked_fill(torch.arange(most, device=keys.device) >= count, -1.0)
        middle = 2 * math.pi * to_unit(random_bits(keys, _SECTOR_PLACES, 0, most))
        hidden = hidden | seen(angles - middle[..., None], width[..., None]).any(1)
    if noise.lidar_min_range[1]:
        hidden = hidden | (ranges < between(random_bits(keys, _MIN_RANGE, 0, 1), noise.lidar_min_range))
    return hidden


@cache
def _angles(beams: int, device: torch.device) -> Tensor:
    return beam_angles(beams).float().to(device)


class LidarPooling:
    """Cleans raw scans and reduces each of ``points`` segments of neighboring beams to its minimum.

    The first segment starts straight ahead. Sizes differ by at most one beam and no beam is dropped. ``+inf`` and NaN
    become ``max_range`` (m). ``-inf`` means that an obstacle is too close to measure (REP 117) and becomes 0.
    """

    def __init__(self, beams: int, points: int, max_range: float, device: torch.device | str | None = None) -> None:
        if points < 1:
            raise ValueError(f"lidar_points must be at least 1, got {points}")
        if beams < points:
            raise ValueError(f"lidar_beams must be at least lidar_points, got {beams} beams for {points} points")
        if not 0 < max_range < math.inf:
            raise ValueError(f"max_lidar_range must be a positive number of meters, got {max_range}")
        self.beams, self.points, self.max_range = beams, points, float(max_range)
        parts = torch.arange(beams).tensor_split(points)
        longest = len(parts[0])
        filled = torch.stack([torch.cat((part, part[-1:].expand(longest - len(part)))) for part in parts])
        self._gather = None if beams % points == 0 else filled.to(device)

    def __call__(self, ranges: Tensor) -> Tensor:
        """Pools ``ranges [N, beams]`` (m) to ``[N, points]``."""
        # NaN must be replaced before the minimum, which it would win. Clipping the fewer pooled readings is faster.
        cleaned = torch.nan_to_num(ranges, nan=self.max_range)
        return self._clip(cleaned if ranges.shape[-1] == self.points else self.grouped(cleaned).amin(-1))

    def _clip(self, readings: Tensor) -> Tensor:
        return readings.clamp_(0.0, self.max_range)

    def grouped(self, values: Tensor) -> Tensor:
        """Returns values of the beams, ``[N, beams]``, by segment, ``[N, points, longest]``; short ones repeat one."""
        return values.unflatten(-1, (self.points, -1)) if self._gather is None else values[..., self._gather]


class LivePooling(LidarPooling):
    """Pooling of a live lidar, whose raw scan has any number of beams: its readings are cut, not the beams.

    Segments with beams that are unseen, hidden or noisy are those of the beams.
    """

    def __init__(self, live: LiveRover, pooling: LidarPooling) -> None:
        super().__init__(pooling.beams, pooling.points, pooling.max_range)
        self._live = live

    def __call__(self, ranges: Tensor) -> Tensor:
        """Pools the beams ``ranges [1, N]`` (m) of the latest scan to ``[1, points]``."""
        pooled, raw = super().__call__(ranges), self._live.segments(self.points)
        if raw is None:
            return pooled
        other = (ranges != self._live.scan()) | ~self._live.covered()
        return torch.where(self.grouped(other).any(-1), pooled, self._clip(raw.clone()))


@dataclass(frozen=True, kw_only=True)
class Pose(Sensor):
    """Position in the world frame as :class:`~rover_rl.envs.config.PoseConfig` has it, ``[N, 3]``, m.

    With it, a policy would memorize the map.
    """

    name: str = "pose"
    bounds = Bounds((-30.0, -30.0, -10.0), (30.0, 30.0, 10.0))

    def read(self, inputs: SensorInput) -> Tensor:
        return inputs.pose.position

    def encode(self, value: Tensor) -> Tensor:
        """Encodes x and y as waves of several lengths."""
        wave_numbers = 2 * math.pi / value.new_tensor(WAVELENGTHS)
        phase = (value[..., :2, None] * wave_numbers).flatten(-2)
        return torch.cat((phase.sin(), phase.cos(), value[..., 2:]), -1)


def clipped_pose(world: World) -> list[str]:
    """Returns a sentence about a world in which a rover may drive beyond the bounds of ``pose``; else an empty list."""
    (x_low, y_low, _), (x_high, y_high, _) = Pose.bounds.low, Pose.bounds.high
    driven = overlap(world.bounds, world.terrain.extent)
    if overlap(driven, ((x_low, x_high), (y_low, y_high))) == driven:
        return []
    reach = max(abs(end) for axis in driven for end in axis)
    return [
        f"pose: {world.name!r} reaches {reach:.0f} m from the origin, and the observation `pose` is clipped at "
        f"{x_high:.0f} m: set closer bounds, move the world to the origin, or train without `pose` "
        "(`target` stays exact)"
    ]


@dataclass(frozen=True, kw_only=True)
class Imu(Sensor):
    """Pitch, roll and yaw, ``[N, 3]``, rad.

    The yaw is the heading of the pose that the sensors report, as of a live rover, with its error. ``heading`` tells
    whether networks read it. Only policies of one map need it.
    """

    name: str = "imu"
    heading: bool = False
    clips = False
    mirror_signs = (1.0, -1.0, -1.0)
    bounds = Bounds((-math.pi,) * 3, (math.pi,) * 3)

    def read(self, inputs: SensorInput) -> Tensor:
        roll, pitch, _ = inputs.sensed.euler.split(1, -1)
        return torch.cat((pitch, roll, inputs.pose.yaw), -1)

    def sense(self, noise: Randomization, truth: Perception, keys: Tensor, step: Tensor) -> dict[str, Tensor]:
        """Turns the rover by a small angle about a random axis."""
        if not noise.imu_noise:
            return {}
        # The vector part of the quaternion of a small rotation is half the rotation vector.
        turn = 0.5 * noise.imu_noise * noise.severity_of(keys) * to_normal(random_bits(keys, _IMU_NOISE, step, 3))
        turn = torch.cat((turn, torch.ones_like(turn[:, :1])), -1)
        return {"orientation": quaternion_product(truth.rover.orientation, turn / turn.norm(dim=-1, keepdim=True))}

    def encode(self, value: Tensor) -> Tensor:
        """Encodes tilts in units of about 20 degrees, and the yaw, if networks read it, as sine and cosine."""
        tilt, yaw = value[..., :2] * 3, value[..., 2:]
        return torch.cat((tilt, yaw.sin(), yaw.cos()), -1) if self.heading else tilt


@dataclass(frozen=True, kw_only=True)
class Target(Sensor):
    """Distance (m) and relative angle (rad) of the goal, ``[N, 2]``."""

    name: str = "target"
    delayed = None
    mirror_signs = (1.0, -1.0)
    bounds = Bounds((0.0, -math.pi), (100.0, math.pi))

    def read(self, inputs: SensorInput) -> Tensor:
        return inputs.target

    def encode(self, value: Tensor) -> Tensor:
        """Encodes the distance on a linear and a logarithmic scale, and the angle also as sine and cosine."""
        distance, angle = value.split(1, -1)
        return torch.cat((distance / 5 - 1, distance.log1p() - 1, angle.sin(), angle.cos(), angle / math.pi), -1)


def _odometry_factors(noise: Randomization, keys: Tensor, step: Tensor, stream: int, count: int) -> Tensor | None:
    """Returns the factors of velocities from wheel odometry, ``[N, count]``; ``None`` if there are none."""
    factors = None
    if noise.odometry_noise:
        factors = 1 + noise.odometry_noise * noise.severity_of(keys) * to_normal(random_bits(keys, stream, step, count))
    if noise.odometry_scale != (1.0, 1.0):
        scale = between(random_bits(keys, _ODOMETRY_SCALE, 0, 1), noise.odometry_scale)
        factors = scale.expand(-1, count) if factors is None else scale * factors
    return factors


@dataclass(frozen=True, kw_only=True)
class WheelOdometry(Sensor):
    """Forward speed (m/s) and yaw rate (rad/s), ``[N, 2]``."""

    name: str = "velocities"
    mirror_signs = (1.0, -1.0)
    bounds = Bounds((-10.0, -10.0), (10.0, 10.0))

    def read(self, inputs: SensorInput) -> Tensor:
        rover = inputs.sensed.rover
        return torch.cat((rover.linear_velocity, rover.angular_velocity), -1)

    def sense(self, noise: Randomization, truth: Perception, keys: Tensor, step: Tensor) -> dict[str, Tensor]:
        """Scales the velocities by random factors of about 1, and by that of the episode."""
        rover, factors = truth.rover, _odometry_factors(noise, keys, step, _ODOMETRY_NOISE, 2)
        if factors is None:
            return {}
        linear, angular = factors.split(1, -1)
        return {"linear_velocity": rover.linear_velocity * linear, "angular_velocity": rover.angular_velocity * angular}

    def encode(self, value: Tensor) -> Tensor:
        """Returns the speed, and the yaw rate in units of 3 rad/s."""
        speed, yaw_rate = value.split(1, -1)
        return torch.cat((speed, yaw_rate / 3), -1)


@dataclass(frozen=True, kw_only=True)
class SidewaysOdometry(Sensor):
    """Speed to the left by the wheels of a drive that moves sideways, ``[N, 1]``, m/s.

    Add it to the robot: ``Robot.from_urdf("omni.urdf", drive=..., sensors=(SidewaysOdometry(),))``.
    """

    name: str = "sideways"
    mirror_signs = (-1.0,)
    bounds = Bounds((-10.0,), (10.0,))

    def read(self, inputs: SensorInput) -> Tensor:
        rover = inputs.sensed.rover
        return torch.zeros_like(rover.dt) if rover.lateral_velocity is None else rover.lateral_velocity

    def sense(self, noise: Randomization, truth: Perception, keys: Tensor, step: Tensor) -> dict[str, Tensor]:
        """Scales the speed as :meth:`WheelOdometry.sense` does."""
        sideways, factor = truth.rover.lateral_velocity, _odometry_factors(noise, keys, step, _SIDEWAYS_NOISE, 1)
        return {} if sideways is None or factor is None else {"lateral_velocity": sideways * factor}

    def encode(self, value: Tensor) -> Tensor:
        return value


@dataclass(frozen=True, kw_only=True)
class LidarMask(Sensor):
    """Share of the beams of each lidar reading that see, ``[N, points]``: 1 if all of them do, 0 if none does.

    Beams outside of the robot's ``lidar_view`` do not see, nor those that ``Randomization`` hides (``lidar_view``,
    ``dead_sectors`` and ``lidar_min_range``). On a live rover, a beam sees if a valid reading of the scan covers it:
    within the scan's ``angle_min`` and ``angle_max``, no NaN, and within its limits.

    A reading with a mask of 0 is the maximum. The map of what has been seen and the tracks of what moves take readings
    with a mask below 1 for unknown, not for free, if the observation has this entry. An environment has it if
    ``Randomization`` hides beams, or if it is asked for. Number of readings and period are those of its lidar.

    Example:
        >>> env = RoverEnv(num_envs=2, seed=0, robot="jackal", sensors=["lidar_mask"])
        >>> env.reset()["lidar_mask"][0, 10:14]
        tensor([1.0000, 1.0000, 0.2500, 0.0000])
    """

    name: str = LIDAR_MASK
    points: int = LidarConfig.points
    clips = False
    delayed = "scan"

    @property
    def bounds(self) -> Bounds:
        return Bounds((0.0,) * self.points, (1.0,) * self.points)

    def reader(self, setup: SensorSetup) -> Callable[[SensorInput], Tensor]:
        lidar, fleet, noise = setup.lidar, setup.fleet, setup.randomization
        angles = beam_angles(lidar.beams)
        views = fleet.table(lambda robot: seen(angles, robot.lidar_view).tolist(), torch.bool)
        pooling = LidarPooling(lidar.beams, lidar.points, lidar.max_range, fleet.index.device)

        def read(inputs: SensorInput) -> Tensor:
            covered, live = views[fleet.index], inputs.surroundings.live
            if noise.hides_beams:
                covered = covered & ~hidden_beams(noise, inputs.keys, inputs.truth.ranges)
            if live is not None:
                covered = covered & live.covered()
            return pooling.grouped(covered.float()).mean(-1)

        return read

    def mirror(self, value: Tensor) -> Tensor:
        return value.flip(-1)


def known_readings(observation: Entries) -> Tensor:
    """Returns the lidar readings of an observation, ``[N, points]``, m; -1 where its mask says that one is unknown."""
    mask = observation.get(LIDAR_MASK, None)
    return observation["lidar"] if mask is None else torch.where(mask < WHOLE, -1.0, observation["lidar"])


@dataclass(frozen=True, kw_only=True)
class ScanPose(Sensor):
    """Pose at which the scan was taken, relative to the entries ``pose`` and ``imu``, ``[N, 6]``.

    How far ahead, to the left and up (m), pitch and roll at the scan, and the turn from the heading now to the one then
    (rad). An environment has this entry if its scans can be late, or if it is asked for. The map of what has been seen
    aligns scans by it, as ROS's tf does by their stamps.
    """

    name: str = SCAN_POSE
    delayed = None
    clips = False
    mirror_signs = (1.0, -1.0, 1.0, 1.0, -1.0, -1.0)
    bounds = Bounds((-10.0, -10.0, -10.0, *(-math.pi,) * 3), (10.0, 10.0, 10.0, *(math.pi,) * 3))

    def read(self, inputs: SensorInput) -> Tensor:
        assert inputs.scan_pose is not None
        return inputs.scan_pose

    def encode(self, value: Tensor) -> Tensor:
        """Returns the way and the turn in units of 20 cm and 0.2 rad, without the tilt and the height."""
        return torch.cat((value[..., :2], value[..., 5:]), -1) * 5


def taken_at(observation: Entries) -> tuple[Tensor, Tensor]:
    """Returns where the scan of an observation was taken: ``pose [N, 3]`` (m) and ``imu [N, 3]`` (rad) of its time.

    If the observation has no ``scan_pose``, the scan is as new as the pose.
    """
    pose, imu, relative = observation["pose"], observation["imu"], observation.get(SCAN_POSE, None)
    if relative is None:
        return pose, imu
    ahead, left, up, pitch, roll, turn = relative.split(1, -1)
    yaw = imu[..., 2:]
    cos, sin = yaw.cos(), yaw.sin()
    position = pose + torch.cat((cos * ahead - sin * left, sin * ahead + cos * left, up), -1)
    # Wrapping rounds. A scan that is as new as the pose was taken right there.
    return position, torch.cat((pitch, roll, torch.where(turn == 0, yaw, wrap_angle(yaw + turn))), -1)


def seen_from_now(x: Tensor, y: Tensor, scan_pose: Tensor | None) -> tuple[Tensor, Tensor]:
    """Returns x and y in the base frame now, ``[..., points]`` each, m, of points in that of a late scan."""
    if scan_pose is None:
        return x, y
    ahead, left, turn = scan_pose[..., :1], scan_pose[..., 1:2], scan_pose[..., 5:]
    return ahead + x * turn.cos() - y * turn.sin(), left + x * turn.sin() + y * turn.cos()
