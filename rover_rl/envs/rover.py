"""RoverEnv: point navigation on rough ground, batched, for TorchRL."""

from __future__ import annotations

import inspect
import secrets
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from rover_rl.checks import MAX_COUNT, MAX_ROVERS, check_seed
from rover_rl.envs import specs
from rover_rl.envs.control import HeadingController, HeadingGains
from rover_rl.envs.devices import available_device
from rover_rl.envs.placement import Placement
from rover_rl.envs.randomization import CommandDelay, Randomization
from rover_rl.envs.rng import episode_keys, row_keys
from rover_rl.envs.sensing import LidarPooling
from rover_rl.envs.task import (
    EVENTS,
    PositionHistory,
    StepEvent,
    TaskConfig,
    TaskState,
    compute_terminations,
    heading_alignment,
    pack_outcome,
    target_info,
)
from rover_rl.sims import BackendLike, Connection, RoverState, Simulator, make_simulator
from rover_rl.sims.base import View
from rover_rl.sims.robots import Robot, get_robot
from rover_rl.sims.rotations import quaternion_to_euler
from rover_rl.sims.worlds import World, get_world


class StepState:
    """The environment's state between two steps; a plain object, as EnvBase is a module and slow to assign to.

    Attributes:
        rover: what the sensors last told.
        euler: roll, pitch, yaw, ``[N, 3]``, rad.
        yaw: ``[N, 1]``, rad.
        position: ``[N, 2]``, m.
        readings: the pooled scan, ``[N, lidar_points]``, m.
        task: what the task remembers.
        outcome: what happened in the last step.
        terminated, truncated: whether it ended the episode, bool ``[N, 1]``.
    """

    rover: RoverState
    euler: Tensor
    yaw: Tensor
    position: Tensor
    readings: Tensor
    task: TaskState
    outcome: TensorDict
    terminated: Tensor
    truncated: Tensor

    def __init__(self, task: TaskState) -> None:
        self.task = task


class RoverEnv(EnvBase):
    """A batch of rovers that navigate to points, with lidar, IMU, odometry and pose.

    The bare task: its reward is 1 for each goal reached. :func:`rover_rl.make_env` adds the contract's reward.

    Observation (float32, clipped to the contract's bounds): ``lidar [N, lidar_points]`` (m), ``pose [N, 3]`` (m),
    ``imu [N, 3]`` (pitch, roll, yaw; rad), ``target [N, 2]`` (distance in m, relative angle in rad),
    ``velocities [N, 2]`` (wheel odometry; m/s, rad/s). ``action [N, 2]``: forward speed in [-1, 1] m/s
    and heading offset in [-pi, pi] rad; finite actions outside are clipped. ``outcome`` says what happened in the step:
    see :mod:`rover_rl.envs.task`.

    ``reset(start=..., goal=...)`` takes poses ``[N, 3]`` (x, y in m, yaw in rad) and goals ``[N, 2]`` (m); the bare
    environment also takes them as entries of the reset tensordict, which transforms would drop.

    Row ``i`` of a batch seeded ``s`` is, to the last bit, the single environment seeded ``s + i``.

    ``num_envs=None`` is one rover without a batch dimension, batch size ``[]``: ``lidar [lidar_points]``,
    ``action [2]``, ``reward [1]``, ``start [3]``. Its numbers are those of the batch of one.

    ``close()`` releases the simulator. The next ``reset()`` builds it anew, as TorchRL's ``ParallelEnv`` does, and
    goes on with the next episodes.

    Args:
        size: dimensions of the camera buffer, reserved for vision as in the original.
        length: steps after which an episode is truncated.
        scan_topic, imu_topic, cmd_vel_topic, camera_topic: ROS 2 topics, for a backend that drives a live rover.
        world_n: a world's name (``"inspect"``, ``"moon"``, ``"maze"``, or ``"maze:7"`` for another seed), a
            :class:`~rover_rl.sims.worlds.World`, or a list of them, each for an equal block of rows.
        connection_check_timeout: seconds to wait for a live rover's first scan.
        lidar_points: readings that the policy sees, each the nearest of its segment of the scan.
        max_lidar_range: the lidar's readings are clipped to this, m.
        num_envs: rovers in the batch; ``None``: one rover, unbatched.
        backend: what moves them: ``"bullet"``, ``"warp"`` (fast, on ``device``), ``"ros2"`` (one live rover), or one's
            settings, for example :class:`~rover_rl.sims.bullet.BulletSettings`.
        physics: preset of a backend given by its name: Bullet's are ``"default"``, ``"accurate"`` and ``"fast"``.
        robot: a robot's name or a :class:`~rover_rl.sims.robots.Robot`.
        lidar_beams: beams of a raw scan.
        seed: of the first row; ``None`` draws one.
        device: where the task's tensors live; ``None`` is the CPU, and leaves the tensordicts without a device.
        end_on_goal: whether reaching the goal ends the episode, instead of a new goal being set.
        task: thresholds of the task.
        heading_gains: of the heading PID.
        randomization: how rovers, sensors and delays vary; ``None``: they do not.

    Attributes:
        num_envs: rovers, the rows of :attr:`goal`, :attr:`rover_state` and ``worlds``: 1 if unbatched.
        simulator: what moves them; another one after each reset that follows a ``close()``.

    Raises:
        ValueError: for an unknown world, backend or robot, a device that is not there, fewer beams than points, or a
            number out of its range.

    Example:
        >>> env = RoverEnv(world_n="maze", num_envs=2, seed=0)
        >>> env.rollout(3)["lidar"].shape
        torch.Size([2, 3, 32])
    """

    batch_locked = True

    def __init__(
        self,
        size: tuple[int, int] = (64, 64),
        length: int = 2000,
        scan_topic: str = "/scan",
        imu_topic: str = "/imu/data",
        cmd_vel_topic: str = "/cmd_vel",
        camera_topic: str = "/camera/image_raw",
        world_n: str | World | Sequence[str | World] = "inspect",
        connection_check_timeout: float = 30,
        lidar_points: int = 32,
        max_lidar_range: float = 12.0,
        *,
        num_envs: int | None = 1,
        backend: BackendLike = "bullet",
        physics: str | None = None,
        robot: str | Robot = "rover_zero",
        lidar_beams: int = 128,
        seed: int | None = None,
        device: torch.device | str | None = None,
        end_on_goal: bool = False,
        task: TaskConfig | None = None,
        heading_gains: HeadingGains | None = None,
        randomization: Randomization | None = None,
    ) -> None:
        batch_size = () if num_envs is None else (num_envs,)
        num_envs = 1 if num_envs is None else num_envs
        _require_count("num_envs", num_envs, MAX_ROVERS)
        _require_count("length", length, MAX_COUNT)
        seed = secrets.randbits(31) if seed is None else check_seed(seed, num_envs)
        super().__init__(device=None if device is None else available_device(device), batch_size=batch_size)
        self._tensor_device = torch.device("cpu") if self.device is None else self.device
        self.size = size
        self.length = length
        self.num_envs = num_envs
        self._row_shape = torch.Size([num_envs])
        self.connection = Connection(scan_topic, imu_topic, cmd_vel_topic, camera_topic, connection_check_timeout)
        self.end_on_goal = end_on_goal
        self.task = task or TaskConfig()
        self.robot = get_robot(robot)
        self.worlds = assign_rows(world_n, num_envs)
        self.lidar = LidarPooling(lidar_beams, lidar_points, max_lidar_range, self._tensor_device)
        self._make_simulator = partial(
            make_simulator,
            backend,
            worlds=self.worlds,
            robot=self.robot,
            lidar_beams=lidar_beams,
            physics=physics,
            connection=self.connection,
            device=self._tensor_device,
        )
        self._open()
        self.placement = Placement(self.worlds, self.robot, self.task.min_goal_distance, self._tensor_device)
        self.controller = HeadingController(num_envs, heading_gains, self._tensor_device)
        self.randomization = randomization or Randomization()
        self._delay = CommandDelay(self.randomization.latency, num_envs, self._tensor_device)
        self._make_specs()
        self._history = PositionHistory(num_envs, self.task.stuck_window, self._tensor_device)
        self._now = StepState(task=TaskState.zeros(num_envs, self._tensor_device))
        self.set_seed(seed)
        if self.randomization.varies_dynamics:
            # A simulator that cannot says so at once.
            nobody = torch.zeros(num_envs, dtype=torch.bool, device=self.simulator.device)
            self.simulator.set_dynamics(nobody, self.randomization.draw_dynamics(self._keys))

    @property
    def goal(self) -> Tensor:
        """Where each row's goal is, ``[N, 2]``, m."""
        return self._now.task.goal.clone()

    @property
    def rover_state(self) -> RoverState:
        """What every rover's sensors last told, unclipped; by it the task is judged, as on a live rover."""
        self._require_started("rover_state")
        return self._now.rover

    @property
    def robot_connected(self) -> bool:
        """Whether there is a rover to drive; of simulated ones always."""
        return self.simulator.robot_connected

    def render(self, row: int = 0, view: View = "chase", width: int = 640, height: int = 480) -> Tensor:
        """A picture of one rover and its goal, from behind (``"chase"``) or above (``"top"``): uint8 ``[H, W, 3]``."""
        self._require_open("render")
        self._require_started("render")
        if not 0 <= row < self.num_envs:
            raise ValueError(f"row must be between 0 and {self.num_envs - 1}, got {row}")
        return self.simulator.render(row, view, width, height, self._now.task.goal[row])

    def close(self, *, raise_if_closed: bool = False) -> None:
        """Releases the simulator, until the next :meth:`reset`. Idempotent."""
        self.simulator.close()
        super().close(raise_if_closed=raise_if_closed)

    def to(self, device: torch.device | str) -> RoverEnv:
        """Names the device that the task lives on, in specs and tensordicts. The task itself does not move.

        Raises:
            ValueError: for another device than the one the task lives on.
        """
        asked, own = torch.device(device), self._tensor_device
        if asked.type != own.type or asked.index not in (None, own.index):
            raise ValueError(f"the task lives on {own}; build RoverEnv(device={str(device)!r}) instead")
        return super().to(own)

    def _open(self) -> None:
        """Builds the simulator, whose rovers are all to be reset next."""
        self.simulator: Simulator = self._make_simulator()
        self._started = False
        self.is_closed = False

    def _make_specs(self) -> None:
        batch_size, device = self.batch_size, self.device
        self.observation_spec = specs.observation_spec(self.lidar.points, self.lidar.max_range, batch_size, device)
        self.action_spec = specs.bounded_spec(specs.ACTION, batch_size, device)
        self.reward_spec = specs.reward_spec(batch_size, device)
        self.full_done_spec = specs.done_spec(batch_size, device)
        bounds = specs.observation_bounds(self.lidar.points, self.lidar.max_range)
        self._clip = {
            key: tuple(torch.tensor(side, device=self._tensor_device) for side in (bounds[key].low, bounds[key].high))
            for key in ("pose", "target", "velocities")
        }
        self._action_clip = tuple(
            torch.tensor(side, device=self._tensor_device) for side in (specs.ACTION.low, specs.ACTION.high)
        )

    def _set_seed(self, seed: int | None) -> None:
        seed = secrets.randbits(31) if seed is None else check_seed(seed, self.num_envs)
        self._row_keys = row_keys(seed, self.num_envs, self._tensor_device)
        self._episode = torch.zeros_like(self._row_keys)
        self._keys = self._row_keys

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
        start = self._given("start", start, tensordict, 3)
        goal = self._given("goal", goal, tensordict, 2)
        self._episode = self._episode + mask
        self._keys = torch.where(mask, episode_keys(self._row_keys, self._episode), self._keys)

        poses = self.placement.draw_start(self._keys) if start is None else start
        device = self.simulator.device
        rows = mask.squeeze(-1).to(device)
        if self.randomization.varies_dynamics:
            self.simulator.set_dynamics(rows, self.randomization.draw_dynamics(self._keys.to(device)))
        self._delay.reset(mask, self._keys)
        steps = self._now.task.steps.masked_fill(mask, 0)
        self._receive(self.simulator.reset(rows, poses.to(device)), steps)
        self.controller.reset(mask)
        self._set_targets(mask, goal)
        self._forget_outcome(mask)
        self._started = True
        now = self._now
        # Fresh tensors for all rows: EnvBase keeps what the rows that were not reset had.
        return self._pack(
            self._observation(),
            outcome=now.outcome,
            done=now.terminated | now.truncated,
            terminated=now.terminated,
            truncated=now.truncated,
        )

    def _forget_outcome(self, mask: Tensor) -> None:
        """Nothing has happened yet on the rows of ``mask``."""
        now = self._now
        nothing = self._pack_outcome(
            torch.zeros(self.num_envs, len(EVENTS), dtype=torch.bool, device=self._tensor_device),
            phase=torch.full_like(self._keys, StepEvent.NONE),
            progress=torch.zeros_like(now.yaw),
            alignment=heading_alignment(now.task.target[:, 1:]),
        )
        if self._started:
            now.outcome = nothing.where(mask.squeeze(-1), now.outcome)
            now.terminated, now.truncated = now.terminated & ~mask, now.truncated & ~mask
        else:
            now.outcome = nothing
            now.terminated, now.truncated = torch.zeros_like(mask), torch.zeros_like(mask)

    def _set_targets(self, mask: Tensor, goal: Tensor | None) -> None:
        """Sets the goals of freshly reset rows, and their counters to zero."""
        none = torch.zeros_like(self._keys)
        if goal is None:
            goal = self.placement.draw_goal(self._keys, none, self._now.position)
        fresh = TaskState(
            goal=goal,
            target=target_info(self._now.position, self._now.yaw, goal),
            goals=none + 1,
            collision_steps=none,
            steps=none,
            total_steps=self._now.task.total_steps,
        )
        self._now.task = fresh.merge(mask, self._now.task)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self._require_open("step")
        self._require_started("step")
        active = tensordict.get("_step", None)
        active = None if active is None else active.reshape(self.num_envs, 1)
        action, invalid = self._checked(tensordict.get("action"))

        heading = self._now.yaw + action[:, 1:]
        turn = self.controller(heading, self._now.yaw, self._now.rover.dt, active)
        command = self._delay(torch.cat((action[:, :1], turn), -1).masked_fill(invalid, 0.0), active)
        device = self.simulator.device
        rows = None if active is None else active.squeeze(-1).to(device)
        steps = self._now.task.steps + (1 if active is None else active)
        self._receive(self.simulator.step(command.to(device), rows), steps)

        self._advance(invalid, active)
        reached = self._now.outcome.get("goal_reached")
        terminated = self._now.outcome.get("phase") < StepEvent.GOAL
        if self.end_on_goal:
            terminated = terminated | reached
        truncated = (self._now.task.steps >= self.length) & ~terminated
        reward = reached.to(torch.float32)
        if active is not None:
            terminated = torch.where(active, terminated, self._now.terminated)
            truncated = torch.where(active, truncated, self._now.truncated)
            reward = reward * active
        self._now.terminated, self._now.truncated = terminated, truncated
        return self._pack(
            self._observation(),
            outcome=self._now.outcome,
            reward=reward,
            done=terminated | truncated,
            terminated=terminated,
            truncated=truncated,
        )

    def _receive(self, rover: RoverState, steps: Tensor) -> None:
        """Takes in a state of the simulator after ``steps`` of each row's episode, and what is derived from it."""
        if rover.device is not None and rover.device != self._tensor_device:
            rover = rover.to(self._tensor_device)
        now = self._now
        now.rover = rover = self.randomization.sense(rover, self._keys, steps)
        now.euler = quaternion_to_euler(rover.orientation)
        now.yaw = now.euler[:, 2:]
        now.position = rover.position[:, :2]
        now.readings = self.lidar(rover.ranges)

    def _advance(self, invalid: Tensor, active: Tensor | None) -> None:
        """Judges the step that the simulator has just made: the outcome, the next targets and the counters."""
        now, before = self._now, self._now.task
        nearest = now.readings.amin(-1, keepdim=True)
        steps = before.steps + 1
        collision_steps = (before.collision_steps + 1) * (nearest < self.task.collision_threshold)
        target = target_info(now.position, now.yaw, before.goal)
        events, phase = compute_terminations(
            position=now.position,
            tilt=now.euler[:, :2],
            distance=target[:, :1],
            displacement=self._history.displacement(now.position, steps, active),
            collision_steps=collision_steps,
            invalid=invalid,
            bounds=(self.placement.bounds_low, self.placement.bounds_high),
            config=self.task,
        )
        after = TaskState(
            goal=before.goal,
            target=target,
            goals=before.goals,
            collision_steps=collision_steps,
            steps=steps,
            total_steps=before.total_steps + 1,
        )
        if not self.end_on_goal:
            after = self._next_goals(after, phase == StepEvent.GOAL)
        now.task = after if active is None else after.merge(active, before)
        outcome = self._pack_outcome(
            events,
            phase=phase,
            progress=before.target[:, :1] - target[:, :1],
            alignment=heading_alignment(target[:, 1:]),
        )
        if active is not None:
            outcome = outcome.where(active.squeeze(-1), now.outcome)
            outcome.set("phase", phase.masked_fill(~active, StepEvent.NONE))
        now.outcome = outcome

    def _next_goals(self, state: TaskState, reached: Tensor) -> TaskState:
        """Gives the rows that reached their goal a new one, from which progress counts anew."""
        # On the host a look is cheap and mostly spares the rest; on an accelerator it would wait for the device.
        if reached.device.type == "cpu" and not reached.any():
            return state
        drawn = self.placement.draw_goal(self._keys, state.goals, self._now.position)
        goal = torch.where(reached, drawn, state.goal)
        return replace(
            state, goal=goal, target=target_info(self._now.position, self._now.yaw, goal), goals=state.goals + reached
        )

    def _pack_outcome(self, events: Tensor, *, phase: Tensor, progress: Tensor, alignment: Tensor) -> TensorDict:
        now = self._now
        return pack_outcome(
            events,
            phase=phase,
            progress=progress,
            alignment=alignment,
            linear_velocity=now.rover.linear_velocity,
            angular_velocity=now.rover.angular_velocity,
            steps=now.task.steps,
            total_steps=now.task.total_steps,
        )

    def _observation(self) -> dict[str, Tensor]:
        velocities = torch.cat((self._now.rover.linear_velocity, self._now.rover.angular_velocity), -1)
        roll, pitch, yaw = self._now.euler.split(1, -1)
        return {
            "lidar": self._now.readings,
            "pose": torch.clamp(self._now.rover.position, *self._clip["pose"]),
            "imu": torch.cat((pitch, roll, yaw), -1),
            "target": torch.clamp(self._now.task.target, *self._clip["target"]),
            "velocities": torch.clamp(velocities, *self._clip["velocities"]),
        }

    def _pack(self, observation: dict[str, Tensor], **entries: Any) -> TensorDict:
        """What is handed out, from rows: the row itself if the environment is unbatched."""
        rows = TensorDict._new_unsafe({**observation, **entries}, batch_size=self._row_shape, device=self.device)
        return rows if self.batch_size else rows[0]

    def _checked(self, action: Tensor) -> tuple[Tensor, Tensor]:
        """The action of each row clipped to its bounds, and which rows (bool ``[N, 1]``) were not finite.

        On the host those raise; on an accelerator they are flagged, because looking would wait for the device.
        """
        expected = (*self.batch_size, 2)
        if action.shape != expected:
            raise ValueError(f"action must have shape {expected}, got {tuple(action.shape)}")
        action = action.reshape(self.num_envs, 2)
        invalid = ~torch.isfinite(action).all(-1, keepdim=True)
        if action.device.type == "cpu" and invalid.any():
            rows = invalid.squeeze(-1).nonzero().squeeze(-1).tolist()
            raise ValueError(f"action must be finite numbers, got NaN or infinity in rows {rows}")
        return torch.clamp(action, *self._action_clip), invalid

    def _reset_mask(self, tensordict: TensorDictBase | None) -> Tensor:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or not self._started:
            return torch.ones(self.num_envs, 1, dtype=torch.bool, device=self._tensor_device)
        return mask.reshape(self.num_envs, 1)

    def _given(self, key: str, value: Tensor | None, tensordict: TensorDictBase | None, width: int) -> Tensor | None:
        """A start or goal of each row that the caller gives, checked."""
        if value is None and tensordict is not None:
            value = tensordict.get(key, None)
        if value is None:
            return None
        value = torch.as_tensor(value, dtype=torch.float32, device=self._tensor_device)
        expected = (*self.batch_size, width)
        if value.shape != expected or not torch.isfinite(value).all():
            raise ValueError(f"{key} must be finite numbers of shape {expected}, got shape {tuple(value.shape)}")
        return value.reshape(self.num_envs, width)

    def _require_open(self, what: str) -> None:
        if self.is_closed:
            raise RuntimeError(f"{what}() was called on a closed RoverEnv; call reset() first, which opens it anew")

    def _require_started(self, what: str) -> None:
        if not self._started:
            raise RuntimeError(f"{what} needs a running episode; call reset() first")


# EnvBase's metaclass takes any arguments, and would hide these from help() and editors.
RoverEnv.__signature__ = inspect.Signature([*inspect.signature(RoverEnv.__init__).parameters.values()][1:])


def assign_rows(world_n: str | World | Sequence[str | World], num_envs: int) -> list[World]:
    """The world of each row: the given ones in equal blocks."""
    names = [world_n] if isinstance(world_n, (str, World)) else list(world_n)
    if not 1 <= len(names) <= num_envs:
        raise ValueError(f"world_n must give between 1 and num_envs={num_envs} worlds, got {len(names)}")
    worlds = [get_world(name) for name in names]
    return [worlds[row * len(worlds) // num_envs] for row in range(num_envs)]


def _require_count(name: str, value: int, most: int) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= most:
        raise ValueError(f"{name} must be a whole number of at least 1 and at most {most}, got {value!r}")
