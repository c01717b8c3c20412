"""``Simulation``: the simulator of a batch of rovers, their lidars, the movers around them, and the stages."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from rover_rl.envs import stages
from rover_rl.envs.chosen_rows import EVERY_ROW, ChosenRows
from rover_rl.envs.config import SCAN_POSE, EnvConfig
from rover_rl.envs.emergency_brake import EmergencyBrake
from rover_rl.envs.events import Events
from rover_rl.envs.prediction import Prediction
from rover_rl.envs.rows import Episodes, RowRobots, RowWorlds
from rover_rl.envs.sensors.base import Sensor, Surroundings
from rover_rl.envs.sensors.standard import LidarPooling, LivePooling
from rover_rl.robots.fleet import Fleet
from rover_rl.rotations import level_to_euler, quaternion_to_euler
from rover_rl.sims import make_simulator
from rover_rl.sims.backends import make_scanner
from rover_rl.sims.base import MAX_AGE, Feature
from rover_rl.sims.free_space import free_space
from rover_rl.sims.movers.field import MoverField
from rover_rl.sims.movers.other_rovers import OtherRovers
from rover_rl.sims.movers.scanner import MoverScanner
from rover_rl.sims.rays import in_view
from rover_rl.sims.rover_state import RoverState
from rover_rl.worlds import World
from rover_rl.worlds.movers import Rovers


class Simulation:
    """Simulator, lidars and movers of a batch, and the stages that commands and readings pass, in their order.

    The ``scanner`` is the lidar in a full turn, which scans what does not move, and ``pooling`` pools the scans of the
    robots' lidars, which see the ``movers`` of each row. Sensors cast rays at the ``surroundings``. ``changes_worlds``:
    whether rows draw worlds, and the simulator lets them change. The first reset must be of all rows.

    Raises ``ValueError`` if the simulator or a robot cannot do what the environment needs.
    """

    def __init__(
        self,
        config: EnvConfig,
        worlds: RowWorlds,
        robots: RowRobots,
        sensors: Mapping[str, Sensor],
        pooling: LidarPooling,
    ) -> None:
        fleet, self._worlds, self._device, self._agents = robots.fleet, worlds, robots.fleet.index.device, config.agents
        self.has_movers = config.agents > 1 or worlds.have_movers
        self.simulator = simulator = make_simulator(
            config.backend,
            worlds=worlds.table,
            robot=fleet,
            physics=config.preset,
            control_rate=config.control_rate,
            connection=config.connection,
            device=self._device,
        )
        live, dt, robot = simulator.live, simulator.control_dt, fleet.largest
        try:
            self._require(config, fleet, sensors)
            if fields := {field for sensor in sensors.values() for field in sensor.needs}:
                simulator.measure(fields)
        except ValueError:
            simulator.close()
            raise
        self.scanner = lidar = make_scanner(simulator, worlds.table, robot, config.lidar.beams)
        self.pooling = pooling if live is None else LivePooling(live, pooling)
        self._to_euler = level_to_euler if simulator.is_level else quaternion_to_euler
        others = OtherRovers(robot, config.agents, len(fleet), dt, self._device) if config.agents > 1 else None
        self.movers = MoverField(worlds.table, dt, robot.radius, live is not None, others)
        self._rover_radius = robot.radius
        self.surroundings = Surroundings(worlds.table, self.movers, live)
        if self.has_movers:
            lidar = MoverScanner(lidar, self.movers, simulator, fleet)
        self._lidar = in_view(lidar, fleet)
        if "movers" in simulator.features:
            simulator.add_movers(self.movers)
        self.changes_worlds = worlds.is_drawn and "worlds" in simulator.features
        if self.changes_worlds:

            def prepare(world: World) -> None:
                free_space(world, robots.robot_in(world))
                simulator.prepare_world(world)

            worlds.open(prepare)
            simulator.enter_worlds()
        self._init_stages(config, robots)
        self._periods = [(each.period, type(each).reader is not Sensor.reader) for each in sensors.values()]
        self._always_reads = config.agents > 1 or self.delays is not None or live is not None

    def reads_between(self, repeat: int) -> bool:
        """Whether a sensor has to read in a step whose number is not a multiple of ``repeat``.

        A sensor does not if its period is a multiple of ``repeat``, or if it has no memory and reads in those steps.
        """
        periods = [period for period, remembers in self._periods if remembers or repeat % period]
        return self._always_reads or any(period % repeat for period in periods)

    def _init_stages(self, config: EnvConfig, robots: RowRobots) -> None:
        noise, period, fleet, live = config.randomization, config.lidar.period, robots.fleet, self.simulator.live
        rows, device, dt = len(fleet), self._device, self.simulator.control_dt
        self.stages: list[stages.Stage] = [stages.Localization(config.pose, noise)]
        self.delays, self._period = None, period
        if config.late_scans:
            self.delays = stages.SensorDelays(noise, period, rows, device, live)
            self.stages.append(self.delays)
        if robots.are_several:
            self.stages.append(stages.DriveBounds(fleet))
        self.brake: EmergencyBrake | None = None
        if config.guard.deceleration:
            self.brake = EmergencyBrake(config.guard, fleet, self._lidar.angles, self.delays)
            self.stages.append(self.brake)
        # A live rover limits its commands itself.
        if config.limits.apply and live is None:
            self.stages.append(stages.RowLimits(config.limits, noise.limits, fleet))
        most = noise.state_latency[1] + (0 if live is None else math.ceil(MAX_AGE / dt))
        if config.compensate_delay and most and self.delays is not None:
            self.stages.append(Prediction(fleet, dt, most, noise.latency, self.delays, live))
        self.command_delay = stages.CommandDelay(noise.latency, rows, device)
        if noise.latency[1]:
            self.stages.append(self.command_delay)
        if config.events and live is None:
            self.stages += [Events(config.events), stages.DriveBounds(fleet)]

    def _require(self, config: EnvConfig, fleet: Fleet, sensors: Mapping[str, Sensor]) -> None:
        """Raises an error for the first thing that the environment needs and its simulator or robot cannot do."""
        simulator, live, agents = self.simulator, self.simulator.live is not None, config.agents
        needs: dict[Feature, str] = {}
        if config.task.collision_from == "contact":
            needs["contacts"] = "a task with collision_from='contact' needs a backend that reports contacts"
        if config.randomization.varies_dynamics:
            needs["dynamics"] = "randomized friction, mass and motors need a backend in which they can be varied"
        if self.has_movers and not live:
            needs["movers"] = "a world with movers needs a backend that lets them push the rovers"
        if len(fleet.robots) > 1:
            needs["robots"] = "several robots in one batch need a backend that simulates them"
        if agents > 1:
            needs["movers"] = f"agents={agents} need a backend in which rovers push one another"
        for key, sensor in sensors.items():
            needs |= dict.fromkeys(sensor.needs, f"sensor {key!r} needs a backend that measures it")
        for feature, need in needs.items():
            if feature not in simulator.features:
                raise ValueError(f"{need}: {type(simulator).__name__} does not have the feature {feature!r}")
        sideways = config.action.max_sideways
        if sideways and live:
            raise ValueError("max_sideways must be 0 with a live rover, whose commands are speed and yaw rate")
        if config.compensate_delay and live and not config.late_scans:
            needed = f"sensors=({SCAN_POSE!r},)"
            raise ValueError(f"compensate_delay needs {needed} with a live rover, whose scans can be late")
        if agents > 1 and len(fleet.robots) > 1:
            raise ValueError(f"agents={agents} need one robot for all rows, got {len(fleet.robots)} robots")
        robot = next((robot for robot in fleet.robots if not robot.drive.sideways), None)
        if sideways and robot is not None:
            drive = type(robot.drive).__name__
            raise ValueError(f"max_sideways needs a drive that moves sideways, and robot {robot.name!r} has a {drive}")

    def reset(self, state: stages.StepState, rows: ChosenRows, poses: Tensor, last: stages.Perception | None) -> None:
        """Places the rovers of ``rows`` at ``poses`` ``[N, 3]``, and writes the true state that follows ``last``."""
        placed = rows.mask.squeeze(-1).to(self.simulator.device)
        rover = self.simulator.reset(placed, poses.to(placed.device))
        self._perceive(state, rover, rows.mask, rows, last)

    def step(self, state: stages.StepState, command: Tensor, episodes: Episodes) -> None:
        """Advances the ``active`` rovers and the movers around them, and writes their true state."""
        active, device = state.active, self.simulator.device
        if self.has_movers:
            truth = state.truth
            heading = torch.cat((truth.yaw.cos(), truth.yaw.sin()), -1)
            velocity = (truth.rover.linear_velocity * heading)[:, None]
            rovers = Rovers(truth.position[:, None], velocity, self._rover_radius)
            self.movers.advance(episodes.advance(active), rovers, active)
        rows = None if active is None else active.squeeze(-1).to(device)
        with self._worlds.preparing():
            rover = self.simulator.step(command.to(device), rows)
        self._perceive(state, rover, active)

    def _perceive(
        self,
        state: stages.StepState,
        rover: RoverState,
        moved: Tensor | None,
        placed: ChosenRows = EVERY_ROW,
        last: stages.Perception | None = None,
    ) -> None:
        """Writes the true state, after a reset that of rows ``placed`` since the ``last``. Lidars scan when it is read.

        Only the rows of ``moved`` (bool ``[N, 1]``; ``None``: all) differ from the state before.
        """
        if self._agents > 1:
            self.movers.follow(rover, moved, state.steps == 0)
        due = None
        if self.delays is not None:
            due = self.delays.scans(state.keys, state.steps)
        elif self._period > 1:
            due = (state.steps % self._period == 0).squeeze(-1)

        def scan() -> Tensor:
            rows = due if state.moved is None else state.moved.squeeze(-1)
            rows = rows & due if rows is not None and due is not None else rows
            return self._lidar.scan(None if rows is None else rows.to(self.simulator.device)).to(self._device)

        if self.simulator.device != self._device:
            rover = rover.to(self._device)
        state.truth = truth = stages.Perception(rover, scan, self.pooling, placed, last, self._to_euler)
        if self.has_movers:
            distance, speed = self.movers.nearest(truth.position)
            touched = rover.mover_contact
            if touched is None:
                touched = torch.zeros_like(distance, dtype=torch.bool)
            met = {"mover_contact": touched, "mover_distance": distance, "mover_speed": speed}
            if moved is not None and state.movers:
                met = {name: torch.where(moved, value, state.movers[name]) for name, value in met.items()}
            state.movers = met

    def close(self) -> None:
        self.simulator.close()
        self._worlds.close()
