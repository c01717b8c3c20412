"""Gymnasium classes: ``RoverEnv`` (drop-in replacement for the original), ``GymWrapper`` and ``GymVectorWrapper``."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray
from torchrl.envs import EnvBase

from rover_rl.checks import check_seed
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.parts import TASKS
from rover_rl.envs.rover import RoverEnv as BatchedRoverEnv
from rover_rl.envs.wrappers.numpy_batch import Mask, NumpyBatch, Observation, Step, base_env, pop_options, row_of
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims.settings import CONTROL_DT

VectorStep = tuple[Observation, NDArray[np.float64], Mask, Mask, dict[str, Any]]


def _original(get: Callable[[BatchedRoverEnv], Any]) -> property:
    return property(lambda wrapper: get(wrapper.base_env))


def _reward(name: str) -> property:
    def get(wrapper: GymWrapper) -> float:
        if wrapper.reward_config is None:
            raise AttributeError(
                "the parameters of the contract's reward are only known if this class has added the reward; "
                "pass a bare RoverEnv, with reward='contract' or a RewardConfig"
            )
        return getattr(wrapper.reward_config, name)

    return property(get)


def _euler(axis: int) -> property:
    return _original(lambda env: quaternion_to_euler(env.rover_state.orientation)[0, axis].item())


class _OriginalNames:
    """Read-only attributes of the original environment, with its names and spelling."""

    _step = property(lambda wrapper: wrapper._steps)
    _robot_connected = _original(lambda env: env.robot_connected)
    size = _original(lambda env: env.config.size)
    length = _length = _original(lambda env: env.length)
    lidar_points = _original(lambda env: env.lidar.points)
    max_lidar_range = _original(lambda env: env.lidar.max_range)
    world_n = _original(lambda env: env.worlds[0].name)
    rand_x_range = _original(lambda env: env.worlds[0].spawn_range[0])
    rand_y_range = _original(lambda env: env.worlds[0].spawn_range[1])
    rand_goal_x_range = _original(lambda env: env.worlds[0].goal_range[0])
    rand_goal_y_range = _original(lambda env: env.worlds[0].goal_range[1])
    too_far_away_low_x = _original(lambda env: env.worlds[0].bounds[0][0])
    too_far_away_high_x = _original(lambda env: env.worlds[0].bounds[0][1])
    too_far_away_low_y = _original(lambda env: env.worlds[0].bounds[1][0])
    too_far_away_high_y = _original(lambda env: env.worlds[0].bounds[1][1])
    success_distance = _original(lambda env: env.config.task.success_distance)
    collision_threshold = _original(lambda env: env.config.task.collision_threshold)
    collision_window = _original(lambda env: env.config.task.collision_window)
    stuck_window = _original(lambda env: env.config.task.stuck_window)
    stuck_threshold = _original(lambda env: env.config.task.stuck_threshold)
    goal_reward = _reward("goal_reward")
    distance_delta_scale = _reward("distance_delta_scale")
    final_reward_multiplier = _reward("final_reward_multiplier")
    collision_penalty = _reward("collision_penalty")
    stuck_penilty = _reward("stuck_penalty")
    general_penility = _reward("general_penalty")
    too_far_away_penilty = _reward("out_of_bounds_penalty")
    current_roll, current_pitch, current_yaw = _euler(0), _euler(1), _euler(2)
    current_linear_velocity = _original(lambda env: env.rover_state.linear_velocity.item())
    current_angular_velocity = _original(lambda env: env.rover_state.angular_velocity.item())
    rover_position = _original(lambda env: env.rover_state.position[0].numpy(force=True).copy())
    lidar_data = property(lambda wrapper: wrapper.get_observation()["lidar"])
    target_positions_x = _original(lambda env: env.goal[0, 0].item())
    target_positions_y = _original(lambda env: env.goal[0, 1].item())


class GymWrapper(_OriginalNames, gymnasium.Env[Any, Any]):
    """Wraps a :class:`rover_rl.RoverEnv` of one rover as a ``gymnasium.Env`` with all methods of the contract.

    The observation is a dictionary of the contract's five float32 arrays. The action is forward speed (m/s) and heading
    offset (rad), ``[2]``. ``info`` of a step contains ``steps`` (in the episode), ``total_steps`` (since the last
    seed), ``reward``, ``goals`` (number of goals reached in the episode), ``is_success`` (whether a goal was reached)
    and a bool for each event: ``goal_reached``, ``collision``, ``flipped``, ``jammed``, ``out_of_bounds``, ``stuck``
    and ``invalid_action``. The attributes of the original environment can be read by its names and spelling.

    For a window, use ``gymnasium.wrappers.HumanRendering``, or ``gymnasium.make(..., render_mode="human")``.

    ``env`` is a ``RoverEnv`` with ``num_envs=1`` or ``None``, or a ``TransformedEnv`` of one (``base_env``). The
    options are those of :class:`~rover_rl.envs.wrappers.numpy_batch.NumpyBatch`. ``reward_config`` are the parameters
    of the contract's reward, and ``None`` if this class has not added it.

    Example:
        >>> import rover_rl
        >>> env = GymWrapper(rover_rl.RoverEnv(world_n="maze"))
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step([1.0, 0.0])
        >>> info["steps"]
        1
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / CONTROL_DT)}  # noqa: RUF012

    def __init__(self, env: EnvBase, **options: Any) -> None:
        rovers = base_env(env).num_envs
        if rovers != 1:
            raise ValueError(f"GymWrapper is for one rover, got num_envs={rovers}; use GymVectorWrapper for a batch")
        self._batch = NumpyBatch(env, **options)
        self.base_env, self.reward_config = self._batch.base_env, self._batch.reward_config
        self.observation_space, self.action_space = self._batch.observation_space, self._batch.action_space
        self.render_mode = self._batch.render_mode
        self.metadata = {**self.metadata, "render_fps": self._batch.frames_per_second}
        self._reward, self._steps = 0.0, 0

    @property
    def total_steps(self) -> int:
        """Number of steps since the environment was last seeded."""
        return int(self._batch.total_steps[0])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins the next episode, with a new seed or that of before.

        The options are ``"start"`` (x, y in m, yaw in rad) and ``"goal"`` (x, y in m). Raises ``ValueError`` for
        another option, a wrong shape, or a seed that is out of range.
        """
        super().reset(seed=None if seed is None else check_seed(seed))
        options = {key: np.asarray(value)[None] for key, value in (options or {}).items()}
        observation = self._batch.reset(seed=seed, options=options)
        self._reward, self._steps = 0.0, 0
        return row_of(observation, 0), {}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Takes one step: 0.05 s, or ``action_repeat`` times as long. The action is clipped to the action space.

        Raises ``ValueError`` if the shape of the action is wrong, or it is not finite.
        """
        action = np.asarray(action, np.float32)
        if action.shape != self.action_space.shape:
            raise ValueError(f"action must have shape {self.action_space.shape}, got {action.shape}")
        step = self._batch.step(action[None])
        info = {key: value[0].item() for key, value in step.info.items()}
        self._reward, self._steps = info["reward"], info["steps"]
        return row_of(step.observation, 0), self._reward, bool(step.terminated[0]), bool(step.truncated[0]), info

    def render(self) -> NDArray[np.uint8] | None:
        """Returns an image, uint8 ``[480, 640, 3]``, if the render mode is ``"rgb_array"``, and ``None`` otherwise."""
        return self._batch.picture(0) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Releases the simulator. Later calls of step, reset and render raise an error."""
        self._batch.env.close()

    def get_observation(self) -> Observation:
        """Returns the current observation without advancing time."""
        return row_of(self._batch.observation(), 0)

    def get_target_info(self) -> NDArray[np.float32]:
        """Returns distance (m) and angle relative to the heading (rad) of the goal, ``[2]``."""
        return self._batch.entry("target")[0]

    def task_reward(self) -> float:
        """Returns the reward of the last step, or 0 before the first step of an episode."""
        return self._reward

    def is_robot_flipped(self) -> str | bool:
        """Returns ``'roll_left'``, ``'roll_right'``, ``'pitch_forward'``, ``'pitch_backward'``, or ``False``."""
        threshold = self.base_env.config.task.flip_threshold
        roll, pitch = self.current_roll, self.current_pitch
        if abs(roll) > threshold:
            return "roll_left" if roll > 0 else "roll_right"
        if abs(pitch) > threshold:
            return "pitch_forward" if pitch < 0 else "pitch_backward"
        return False

    def heading_controller(self, desired_heading: float, current_heading: float) -> float:
        """Returns the yaw rate (rad/s) that the heading PID would command for headings in the world frame (rad).

        The state of the PID does not change.
        """
        # The controller replaces its state tensors and does not modify them in place, so that a shallow copy suffices.
        controller = copy.copy(self.base_env.controller)
        dt = self.base_env.rover_state.dt
        desired, current = (torch.full_like(dt, float(heading)) for heading in (desired_heading, current_heading))
        return controller(desired, current, dt).item()

    def too_far_away(self) -> bool:
        """Whether the rover is outside of the world's bounds."""
        x, y, _ = self.rover_position.tolist()
        (x_low, x_high), (y_low, y_high) = self.base_env.worlds[0].bounds
        return not (x_low <= x <= x_high and y_low <= y <= y_high)

    def _check_robot_connection(self, timeout: float) -> bool:
        wait = getattr(self.base_env.simulator, "wait_for_robot", None)
        return self.base_env.robot_connected if wait is None else wait(timeout)

    def pose_array_callback(self, msg: Any) -> None:
        """Passes a ``geometry_msgs/PoseArray`` to a live backend, which uses pose 0."""
        self._pass_message("pose", msg)

    def lidar_callback(self, msg: Any) -> None:
        """Passes a ``sensor_msgs/LaserScan`` to a live backend, which ignores a malformed one with a warning."""
        self._pass_message("scan", msg)

    def imu_callback(self, msg: Any) -> None:
        """Passes a ``sensor_msgs/Imu`` to a live backend."""
        self._pass_message("imu", msg)

    def odom_callback(self, msg: Any) -> None:
        """Passes a ``nav_msgs/Odometry`` to a live backend."""
        self._pass_message("odometry", msg)

    def _pass_message(self, kind: str, msg: Any) -> None:
        simulator = self.base_env.simulator
        if not hasattr(simulator, "receive"):
            name = type(simulator).__name__
            raise RuntimeError(f"{name}: this backend makes its own sensor data; callbacks are for backend='ros2'")
        simulator.receive(kind, msg)


class RoverEnv(GymWrapper):
    """Drop-in replacement for the original environment: same positional arguments, methods and attributes.

    It takes the contract's ten arguments, settings of :class:`rover_rl.RoverEnv` except ``num_envs``, and options of
    :class:`GymWrapper`. ``task="mazes"`` takes the settings of a task, which others override.

    Example:
        >>> env = RoverEnv(world_n="maze", length=500)
        >>> observation, info = env.reset(seed=0)
        >>> env.too_far_away_penilty
        -10.0
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        if "num_envs" in kwargs:
            raise TypeError("this class is for one rover and takes no num_envs; use GymVectorWrapper for a batch")
        rovers, options = _rovers_and_options(args, kwargs)
        super().__init__(rovers, **options)


class GymVectorWrapper(VectorEnv[Any, Any, Any]):
    """Wraps a :class:`rover_rl.RoverEnv` of any number of rovers as a ``gymnasium.vector.VectorEnv``.

    Row ``i`` is bit-identical to a :class:`GymWrapper` of one rover with seed ``seed + i``. ``infos`` contains the
    entries of its ``info`` as arrays ``[N]``, each with a mask under ``"_" + key``, but not ``reward``, because
    TorchRL's ``GymWrapper`` would use an info of that name instead of the reward.

    ``env`` and the other options are as in :class:`GymWrapper`. ``autoreset_mode`` says when rows whose episode ended
    are reset, as defined by Gymnasium: in the next step, which ignores their action (``NEXT_STEP``); in the same step,
    with ``final_obs`` and ``final_info`` in ``infos`` (``SAME_STEP``); or by ``reset(options={"reset_mask": ...})``
    (``DISABLED``).

    Example:
        >>> import rover_rl
        >>> envs = GymVectorWrapper(rover_rl.RoverEnv(world_n="maze", num_envs=4))
        >>> observations, infos = envs.reset(seed=0)
        >>> observations["lidar"].shape
        (4, 32)
    """

    def __init__(
        self, env: EnvBase, *, autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP, **options: Any
    ) -> None:
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self._batch = NumpyBatch(env, **options)
        self.base_env, self.num_envs = self._batch.base_env, self._batch.num_envs
        self.single_observation_space = self._batch.observation_space
        self.single_action_space = self._batch.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.render_mode = self._batch.render_mode
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": self._batch.frames_per_second}
        self.metadata["autoreset_mode"] = self.autoreset_mode
        self._ended = np.zeros(self.num_envs, np.bool_)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins the next episode in all rows, or in those of a mask.

        ``seed`` is the seed ``s`` of row 0, with ``s + i`` in row ``i``, the list ``[s, s + 1, ...]``, or ``None`` for
        the current seeds. Options are ``"start"`` (``[N, 3]``: x, y in m, yaw in rad), ``"goal"`` (``[N, 2]``, m) and
        ``"reset_mask"`` (bool ``[N]``, rows to reset). Raises ``ValueError`` if seeds are out of range or not
        consecutive, a seed is given for some rows only, or an option is unknown or has the wrong shape.
        """
        options = dict(options or {})
        rows = self._reset_mask(options.pop("reset_mask", None))
        first = _first_seed(seed, self.num_envs)
        super().reset(seed=first)
        observation = self._batch.reset(rows, seed=first, options=options)
        self._ended = self._ended & ~rows
        return observation, {}

    def step(self, actions: ArrayLike) -> VectorStep:
        """Takes one step in every row with actions ``[N, 2]``, as :meth:`GymWrapper.step`.

        Raises ``RuntimeError`` if ``autoreset_mode`` is ``DISABLED`` and a row whose episode ended was not reset.
        """
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and self._ended.any():
            return self._step_and_reset_ended(actions)
        if self._ended.any():
            raise RuntimeError(
                f"rows {np.flatnonzero(self._ended).tolist()} have ended; "
                "reset them with reset(options={'reset_mask': ...}) before the next step"
            )
        step = self._batch.step(actions)
        if self.autoreset_mode is AutoresetMode.SAME_STEP and step.ended.any():
            return self._reset_in_same_step(step)
        self._ended = step.ended
        infos = _masked(step.info, np.ones_like(self._ended))
        return step.observation, step.reward, step.terminated, step.truncated, infos

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Returns an image of every rover, uint8 ``[480, 640, 3]``, or ``None`` if there is no render mode."""
        if self.render_mode is None:
            return None
        return tuple(self._batch.picture(row) for row in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        self._batch.env.close()

    def _step_and_reset_ended(self, actions: ArrayLike) -> VectorStep:
        running = ~self._ended
        step = self._batch.step(actions, running)
        # The reset comes after the step, so that the reset rows do not take part in it.
        observation = self._batch.reset(self._ended)
        self._ended = step.ended
        return observation, step.reward, step.terminated, step.truncated, _masked(step.info, running)

    def _reset_in_same_step(self, step: Step) -> VectorStep:
        ended = step.ended
        final = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(ended).tolist():
            final[row] = row_of(step.observation, row)
        infos = _masked(step.info, ~ended)
        infos.update(final_obs=final, _final_obs=ended, final_info=_masked(step.info, ended), _final_info=ended.copy())
        return self._batch.reset(ended), step.reward, step.terminated, step.truncated, infos

    def _reset_mask(self, mask: Any) -> Mask:
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
            raise ValueError(
                f"reset_mask must be {self.num_envs} bools, at least one of them True, "
                f"got {mask.dtype} of shape {mask.shape}: {mask.tolist()}"
            )
        return mask


def make_vector_env(num_envs: int = 1, **kwargs: Any) -> GymVectorWrapper:
    """Entry point of ``gymnasium.make_vec("rover_rl/Rover-v0", vectorization_mode="vector_entry_point")``.

    It takes the arguments of :class:`rover_rl.RoverEnv` and of :class:`GymVectorWrapper`, and Gymnasium's
    ``disable_env_checker``, which has no effect on a batch.
    """
    kwargs.pop("disable_env_checker", None)
    mode = kwargs.pop("autoreset_mode", AutoresetMode.NEXT_STEP)
    rovers, options = _rovers_and_options((), {"num_envs": num_envs, **kwargs})
    return GymVectorWrapper(rovers, autoreset_mode=mode, **options)


def _rovers_and_options(args: Sequence[Any], settings: dict[str, Any]) -> tuple[BatchedRoverEnv, dict[str, Any]]:
    """Makes rovers by settings, with the options of a wrapper among them: those of a task are the defaults."""
    options = pop_options(settings)
    if isinstance(task := settings.get("task"), str):
        options.setdefault("observation", TASKS.find(task).observation)
    config = EnvConfig.of(*args, **settings)
    options.setdefault("reward", config.reward)
    return BatchedRoverEnv(config), options


def _first_seed(seed: int | Sequence[int | None] | None, num_envs: int) -> int | None:
    if not isinstance(seed, Iterable):
        return None if seed is None else check_seed(seed, num_envs)
    seeds = list(seed)
    if seeds == [None] * num_envs:
        return None
    if len(seeds) == num_envs and None not in seeds:
        first = check_seed(seeds[0], num_envs)
        if seeds == list(range(first, first + num_envs)):
            return first
    raise ValueError(f"seeds must be {num_envs} numbers that count on (s, s + 1, ...), or all None; got {seeds}")


def _masked(info: dict[str, NDArray[Any]], rows: Mask) -> dict[str, Any]:
    """Converts ``info`` to Gymnasium's format: without the reward, 0 outside of ``rows``, and with a mask per entry."""
    infos: dict[str, Any] = {}
    for key, value in info.items():
        if key != "reward" and rows.any():
            infos |= {key: np.where(rows, value, value.dtype.type(0)), f"_{key}": rows.copy()}
    return infos
