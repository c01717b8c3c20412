"""``RoverEnv``: batched TorchRL environment for point navigation on rough terrain."""

from __future__ import annotations

import math
import secrets
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NoReturn

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from rover_rl.checks import MAX_COUNT, MAX_ROVERS, check_count, check_seed
from rover_rl.envs import specs
from rover_rl.envs.arguments import SIGNATURE, EnvSettings, config_from
from rover_rl.envs.config import SCAN_POSE, EnvConfig, Randomization, TaskConfig
from rover_rl.envs.control import HeadingController, checked_action, checked_place
from rover_rl.envs.delays import CommandDelay, SensorDelays, relative_pose
from rover_rl.envs.emergency_brake import EmergencyBrake
from rover_rl.envs.group_placement import GroupPlacement
from rover_rl.envs.groups import Groups, first_of_group
from rover_rl.envs.perception import Localization, Perception, SensedPose, rovers_of
from rover_rl.envs.placement import Placement, draw_dynamics
from rover_rl.envs.prediction import Prediction
from rover_rl.envs.privileged import PrivilegedObservation
from rover_rl.envs.row_limits import RowLimits
from rover_rl.envs.row_robots import RowRobots
from rover_rl.envs.row_worlds import RowWorlds
from rover_rl.envs.sensors.base import Observer, Rig, Sensor, SensorInput, Surroundings
from rover_rl.envs.sensors.standard import LidarPooling, LivePooling, clipped_pose
from rover_rl.envs.sensors.suite import environment_sensors
from rover_rl.envs.task import Navigation, StepState, TaskState, target_info
from rover_rl.rng import episode_keys, row_keys
from rover_rl.robots import Robot, get_robots
from rover_rl.robots.fleet import Fleet
from rover_rl.sims import Connection, RoverState, Simulator, make_simulator
from rover_rl.sims.backends import make_scanner
from rover_rl.sims.base import MAX_AGE, Feature, Scanner, View
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.fitting import RobotGroups
from rover_rl.sims.movers.field import MoverField
from rover_rl.sims.movers.other_rovers import OtherRovers
from rover_rl.sims.movers.scanner import MoverScanner
from rover_rl.sims.rays import in_view
from rover_rl.tensordicts import unchecked_tensordict
from rover_rl.torch_defaults import with_torch_defaults
from rover_rl.worlds import World
from rover_rl.worlds.pool import WorldPool, draws_worlds

if TYPE_CHECKING:
    from typing_extensions import Unpack


class RoverEnv(EnvBase):
    """Batch of rovers that navigate to goals with lidar, IMU, wheel odometry and pose.

    The reward is 1 for each goal reached. :func:`rover_rl.make_env` adds the contract's reward.

    Observation (float32, clipped to the contract's bounds): ``lidar [N, lidar_points]`` (m), ``pose [N, 3]`` (m),
    ``imu [N, 3]`` (pitch, roll, yaw; rad), ``target [N, 2]`` (distance in m, relative angle in rad) and
    ``velocities [N, 2]`` (wheel odometry; m/s, rad/s). Action: ``action [N, 2]``, forward speed in m/s, for Rover Zero
    in [-1, 1], and heading offset in [-pi, pi] rad; with ``max_sideways``, ``[N, 3]`` with the speed to the left in
    m/s. Finite actions are clipped to these bounds. ``outcome`` contains the events of the step, see
    :mod:`rover_rl.envs.task`.

    ``reset(start=..., goal=...)`` sets start poses ``[N, 3]`` (x, y in m, yaw in rad) and goals ``[N, 2]`` (m). Without
    transforms, they can also be entries of the reset tensordict; transforms drop these entries.

    Row ``i`` of a batch with seed ``s`` is bit-identical to a single environment with seed ``s + i``.

    With ``agents``, the rovers of each ``agents`` consecutive rows share a world, see one another and push one another:
    see :class:`~rover_rl.envs.wrappers.groups.GroupedRovers`. Row ``i`` is then bit-identical in all batches with its
    whole group.

    ``num_envs=None`` creates one rover without a batch dimension (batch size ``[]``): ``lidar [lidar_points]``,
    ``action [2]``, ``reward [1]``, ``start [3]``. Its values equal those of a batch of one.

    ``close()`` releases the simulator. The next ``reset()`` builds a new one, as TorchRL's ``ParallelEnv`` does, and
    continues with the next episodes.

    ``RoverEnv(config)`` takes an :class:`EnvConfig` and nothing else; its reward has no effect. Otherwise:

    Args:
        size: size of the camera buffer, pixels. Reserved for vision, as in the original environment.
        length: number of steps after which an episode is truncated.
        scan_topic, imu_topic, cmd_vel_topic, camera_topic: ROS 2 topics of a live rover.
        world_n: name of a world (``"inspect"``, ``"moon"``, ``"maze"``, ``"maze:7"`` for seed 7, or
            ``"module:attribute"``), a :class:`~rover_rl.worlds.World`, or a list of worlds, which are assigned to
            equal blocks of rows. With a range of seeds (``"maze:0-999"``, or ``"maze:*"`` for those from 0 to 9999), a
            list that has one, or a :class:`~rover_rl.worlds.pool.WorldPool`, each episode draws a world.
        connection_check_timeout: time to wait for a live rover's first scan, s.
        lidar_points: number of lidar readings in an observation, each the minimum of a segment of the scan.
        max_lidar_range: maximum of a lidar reading, m. Larger ranges are clipped.
        num_envs: number of rovers in the batch. ``None`` creates one rover without a batch dimension.
        agents: number of rovers that share a world. ``num_envs`` must be a multiple.
        backend: name of a backend, ``"bullet"``, ``"mujoco"``, ``"warp"`` (fast, on ``device``), ``"ros2"`` (one live
            rover) or ``"module:attribute"``; or settings of a backend, for example
            :class:`~rover_rl.sims.bullet.BulletSettings`.
        physics: physics preset of a backend given by name. Bullet has ``"default"``, ``"accurate"`` and ``"fast"``.
        robot: name of a robot, or a :class:`~rover_rl.robots.Robot`. With a range of a family (``"any:0-255"``) or
            a list, each episode draws a robot: see :class:`EnvConfig`.
        lidar_beams: number of beams of a raw scan.
        lidar_period: number of steps from one scan to the next: see :class:`LidarConfig`.
        pose: pose that the sensors report. ``None``: the true one.
        seed: seed of the first row. ``None`` uses a random seed.
        device: device of the tensors. ``None`` is the CPU, and leaves the device of the tensordicts unset.
        end_on_goal: whether reaching the goal ends the episode, instead of setting a new goal.
        task: thresholds of the task. ``None`` uses the contract's.
        heading_gains: gains of the heading PID. ``None`` uses the contract's.
        limits: limits of the commands. ``None``: those of the robot's drive alone.
        guard: emergency brake. ``None``: none.
        randomization: domain randomization. ``None`` disables it.
        action: bounds of the action. ``None`` uses the robot's; those of Rover Zero are the contract's.
        outcome_from: state that events, rewards and metrics are computed from: the simulator's ``"truth"`` or the
            ``"sensors"``. They differ if ``randomization`` adds sensor noise.
        privileged: whether to add the nested observation ``privileged``, see :mod:`rover_rl.envs.privileged`.
        sensors: sensors of one's own that add entries to the observation: each a
            :class:`~rover_rl.envs.sensors.base.Sensor`, a registered name or ``"module:attribute"``.
        world, lidar, connection: names of :class:`EnvConfig` for ``world_n``, for the four settings of the lidar, and
            for topics and timeout, in place of these.

    Attributes:
        config: description of the environment.
        num_envs: number of rovers, and of rows of :attr:`goal`, :attr:`rover_state` and ``worlds``. 1 if unbatched.
        robots: robots of the rows, and how episodes draw them.
        fleet: robot of each row, ``env.fleet[row]``.
        robot: the robot, or of several the one that needs the most space.
        sensors: sensors that it reads, by name.
        simulator: simulator. A reset after ``close()`` replaces it.
        movers: movers of each row, where they are and where they go.
        scanner: its lidar, which scans what does not move, in a full turn.
        delays: delays of the sensors. ``None`` if there are none.

    Raises:
        ValueError: if the world, backend or robot is unknown, the device is not available, there are fewer beams than
            points, a number is out of range, or the task needs contacts that the backend does not report.
        TypeError: if there are arguments besides an ``EnvConfig``, or an argument is unknown or given by both of its
            names.

    Example:
        >>> env = RoverEnv(world_n="maze", num_envs=2, seed=0)
        >>> env.rollout(3)["lidar"].shape
        torch.Size([2, 3, 32])
    """

    batch_locked = True

    @with_torch_defaults
    def __init__(self, *args: Any, **settings: Unpack[EnvSettings]) -> None:
        self._init_config(replace(config_from("RoverEnv", args, settings), reward="task"))

    def _init_config(self, config: EnvConfig) -> None:
        num_envs = 1 if config.num_envs is None else check_count(MAX_ROVERS, num_envs=config.num_envs)
        check_count(MAX_ROVERS, agents=config.agents)
        if num_envs % config.agents:
            raise ValueError(f"num_envs must be a multiple of agents={config.agents}, got {num_envs}")
        check_count(MAX_COUNT, length=config.length)
        seed = secrets.randbits(31) if config.seed is None else check_seed(config.seed, num_envs)
        super().__init__(
            device=None if config.device is None else specs.available_device(config.device),
            batch_size=() if config.num_envs is None else (num_envs,),
        )
        self._tensor_device = torch.device("cpu") if self.device is None else self.device
        self.config = config
        self.size = config.size
        self.num_envs = num_envs
        self._row_shape = torch.Size([num_envs])
        self._every = torch.ones(num_envs, dtype=torch.bool, device=self._tensor_device)
        first_keys = episode_keys(row_keys(seed, num_envs, self._tensor_device), 1)
        self._robot_groups = RobotGroups(get_robots(config.robot))
        config = config.fitted()
        worlds, choices = self._robot_groups.spread(config.world)
        is_drawn = (draws_worlds(config.world) or len(choices) > len(config.worlds)) if choices else None
        world_keys = first_of_group(first_keys, config.agents)
        self._row_worlds = RowWorlds(worlds, world_keys, config.agents, is_drawn)
        self._choices = torch.tensor(choices or [(0, 1)], device=self._tensor_device)
        self.robots = RowRobots(self._robot_groups.robots, first_keys, self._row_choices())
        self.fleet = self.robots.fleet
        self.robot = self.fleet.largest
        self.config = config = _with_threshold(config, self.fleet)
        self._has_movers = config.agents > 1 or self._row_worlds.have_movers
        for world in dict.fromkeys(self._row_worlds.table):
            for sentence in clipped_pose(world):
                warnings.warn(sentence, stacklevel=2)
        noise = config.randomization
        self.sensors = environment_sensors(config.lidar, config.own_sensors, config.late_scans, noise.hides_beams)
        self.lidar = LidarPooling(config.lidar.beams, config.lidar.points, config.lidar.max_range, self._tensor_device)
        self._make_simulator = partial(
            make_simulator,
            config.backend,
            robot=self.fleet,
            physics=config.preset,
            control_rate=config.control_rate,
            connection=config.connection,
            device=self._tensor_device,
        )
        self._open()
        self._init_task()
        self._make_specs()
        self.set_seed(seed)

    def _init_task(self) -> None:
        config, device = self.config, self._tensor_device
        worlds, agents, least = self._row_worlds.table, config.agents, config.task.min_goal_distance
        if agents == 1:
            self.placement = Placement(worlds, self.robot_in, least)
        else:
            self.placement = GroupPlacement(worlds, self.robot, least, agents)
        self._navigation = Navigation(config, self.placement, self.fleet)
        gains = config.heading_gains
        fastest = max(robot.drive.max_yaw_rate for robot in self.fleet.robots)
        gains = replace(gains, max_output=min(gains.max_output, fastest))
        self.controller = HeadingController(self.num_envs, gains, device)
        self._localization = Localization(config.pose, config.randomization)
        # A live rover limits its commands itself.
        limited = config.limits.apply and self.simulator.live is None
        self._limits = RowLimits(config.limits, config.randomization.limits, self.fleet, device) if limited else None
        self._brake = (
            EmergencyBrake(config.guard, self.fleet, self._lidar.angles) if config.guard.deceleration else None
        )
        self._delay = CommandDelay(config.randomization.latency, self.num_envs, device)
        delays = config.randomization, config.lidar.period, self.num_envs, device
        self.delays = SensorDelays(*delays) if config.late_scans else None
        most = config.randomization.state_latency[1]
        if self.simulator.live is not None:
            most += math.ceil(MAX_AGE / self.control_dt)
        predicts = config.compensate_delay and most
        latency = config.randomization.latency
        self._prediction = Prediction(self.fleet, self.control_dt, most, latency) if predicts else None
        self._known_scan: Tensor | None = None
        self._privileged = PrivilegedObservation(self.pool, self.robot_in, device) if config.privileged else None
        self._state = StepState(task=TaskState.zeros(self.num_envs, device), world=self._row_worlds.index_if_several)

    @property
    def worlds(self) -> list[World]:
        """World of each row, a new list at each access."""
        return list(self._row_worlds.table)

    @property
    def pool(self) -> WorldPool:
        """All worlds that rows can be in. ``outcome["world"]`` is the index of a row's world."""
        return self._row_worlds.pool

    def robot_in(self, world: World) -> Robot:
        """Returns the robot, or of several the one that needs the most space of those that drive in a world.

        It determines the free space: where starts and goals are, and where paths lead.
        """
        return self._robot_groups.largest_in(world)

    @property
    def length(self) -> int:
        """Number of steps after which an episode is truncated."""
        return self.config.length

    @length.setter
    def length(self, steps: int) -> None:
        self._navigation.length = check_count(MAX_COUNT, length=steps)
        self.config = replace(self.config, length=steps)

    @property
    def connection(self) -> Connection:
        """ROS 2 topics of a live rover, and connection timeout."""
        return self.config.connection

    @property
    def end_on_goal(self) -> bool:
        """Whether reaching the goal ends the episode."""
        return self.config.end_on_goal

    @property
    def task(self) -> TaskConfig:
        """Thresholds of the task."""
        return self.config.task

    @property
    def randomization(self) -> Randomization:
        """Domain randomization."""
        return self.config.randomization

    @property
    def control_dt(self) -> float:
        """Duration of a step, s."""
        return self.simulator.control_dt

    @property
    def goal(self) -> Tensor:
        """Goal of each row, ``[N, 2]``, m."""
        return self._state.task.goal.clone()

    @property
    def rover_state(self) -> RoverState:
        """True state of every rover, unclipped. For a live rover, its sensor readings."""
        self._require_started("rover_state")
        return self._state.truth.rover

    @property
    def sensed_state(self) -> RoverState:
        """State of every rover as reported by its sensors, including sensor noise, without delay, unclipped."""
        self._require_started("sensed_state")
        return self._state.sensed.rover

    @property
    def sensed_pose(self) -> SensedPose:
        """Pose of every rover as reported by its sensors, with its error, without delay, unclipped."""
        self._require_started("sensed_pose")
        return self._state.pose

    @property
    def sensed_yaw(self) -> Tensor:
        """Heading of every rover by :attr:`sensed_state`, without the error of the pose, ``[N, 1]``, rad."""
        self._require_started("sensed_yaw")
        return self._state.sensed.yaw

    @property
    def scan(self) -> Tensor:
        """Raw scan of every lidar, without noise, ``[N, beams]``, m; ``inf`` for no return."""
        self._require_started("scan")
        return self._state.truth.ranges

    @property
    def sensed_scan(self) -> Tensor:
        """Raw scan of every lidar, including sensor noise, without delay, ``[N, beams]``, m."""
        self._require_started("sensed_scan")
        return self._state.sensed.ranges

    @property
    def robot_connected(self) -> bool:
        """Whether the rovers are connected. Always true in simulation."""
        return self.simulator.robot_connected

    @with_torch_defaults
    def set_world_weights(self, weights: Tensor) -> None:
        """Sets how often episodes draw each world of ``pool``, for the episodes after the next one of each row.

        Args:
            weights: weight of each world, ``[len(pool)]``.

        Raises:
            ValueError: if episodes do not draw worlds here, or a weight is negative or not finite, or all are 0.
        """
        if "worlds" not in self.simulator.features:
            raise ValueError(f"rows keep their worlds in {type(self.simulator).__name__}: weights have no effect")
        self._row_worlds.set_weights(weights)

    @with_torch_defaults
    def set_goal(self, goal: Tensor) -> None:
        """Sets the goal of every row, ``[N, 2]``, m, within its episode: from the next step on, for example by hand."""
        self._require_started("set_goal")
        checked = checked_place("goal", goal, None, (self.num_envs, 2), self._tensor_device)
        assert checked is not None
        state, reference = self._state, self._state.reference
        target = target_info(reference.position, reference.yaw, checked)
        state.task = replace(state.task, goal=checked, target=target)

    @with_torch_defaults
    def render(self, row: int = 0, view: View = "chase", width: int = 640, height: int = 480) -> Tensor:
        """Renders one rover and its goal from behind (``"chase"``) or above (``"top"``), uint8 ``[H, W, 3]``."""
        self._require_open("render")
        self._require_started("render")
        if not 0 <= row < self.num_envs:
            raise ValueError(f"row must be between 0 and {self.num_envs - 1}, got {row}")
        return self.simulator.render(row, view, width, height, self._state.task.goal[row])

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        """Refuses to be copied or pickled: a copy would share the simulator, or lose it."""
        raise TypeError(
            "an environment cannot be copied or pickled, as its simulator is not Python's: "
            "make another one from its description, make_env(env.config)"
        )

    def close(self, *, raise_if_closed: bool = False) -> None:
        """Releases the simulator. The next ``reset()`` builds a new one. Idempotent."""
        self.simulator.close()
        self._row_worlds.close()
        super().close(raise_if_closed=raise_if_closed)

    def to(self, device: torch.device | str) -> RoverEnv:
        """Sets the device of specs and tensordicts. It must be the device of the environment's tensors.

        Raises:
            ValueError: if the device is another one. The environment cannot move.
        """
        target, own = torch.device(device), self._tensor_device
        if target.type != own.type or target.index not in (None, own.index):
            raise ValueError(f"the task lives on {own}; build RoverEnv(device={str(device)!r}) instead")
        return super().to(own)

    def _open(self) -> None:
        """Builds the simulator. The next reset must include all rows."""
        self.simulator: Simulator = self._make_simulator(worlds=self._row_worlds.table)
        try:
            _check_requirements(self.config, self.fleet, self.simulator, self._has_movers, self.sensors)
            if fields := {field for sensor in self.sensors.values() for field in sensor.needs}:
                self.simulator.measure(fields)
        except ValueError:
            self.simulator.close()
            raise
        self.scanner: Scanner = make_scanner(
            self.simulator, self._row_worlds.table, self.robot, self.config.lidar.beams
        )
        live = self.simulator.live
        self._pooling = self.lidar if live is None else LivePooling(live, self.lidar)
        self._meet_movers()
        if self.config.compensate_delay and live is not None:
            live.follow_clock()
        self._started = False
        self.is_closed = False
        if self._row_worlds.is_drawn and "worlds" in self.simulator.features:
            self._row_worlds.open(partial(_prepare, self.robot_in, self.simulator))
            self.simulator.enter_worlds()

    def _meet_movers(self) -> None:
        """Lets lidar and simulator meet the movers of the worlds. Those around a live rover move on their own."""
        live = self.simulator.live
        others, agents = None, self.config.agents
        if agents > 1:
            others = OtherRovers(self.robot, agents, self.num_envs, self.control_dt, self._tensor_device)
        self.movers = MoverField(self._row_worlds.table, self.control_dt, self.robot.radius, live is not None, others)
        self._surroundings = Surroundings(self._row_worlds.table, self.movers)
        self._surroundings.live = live
        lidar = MoverScanner(self.scanner, self.movers, self.simulator, self.fleet)
        self._lidar = in_view(lidar, self.fleet)
        if "movers" in self.simulator.features:
            self.simulator.add_movers(self.movers)

    def _make_specs(self) -> None:
        batch_size, device, privileged = self.batch_size, self.device, self.config.privileged
        action = specs.action_bounds(self.config.bounded_action)
        bounds = {key: sensor.bounds for key, sensor in self.sensors.items()}
        several, moving = len(self.pool) > 1, self._has_movers
        self.observation_spec = specs.observation_spec(bounds, batch_size, device, privileged, several, moving)
        self.action_spec = specs.bounded_spec(action, batch_size, device)
        self.reward_spec = specs.reward_spec(batch_size, device)
        self.full_done_spec = specs.done_spec(batch_size, device)
        self.observer = Observer(self.sensors, Rig(self.fleet, self.config.lidar, self.control_dt, self.randomization))
        self._action_clip = action.tensors(self._tensor_device)

    @with_torch_defaults
    def _set_seed(self, seed: int | None) -> None:
        seed = secrets.randbits(31) if seed is None else check_seed(seed, self.num_envs)
        self._row_keys = row_keys(seed, self.num_envs, self._tensor_device)
        self._episode = torch.zeros_like(self._row_keys)
        self._keys = self._row_keys
        agents = self.config.agents
        self._groups = Groups(agents, self._row_keys) if agents > 1 else None
        self._state.task = replace(self._state.task, total_steps=torch.zeros_like(self._row_keys))

    @with_torch_defaults
    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        start: Tensor | None = None,
        goal: Tensor | None = None,
        **_: Any,
    ) -> TensorDictBase:
        if self.is_closed:
            self._open()
        mask = self._reset_mask(tensordict)
        start = checked_place("start", start, tensordict, (*self.batch_size, 3), self._tensor_device)
        goal = checked_place("goal", goal, tensordict, (*self.batch_size, 2), self._tensor_device)
        self._episode = self._episode + mask
        self._keys = torch.where(mask, episode_keys(self._row_keys, self._episode), self._keys)

        begins, keys = mask, self._keys
        if self._groups is not None:
            begins, keys = self._groups.begin(mask), self._groups.keys
        self._change_worlds(begins, keys)
        if start is None:
            poses = self.placement.draw_start(self._keys, mask, self._state.truth.position if self._started else None)
        else:
            poses = start
        device = self.simulator.device
        rows = mask.squeeze(-1).to(device)
        if self.robots.are_several:
            self.robots.draw(mask, self._keys, self._row_choices())
            self.simulator.enter_robots(rows)
        if self.randomization.varies_dynamics:
            self.simulator.set_dynamics(rows, draw_dynamics(self.randomization, self._keys.to(device)))
        if self._privileged is not None:
            self._dynamics = draw_dynamics(self.randomization, self._keys)
        self.movers.reset(begins, keys, poses[:, :2])
        self._delay.begin(self._keys)
        if self.delays is not None:
            self.delays.begin(self._keys)
        if self._limits is not None:
            self._limits.begin(mask, self._keys)
        if self._prediction is not None:
            self._prediction.begin(mask, self._keys)
        steps = self._state.task.steps.masked_fill(mask, 0)
        self._perceive(self.simulator.reset(rows, poses.to(device)), rows, steps)
        self.controller.reset(mask)
        self._navigation.begin(self._state, mask, goal, self._keys, first=not self._started)
        self._started = True
        state = self._state
        # All rows are returned. EnvBase keeps the previous values of the rows that were not reset.
        return self._pack(
            self._observation(mask.squeeze(-1)),
            outcome=state.outcome,
            done=state.terminated | state.truncated,
            terminated=state.terminated,
            truncated=state.truncated,
        )

    def _row_choices(self) -> Tensor:
        """Returns the first of the robots that drive in each row's world, and their number, ``[N, 2]``."""
        one = len(self._choices) == 1
        return self._choices.expand(self.num_envs, 2) if one else self._choices[self._row_worlds.entry]

    def _change_worlds(self, mask: Tensor, keys: Tensor) -> None:
        """Draws the worlds of new episodes. In a simulator that cannot change worlds, a seed has those of its first."""
        if not self._row_worlds.is_drawn:
            return
        changes = "worlds" in self.simulator.features
        if not changes and (self.simulator.live is not None or not (self._episode == 1).all()):
            return
        groups, before = self._groups, self._row_worlds.index
        next_keys = episode_keys(self._row_keys, self._episode + 1) if groups is None else groups.next_keys
        self._row_worlds.draw(mask, keys, next_keys)
        if not changes and self._row_worlds.index.equal(before):
            return
        self.placement.enter_worlds()
        self._state.world = self._row_worlds.index_if_several
        if changes:
            self.simulator.enter_worlds()
            self.movers.enter_worlds()
        else:
            self.simulator.close()
            self._open()

    @with_torch_defaults
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._require_open("step")
        self._require_started("step")
        active = tensordict.get("_step", None)
        active = None if active is None else active.reshape(self.num_envs, 1)
        action, invalid = checked_action(tensordict.get("action"), self.batch_size, self._action_clip)

        # The heading controller runs on the robot, so it uses the sensor readings and not the true state.
        sensed = self._state.sensed
        turn = self.controller(sensed.yaw + action[:, 1:], sensed.yaw, sensed.rover.dt, active)
        command = self.robots.limited(torch.cat((action[:, :1], turn, action[:, 2:]), -1))
        return self._follow(command.masked_fill(invalid, 0.0), invalid, active)

    @with_torch_defaults
    def step_commands(self, command: Tensor) -> TensorDictBase:
        """Takes a step with commands in place of actions, as those that a simulated robot receives over ROS 2.

        Args:
            command: forward speed (m/s), yaw rate (rad/s) and, with ``max_sideways``, speed to the left (m/s),
                ``[N, A]``.

        Returns:
            The result of the step.
        """
        self._require_open("step_commands")
        self._require_started("step_commands")
        return self._follow(command, torch.zeros_like(self._row_keys, dtype=torch.bool), None)

    def _follow(self, command: Tensor, invalid: Tensor, active: Tensor | None) -> TensorDictBase:
        """Takes a step with commands. ``invalid`` are rows whose action is not finite, bool ``[N, 1]``."""
        sensed = self._state.sensed
        if self._brake is not None:
            command = self._brake(command, sensed.ranges if self._known_scan is None else self._known_scan)
        if self._limits is not None:
            command = self._limits(command, sensed.rover.dt, active)
        sent = command
        command = self._delay(command, self._state.task.steps)
        device = self.simulator.device
        rows = None if active is None else active.squeeze(-1).to(device)
        steps = self._state.task.steps + (1 if active is None else active)
        if self._has_movers:
            moving = active if self._groups is None else self._groups.advance(active)
            self.movers.advance(moving, rovers_of(self._state.truth, self.robot.radius), active)
        with self._row_worlds.preparing():
            self._perceive(self.simulator.step(command.to(device), rows), rows, steps)
        if self._prediction is not None:
            dt = self._state.sensed.rover.dt
            self._prediction.follow(self._limited_by_rover(sent), self._state.task.steps, dt, active)

        self._navigation.advance(self._state, invalid, active, self._keys)
        state = self._state
        reward = state.outcome.get("goal_reached").to(torch.float32)
        if active is not None:
            reward = reward * active
        return self._pack(
            self._observation(self._every if active is None else active.squeeze(-1)),
            outcome=state.outcome,
            reward=reward,
            done=state.terminated | state.truncated,
            terminated=state.terminated,
            truncated=state.truncated,
        )

    def _perceive(self, rover: RoverState, rows: Tensor | None, steps: Tensor) -> None:
        """Scans, and stores the true and the sensed state after ``steps`` steps of each row's episode.

        ``rows`` have moved, bool ``[N]`` on the simulator's device; ``None``: all.
        """
        state, config = self._state, self.config
        if self._groups is not None:
            self.movers.follow(rover, None if rows is None else rows[:, None].to(self._tensor_device), steps == 0)
            state.world_steps = self._groups.steps if self._row_worlds.is_drawn else None
        ranges = self._lidar.scan(self._scanning(rows, steps))
        if self.simulator.device != self._tensor_device:
            rover, ranges = rover.to(self._tensor_device), ranges.to(self._tensor_device)
        state.truth = Perception(rover, ranges, self._pooling)
        scan_step = None if self.delays is None else self.delays.scan_step
        noise = config.randomization
        state.sensed = self.observer.sense(noise, state.truth, self._keys, steps, self._pooling, scan_step)
        state.pose = self._localization(state.truth, state.sensed, self._keys, steps)
        state.reference = state.truth if config.outcome_from == "truth" else state.sensed
        if self._has_movers:
            state.movers = self._mover_outcome(state.truth)

    def _mover_outcome(self, truth: Perception) -> dict[str, Tensor]:
        """Returns the entries of ``outcome`` on movers."""
        distance, speed = self.movers.nearest(truth.position)
        touched = truth.rover.mover_contact
        if touched is None:
            touched = torch.zeros_like(distance, dtype=torch.bool)
        return {"mover_contact": touched, "mover_distance": distance, "mover_speed": speed}

    def _scanning(self, rows: Tensor | None, steps: Tensor) -> Tensor | None:
        """Returns which of the ``rows`` scan after ``steps`` steps of their episodes."""
        period = self.config.lidar.period
        if self.delays is None and period == 1:
            return rows
        due = (steps % period == 0).squeeze(-1) if self.delays is None else self.delays.scans(self._keys, steps)
        due = due.to(self.simulator.device)
        return due if rows is None else due & rows

    def _observation(self, rows: Tensor) -> dict[str, Any]:
        """Returns the observation, in which ``rows`` (bool ``[N]``) are new."""
        state, goal = self._state, self._state.task.goal
        position, yaw, scan_pose, predicted = state.pose.position, state.pose.yaw, None, {}
        if self.delays is not None:
            steps = state.task.steps
            live = self.simulator.live
            stamped = None if live is None else live.scan_pose()
            known, scan = self.delays.poses(state.pose, state.sensed.euler, steps, stamped)
            if self._prediction is not None:
                known, velocities = self._predicted(self._prediction, known)
                predicted = {"pose": known[:, :3], "imu": known[:, 3:], "velocities": velocities}
            position, yaw, scan_pose = known[:, :3], known[:, 5:], relative_pose(known, scan)
            if self._brake is not None:
                self._known_scan = self.delays.late("scan", state.sensed.ranges, steps, self.delays.scan)
        same = state.sensed is state.reference and self.config.pose.source == "truth" and self.delays is None
        inputs = SensorInput(
            truth=state.truth,
            sensed=state.sensed,
            pose=state.pose,
            target=state.task.target if same else target_info(position[:, :2], yaw, goal),
            goal=goal,
            steps=state.task.steps,
            keys=self._keys,
            surroundings=self._surroundings,
            bounds=self.placement.bounds,
            rows=rows,
            scan_pose=scan_pose,
            predicted=predicted,
        )
        observation: dict[str, Any] = self.observer(inputs, self.delays)
        if self._privileged is not None:
            observation["privileged"] = self._privileged(
                state.truth, self._row_worlds.index, goal, self._dynamics, self._delay.steps
            )
        return observation

    def _limited_by_rover(self, command: Tensor) -> Tensor:
        """Returns the command that a live rover got, which limits it itself, else the given one."""
        live = self.simulator.live
        return command if live is None else command.new_tensor([live.last_command])

    def _predicted(self, prediction: Prediction, known: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the present pose ``[N, 6]`` and velocities ``[N, 2]`` for the ``known`` pose, which may be late."""
        assert self.delays is not None
        rover, steps, delay = self._state.sensed.rover, self._state.task.steps, self.delays.state
        velocities = torch.cat((rover.linear_velocity, rover.angular_velocity), -1)
        velocities = self.delays.late("velocities", velocities, steps, delay)
        if (live := self.simulator.live) is not None:
            delay = delay + live.state_age().to(velocities) / rover.dt
        return prediction(known, velocities, steps, delay)

    def _pack(self, observation: dict[str, Any], **entries: Any) -> TensorDict:
        """Creates the result of a reset or step from rows, without the batch dimension if unbatched."""
        rows = unchecked_tensordict({**observation, **entries}, self._row_shape, self.device)
        return rows if self.batch_size else rows[0]

    def _reset_mask(self, tensordict: TensorDictBase | None) -> Tensor:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or not self._started:
            return torch.ones(self.num_envs, 1, dtype=torch.bool, device=self._tensor_device)
        return mask.reshape(self.num_envs, 1)

    def _require_open(self, what: str) -> None:
        if self.is_closed:
            raise RuntimeError(f"{what}() was called on a closed RoverEnv; call reset() first, which reopens it")

    def _require_started(self, what: str) -> None:
        if not self._started:
            raise RuntimeError(f"{what} needs a running episode; call reset() first")


# The metaclass of EnvBase hides the arguments from help() and editors.
RoverEnv.__signature__ = SIGNATURE


def _prepare(robot_in: Callable[[World], Robot], simulator: Simulator, world: World) -> None:
    """Prepares a world for episodes in it."""
    free_space(world, robot_in(world))
    simulator.prepare_world(world)


def _with_threshold(config: EnvConfig, fleet: Fleet) -> EnvConfig:
    """Returns a description with the threshold of the robots, if they have the same one, in place of none."""
    thresholds = {robot.collision_range for robot in fleet.robots}
    if config.task.collision_threshold is not None or len(thresholds) > 1 or None in thresholds:
        return config
    return replace(config, task=replace(config.task, collision_threshold=thresholds.pop()))


def _check_requirements(
    config: EnvConfig, fleet: Fleet, simulator: Simulator, has_movers: bool, sensors: Mapping[str, Sensor]
) -> None:
    """Raises an error for the first thing that an environment needs and its simulator or robot cannot do."""
    needs: dict[Feature, str] = {}
    if config.task.collision_from == "contact":
        needs["contacts"] = "a task with collision_from='contact' needs a backend that reports contacts"
    if config.randomization.varies_dynamics:
        needs["dynamics"] = "randomized friction, mass and motors need a backend in which they can be varied"
    if has_movers and simulator.live is None:
        needs["movers"] = "a world with movers needs a backend that lets them push the rovers"
    if len(fleet.robots) > 1:
        needs["robots"] = "several robots in one batch need a backend that simulates them"
    if config.agents > 1:
        needs["movers"] = f"agents={config.agents} need a backend in which rovers push one another"
    for key, sensor in sensors.items():
        need = f"sensor {key!r} needs a backend that measures it"
        needs |= dict.fromkeys(sensor.needs, need)
    for feature, need in needs.items():
        if feature not in simulator.features:
            raise ValueError(f"{need}: {type(simulator).__name__} does not have the feature {feature!r}")
    if config.action.max_sideways and simulator.live is not None:
        raise ValueError("max_sideways must be 0 with a live rover, whose commands are speed and yaw rate")
    if config.compensate_delay and simulator.live is not None and not config.late_scans:
        raise ValueError(f"compensate_delay needs sensors=({SCAN_POSE!r},) with a live rover, whose scans can be late")
    if config.agents > 1 and len(fleet.robots) > 1:
        raise ValueError(f"agents={config.agents} need one robot for all rows, got {len(fleet.robots)} robots")
    robot = next((robot for robot in fleet.robots if not robot.drive.sideways), None)
    if config.action.max_sideways and robot is not None:
        drive = type(robot.drive).__name__
        raise ValueError(f"max_sideways needs a drive that moves sideways, and robot {robot.name!r} has a {drive}")
