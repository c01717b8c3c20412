"""Configuration of an environment: :class:`EnvConfig` and its parts. Does not import PyTorch.

Training, evaluation, the command line and checkpoints all use this description.

Example:
    >>> config = EnvConfig(world="maze", num_envs=64, lidar=LidarConfig(points=16))
    >>> make_env(config).observation_spec["lidar"].shape
    torch.Size([64, 16])
"""

from __future__ import annotations

import ast
import math
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, field, fields, is_dataclass, replace
from functools import cached_property
from inspect import Parameter, Signature
from itertools import pairwise
from operator import attrgetter
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeAlias, get_args

import tyro

from rover_rl.checks import MAX_COUNT, MAX_NUMBER, check_at_least, check_positive, check_seed
from rover_rl.envs.parts import ACTIONS, HEADING, TASKS
from rover_rl.names import Name
from rover_rl.plain import from_plain, take_numbers, to_plain
from rover_rl.registry import perhaps
from rover_rl.robots import names_several
from rover_rl.robots.options import RobotOptions, with_options
from rover_rl.sims.backends import find_settings, name_of
from rover_rl.sims.settings import CONTROL_DT, MIN_REVERSAL, Connection

if TYPE_CHECKING:
    from torch import Tensor
    from torchrl.envs import Transform

    from rover_rl.robots import Robot
    from rover_rl.worlds import World
    from rover_rl.worlds.pool import WorldSource as WorldLike

    RobotLike: TypeAlias = str | Robot | Sequence[str | Robot]
    RewardLike: TypeAlias = "str | RewardConfig | Sequence[str | Transform]"
    BackendLike: TypeAlias = Any
    SensorLike: TypeAlias = Any
    TerminationLike: TypeAlias = Any
    EventLike: TypeAlias = Any
    RobotSettings: TypeAlias = RobotOptions
else:
    # Types that the command line and YAML files support.
    WorldLike = RewardLike = RobotLike = str | tuple[str, ...]
    BackendLike = SensorLike = TerminationLike = EventLike = str
    # The options --robot.drive and so on, beside --robot.
    RobotSettings = Annotated[RobotOptions, tyro.conf.arg(name="robot")]

SCAN_POSE = "scan_pose"
"""Sensor of the pose at which the scan was taken. An environment has it if asked for, or if its scans can be late."""
DEFAULT_PHYSICS = "default"
"""Name of the physics preset that every backend has."""
MAX_RATE = 1000.0
"""Highest control rate, Hz."""
OutcomeSource: TypeAlias = Literal["truth", "sensors"]
PoseSource: TypeAlias = Literal["truth", "odometry", "localized", "either"]
CollisionSource: TypeAlias = Literal["lidar", "contact"]

_CHOICES = {"source": PoseSource, "collision_from": CollisionSource, "outcome_from": OutcomeSource}
_UNCHANGED = (1.0, 1.0)
_SEVERITY = 22
"""Stream of random numbers."""
_TURN = 2 * math.pi + 0.01
"""A full turn, rad, which rounded numbers may exceed."""


class Settings:
    """Base of the parts of a description, which are frozen dataclasses: checks their numbers and choices.

    Those in ``positive`` and ``not_negative`` are so, at most ``most``, or ``None``. Numbers of NumPy and PyTorch
    become Python's.
    """

    positive: ClassVar[tuple[str, ...]] = ()
    not_negative: ClassVar[tuple[str, ...]] = ()
    most: ClassVar[float] = MAX_NUMBER

    def __post_init__(self) -> None:
        take_numbers(self)
        values = {name: value for name, value in vars(self).items() if value is not None}
        for name in values.keys() & _CHOICES.keys():
            if values[name] not in get_args(_CHOICES[name]):
                raise ValueError(f"{name} must be one of {get_args(_CHOICES[name])}, got {values[name]!r}")
        check_positive(self.most, **{name: values[name] for name in self.positive if name in values})
        check_at_least(0, self.most, **{name: values[name] for name in self.not_negative if name in values})


@dataclass(frozen=True)
class LidarConfig(Settings):
    """Lidar and its readings."""

    points: int = 32
    """Number of readings in an observation, each the minimum of a segment of the scan."""
    beams: int = 128
    """Number of beams of a raw scan."""
    max_range: float = 12.0
    """Maximum of a reading, m. Larger ranges are clipped."""
    period: int = 1
    """Number of steps from one scan to the next, in simulation: 4 is 5 Hz. Fewer scans take less time."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(1, MAX_COUNT, period=self.period)


@dataclass(frozen=True)
class PoseConfig(Settings):
    """Pose that the sensors report, from which the target is computed. Events and rewards know the true pose.

    - ``truth``: the true pose, as in the original environment.
    - ``odometry``: dead reckoning by the speed of the wheels and the attitude of the IMU. It drifts where wheels slip,
      and with the noise of both.
    - ``localized``: the true pose with an error that drifts and jumps, as that of a localization does.
    - ``either``: each episode draws odometry or localized.
    """

    source: PoseSource = "truth"
    """Where the pose comes from: truth, odometry, localized or either."""
    drift: float = 0.05
    """Standard deviation of the drifting error of x and y each, m."""
    drift_heading: float = 0.02
    """Standard deviation of the drifting error of the heading, rad."""
    drift_time: float = 10.0
    """Time in which the drifting error forgets all but 1/e of itself, s."""
    jump: float = 0.1
    """Standard deviation of the error of x and y each that each jump draws anew, m."""
    jump_rate: float = 0.05
    """Mean number of jumps per second."""
    jump_heading: float = 0.0
    """Standard deviation of the error of the heading that each jump draws anew, rad."""

    positive = ("drift_time",)
    not_negative = ("drift", "drift_heading", "jump", "jump_rate", "jump_heading")


@dataclass(frozen=True)
class ActionConfig(Settings):
    """Action of a policy, and its bounds. Actions outside of them are clipped."""

    min_speed: float | None = None
    """Minimum forward speed, m/s. 0 prevents driving backward. Default: that of the robot's drive."""
    max_speed: float | None = None
    """Maximum forward speed, m/s. Default: that of the robot's drive."""
    max_turn: float = math.pi
    """Maximum absolute heading offset, rad. It is at most that at which the robot turns as fast as it can."""
    max_sideways: float = 0.0
    """Maximum absolute speed to the left, m/s, of a drive that moves sideways. 0 leaves it out of the action."""
    max_yaw_rate: float | None = None
    """Maximum absolute yaw rate, rad/s, of an action that has one, as twist. Default: that of the robot's drive."""

    kind: Annotated[str, tyro.conf.arg(name="")] = HEADING
    """Action: heading (speed and heading offset, as in the contract), twist (speed and yaw rate), wheels (speeds of the
    left and right wheels), residual (what to add to the action of a driver who follows the route on what has been
    seen), or module:attribute of an Action."""

    positive = ("max_yaw_rate",)
    not_negative = ("max_sideways",)

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.min_speed, self.max_speed
        speeds = [speed for speed in (low, high) if speed is not None]
        if not all(map(math.isfinite, speeds)) or (len(speeds) == 2 and not speeds[0] < speeds[1]):
            raise ValueError(f"min_speed must be less than max_speed, both finite, got {low} and {high}")
        if not 0 < self.max_turn <= math.pi:
            raise ValueError(f"max_turn must be positive and at most pi, got {self.max_turn}")

    def for_robot(self, robot: RobotLike, gain: float = 2.0) -> ActionConfig:
        """Returns the bounds for a robot, whose heading PID has a proportional ``gain``, 1/s.

        Those of several robots are those of the fastest one, and of the one that turns fastest.
        """
        from rover_rl.robots import get_robots

        robots = get_robots(robot)
        most = max(robot.drive.max_speed for robot in robots)
        low, high = -most if self.min_speed is None else self.min_speed, self.max_speed
        fastest = max(robot.drive.fastest_turn(robot.wheels) for robot in robots)
        turn = min(self.max_turn, fastest / gain) if gain > 0 else self.max_turn
        bounds = replace(self, min_speed=low, max_speed=most if high is None else high, max_turn=turn)
        return (
            bounds if self.kind == HEADING else replace(bounds, max_yaw_rate=min(fastest, self.max_yaw_rate or fastest))
        )


@dataclass(frozen=True)
class TaskConfig(Settings):
    """Thresholds of the task. The defaults are the contract's."""

    success_distance: float = 0.5
    """Distance below which a goal is reached, m."""
    min_goal_distance: float = 1.0
    """Minimum distance from the rover to a new goal, m."""
    collision_threshold: float | None = None
    """Lidar reading below which the rover is in collision, m. None is the robot's: 0.3 m for Rover Zero, as in the
    contract, and for a robot that states none, in each direction, what its outline takes and 5 cm."""
    collision_window: int = 15
    """Number of consecutive steps in collision above which a jam ends the episode. 0 ends it at the first."""
    flip_threshold: float = 1.48
    """Absolute roll or pitch above which the rover is flipped, rad."""
    stuck_window: int = 600
    """Number of recent positions that are compared to detect a stuck rover."""
    stuck_threshold: float = 0.001
    """Displacement from the oldest to the newest of them below which the rover is stuck, m."""
    collision_from: CollisionSource = "lidar"
    """What counts as a collision: lidar (a reading below the threshold) or contact (the chassis or a wheel touches
    an obstacle). A live rover senses no contact and is never in collision then."""

    positive = ("success_distance", "min_goal_distance", "stuck_window")
    not_negative = ("collision_threshold", "collision_window", "flip_threshold", "stuck_threshold")
    most = math.inf


@dataclass(frozen=True)
class RewardConfig(Settings):
    """Parameters of the contract's reward, which are the defaults, and of components that may be added to it."""

    goal_reward: float = 100.0
    """Reward for reaching a goal."""
    distance_delta_scale: float = 0.3
    """Reward per meter of progress toward the goal."""
    final_reward_multiplier: float = 1.5
    """Factor of the progress reward and of the idle penalty."""
    idle_penalty: float = -0.03
    """Reward that replaces the progress reward if the rover makes too little progress or faces away."""
    min_progress: float = 0.001
    """Absolute change of the distance above which progress counts, m."""
    min_alignment: float = 0.0
    """Heading alignment (-1 to 1) above which progress counts."""
    velocity_scale: float = 0.0025
    """Reward per m/s of forward speed."""
    turn_scale: float = -0.0015
    """Reward per rad/s of absolute yaw rate."""
    collision_penalty: float = -0.5
    """Reward for each step in collision."""
    stuck_penalty: float = -25.0
    """Reward for an episode that ends because the rover is stuck."""
    general_penalty: float = -20.0
    """Reward for an episode that ends in a flip or a jam."""
    flip_grace_steps: int = 500
    """Number of steps at the start of an episode in which a flip has no penalty."""
    out_of_bounds_penalty: float = -10.0
    """Reward for leaving the world's bounds (too_far_away_penilty in the contract)."""
    clearance_penalty: float = 0.0
    """Reward for each step with a lidar reading of 0, falling linearly to nothing at the clearance distance."""
    clearance_distance: float = 0.5
    """Lidar reading below which the clearance penalty applies, m."""
    action_rate_penalty: float = 0.0
    """Reward for each squared change of the action between steps, (m/s)^2 + rad^2."""
    mover_contact_penalty: float = 0.0
    """Reward for each step in contact with a mover that the rover drove into: it was not standing still before."""
    struck_penalty: float = 0.0
    """Reward for each step in contact with a mover that ran into the standing rover."""
    intrusion_penalty: float = 0.0
    """Reward for each step at a mover, falling linearly to nothing at the intrusion distance."""
    haste_penalty: float = 0.0
    """Reward for each step at 1 m/s at a mover, in proportion to the speed, falling in the same way."""
    risk_penalty: float = 0.0
    """Reward for each step within the risk distance of a mover."""
    intrusion_distance: float = 1.2
    """Distance from the center of the rover to the surface of a mover from which on it does not intrude, m."""
    risk_distance: float = 0.5
    """Distance from the center of the rover to the surface of a mover within which it is at risk, m."""

    positive = ("clearance_distance", "intrusion_distance", "risk_distance")
    most = math.inf


@dataclass(frozen=True)
class HeadingGains(Settings):
    """Gains of the heading PID. The defaults are the contract's."""

    kp: float = 2.0
    """Proportional gain, 1/s."""
    ki: float = 0.0
    """Integral gain, 1/s^2."""
    kd: float = 0.1
    """Derivative gain, dimensionless."""
    max_output: float = 7.0
    """Maximum absolute yaw rate, rad/s. A robot whose drive is slower turns at most at its own."""


@dataclass(frozen=True)
class LimitsConfig(Settings):
    """Limits of the commands, as ``rover-rl drive`` applies them to a live rover. In simulation, its drive lags too."""

    apply: bool = False
    """Limit the commands in simulation, too. ``rover-rl drive`` then uses the limits below by default."""
    max_speed: float | None = None
    """Largest speed, m/s. None: that of the robot."""
    max_yaw_rate: float | None = None
    """Largest yaw rate, rad/s. None: that of the robot."""
    max_acceleration: float | None = None
    """Largest change of the speed, m/s^2. None: that of the robot."""
    max_yaw_acceleration: float | None = None
    """Largest change of the yaw rate, rad/s^2. None: that of the robot."""
    min_reversal: float = MIN_REVERSAL
    """Smallest yaw rate that changes the turning direction, rad/s. With less, the rover stops turning."""

    positive = ("max_speed", "max_yaw_rate", "max_acceleration", "max_yaw_acceleration")
    not_negative = ("min_reversal",)


@dataclass(frozen=True)
class GuardConfig(Settings):
    """Emergency brake: limits the speed so that the rover stops before what the scan shows in its way.

    The way is the arc of the command, swept by the outline of the robot. The largest speed ``v`` uses up the free
    distance ``d`` on it, less what obstacles that come towards the rover take until it stands, as in the protective
    separation distance of ISO/TS 15066: ``d = v reaction + v^2 / (2 deceleration) + approach (reaction + v /
    deceleration)``.
    """

    deceleration: float = 0.0
    """Deceleration of the rover when it brakes, m/s^2. 0 leaves the brake out."""
    reaction: float = 0.2
    """Time from a scan until the rover brakes, with the period of the lidar, s."""
    approach: float = 0.0
    """Speed of obstacles towards the rover that it reckons with, m/s."""
    margin: float = 0.02
    """Free distance around the outline, m."""

    not_negative = ("deceleration", "reaction", "approach", "margin")


@dataclass(frozen=True)
class Randomization(Settings):
    """Domain randomization. The defaults disable it.

    Factors, delays and biases are drawn uniformly from their ranges at each reset. Noise is drawn at each step.

    Example:
        >>> env = RoverEnv(world_n="maze", randomization=Randomization(friction=(0.7, 1.3), range_noise=0.01))
    """

    friction: tuple[float, float] = _UNCHANGED
    """Range of the scale factor of all friction coefficients."""
    chassis_mass: tuple[float, float] = _UNCHANGED
    """Range of the scale factor of the mass and inertia of the chassis."""
    motor_torque: tuple[float, float] = _UNCHANGED
    """Range of the scale factor of the maximum motor torque."""
    latency: tuple[int, int] = (0, 0)
    """Range of the delay of commands, control steps."""
    range_noise: float = 0.0
    """Standard deviation of the lidar ranges, m."""
    dropout: float = 0.0
    """Fraction of lidar beams without a return."""
    odometry_noise: float = 0.0
    """Relative standard deviation of the velocities from wheel odometry."""
    imu_noise: float = 0.0
    """Standard deviation of roll, pitch and yaw, rad."""
    scan_latency: tuple[int, int] = (0, 0)
    """Range of the delay of scans, control steps."""
    state_latency: tuple[int, int] = (0, 0)
    """Range of the delay of all other sensors, control steps. A scan waits for the pose of its time."""
    scan_period: tuple[int, int] | None = None
    """Range of the number of steps from one scan to the next. None: that of the lidar."""
    lost_scans: float = 0.0
    """Fraction of scans that never arrive. The last one stays."""
    odometry_scale: tuple[float, float] = _UNCHANGED
    """Range of the scale factor of the velocities from wheel odometry."""
    yaw_bias: tuple[float, float] = (0.0, 0.0)
    """Range of the error of the yaw rate that dead reckoning adds up, rad/s."""
    limits: tuple[float, float] = _UNCHANGED
    """Range of the scale factor of the limits of the commands."""
    severity: tuple[float, float] = _UNCHANGED
    """Range of the scale factor of all noise, lost beams and scans, and of the errors of a localization."""
    lidar_view: tuple[float, float] | None = None
    """Range of the angle that the lidar sees, centered on straight ahead, rad, at most that of the robot (``None``).
    Beams outside of it have no return."""
    dead_sectors: int = 0
    """Largest number of sectors, at most 16, in which the lidar sees nothing, as behind a part of the robot or dirt.
    Each episode has from 0 to this many, in any direction."""
    dead_sector_width: tuple[float, float] = (0.1, 0.6)
    """Range of the width of each of these sectors, rad."""
    lidar_min_range: tuple[float, float] = (0.0, 0.0)
    """Range of the least distance that the lidar measures, m. Beams that meet something closer have no return."""

    not_negative = ("range_noise", "odometry_noise", "imu_noise")

    def __post_init__(self) -> None:
        super().__post_init__()
        least = math.ulp(0.0)
        for names, what, low, high in (
            ("friction chassis_mass motor_torque odometry_scale limits", "positive factors", least, MAX_NUMBER),
            ("severity", "factors of at least 0", 0, MAX_NUMBER),
            ("latency scan_latency state_latency", "control steps", 0, MAX_NUMBER),
            ("scan_period", "at least 1 step", 1, MAX_NUMBER),
            ("yaw_bias", "yaw rates, rad/s", -MAX_NUMBER, MAX_NUMBER),
            ("lidar_view", "positive angles of at most 2 pi rad", least, _TURN),
            ("dead_sector_width", "angles of 0 to 2 pi rad", 0, _TURN),
            ("lidar_min_range", "distances, m", 0, MAX_NUMBER),
        ):
            for name in names.split():
                ends = getattr(self, name) or (low, high)
                if not low <= ends[0] <= ends[1] <= high:
                    raise ValueError(f"{name} must be a range (low, high) of {what}, got {ends}")
        check_at_least(0, 16, dead_sectors=self.dead_sectors)
        for name, share in {"dropout": self.dropout, "lost_scans": self.lost_scans}.items():
            if not 0 <= share < 1:
                raise ValueError(f"{name} must be at least 0 and less than 1, got {share}")

    @classmethod
    def typical(cls, dt: float = CONTROL_DT) -> Randomization:
        """Returns typical ranges for a skid-steer rover with low-cost sensors, with delays in steps of ``dt``, s."""
        late, bias = (0, round(0.1 / dt)), math.radians(0.1)
        noise = cls(range_noise=0.01, dropout=0.01, odometry_noise=0.02, imu_noise=0.01, lost_scans=0.01)
        noise = replace(noise, odometry_scale=(0.98, 1.02), yaw_bias=(-bias, bias), severity=(0.0, 1.0))
        noise = replace(noise, latency=late, scan_latency=late, state_latency=(0, round(0.05 / dt)))
        return replace(noise, friction=(0.7, 1.3), chassis_mass=(0.9, 1.3), motor_torque=(0.7, 1.0))

    def severity_of(self, keys: Tensor) -> Tensor | float:
        """Returns the factors of noise and errors, ``[N, 1]``, of episodes with random ``keys``, or that of all."""
        if self.severity[0] == self.severity[1]:
            return self.severity[0]
        from rover_rl.rng import between, random_bits

        return between(random_bits(keys, _SEVERITY, 0, 1), self.severity)

    @property
    def varies_dynamics(self) -> bool:
        """Whether friction, mass or motor torque are randomized."""
        return not self.friction == self.chassis_mass == self.motor_torque == _UNCHANGED

    @property
    def delays_sensors(self) -> bool:
        """Whether what the sensors tell may be older than now, beyond the period of the lidar."""
        return bool(self.scan_latency[1] or self.state_latency[1] or self.lost_scans or self.scan_period)

    @cached_property
    def hides_beams(self) -> bool:
        """Whether the lidar sees less than that of the robot. An environment then has the sensor ``lidar_mask``."""
        return self.lidar_view is not None or self.dead_sectors > 0 or self.lidar_min_range[1] > 0


@dataclass(frozen=True)
class EnvConfig(Settings):
    """Description of an environment: world, robot, sensors, task, reward and simulator.

    ``make_env(EnvConfig(...))`` builds the environment. Training stores the description in the run's folder and in the
    checkpoint. Worlds, robots, sensors, rewards and backends can be your own, named as ``module:attribute``. A setting
    out of range raises ``ValueError``.
    """

    world: WorldLike = "inspect"
    """World: a name (rover-rl worlds lists them), module:attribute, or a file. "maze:7" is the maze with seed 7, and
    "maze:7@0.8" a hard one. Several worlds get equal shares of the rovers. "maze:0-99" draws one of 100 mazes for each
    episode."""
    robot: RobotLike = "rover_zero"
    """Robot: a name (rover-rl robots lists them; any:7 is number 7 of a family), a URDF file, or module:attribute. Of
    several ("leo husky", or "any:0-255" for 256 robots), each episode draws one, with backend warp. The entries of a
    list have equal shares of the episodes."""
    robot_options: RobotSettings = field(default_factory=RobotOptions)
    """What a URDF does not tell of the robot. They become part of its name: "scout.urdf(max_speed=1.5)"."""
    lidar: LidarConfig = field(default_factory=LidarConfig)
    """Lidar and its readings."""
    pose: PoseConfig = field(default_factory=PoseConfig)
    """Pose that the sensors report: true, dead reckoning or with the error of a localization."""
    sensors: tuple[SensorLike, ...] = ()
    """Sensors that add entries to the observation: depth, colors, segmentation, lidar3d, lidar_mask, past_scans,
    heights, contact, effort, route, movers, contact_times, robot, or module:attribute of a Sensor, or of a function
    or class that makes one. A name can have settings: "depth(size=(24, 32))".
    Name the entries in --observation, too."""
    action: ActionConfig = field(default_factory=ActionConfig)
    """Action of a policy, and its bounds."""
    task: TaskConfig = field(default_factory=TaskConfig)
    """Thresholds of the task."""
    terminate: tuple[TerminationLike, ...] = ()
    """What ends an episode beside the contract's events, whose thresholds are those of task: no_progress, or
    module:attribute of a Termination. A name can have settings: "no_progress(seconds=10)"."""
    reward: RewardLike = "contract"
    """Reward: contract, task (1 per goal), or module:attribute of a component or of a function that returns components.
    Several rewards are added up: "contract my_package:TiltPenalty"."""
    contract_reward: RewardConfig = field(default_factory=RewardConfig)
    """Parameters of the contract's reward. Components whose penalties are 0 are left out."""
    heading_gains: HeadingGains = field(default_factory=HeadingGains)
    """Gains of the heading PID."""
    limits: LimitsConfig = field(default_factory=LimitsConfig)
    """Limits of the commands."""
    guard: GuardConfig = field(default_factory=GuardConfig)
    """Emergency brake."""
    randomization: Randomization = field(default_factory=Randomization)
    """Domain randomization."""
    events: tuple[EventLike, ...] = ()
    """What happens to rovers in simulation beside the randomization: power_dips, or module:attribute of an Event. A
    name can have settings: "power_dips(rate=0.2)"."""
    compensate_delay: bool = False
    """Carry late pose, heading and velocities on to now, by the commands sent since and the limits of the drive. Late
    scans then tell where they were taken from there."""
    outcome_from: OutcomeSource = "truth"
    """State that events, rewards and metrics are computed from: truth (of the simulator) or sensors (with noise)."""
    privileged: bool = False
    """Add the nested observation "privileged": true state, path distance and randomized dynamics."""
    backend: BackendLike = "bullet"
    """Simulator: bullet, warp (fast), mujoco (an extra), ros2 (one live rover), or module:attribute."""
    physics: str = DEFAULT_PHYSICS
    """Physics preset of the backend. Bullet has default, accurate and fast (docs/simulators.md), and Warp default, full
    and planar, which is several times as fast on level ground (docs/warp.md); by default, training takes it there."""
    control_rate: float | None = None
    """Control steps per second. Default: those of the backend's settings, 20. A fast robot needs more: at 5 m/s and 20
    Hz, it drives 0.25 m in a step. Numbers of steps, as the length of an episode, stay as they are."""
    connection: Connection = field(default_factory=Connection)
    """ROS 2 topics of a live rover, and connection timeout."""
    length: int = 2000
    """Number of steps after which an episode is truncated."""
    end_on_goal: bool = False
    """End the episode when the goal is reached, instead of setting a new goal."""
    size: tuple[int, int] = (64, 64)
    """Size of the camera buffer, pixels. Reserved for vision, as in the original environment."""
    num_envs: int | None = 1
    """Number of rovers in the batch."""
    agents: int = 1
    """Number of consecutive rovers of the batch that share a world, in which they see and push one another."""
    seed: int | None = None
    """Seed of the first rover. Rover i has this seed plus i. Without a seed, a random one is used."""
    device: str | None = None
    """Device of the tensors: cpu, cuda or cuda:1."""

    positive = ("control_rate",)
    most = MAX_RATE

    def __post_init__(self) -> None:
        def take(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        if self.seed is not None:
            take("seed", check_seed(self.seed))
        take("device", None if self.device is None else str(self.device))
        if isinstance(self.action, str):
            take("action", ActionConfig(kind=self.action))
        if isinstance(self.action, type):
            advice = "register it, or name it as module:attribute"
            raise ValueError(f"action must be the name of an Action, got the class {self.action.__name__}; {advice}")
        super().__post_init__()
        for name, kind in PARTS.items():
            if not isinstance(value := getattr(self, name), kind):
                raise ValueError(f"{name} must be a {kind.__name__}, got {type(value).__name__} {value!r}"[:200])
        if self.robot_options != RobotOptions():
            take("robot", _with_options(self.robot, self.robot_options))
            take("robot_options", RobotOptions())
        # A World and a WorldPool, which are not imported here, as they import PyTorch, have one of these.
        if not (isinstance(self.world, Sequence) or hasattr(self.world, "terrain") or hasattr(self.world, "entries")):
            raise ValueError(f"world must be a name, a World, or a list of them, got {self.world!r}")
        if (self.action.min_speed is None) != (self.action.max_speed is None):
            self.action.for_robot(self.robot)  # Raises an error if they leave no range.
        if isinstance(self.reward, RewardConfig):
            take("contract_reward", self.reward)
            take("reward", "contract")
        if isinstance(self.sensors, str) or not isinstance(self.sensors, Sequence):
            raise ValueError(f"sensors must be a list of names or Sensors, got {self.sensors!r}")
        for name in ("terminate", "events"):
            if not isinstance(value := getattr(self, name), (list, tuple)):
                take(name, (value,))
        for name in ("world", "robot", "reward", "sensors", "terminate", "events"):
            if isinstance(value := getattr(self, name), list):
                take(name, tuple(value))

    @classmethod
    def of(cls, *args: Any, **settings: Any) -> EnvConfig:
        """Creates a description from an ``EnvConfig``, from settings, or from the contract's arguments.

        ``None`` is the default of a setting. The defaults are those of ``task``, if that is the name of a task. Raises
        ``TypeError`` if there are arguments besides an ``EnvConfig``, or one is unknown, or given by two names.

        Example:
            >>> EnvConfig.of(world_n="maze", lidar_points=16) == EnvConfig(world="maze", lidar=LidarConfig(points=16))
            True
        """
        if args and isinstance(args[0], EnvConfig):
            if len(args) > 1 or settings:
                raise TypeError("an EnvConfig is given alone; use dataclasses.replace(config, ...) to change it")
            return args[0]
        base = cls()
        task = settings.get("task")
        if isinstance(task, str) or hasattr(task, "test_env"):
            named = TASKS.find(settings.pop("task")) if isinstance(task, str) else settings.pop("task")
            if not hasattr(named, "test_env"):
                raise ValueError(f"task must be the name of a Task, and {task!r} is {type(named).__name__}")
            base = named.env
        known = [*CONTRACT, *(item.name for item in fields(cls))]
        changes: dict[str, Any] = {}
        parts: dict[str, dict[str, Any]] = {}
        if len(args) > 10 or settings.keys() & set(known[: len(args)]):
            raise TypeError(f"an environment takes the contract's 10 arguments by position, each once, got {len(args)}")
        for name, value in (dict(zip(CONTRACT, args, strict=False)) | settings).items():
            if name not in known:
                raise TypeError(f"there is no setting {name!r}{perhaps(name, known)}")
            part, _, attribute = CONTRACT.get(name, name).partition(".")
            if part in changes or (part in parts and not attribute):
                raise TypeError(f"{name} and another argument set {part}: give one of them")
            if attribute:
                parts.setdefault(part, {})[attribute] = value
            elif value is not None or name == "num_envs":
                changes[part] = value
        if isinstance(kind := changes.get("action"), str):
            changes["action"] = replace(base.action, kind=kind)
        return replace(
            base, **changes, **{part: replace(getattr(base, part), **values) for part, values in parts.items()}
        )

    @property
    def worlds(self) -> tuple[str | World, ...]:
        """Worlds and ranges of worlds, also if there is only one."""
        # The entries of a WorldPool, which is not imported here, as it imports PyTorch.
        world: Any = getattr(self.world, "entries", self.world)
        return tuple(world) if isinstance(world, Sequence) and not isinstance(world, str) else (world,)

    @property
    def world_names(self) -> tuple[str, ...]:
        return tuple(map(name_of_part, self.worlds))

    def fitted(self) -> EnvConfig:
        """Returns the description with worlds that are wide enough for the robot, where their names leave that open.

        ``"maze:5"`` becomes ``"maze:5*1.8"`` for a robot that needs passages 1.8 times as wide as Rover Zero does. A
        live rover is in the world that is named. Worlds of several robots are fitted to each of them later.
        """
        backend = self.backend if isinstance(self.backend, str) else name_of(self.backend)
        if self.robot == EnvConfig.robot or backend == "ros2" or names_several(self.robot):
            return self
        from rover_rl.robots import get_robot
        from rover_rl.sims.free_space.fitting import fitting_worlds

        world = fitting_worlds(self.world, get_robot(self.robot))
        return self if world is self.world else replace(self, world=world)

    @property
    def own_sensors(self) -> tuple[SensorLike, ...]:
        """Sensors besides those of every rover: of the robot, :attr:`sensors`, and what the action needs."""
        if self.robot == EnvConfig.robot and self.action.kind == HEADING:
            # They have none, and robots and actions need PyTorch.
            return self.sensors
        from rover_rl.robots import get_robots

        named = (*get_robots(self.robot)[0].sensors, *self.sensors)
        there = {Name.parse(one).part if isinstance(one, str) else getattr(one, "name", one) for one in named}
        return (*named, *(one for one in getattr(ACTIONS.find(self.action.kind), "needs", ()) if one not in there))

    @property
    def late_scans(self) -> bool:
        """Whether scans can be older than the pose, and where they were taken is told."""
        asked = any(getattr(sensor, "name", sensor) == SCAN_POSE for sensor in self.own_sensors)
        return asked or self.randomization.delays_sensors

    @property
    def bounded_action(self) -> ActionConfig:
        """Bounds of the action for :attr:`robot`."""
        return self.action.for_robot(self.robot, self.heading_gains.kp)

    @property
    def control_dt(self) -> float:
        """Duration of a step, s."""
        return 1 / self.control_rate if self.control_rate else getattr(self.backend, "control_dt", CONTROL_DT)

    @property
    def preset(self) -> str | None:
        """Name of the physics preset, as :func:`~rover_rl.sims.make_simulator` takes it."""
        return None if self.physics == DEFAULT_PHYSICS else self.physics


_factories = {item.name: item.default_factory for item in fields(EnvConfig)}
PARTS: dict[str, Any] = {name: kind for name, kind in _factories.items() if isinstance(kind, type)}
"""Types of the parts of :class:`EnvConfig`."""
_TOPICS = ("scan_topic", "imu_topic", "cmd_vel_topic", "camera_topic")
CONTRACT = {
    **{"size": "size", "length": "length", **{name: f"connection.{name}" for name in _TOPICS}},
    **{"world_n": "world", "connection_check_timeout": "connection.timeout"},
    **{"lidar_points": "lidar.points", "max_lidar_range": "lidar.max_range", "lidar_beams": "lidar.beams"},
}
"""Settings by the names of the contract's ten arguments, in their order, and of one more that goes with them."""


def env_signature() -> Signature:
    """Signature of an environment: the contract's arguments and the settings, for ``help()`` and editors."""
    default, parameters = EnvConfig(), []
    for number, (name, path) in enumerate((CONTRACT | {item.name: item.name for item in fields(EnvConfig)}).items()):
        kind = Parameter.POSITIONAL_OR_KEYWORD if number < 10 else Parameter.KEYWORD_ONLY
        parameters.append(Parameter(name, kind, default=attrgetter(path)(default)))
    return Signature(parameters)


def describe_settings() -> str:
    """Returns the names and descriptions of all settings, as they stand in this file, for ``help()``."""
    with open(__file__, encoding="utf-8") as file:
        body = ast.parse(file.read()).body
    classes = {node.name: node.body for node in body if isinstance(node, ast.ClassDef)}

    def lines(kind: str, prefix: str = "") -> Iterator[str]:
        for item, text in pairwise(classes[kind]):
            if isinstance(item, ast.AnnAssign) and isinstance(text, ast.Expr):
                yield f"- ``{prefix}{ast.unparse(item.target)}``: {' '.join(ast.literal_eval(text.value).split())}"
                if (part := ast.unparse(item.annotation)) in classes:
                    yield from lines(part, f"{ast.unparse(item.target)}.")

    return "\n".join(lines("EnvConfig"))


def _with_options(robots: RobotLike, options: RobotOptions) -> RobotLike:
    if isinstance(robots, str):
        return with_options(robots, options)
    if not isinstance(robots, (list, tuple)) or not all(isinstance(robot, str) for robot in robots):
        raise ValueError("robot_options are for robots by name and URDF files, and robot is a Robot")
    return tuple(with_options(robot, options) for robot in robots)


def require_match(made_for: EnvConfig, env: EnvConfig) -> None:
    """Raises ``ValueError`` with the first difference if a policy made for one environment cannot be used in another.

    The lidar readings (number and range), robot, action bounds and heading gains must be equal, and the environment
    must have the sensors that the policy was made for. Worlds, rewards, randomization and simulators may differ. A
    policy made for several robots may drive any robot, whose limits bound its actions. One whose ``Randomization`` has
    a ``lidar_view`` may drive its robot with a lidar of any view in that range.
    """
    for what, expected, actual in _pairs(made_for, env):
        if expected != actual:
            raise ValueError(f"the policy was made for {what} {expected}, and the environment has {actual}")


def _pairs(made_for: EnvConfig, env: EnvConfig) -> Iterator[tuple[str, Any, Any]]:
    yield "lidar points", made_for.lidar.points, env.lidar.points
    yield "a lidar range of (m)", made_for.lidar.max_range, env.lidar.max_range
    several = names_several(made_for.robot)
    if not several:
        yield "the robot", *_robots(made_for, env.robot)
    yield "the sensors", made_for.sensors, tuple(each for each in made_for.sensors if each in env.sensors)
    # These depend on the robot. Of several, one whose limits are tighter bounds what the policy does.
    expected, actual = (config.action if several else config.bounded_action for config in (made_for, env))
    names = ", ".join(vars(ActionConfig()))
    yield f"actions of ({names})", astuple(expected), astuple(actual)
    gains = astuple(made_for.heading_gains), astuple(env.heading_gains)
    yield "heading gains of (kp, ki, kd, max_output)", *gains


def _robots(made_for: EnvConfig, given: RobotLike) -> tuple[str, str]:
    """Returns the names of two robots, equal ones if the robots are the same but for a view in the trained range."""
    names, views = (name_of_part(made_for.robot), name_of_part(given)), made_for.randomization.lidar_view
    if isinstance(made_for.robot, str) and isinstance(given, str) and (views is None or names_several(given)):
        return names
    from rover_rl.robots import get_robot, get_robots

    expected, robots = get_robot(made_for.robot), get_robots(given)
    if views is not None and len(robots) == 1 and views[0] - 1e-3 <= robots[0].lidar_view <= views[1] + 1e-3:
        robots = (replace(robots[0], name=expected.name, lidar_view=expected.lidar_view),)
    if tuple(robots) == (expected,):
        return names[0], names[0]
    return names if names[0] != names[1] else (names[0], f"another robot of the name {names[1]}")


def name_of_part(part: Any) -> str:
    """Returns the name of a world or robot, which is either a name or an object, or the names of several."""
    if isinstance(part, tuple):
        return " ".join(map(name_of_part, part))
    return part if isinstance(part, str) else part.name


def plain_env(config: EnvConfig) -> dict[str, Any]:
    """Converts a description to plain data for YAML and JSON.

    Raises ``ValueError`` if the world, robot, reward or a sensor is an object. Only names can be written.
    """
    objects = {"world": "a World", "robot": "a Robot", "reward": "a reward object", "sensors": "a Sensor"}
    objects |= {"terminate": "a Termination", "events": "an Event"}
    for name, kind in objects.items():
        value = getattr(config, name)
        if not all(isinstance(part, str) for part in (value if isinstance(value, tuple) else (value,))):
            advice = "register it, or name it as module:attribute"
            raise ValueError(f"{kind} cannot be written to a file, and {name} is one; {advice}")
    own = not isinstance(config.backend, str)
    data = to_plain(replace(config, backend="bullet") if own else config)
    # They are part of the robot's name.
    del data["robot_options"]
    if own:
        data["backend"] = {name_of(config.backend): to_plain(config.backend) if is_dataclass(config.backend) else {}}
    return data


def env_from_plain(data: Any, source: str) -> EnvConfig:
    """Creates a description from plain data, the inverse of :func:`plain_env`. Missing settings get their defaults.

    ``source`` is the origin of the data, such as a file. Raises ``ValueError`` if a setting does not exist, or a value
    has the wrong type or is out of range.
    """
    if not isinstance(data, dict) or not isinstance(data.get("backend"), dict):
        return from_plain(data, EnvConfig, source)
    config = from_plain({key: value for key, value in data.items() if key != "backend"}, EnvConfig, source)
    ((name, settings),) = data["backend"].items()
    return replace(config, backend=from_plain(settings, find_settings(name), f"backend {name} in {source}"))
