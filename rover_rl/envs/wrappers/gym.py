"""One rover as a Gymnasium environment, with the contract's interface."""

from __future__ import annotations

import copy
import inspect
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torchrl.envs import EnvBase

from rover_rl.checks import check_seed
from rover_rl.envs.rewards import RewardConfig
from rover_rl.envs.rover import RoverEnv as BatchedRoverEnv
from rover_rl.envs.wrappers.gym_vector import GymVectorWrapper, make_vector_env
from rover_rl.envs.wrappers.numpy_batch import (
    NumpyBatch,
    Observation,
    Reward,
    TimeLimit,
    base_env,
    frames_per_second,
    row_of,
)
from rover_rl.envs.wrappers.original_names import OriginalNames
from rover_rl.envs.wrappers.window import Window
from rover_rl.sims.base import View
from rover_rl.sims.timing import CONTROL_DT

__all__ = ["GymVectorWrapper", "GymWrapper", "RoverEnv", "make_vector_env"]


class GymWrapper(OriginalNames, gymnasium.Env[Any, Any]):
    """A :class:`rover_rl.RoverEnv` of one rover as a ``gymnasium.Env`` with every method of the contract.

    Observations are the contract's five float32 arrays; the action is ``[2]``: forward speed (m/s) and
    heading offset (rad). ``info`` of a step holds ``steps`` (of the episode), ``total_steps`` (since the last
    seed), ``reward``, ``goals`` (reached in this episode), ``is_success`` (whether there was one) and a bool
    for each event: ``goal_reached``, ``collision``, ``flipped``, ``jammed``, ``out_of_bounds``, ``stuck``,
    ``invalid_action``.

    Args:
        env: a ``RoverEnv`` with ``num_envs=1`` or ``None``, or a ``TransformedEnv`` made from one (as by
            :func:`rover_rl.make_env`).
        reward: for a bare ``RoverEnv``: ``"contract"`` (``None`` means the same), ``"task"``, a
            ``RewardConfig`` or a list of components; a ``TransformedEnv`` keeps its own.
        time_limit: ``"terminated"`` as the contract says (``truncated`` is never True), or ``"truncated"`` as
            Gymnasium means it.
        render_mode: ``None``; ``"rgb_array"``, for pictures by :meth:`render`; or ``"human"``, which shows one in a
            window after each reset and step, at 20 steps a second (extra ``human``).
        camera: where pictures are taken from: behind the rover (``"chase"``) or above it (``"top"``).

    Raises:
        TypeError: if ``env`` is neither.
        ValueError: for more than one rover, or an unknown option.
        ImportError: for ``"human"`` without pygame.
        RuntimeError: for ``"human"`` without a display.

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
    ) -> None:
        rovers = base_env(env).num_envs
        if rovers != 1:
            raise ValueError(f"GymWrapper is for one rover, got num_envs={rovers}; use GymVectorWrapper for a batch")
        modes = [None, *self.metadata["render_modes"]]
        if render_mode not in modes:
            raise ValueError(f"render_mode must be one of {modes}, got {render_mode!r}")
        human = render_mode == "human"
        self.metadata = {**self.metadata, "render_fps": frames_per_second(env)}
        self._window = Window("rover_rl", self.metadata["render_fps"]) if human else None
        pictures = "rgb_array" if human else render_mode
        self._batch = NumpyBatch(env, reward=reward, time_limit=time_limit, render_mode=pictures, camera=camera)
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
        """Numbers of the contract's reward; ``None`` where the reward is another, or was added elsewhere."""
        return self._batch.reward_config

    @property
    def _step(self) -> int:
        """Steps of this episode, by the original's name."""
        return self._steps

    @property
    def total_steps(self) -> int:
        """Steps since the environment was seeded last."""
        return int(self._batch.total_steps[0])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins the next episode.

        Args:
            seed: the same seed gives the same episodes from here on; ``None`` goes on to the next one.
            options: may hold ``"start"`` (x, y in m, yaw in rad) and ``"goal"`` (x, y in m).

        Returns:
            The observation and an empty info.

        Raises:
            ValueError: for a seed out of range, another option, or one of the wrong shape.
        """
        super().reset(seed=None if seed is None else check_seed(seed))
        options = {key: np.asarray(value)[None] for key, value in (options or {}).items()}
        observation = self._batch.reset(seed=seed, options=options)
        self._reward, self._steps = 0.0, 0
        self._show()
        return row_of(observation, 0), {}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """One step of 0.05 s.

        Args:
            action: ``[2]``: forward speed (m/s) and heading offset (rad); clipped to the action space.

        Returns:
            Observation, reward, terminated, truncated and info.

        Raises:
            ValueError: for another shape, or numbers that are not finite.
        """
        action = np.asarray(action, np.float32)
        if action.shape != self.action_space.shape:
            raise ValueError(f"action must have shape {self.action_space.shape}, got {action.shape}")
        step = self._batch.step(action[None])
        info = {key: value[0].item() for key, value in step.info.items()}
        self._reward, self._steps = info["reward"], info["steps"]
        self._show()
        return (
            row_of(step.observation, 0),
            self._reward,
            bool(step.terminated[0]),
            bool(step.truncated[0]),
            info,
        )

    def render(self) -> NDArray[np.uint8] | None:
        """A picture ``[480, 640, 3]``; ``None`` without a render mode, and where a window shows it."""
        return self._batch.picture(0) if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Releases the simulator and the window. Idempotent. Afterwards step, reset and render raise."""
        self._batch.env.close()
        if self._window is not None:
            self._window.close()

    def _show(self) -> None:
        if self._window is not None and not self._window.dismissed:
            self._window.show(self._batch.picture(0))

    def get_observation(self) -> Observation:
        """The present observation, without moving anything."""
        return row_of(self._batch.observation(), 0)

    def get_target_info(self) -> NDArray[np.float32]:
        """Distance (m) and angle relative to the heading (rad) of the goal: ``[2]``."""
        return self.get_observation()["target"]

    def task_reward(self) -> float:
        """The reward of the present state: the last step's, or 0 before the first. Asking changes nothing."""
        return self._reward

    def is_robot_flipped(self) -> str | bool:
        """Which way the rover has fallen over, or False.

        ``'roll_left'``, ``'roll_right'``, ``'pitch_forward'`` or ``'pitch_backward'``.
        """
        threshold = self.base_env.task.flip_threshold
        roll, pitch = self.current_roll, self.current_pitch
        if abs(roll) > threshold:
            return "roll_left" if roll > 0 else "roll_right"
        if abs(pitch) > threshold:
            return "pitch_forward" if pitch < 0 else "pitch_backward"
        return False

    def heading_controller(self, desired_heading: float, current_heading: float) -> float:
        """The yaw rate (rad/s) that the PID would command now, for headings in rad.

        A question only: the running episode's PID does not notice.
        """
        # The controller replaces its memory and never writes into it: the call changes only the copy.
        controller = copy.copy(self.base_env.controller)
        dt = self.base_env.sensed_state.dt
        desired, current = (torch.full_like(dt, float(heading)) for heading in (desired_heading, current_heading))
        return controller(desired, current, dt).item()

    def too_far_away(self) -> bool:
        """Whether the rover is outside of the world's bounds."""
        x, y, _ = self.rover_position.tolist()
        (x_low, x_high), (y_low, y_high) = self.base_env.worlds[0].bounds
        return not (x_low <= x <= x_high and y_low <= y <= y_high)

    @property
    def _robot_connected(self) -> bool:
        """Whether there is a rover to drive, by the original's name."""
        return self.base_env.robot_connected

    def _check_robot_connection(self, timeout: float) -> bool:
        """Waits for a live rover's first scan (s); whether it came. Simulated rovers are there."""
        wait = getattr(self.base_env.simulator, "wait_for_robot", None)
        return self.base_env.robot_connected if wait is None else wait(timeout)

    def pose_array_callback(self, msg: Any) -> None:
        """Hands a ``geometry_msgs/PoseArray`` to a live backend; its first pose counts. See :meth:`lidar_callback`."""
        self._hand_over("pose", msg)

    def lidar_callback(self, msg: Any) -> None:
        """Hands a ``sensor_msgs/LaserScan`` to a live backend, as if it had come over its topic.

        Any object with the message's attributes will do; a malformed one is left out with a warning.

        Raises:
            RuntimeError: if the backend makes its own sensor data, as Bullet does.
        """
        self._hand_over("scan", msg)

    def imu_callback(self, msg: Any) -> None:
        """Hands a ``sensor_msgs/Imu`` to a live backend; see :meth:`lidar_callback`."""
        self._hand_over("imu", msg)

    def odom_callback(self, msg: Any) -> None:
        """Hands a ``nav_msgs/Odometry`` to a live backend; see :meth:`lidar_callback`."""
        self._hand_over("odometry", msg)

    def _hand_over(self, kind: str, msg: Any) -> None:
        receive = getattr(self.base_env.simulator, "receive", None)
        if receive is None:
            raise RuntimeError(
                f"{type(self.base_env.simulator).__name__}: this backend makes its own sensor data; "
                "callbacks are for backend='ros2'"
            )
        receive(kind, msg)


class RoverEnv(GymWrapper):
    """Drop-in for the original: the same ten arguments in the same order, the same methods and attributes.

    Args:
        *args, **kwargs: arguments of :class:`rover_rl.RoverEnv` without ``num_envs``: the contract's ten arguments,
            then keywords.
        reward, time_limit, render_mode, camera: see :class:`GymWrapper`.

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
            raise TypeError("this class is one rover and takes no num_envs; use GymVectorWrapper for a batch")
        env = BatchedRoverEnv(*args, **kwargs)
        super().__init__(env, reward=reward, time_limit=time_limit, render_mode=render_mode, camera=camera)


def _signature() -> inspect.Signature:
    """The arguments of the batched environment without ``num_envs``, then those of the wrapper."""
    batched = inspect.signature(BatchedRoverEnv).parameters
    own = inspect.signature(RoverEnv.__init__).parameters
    forwarded = [parameter for name, parameter in batched.items() if name != "num_envs"]
    added = [parameter for parameter in own.values() if parameter.kind is parameter.KEYWORD_ONLY]
    return inspect.Signature([*forwarded, *added])


RoverEnv.__signature__ = _signature()  # type: ignore[attr-defined]
