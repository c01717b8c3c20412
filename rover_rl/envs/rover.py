"""``RoverEnv``: batched TorchRL environment for point navigation on rough terrain."""

from __future__ import annotations

import secrets
import warnings
from dataclasses import replace
from inspect import cleandoc
from typing import Any, NoReturn

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase

from rover_rl import checks, tensordicts
from rover_rl.envs import actions, chosen_rows, placement, privileged, rows, specs, stages, task
from rover_rl.envs.config import EnvConfig, describe_settings, env_signature
from rover_rl.envs.sensors import base, standard, suite
from rover_rl.envs.simulation import Simulation
from rover_rl.sims.base import RoverState, View
from rover_rl.worlds import World


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

    Row ``i`` of a batch with seed ``s`` is bit-identical to a single environment with seed ``s + i``. With ``agents``,
    the rovers of each ``agents`` consecutive rows share a world, see one another and push one another: see
    :class:`~rover_rl.envs.wrappers.groups.GroupedRovers`. Row ``i`` is then bit-identical in all batches with its whole
    group.

    ``num_envs=None`` creates one rover without a batch dimension (batch size ``[]``): ``lidar [lidar_points]``,
    ``action [2]``, ``reward [1]``, ``start [3]``. Its values equal those of a batch of one.

    ``close()`` releases the simulator. The next ``reset()`` builds a new one, as TorchRL's ``ParallelEnv`` does, and
    continues with the next episodes.

    It takes an :class:`EnvConfig`, whose reward has no effect, its settings, or the ten arguments of the original
    environment: ``RoverEnv(world_n="maze", lidar_points=16)``.

    Attributes:
        config: description of the environment.
        pool: all worlds that rows can be in. ``outcome["world"]`` is the index of a row's world.
        fleet: robot of each row, ``env.fleet[row]``.
        robot: the robot, or of several the one that needs the most space.
        sensors: sensors that it reads, by name.
        simulator: simulator. A reset after ``close()`` replaces it.
        reads_between: whether sensors read in steps whose number is not a multiple of a given one, for later steps.
        movers: movers of each row, where they are and where they go.

    Raises ``ValueError`` if a name is unknown, a number is out of range, the device is not available, or the backend
    cannot do what the task needs, and ``TypeError`` for an argument that is unknown or given by both of its names.

    Example:
        >>> env = RoverEnv(world_n="maze", num_envs=2, seed=0)
        >>> env.rollout(3)["lidar"].shape
        torch.Size([2, 3, 32])
    """

    batch_locked = True

    @tensordicts.with_torch_defaults
    def __init__(self, *args: Any, **settings: Any) -> None:
        config = replace(EnvConfig.of(*args, **settings), reward="task").fitted()
        num_envs = 1 if config.num_envs is None else checks.check_count(checks.MAX_ROVERS, num_envs=config.num_envs)
        checks.check_count(checks.MAX_ROVERS, agents=config.agents)
        if num_envs % config.agents:
            raise ValueError(f"num_envs must be a multiple of agents={config.agents}, got {num_envs}")
        checks.check_count(checks.MAX_COUNT, length=config.length)
        seed = secrets.randbits(31) if config.seed is None else checks.check_seed(config.seed, num_envs)
        super().__init__(
            device=None if config.device is None else specs.available_device(config.device),
            batch_size=() if config.num_envs is None else (num_envs,),
        )
        self._tensor_device = device = torch.device("cpu") if self.device is None else self.device
        self.num_envs, self._row_shape = num_envs, torch.Size([num_envs])
        self._every = torch.ones(num_envs, dtype=torch.bool, device=device)
        self._row_worlds, self.robots = rows.RowRobots.of(config, rows.first_keys(seed, num_envs, device))
        self.fleet, self.robot_in = self.robots.fleet, self.robots.robot_in
        self.robot, self.pool = self.fleet.largest, self._row_worlds.pool
        self.config = config = task.with_threshold(config, self.fleet)
        for world in dict.fromkeys(self._row_worlds.table):
            for sentence in standard.clipped_pose(world):
                warnings.warn(sentence, stacklevel=2)
        lidar, hides_beams = config.lidar, config.randomization.hides_beams
        self.sensors = suite.environment_sensors(lidar, config.own_sensors, config.late_scans, hides_beams)
        self.lidar = standard.LidarPooling(lidar.beams, lidar.points, lidar.max_range, device)
        self._state = stages.StepState(num_envs, device)
        self._state.world = self._row_worlds.index_if_several
        self._open()
        least = config.task.min_goal_distance
        if config.agents == 1:
            self.placement = placement.Placement(self._row_worlds.table, self.robot_in, least)
        else:
            from rover_rl.envs.groups import GroupPlacement

            self.placement = GroupPlacement(self._row_worlds.table, self.robot, least, config.agents)
        self._navigation = task.Navigation(config, self.placement, self.fleet)
        self._privileged = (
            privileged.PrivilegedObservation(self.pool, self.robot_in, device) if config.privileged else None
        )
        self._make_specs()
        self.set_seed(seed)

    def _open(self) -> None:
        """Builds the simulator, and what commands and readings pass. The next reset must include all rows."""
        self._simulation = Simulation(self.config, self._row_worlds, self.robots, self.sensors, self.lidar)
        self.simulator, self.scanner = self._simulation.simulator, self._simulation.scanner
        self.movers, self.delays = self._simulation.movers, self._simulation.delays
        self.brake, self.reads_between = self._simulation.brake, self._simulation.reads_between
        gains, fastest = self.config.heading_gains, max(robot.drive.max_yaw_rate for robot in self.fleet.robots)
        gains = replace(gains, max_output=min(gains.max_output, fastest))
        self.controller = stages.HeadingController(self.num_envs, gains, self._tensor_device)
        self._started, self.is_closed = False, False

    def _make_specs(self) -> None:
        config, batch_size, device = self.config, self.batch_size, self.device
        action = actions.Heading.bounds(config.bounded_action)
        nested = {"outcome": specs.outcome_spec(batch_size, device, len(self.pool) > 1, self._simulation.has_movers)}
        if config.privileged:
            nested["privileged"] = specs.vectors_spec(privileged.FEATURES, batch_size, device)
        entries = {key: specs.bounded_spec(each.bounds, batch_size, device) for key, each in self.sensors.items()}
        self.observation_spec = Composite({**entries, **nested}, shape=batch_size, device=device)
        self.action_spec = specs.bounded_spec(action, batch_size, device)
        self.reward_spec = Unbounded(shape=(*batch_size, 1), device=device)
        self.full_done_spec = specs.done_spec(batch_size, device)
        self._action_clip = action.tensors(self._tensor_device)
        drives, bounds = [robot.drive for robot in self.fleet.robots], config.bounded_action
        speed = max(abs(bounds.min_speed or 0), bounds.max_speed or 0, *(drive.max_speed for drive in drives))
        most = (speed, max(drive.max_yaw_rate for drive in drives), *[speed] * (len(action.low) - 2))
        self._command_clip = specs.Bounds(tuple(-end for end in most), most).tensors(self._tensor_device)
        setup = base.SensorSetup(self.fleet, config.lidar, self.control_dt, config.randomization)
        self.observer = base.Observer(self.sensors, setup)

    @tensordicts.with_torch_defaults
    def _set_seed(self, seed: int | None) -> None:
        seed = secrets.randbits(31) if seed is None else checks.check_seed(seed, self.num_envs)
        given = seed, self.num_envs, self._tensor_device
        if self.config.agents == 1:
            self._episodes = rows.Episodes(*given)
        else:
            from rover_rl.envs.groups import GroupEpisodes

            self._episodes = GroupEpisodes(*given, self.config.agents)
        self._state.keys, self._state.total_steps = self._episodes.keys, torch.zeros_like(self._episodes.keys)

    @tensordicts.with_torch_defaults
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
        state, episodes = self._state, self._episodes
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = self._every[:, None] if mask is None or not self._started else mask.reshape(self.num_envs, 1)
        start = placement.checked_place("start", start, tensordict, (*self.batch_size, 3), self._tensor_device)
        goal = placement.checked_place("goal", goal, tensordict, (*self.batch_size, 2), self._tensor_device)
        chosen = chosen_rows.ChosenRows(mask)
        begins = episodes.begin(chosen)
        state.keys = keys = episodes.keys
        self._change_worlds(begins)
        last = state.truth if self._started else None
        if start is None:
            start = self.placement.draw_start(keys, chosen, None if last is None else last.position)
        noise, device = self.config.randomization, self.simulator.device
        if self.robots.are_several:
            self.robots.draw(mask, keys)
            self.simulator.enter_robots(mask.squeeze(-1).to(device))
        if noise.varies_dynamics:
            self.simulator.set_dynamics(mask.squeeze(-1).to(device), placement.draw_dynamics(noise, keys.to(device)))
        if self._privileged is not None:
            self._dynamics = placement.draw_dynamics(noise, keys)
        self.movers.reset(begins.mask, episodes.world_keys, start[:, :2])
        for stage in self._simulation.stages:
            stage.begin(mask, keys)
        self.controller.reset(mask)
        state.steps = state.steps.masked_fill(mask, 0)
        state.move(mask)
        self._simulation.reset(state, chosen, start, last)
        self._sense(state)
        self._navigation.begin(state, chosen, goal)
        self._started = True
        # All rows are returned. EnvBase keeps the previous values of the rows that were not reset.
        return self._pack()

    def _change_worlds(self, begins: chosen_rows.ChosenRows) -> None:
        """Draws the worlds of new episodes. In a simulator that cannot change worlds, a seed has those of its first."""
        worlds, episodes, changes = self._row_worlds, self._episodes, self._simulation.changes_worlds
        if not worlds.is_drawn or not (changes or (self.simulator.live is None and episodes.are_first())):
            return
        before = worlds.index
        worlds.draw(begins, episodes.world_keys, episodes.next_world_keys(begins))
        if not changes and worlds.index.equal(before):
            return
        self.placement.enter_worlds()
        self._state.world = worlds.index_if_several
        if changes:
            self.simulator.enter_worlds()
            self.movers.enter_worlds()
        else:
            self.simulator.close()
            self._open()

    @tensordicts.with_torch_defaults
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._require_started("step")
        active = tensordict.get("_step", None)
        active = None if active is None else active.reshape(self.num_envs, 1)
        if (command := tensordict.get("command", None)) is not None:
            # Another action than the contract's has turned into it, or into steering: see rover_rl.envs.actions.
            command, invalid = stages.checked_action(command, self.batch_size, self._command_clip)
        else:
            action = tensordict.get("steering", tensordict.get("action"))
            action, invalid = stages.checked_action(action, self.batch_size, self._action_clip)
            # The heading controller runs on the robot, so it uses the sensor readings and not the true state.
            sensed = self._state.sensed
            turn = self.controller(sensed.yaw + action[:, 1:2], sensed.yaw, sensed.rover.dt, active)
            command = torch.cat((action[:, :1], turn, action[:, 2:]), -1)
        observed = specs.UNOBSERVED not in tensordict.keys()  # noqa: SIM118
        return self._follow(command.masked_fill(invalid, 0.0), invalid, active, observed)

    @tensordicts.with_torch_defaults
    def step_commands(self, command: Tensor) -> TensorDictBase:
        """Takes a step with commands ``[N, A]`` in place of actions, as a simulated robot receives them over ROS 2."""
        self._require_started("step_commands")
        return self._follow(command, ~self._every[:, None], None)

    def _follow(self, command: Tensor, invalid: Tensor, active: Tensor | None, observed: bool = True) -> TensorDictBase:
        """Takes a step with commands. ``invalid`` are rows whose action is not finite, bool ``[N, 1]``."""
        state = self._state
        state.active = active
        for stage in self._simulation.stages:
            command = stage.command(command, state)
        taken = 1 if active is None else active
        state.steps, state.total_steps = state.steps + taken, state.total_steps + taken
        state.move(active)
        self._simulation.step(state, command, self._episodes)
        self._sense(state)
        self._navigation.advance(state, invalid)
        return self._pack(observed, reward=(state.phase == task.StepEvent.GOAL).to(torch.float32))

    def _sense(self, state: stages.StepState) -> None:
        scan_step, pooling = None if self.delays is None else self.delays.scan_step, self._simulation.pooling
        state.sensed = self.observer.sense(state.truth, state.keys, state.steps, scan_step, pooling)
        state.reference = state.truth if self.config.outcome_from == "truth" else state.sensed
        state.world_steps = self._episodes.world_steps if self._row_worlds.is_drawn else None
        for stage in self._simulation.stages:
            stage.read(state)

    def _pack(self, observed: bool = True, **entries: Any) -> TensorDict:
        """Returns the result of a reset or step."""
        state, observation = self._state, self._observation() if observed else {}
        ends = {"terminated": state.terminated, "truncated": state.truncated}
        ends["done"] = state.terminated | state.truncated
        return self._result(**observation, outcome=task.outcome(state), **entries, **ends)

    @tensordicts.with_torch_defaults
    def observe(self) -> TensorDict:
        """Returns the observation after the last step. Some rows may have moved in steps before, since the last one."""
        return self._result(**self._observation())

    def _result(self, **entries: Any) -> TensorDict:
        result = tensordicts.unchecked_tensordict(entries, self._row_shape, self.device)
        return result if self.batch_size else result[0]

    def _observation(self) -> dict[str, Any]:
        state, known = self._state, self._state.known
        is_exact = state.sensed is state.reference and self.config.pose.source == "truth" and self.delays is None
        target = state.target if is_exact else task.target_info(known.position[:, :2], known.yaw, state.goal)
        moved = self._every if state.moved is None else state.moved.squeeze(-1)
        inputs = base.SensorInput.of(state, target, self._simulation.surroundings, self.placement.bounds, moved)
        observation: dict[str, Any] = self.observer(inputs, self.delays)
        if self._privileged is not None:
            world, latency = self._row_worlds.index, self._simulation.command_delay.steps
            observation["privileged"] = self._privileged(
                state.truth, self.movers, world, state.goal, self._dynamics, latency
            )
        state.is_observed = True
        return observation

    @property
    def worlds(self) -> list[World]:
        """World of each row, a new list at each access."""
        return list(self._row_worlds.table)

    @property
    def length(self) -> int:
        """Number of steps after which an episode is truncated."""
        return self.config.length

    @length.setter
    def length(self, steps: int) -> None:
        self._navigation.length = checks.check_count(checks.MAX_COUNT, length=steps)
        self.config = replace(self.config, length=steps)

    @property
    def control_dt(self) -> float:
        """Duration of a step, s."""
        return self.simulator.control_dt

    @property
    def goal(self) -> Tensor:
        """Goal of each row, ``[N, 2]``, m."""
        return self._state.goal.clone()

    @property
    def state(self) -> stages.StepState:
        """True state of every rover and what its sensors report, without delay, unclipped."""
        self._require_started("state")
        return self._state

    @property
    def rover_state(self) -> RoverState:
        """True state of every rover, unclipped. For a live rover, its sensor readings."""
        return self.state.truth.rover

    @property
    def scan(self) -> Tensor:
        """Raw scan of every lidar, without noise, ``[N, beams]``, m; ``inf`` for no return."""
        return self.state.truth.ranges

    @property
    def robot_connected(self) -> bool:
        """Whether the rovers are connected. Always true in simulation."""
        return self.simulator.robot_connected

    @tensordicts.with_torch_defaults
    def set_world_weights(self, weights: Tensor) -> None:
        """Sets the weights ``[len(pool)]`` of the worlds in draws, for the episodes after the next one of each row."""
        if "worlds" not in self.simulator.features:
            raise ValueError(f"rows keep their worlds in {type(self.simulator).__name__}: weights have no effect")
        self._row_worlds.set_weights(weights)

    @tensordicts.with_torch_defaults
    def set_goal(self, goal: Tensor) -> None:
        """Sets the goal of every row, ``[N, 2]``, m, within its episode: from the next step on, for example by hand."""
        self._require_started("set_goal")
        checked = placement.checked_place("goal", goal, None, (self.num_envs, 2), self._tensor_device)
        assert checked is not None
        state, reference = self._state, self._state.reference
        state.goal, state.target = checked, task.target_info(reference.position, reference.yaw, checked)

    @tensordicts.with_torch_defaults
    def render(self, row: int = 0, view: View = "chase", width: int = 640, height: int = 480) -> Tensor:
        """Renders one rover and its goal from behind (``"chase"``) or above (``"top"``), uint8 ``[H, W, 3]``."""
        self._require_started("render")
        if not 0 <= row < self.num_envs:
            raise ValueError(f"row must be between 0 and {self.num_envs - 1}, got {row}")
        return self.simulator.render(row, view, width, height, self._state.goal[row])

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise TypeError(
            "an environment cannot be copied or pickled, as its simulator is not Python's: "
            "make another one from its description, make_env(env.config)"
        )

    def close(self, *, raise_if_closed: bool = False) -> None:
        """Releases the simulator. The next ``reset()`` builds a new one. Idempotent."""
        self._simulation.close()
        super().close(raise_if_closed=raise_if_closed)

    def to(self, device: torch.device | str) -> RoverEnv:
        """Sets the device of specs and tensordicts, which must be that of the environment: it cannot move."""
        target, own = torch.device(device), self._tensor_device
        if target.type != own.type or target.index not in (None, own.index):
            raise ValueError(f"the task lives on {own}; build RoverEnv(device={str(device)!r}) instead")
        return super().to(own)

    def _require_started(self, what: str) -> None:
        if self.is_closed and what in ("step", "step_commands", "render"):
            raise RuntimeError(f"{what}() was called on a closed RoverEnv; call reset() first, which reopens it")
        if not self._started:
            raise RuntimeError(f"{what} needs a running episode; call reset() first")


RoverEnv.__doc__ = f"{cleandoc(RoverEnv.__doc__ or '')}\n\nSettings of :class:`EnvConfig`:\n\n{describe_settings()}\n"
# The metaclass of EnvBase hides the arguments from help() and editors.
RoverEnv.__signature__ = env_signature()
