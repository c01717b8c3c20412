"""Gymnasium environment of one rover, with the contract's interface."""

from __future__ import annotations

import copy
import inspect
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torchrl.envs import EnvBase

from rover_rl.checks import check_seed
from rover_rl.envs.rewards import RewardConfig
from rover_rl.envs.rover import RoverEnv as BatchedRoverEnv
from rover_rl.envs.wrappers.gym_vector import GymVectorWrapper, make_vector_env
from rover_rl.envs.wrappers.learning_options import LearningOptions, Reward, base_env, learning_transforms, pop_options
from rover_rl.envs.wrappers.numpy_batch import NumpyBatch, Observation, TimeLimit, row_of
from rover_rl.envs.wrappers.original_names import OriginalNames
from rover_rl.envs.wrappers.window import Window
from rover_rl.sims.base import View
from rover_rl.sims.timing import CONTROL_DT

if TYPE_CHECKING:
    from typing_extensions import Unpack

__all__ = ["GymVectorWrapper", "GymWrapper", "RoverEnv", "make_vector_env"]


class GymWrapper(OriginalNames, gymnasium.Env[Any, Any]):
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
        **options: ``action_repeat``, ``reward_scale`` and ``scale_observations``, with which algorithms learn at their
            default settings: see :class:`~rover_rl.envs.wrappers.learning_options.LearningOptions`.

    Raises:
        TypeError: if ``env`` has another type.
        ValueError: if there is more than one rover, or an option is unknown.
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

    def __init__(
        self,
        env: EnvBase,
        *,
        reward: Reward | None = None,
        time_limit: TimeLimit = "terminated",
        render_mode: str | None = None,
        camera: View = "chase",
        **options: Unpack[LearningOptions],
    ) -> None:
        rovers = base_env(env).num_envs
        if rovers != 1:
            raise ValueError(f"GymWrapper is for one rover, got num_envs={rovers}; use GymVectorWrapper for a batch")
        modes = [None, *self.metadata["render_modes"]]
        if render_mode not in modes:
            raise ValueError(f"render_mode must be one of {modes}, got {render_mode!r}")
        human = render_mode == "human"
        batch_mode = "rgb_array" if human else render_mode
        self._batch = NumpyBatch(
            env, reward=reward, time_limit=time_limit, render_mode=batch_mode, camera=camera, options=options
        )
        self.metadata = {**self.metadata, "render_fps": self._batch.frames_per_second}
        self._window = Window("rover_rl", self.metadata["render_fps"]) if human else None
        self.observation_space = self._batch.observation_space
        self.action_space = self._batch.action_space
        self.render_mode = render_mode
        self._reward = 0.0
        self._steps = 0

    @property
    def base_env(self) -> BatchedRoverEnv:
        """The ``RoverEnv`` under the transforms."""
        return self._batch.base_env

    @property
    def reward_config(self) -> RewardConfig | None:
        """Parameters of the contract's reward. ``None`` if this class has not added it."""
        return self._batch.reward_config

    @property
    def _step(self) -> int:
        """Number of steps in the episode. The original environment uses this name."""
        return self._steps

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

        Returns:
            The observation and an empty info.

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

        Returns:
            Observation, reward, terminated, truncated and info.

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
        return (row_of(step.observation, 0), self._reward, bool(step.terminated[0]), bool(step.truncated[0]), info)

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
        """Returns the yaw rate (rad/s) that the heading PID would command, without changing the state of the PID.

        Args:
            desired_heading: desired heading in the world frame, rad.
            current_heading: current heading in the world frame, rad.
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

    @property
    def _robot_connected(self) -> bool:
        """Whether the rover is connected. The original environment uses this name."""
        return self.base_env.robot_connected

    def _check_robot_connection(self, timeout: float) -> bool:
        """Waits up to ``timeout`` seconds for a live rover's first scan. Returns whether the rover is connected."""
        wait = getattr(self.base_env.simulator, "wait_for_robot", None)
        return self.base_env.robot_connected if wait is None else wait(timeout)

    def pose_array_callback(self, msg: Any) -> None:
        """Passes a ``geometry_msgs/PoseArray`` to a live backend, which uses pose 0; see :meth:`lidar_callback`."""
        self._pass_message("pose", msg)

    def lidar_callback(self, msg: Any) -> None:
        """Passes a ``sensor_msgs/LaserScan`` to a live backend, as if it were received on the topic.

        Args:
            msg: object with the attributes of the message. A malformed message is ignored with a warning.

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
        receive = getattr(self.base_env.simulator, "receive", None)
        if receive is None:
            raise RuntimeError(
                f"{type(self.base_env.simulator).__name__}: this backend makes its own sensor data; "
                "callbacks are for backend='ros2'"
            )
        receive(kind, msg)


class RoverEnv(GymWrapper):
    """Drop-in replacement for the original environment: same positional arguments, methods and attributes.

    Args:
        *args: positional arguments of :class:`rover_rl.RoverEnv`: the contract's ten.
        reward, time_limit, render_mode, camera: see :class:`GymWrapper`.
        **kwargs: ``action_repeat``, ``reward_scale`` and ``scale_observations`` of :class:`GymWrapper`, and keyword
            arguments of :class:`rover_rl.RoverEnv` except ``num_envs``.

    Example:
        >>> env = RoverEnv(world_n="maze", length=500)
        >>> observation, info = env.reset(seed=0)
        >>> env.too_far_away_penilty
        -10.0
    """

    def __init__(
        self,
        *args: Any,
        reward: Reward = "contract",
        time_limit: TimeLimit = "terminated",
        render_mode: str | None = None,
        camera: View = "chase",
        **kwargs: Any,
    ) -> None:
        if "num_envs" in kwargs:
            raise TypeError("this class is for one rover and takes no num_envs; use GymVectorWrapper for a batch")
        options = pop_options(kwargs)
        env = BatchedRoverEnv(*args, **kwargs)
        super().__init__(env, reward=reward, time_limit=time_limit, render_mode=render_mode, camera=camera, **options)


def _signature() -> inspect.Signature:
    """Returns the arguments of the batched environment except ``num_envs``, followed by those of the wrapper."""
    batched = inspect.signature(BatchedRoverEnv).parameters
    own = inspect.signature(RoverEnv.__init__).parameters
    forwarded = [parameter for name, parameter in batched.items() if name != "num_envs"]
    added = [parameter for parameter in own.values() if parameter.kind is parameter.KEYWORD_ONLY]
    options = [*inspect.signature(learning_transforms).parameters.values()][1:]
    options = [parameter.replace(kind=parameter.KEYWORD_ONLY) for parameter in options]
    return inspect.Signature([*forwarded, *added, *options])


RoverEnv.__signature__ = _signature()  # type: ignore[attr-defined]
