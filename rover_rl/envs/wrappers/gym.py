"""Gymnasium environment of one rover, with the contract's interface."""

from __future__ import annotations

import copy
import inspect
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torchrl.envs import EnvBase

from rover_rl.checks import check_seed
from rover_rl.envs.rover import RoverEnv as BatchedRoverEnv
from rover_rl.envs.wrappers.learning_options import base_env, learning_transforms
from rover_rl.envs.wrappers.numpy_batch import (
    NumpyBatch,
    Observation,
    WrapperOptions,
    pop_options,
    require_one_of,
    row_of,
)
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims.settings import CONTROL_DT

if TYPE_CHECKING:
    from typing_extensions import Unpack


def _original(get: Callable[[BatchedRoverEnv], Any], doc: str) -> property:
    return property(lambda wrapper: get(wrapper.base_env), doc=doc)


def _reward(name: str, doc: str) -> property:
    def get(wrapper: GymWrapper) -> float:
        if wrapper.reward_config is None:
            raise AttributeError(
                "the parameters of the contract's reward are only known if this class has added the reward; "
                "pass a bare RoverEnv, with reward='contract' or a RewardConfig"
            )
        return getattr(wrapper.reward_config, name)

    return property(get, doc=doc)


def _euler(axis: int, doc: str) -> property:
    return _original(lambda env: quaternion_to_euler(env.rover_state.orientation)[0, axis].item(), doc)


class _OriginalNames:
    """Read-only attributes of the original environment, with its names and spelling."""

    _step = property(lambda wrapper: wrapper._steps, doc="Number of steps in the episode.")
    _robot_connected = _original(lambda env: env.robot_connected, "Whether the rover is connected.")

    size = _original(lambda env: env.size, "Size of the camera buffer, pixels. Reserved for vision.")
    length = _length = _original(lambda env: env.length, "Number of steps after which an episode ends.")
    lidar_points = _original(lambda env: env.lidar.points, "Number of lidar readings in an observation.")
    max_lidar_range = _original(lambda env: env.lidar.max_range, "Maximum of a lidar reading, m.")

    world_n = _original(lambda env: env.worlds[0].name, "Name of the world.")
    rand_x_range = _original(lambda env: env.worlds[0].spawn_range[0], "Range of starts in x, (low, high), m.")
    rand_y_range = _original(lambda env: env.worlds[0].spawn_range[1], "Range of starts in y, (low, high), m.")
    rand_goal_x_range = _original(lambda env: env.worlds[0].goal_range[0], "Range of goals in x, (low, high), m.")
    rand_goal_y_range = _original(lambda env: env.worlds[0].goal_range[1], "Range of goals in y, (low, high), m.")
    too_far_away_low_x = _original(lambda env: env.worlds[0].bounds[0][0], "Lower bound of the world in x, m.")
    too_far_away_high_x = _original(lambda env: env.worlds[0].bounds[0][1], "Upper bound of the world in x, m.")
    too_far_away_low_y = _original(lambda env: env.worlds[0].bounds[1][0], "Lower bound of the world in y, m.")
    too_far_away_high_y = _original(lambda env: env.worlds[0].bounds[1][1], "Upper bound of the world in y, m.")

    success_distance = _original(lambda env: env.task.success_distance, "Distance below which a goal is reached, m.")
    collision_threshold = _original(lambda env: env.task.collision_threshold, "Reading below which it collides, m.")
    collision_window = _original(lambda env: env.task.collision_window, "Steps in collision that are not yet a jam.")
    stuck_window = _original(lambda env: env.task.stuck_window, "Number of positions that tell a stuck rover.")
    stuck_threshold = _original(lambda env: env.task.stuck_threshold, "Displacement of a stuck rover, less than, m.")

    goal_reward = _reward("goal_reward", "Reward for reaching a goal.")
    distance_delta_scale = _reward("distance_delta_scale", "Reward per meter of progress toward the goal.")
    final_reward_multiplier = _reward("final_reward_multiplier", "Factor of progress reward and idle penalty.")
    collision_penalty = _reward("collision_penalty", "Reward for each step in collision.")
    stuck_penilty = _reward("stuck_penalty", "Reward for an episode that ends with a stuck rover.")
    general_penility = _reward("general_penalty", "Reward for an episode that ends in a flip or a jam.")
    too_far_away_penilty = _reward("out_of_bounds_penalty", "Reward for leaving the world's bounds.")

    current_roll = _euler(0, "Roll, rad.")
    current_pitch = _euler(1, "Pitch, rad.")
    current_yaw = _euler(2, "Yaw, rad.")
    current_linear_velocity = _original(lambda env: env.rover_state.linear_velocity.item(), "Wheel odometry, m/s.")
    current_angular_velocity = _original(lambda env: env.rover_state.angular_velocity.item(), "Wheel odometry, rad/s.")
    rover_position = _original(lambda env: env.rover_state.position[0].numpy(force=True).copy(), "float32 [3], m.")
    lidar_data = property(lambda wrapper: wrapper.get_observation()["lidar"], doc="float32 [lidar_points], m.")
    target_positions_x = _original(lambda env: env.goal[0, 0].item(), "Position of the goal in x, m.")
    target_positions_y = _original(lambda env: env.goal[0, 1].item(), "Position of the goal in y, m.")


class GymWrapper(_OriginalNames, gymnasium.Env[Any, Any]):
    """Wraps a :class:`rover_rl.RoverEnv` of one rover as a ``gymnasium.Env`` with all methods of the contract.

    The observation is a dictionary of the contract's five float32 arrays. The action is forward speed (m/s) and heading
    offset (rad), ``[2]``. ``info`` of a step contains ``steps`` (in the episode), ``total_steps`` (since the last
    seed), ``reward``, ``goals`` (number of goals reached in the episode), ``is_success`` (whether a goal was reached)
    and a bool for each event: ``goal_reached``, ``collision``, ``flipped``, ``jammed``, ``out_of_bounds``, ``stuck``
    and ``invalid_action``.

    Args:
        env: ``RoverEnv`` with ``num_envs=1`` or ``None``, or a ``TransformedEnv`` of one, for example from
            :func:`rover_rl.make_env`.
        reward: reward of a ``RoverEnv``: ``"contract"`` (also ``None``), ``"task"``, a ``RewardConfig`` or a list of
            components. A ``TransformedEnv`` already has its reward.
        time_limit: signal at the end of an episode's length: ``"terminated"`` as in the contract (``truncated`` is
            never true), or ``"truncated"`` as in Gymnasium's API.
        render_mode: ``None``; ``"rgb_array"``: :meth:`render` returns an image; or ``"human"``: each reset and step
            shows an image in a window, in real time (requires the extra ``human``).
        camera: camera position: behind the rover (``"chase"``) or above it (``"top"``).
        max_episode_steps: number of actions after which an episode is truncated, as by Gymnasium's ``TimeLimit``. The
            environment has a length of its own besides.
        action_repeat, reward_scale, scale_observations: options with which algorithms learn at their default settings:
            see :class:`~rover_rl.envs.wrappers.learning_options.LearningOptions`.

    Attributes:
        base_env: the ``RoverEnv`` under the transforms.
        reward_config: parameters of the contract's reward. ``None`` if this class has not added it.

    Raises:
        TypeError: if ``env`` has another type, or an option does not exist.
        ValueError: if there is more than one rover, or an option is out of range.
        ImportError: if ``render_mode="human"`` and pygame is not installed.
        RuntimeError: if ``render_mode="human"`` and there is no display.

    Example:
        >>> import rover_rl
        >>> env = GymWrapper(rover_rl.RoverEnv(world_n="maze"))
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step([1.0, 0.0])
        >>> info["steps"]
        1
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": round(1 / CONTROL_DT)}  # noqa: RUF012

    def __init__(self, env: EnvBase, **options: Unpack[WrapperOptions]) -> None:
        rovers = base_env(env).num_envs
        if rovers != 1:
            raise ValueError(f"GymWrapper is for one rover, got num_envs={rovers}; use GymVectorWrapper for a batch")
        self.render_mode = options.get("render_mode")
        require_one_of("render_mode", self.render_mode, (None, *self.metadata["render_modes"]))
        if self.render_mode == "human":
            options["render_mode"] = "rgb_array"
        self._batch = NumpyBatch(env, **options)
        self.base_env, self.reward_config = self._batch.base_env, self._batch.reward_config
        self.observation_space, self.action_space = self._batch.observation_space, self._batch.action_space
        self.metadata = {**self.metadata, "render_fps": self._batch.frames_per_second}
        self._window = _Window(self.metadata["render_fps"]) if self.render_mode == "human" else None
        self._reward, self._steps = 0.0, 0

    @property
    def total_steps(self) -> int:
        """Number of steps since the environment was last seeded."""
        return int(self._batch.total_steps[0])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins the next episode.

        Args:
            seed: seed of this and the following episodes. ``None`` continues with the current seed.
            options: ``"start"`` (x, y in m, yaw in rad) and ``"goal"`` (x, y in m), both optional.

        Raises:
            ValueError: if the seed is out of range, or an option is unknown or has the wrong shape.
        """
        super().reset(seed=None if seed is None else check_seed(seed))
        options = {key: np.asarray(value)[None] for key, value in (options or {}).items()}
        observation = self._batch.reset(seed=seed, options=options)
        self._reward, self._steps = 0.0, 0
        self._show()
        return row_of(observation, 0), {}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Takes one step: 0.05 s, or ``action_repeat`` times as long.

        Args:
            action: forward speed (m/s) and heading offset (rad), ``[2]``. Clipped to the action space.

        Raises:
            ValueError: if the shape is wrong, or values are not finite.
        """
        action = np.asarray(action, np.float32)
        if action.shape != self.action_space.shape:
            raise ValueError(f"action must have shape {self.action_space.shape}, got {action.shape}")
        step = self._batch.step(action[None])
        info = {key: value[0].item() for key, value in step.info.items()}
        self._reward, self._steps = info["reward"], info["steps"]
        self._show()
        return row_of(step.observation, 0), self._reward, bool(step.terminated[0]), bool(step.truncated[0]), info

    def render(self) -> NDArray[np.uint8] | None:
        """Returns an image, uint8 ``[480, 640, 3]``, if the render mode is ``"rgb_array"``, and ``None`` otherwise."""
        return self._batch.picture(0) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Releases the simulator and the window. Idempotent. Later calls of step, reset and render raise an error."""
        self._batch.env.close()
        if self._window is not None:
            self._window.close()

    def _show(self) -> None:
        if self._window is not None and not self._window.dismissed:
            self._window.show(self._batch.picture(0))

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
        """Returns the direction in which the rover has flipped, or ``False``.

        The directions are ``'roll_left'``, ``'roll_right'``, ``'pitch_forward'`` and ``'pitch_backward'``.
        """
        threshold = self.base_env.task.flip_threshold
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
        """Returns whether the rover is outside of the world's bounds."""
        x, y, _ = self.rover_position.tolist()
        (x_low, x_high), (y_low, y_high) = self.base_env.worlds[0].bounds
        return not (x_low <= x <= x_high and y_low <= y <= y_high)

    def _check_robot_connection(self, timeout: float) -> bool:
        """Waits up to ``timeout`` seconds for a live rover's first scan. Returns whether the rover is connected."""
        wait = getattr(self.base_env.simulator, "wait_for_robot", None)
        return self.base_env.robot_connected if wait is None else wait(timeout)

    def pose_array_callback(self, msg: Any) -> None:
        """Passes a ``geometry_msgs/PoseArray`` to a live backend, which uses pose 0; see :meth:`lidar_callback`."""
        self._pass_message("pose", msg)

    def lidar_callback(self, msg: Any) -> None:
        """Passes a ``sensor_msgs/LaserScan`` to a live backend, as if it were received on the topic.

        A malformed message is ignored with a warning.

        Raises:
            RuntimeError: if the backend is a simulator, which generates its own sensor data.
        """
        self._pass_message("scan", msg)

    def imu_callback(self, msg: Any) -> None:
        """Passes a ``sensor_msgs/Imu`` to a live backend; see :meth:`lidar_callback`."""
        self._pass_message("imu", msg)

    def odom_callback(self, msg: Any) -> None:
        """Passes a ``nav_msgs/Odometry`` to a live backend; see :meth:`lidar_callback`."""
        self._pass_message("odometry", msg)

    def _pass_message(self, kind: str, msg: Any) -> None:
        simulator = self.base_env.simulator
        if not hasattr(simulator, "receive"):
            name = type(simulator).__name__
            raise RuntimeError(f"{name}: this backend makes its own sensor data; callbacks are for backend='ros2'")
        simulator.receive(kind, msg)


class RoverEnv(GymWrapper):
    """Drop-in replacement for the original environment: same positional arguments, methods and attributes.

    Args:
        *args: positional arguments of :class:`rover_rl.RoverEnv`: the contract's ten.
        **kwargs: options of :class:`GymWrapper`, and keyword arguments of :class:`rover_rl.RoverEnv` except
            ``num_envs``.

    Example:
        >>> env = RoverEnv(world_n="maze", length=500)
        >>> observation, info = env.reset(seed=0)
        >>> env.too_far_away_penilty
        -10.0
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        if "num_envs" in kwargs:
            raise TypeError("this class is for one rover and takes no num_envs; use GymVectorWrapper for a batch")
        options = pop_options(kwargs)
        super().__init__(BatchedRoverEnv(*args, **kwargs), **options)


def _signature() -> inspect.Signature:
    """Returns the arguments of the batched environment except ``num_envs``, followed by those of the wrapper."""
    batched = inspect.signature(BatchedRoverEnv).parameters
    wrapper = [each for each in inspect.signature(NumpyBatch).parameters.values() if each.kind is each.KEYWORD_ONLY]
    learning = [*inspect.signature(learning_transforms).parameters.values()][1:]
    options = [each.replace(kind=each.KEYWORD_ONLY) for each in (*wrapper, *learning)]
    return inspect.Signature([*(each for name, each in batched.items() if name != "num_envs"), *options])


RoverEnv.__signature__ = _signature()  # type: ignore[attr-defined]


class _Window:
    """Window of pygame for ``render_mode="human"``, of which a process has one. ``dismissed``: the user closed it."""

    def __init__(self, fps: float) -> None:
        # Prevents pygame from printing a greeting to standard output.
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            import pygame
        except ImportError as error:
            raise ImportError('render_mode="human" needs pygame: pip install "rover_rl[human]"') from error
        self._pygame, self._clock, self._fps = pygame, pygame.time.Clock(), fps
        self.dismissed = False
        try:
            pygame.display.init()
        except pygame.error as error:
            raise RuntimeError(f'render_mode="human" needs a display: {error}; "rgb_array" needs none') from error

    def show(self, picture: NDArray[np.uint8]) -> None:
        """Shows an image, uint8 ``[height, width, 3]``, and waits so that there are at most ``fps`` per second."""
        display = self._pygame.display
        size = picture.shape[1], picture.shape[0]
        screen = display.get_surface() if display.get_init() else None
        if screen is None or screen.get_size() != size:
            display.init()
            screen = display.set_mode(size)
            display.set_caption("rover_rl")
        if self._pygame.event.get(self._pygame.QUIT):
            self.dismissed = True
            self.close()
            return
        self._pygame.event.pump()
        screen.blit(self._pygame.image.frombytes(picture.tobytes(), size, "RGB"), (0, 0))
        display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        self._pygame.display.quit()
