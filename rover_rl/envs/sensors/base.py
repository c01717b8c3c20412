"""``Sensor``: an entry of the observation, what it reads from, and how networks read it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, ClassVar, Literal, TypeAlias
from zlib import crc32

import torch
from torch import Tensor

from rover_rl import checks, rng
from rover_rl.envs.config import LidarConfig, Randomization
from rover_rl.envs.specs import Bounds
from rover_rl.envs.stages import Perception, SensedPose, SensorDelays, StepState
from rover_rl.robots.fleet import Fleet
from rover_rl.sims.base import LiveRover
from rover_rl.sims.movers.field import MoverField
from rover_rl.sims.rover_state import Force, RoverState
from rover_rl.worlds import World
from rover_rl.worlds.table import TerrainTable, WorldTable

# NVIDIA Warp takes half a second to import, and the renderer a second: they are imported when a sensor casts rays.
if TYPE_CHECKING:
    from rover_rl.sims.rays import RayCaster
    from rover_rl.sims.rendering.colors import ColorCaster

Directions: TypeAlias = Tensor | Sequence[Sequence[float]]
Pooling: TypeAlias = Callable[[Tensor], Tensor]
Delayed: TypeAlias = Literal["scan", "state"] | None
"""Delay of a sensor: that of scans, that of pose and other sensors, or none for what other entries tell."""


class Surroundings:
    """Ground, obstacles and movers around each row. Nothing is built until a sensor asks for it.

    Around a ``live`` rover, nothing is known but the map of its world: casting rays raises ``ValueError``.
    """

    def __init__(self, worlds: WorldTable, movers: MoverField, live: LiveRover | None = None) -> None:
        self._worlds, self._movers, self.live = worlds, movers, live

    def cast(self, origins: Tensor, directions: Tensor, farthest: float = math.inf) -> Tensor:
        """Casts rays: see :meth:`rover_rl.sims.rays.RayCaster.cast`. Movers beyond ``farthest`` are seen, too."""
        return self.cast_apart(origins, directions, farthest)[1]

    def cast_apart(self, origins: Tensor, directions: Tensor, farthest: float = math.inf) -> tuple[Tensor, Tensor]:
        """Casts rays, and returns the ranges without movers and those with them."""
        self.require_simulated()
        ranges, parts = self._caster.cast(origins, directions, farthest), self._movers.parts
        if parts is None:
            return ranges, ranges
        from rover_rl.worlds.movers.part_kernels import cast_at_movers

        return ranges, cast_at_movers(parts, origins, directions, ranges)

    def colors(self, origins: Tensor, directions: Tensor, goal: Tensor, spread: float) -> Tensor:
        """Returns the color that each ray sees, red, green and blue from 0 to 1, ``[N, 3, K]``.

        ``goal`` is where the posts of the goals stand, ``[N, 2]``, m, and ``spread`` the distance between neighboring
        rays at a distance of 1 m, m.
        """
        self.require_simulated()
        posts = torch.cat((goal, self.height_at(goal)[:, None]), -1)
        return self._color_caster.cast(origins, directions, posts, spread)

    def height_at(self, xy: Tensor) -> Tensor:
        """Returns the height of the ground (m) at points ``xy [N, ..., 2]`` (m) of each row's world: ``[N, ...]``."""
        table, entered = self._terrains
        for slot, world in entered().items():
            table[slot] = world.terrain
        # Importing NVIDIA Warp takes half a second.
        from rover_rl.worlds.ground_kernels import measured_at

        return measured_at(table.of(self._worlds.slots), xy)

    def require_simulated(self) -> None:
        if self.live is not None:
            raise ValueError("a sensor casts rays, which needs a simulated world: a live rover has none")

    @cached_property
    def _caster(self) -> RayCaster:
        from rover_rl.sims.rays import RayCaster

        return RayCaster(self._worlds)

    @cached_property
    def _color_caster(self) -> ColorCaster:
        from rover_rl.sims.rendering.colors import ColorCaster

        return ColorCaster(self._worlds, self._movers)

    @cached_property
    def _terrains(self) -> tuple[TerrainTable, Callable[[], dict[int, World]]]:
        return TerrainTable(self._worlds.slots.device), self._worlds.follow()


@dataclass(frozen=True)
class SensorSetup:
    """What a sensor with a memory is mounted on.

    Attributes:
        fleet: robots of the N rows. Its device is that of the readings.
        lidar: settings of their lidars.
        control_dt: duration of a step, s.
        randomization: what varies from episode to episode.
    """

    fleet: Fleet
    lidar: LidarConfig
    control_dt: float
    randomization: Randomization = field(default_factory=Randomization)


@dataclass(frozen=True)
class SensorInput:
    """What sensors read from.

    Attributes:
        truth: true state of the rovers, ``[N]``.
        sensed: state of the rovers as lidar, IMU and wheel odometry report it, ``[N]``.
        pose: pose that the sensors report, ``[N]``.
        target: distance (m) and relative angle (rad) of the goals from the pose that is known, which may be late.
        goal: places of the goals in the world frame, ``[N, 2]``, m.
        steps: number of steps of each row's episode, int64 ``[N, 1]``.
        keys: random keys of the episodes, int64 ``[N, 1]``.
        surroundings: ground and obstacles: heights and rays in the world frame.
        bounds: lower x and y, and upper x and y of each row's world, ``[N, 4]``, m.
        rows: rows that have moved or begun an episode since the last reading, bool ``[N]``.
        scan_pose: values of :class:`~rover_rl.envs.sensors.standard.ScanPose`; ``None`` if nothing reads them.
        predicted: entries that are not read, as they are predicted: see :class:`~rover_rl.envs.prediction.Prediction`.
        ticks: number of control steps that would have fitted in the time since the episode began, before the last step
            and now, ``[N, 1]`` each, of a live rover, whose scans come at their own times. ``None``: ``steps``.
        observation: entries of the sensors that have been read before in this step.
    """

    truth: Perception
    sensed: Perception
    pose: SensedPose
    target: Tensor
    goal: Tensor
    steps: Tensor
    keys: Tensor
    surroundings: Surroundings
    bounds: Tensor
    rows: Tensor
    scan_pose: Tensor | None = None
    predicted: Mapping[str, Tensor] = field(default_factory=dict)
    ticks: tuple[Tensor, Tensor] | None = None
    observation: dict[str, Tensor] = field(default_factory=dict)

    @classmethod
    def of(
        cls, state: StepState, target: Tensor, surroundings: Surroundings, bounds: Tensor, rows: Tensor
    ) -> SensorInput:
        """Returns what sensors read after a step with this state."""
        return cls(
            truth=state.truth,
            sensed=state.sensed,
            pose=state.pose,
            target=target,
            goal=state.goal,
            steps=state.steps,
            keys=state.keys,
            surroundings=surroundings,
            bounds=bounds,
            rows=rows,
            scan_pose=state.scan_pose,
            predicted=state.predicted,
        )

    def due(self, period: int) -> Tensor:
        """Returns the rows in which a sensor with a period reads in this step, bool ``[N]``."""
        if self.ticks is None or period == 1:
            return self.rows & (self.steps % period == 0).squeeze(-1)
        before, now = (ticks.div(period, rounding_mode="floor") for ticks in self.ticks)
        return self.rows & ((before != now) | (self.steps == 0)).squeeze(-1)

    def scan(self, mount: Sequence[float], directions: Directions, farthest: float = math.inf) -> Tensor:
        """Casts rays from a point of the rover, and returns their ranges, ``[N, K]``, m; ``inf`` for no return.

        Args:
            mount: position in the frame of the rover, whose origin is on the ground and whose axes point forward, left
                and up, m.
            directions: K directions in this frame, of any length but 0: a tensor ``[K, 3]``, or a list.
            farthest: length of the rays, m. Short ones take less time.
        """
        return self.surroundings.cast(*self.rays(mount, directions), farthest)

    def rays(self, mount: Sequence[float], directions: Directions) -> tuple[Tensor, Tensor]:
        """Returns origins and directions of rays in the world frame, ``[N, K, 3]`` each: see :meth:`scan`."""
        from rover_rl.sims.rays import aimed_rays

        self.surroundings.require_simulated()
        return aimed_rays(self.truth.rover, mount, torch.as_tensor(directions, device=self.goal.device))

    def uniform(self, sensor: Sensor, count: int) -> Tensor:
        """Returns random numbers in [0, 1) of a sensor, float32 ``[N, count]``.

        They depend on the seed of the row, the episode, the step and the name of the sensor alone.
        """
        return rng.to_unit(self._bits(sensor, "uniform", count))

    def normal(self, sensor: Sensor, count: int) -> Tensor:
        """Returns standard normal random numbers of a sensor, float32 ``[N, count]``: see :meth:`uniform`."""
        return rng.to_normal(self._bits(sensor, "normal", count))

    def _bits(self, sensor: Sensor, kind: str, count: int) -> Tensor:
        # Small numbers are streams of the package.
        stream = (1 << 32) + crc32(f"{sensor.name} {kind}".encode())
        return rng.random_bits(self.keys, stream, self.steps, count)


@dataclass(frozen=True, kw_only=True)
class Sensor(ABC):
    """An entry of the observation.

    Sensors of one's own are given to :func:`rover_rl.make_env` (``sensors``) or to the command line (``--sensors``). A
    subclass is a frozen dataclass whose fields are the settings of the sensor. It defines :attr:`bounds` and
    :meth:`read`, and overrides what else differs. Settings that are out of range raise ``ValueError``.

    Args:
        name: key of the entry, an identifier.
        period: number of steps from one reading to the next. Readings stay the same in between.

    Attributes:
        clips: whether the value can leave the bounds, and is clipped to them.
        delayed: delay that ``Randomization`` adds to the readings: ``"scan"``, ``"state"``, or ``None`` for an entry
            that is computed from other entries.
        takes_long: whether training reads it once for a decision, and not in each step.
        mirror_signs: signs of the left-right mirror image of a value. Empty if it does not change.
        needs: fields of :class:`~rover_rl.sims.RoverState` that it reads and that simulators measure only if
            asked: ``"contact_force"``, ``"wheel_torque"``.
    """

    name: str
    period: int = 1
    clips: ClassVar[bool] = True
    delayed: ClassVar[Delayed] = "state"
    takes_long: ClassVar[bool] = False
    mirror_signs: ClassVar[tuple[float, ...]] = ()
    needs: ClassVar[tuple[Force, ...]] = ()

    def __post_init__(self) -> None:
        checks.check_at_least(1, checks.MAX_COUNT, period=self.period)
        if not self.name.isidentifier():
            raise ValueError(f"the name of a sensor must be an identifier, got {self.name!r}")
        if (topic := getattr(self, "topic", None)) is not None:
            checks.check_topics(topic=topic)

    @property
    @abstractmethod
    def bounds(self) -> Bounds:
        """Bounds of a value."""

    def read(self, inputs: SensorInput) -> Tensor:
        """Returns the value of every row, float32 ``[N, k]``."""
        raise NotImplementedError(f"sensor {self.name!r} depends on its setup: read it by reader(setup)")

    def reader(self, setup: SensorSetup) -> Callable[[SensorInput], Tensor]:
        """Returns what reads this sensor on a batch of rovers.

        A sensor that has a memory or depends on the robots of the rows defines it in place of :meth:`read`. What it
        returns is called in each step in which :meth:`SensorInput.due` has rows. The other rows keep their values.
        """
        return self.read

    def sense(self, noise: Randomization, truth: Perception, keys: Tensor, step: Tensor) -> dict[str, Tensor]:
        """Returns what the noise of this sensor changes: ``ranges``, or fields of the rovers' state, by name.

        ``truth`` is the true state of the rovers and their scans. ``keys`` and ``step`` are random keys of the episodes
        and indices of their steps, ``[N, 1]``: those of late scans for a sensor that is ``delayed`` as scans are.
        """
        return {}

    @property
    def image(self) -> tuple[int, int] | None:
        """Rows and columns if the encoded value is an image, or several, which networks read with convolutions."""
        return None

    @property
    def features(self) -> int:
        """Number of features that a network reads."""
        return self.encode(torch.zeros(len(self.bounds.low))).shape[-1]

    def encode(self, value: Tensor) -> Tensor:
        """Returns what a network reads, ``[..., features]``: by default the value, scaled by the bounds to [-1, 1]."""
        low, high = self.bounds.tensors(value.device)
        return (2 * value - low - high) / (high - low)

    def mirror(self, value: Tensor) -> Tensor:
        """Returns the value ``[..., k]`` in the world mirrored left to right."""
        return mirrored_signs(self.mirror_signs, value) if self.mirror_signs else value


def mirrored_signs(signs: tuple[float, ...], value: Tensor) -> Tensor:
    """Returns ``value [..., k]`` times the signs of its mirror image."""
    return value * _signs(signs, value.device)


@cache
def _signs(signs: tuple[float, ...], device: torch.device) -> Tensor:
    return torch.tensor(signs, device=device)


class Observer:
    """Computes observations with sensors, by key.

    Attributes:
        readers: what reads the sensors, by key.
        inputs: what they read from last.
    """

    def __init__(self, sensors: Mapping[str, Sensor], setup: SensorSetup) -> None:
        device = setup.fleet.index.device
        self._sensors, self._noise, self._control_dt = sensors, setup.randomization, setup.control_dt
        self.readers = {key: sensor.reader(setup) for key, sensor in sensors.items()}
        self._limits = {key: each.bounds.tensors(device) for key, each in sensors.items() if each.clips}
        self._held: dict[str, Tensor] = {}
        self._is_checked = False
        self._elapsed = torch.zeros(len(setup.fleet), 1, device=device)

    def sense(
        self,
        truth: Perception,
        keys: Tensor,
        step: Tensor,
        scan_step: Tensor | None,
        pooling: Callable[[Tensor], Tensor],
    ) -> Perception:
        """Adds the noise of the sensors (see :meth:`Sensor.sense`) to the true state. Returns it if there is none.

        ``scan_step`` are the steps at which the scans were taken, int64 ``[N, 1]``. ``None``: their periods tell.
        """
        sensed: dict[str, Tensor] = {}
        for sensor in self._sensors.values():
            at = scan_step if scan_step is not None and sensor.delayed == "scan" else step
            sensed |= sensor.sense(self._noise, truth, keys, at)
        if not sensed:
            return truth
        ranges = sensed.pop("ranges", None)
        rover = RoverState.pack(**(dict(truth.rover.items()) | sensed))
        return Perception(rover, lambda: truth.ranges if ranges is None else ranges, pooling)

    def __call__(self, inputs: SensorInput, delays: SensorDelays | None = None) -> dict[str, Tensor]:
        """Returns the observation, each entry ``[N, k]``, as late as ``delays`` say.

        Raises:
            ValueError: if a reading does not fit the bounds of its sensor.
        """
        if inputs.surroundings.live is not None:
            before, dt = self._elapsed, self._control_dt
            self._elapsed = torch.where(inputs.steps == 0, 0.0, before + inputs.truth.rover.dt)
            inputs = replace(inputs, ticks=((before / dt).round(), (self._elapsed / dt).round()))
        self.inputs = inputs
        for key, sensor in self._sensors.items():
            if key in inputs.predicted:
                value = self._clipped(key, inputs.predicted[key])
            else:
                value = (self._read if sensor.period == 1 else self._held_or_read)(key, inputs)
                if delays is not None and sensor.delayed is not None:
                    value = delays.late(key, value, inputs.steps, getattr(delays, sensor.delayed))
            inputs.observation[key] = value
        self._is_checked = True
        return inputs.observation

    def _read(self, key: str, inputs: SensorInput) -> Tensor:
        value = self.readers[key](inputs)
        shape = len(inputs.steps), len(self._sensors[key].bounds.low)
        if not self._is_checked and (value.shape != shape or value.dtype != torch.float32):
            got = f"{value.dtype} {(*value.shape,)}"
            raise ValueError(f"sensor {key!r} must read float32 {shape} by its bounds, got {got}")
        return self._clipped(key, value)

    def _clipped(self, key: str, value: Tensor) -> Tensor:
        return value.clamp(*self._limits[key]) if key in self._limits else value

    def _held_or_read(self, key: str, inputs: SensorInput) -> Tensor:
        due, last = inputs.due(self._sensors[key].period), self._held.get(key)
        # On the CPU, the check is cheap and may save the reading. On an accelerator it would synchronize.
        if last is None or due.device.type != "cpu" or due.any():
            value = self._read(key, inputs)
            self._held[key] = value if last is None else torch.where(due[:, None], value, last)
        return self._held[key]
