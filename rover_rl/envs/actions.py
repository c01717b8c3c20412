"""Actions as TorchRL transforms: what the numbers that a policy decides mean.

The contract's action, ``heading``, is that of :class:`~rover_rl.RoverEnv` itself. The others are transforms that turn
an action into ``command`` (m/s, rad/s), or into an action of the contract, ``steering``, entries of the tensordict that
the environment then follows. Name one in ``ActionConfig(kind=...)``, ``make_env(action="twist")`` or ``--action``.
"""

from __future__ import annotations

import math
import operator
from abc import abstractmethod
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs.transforms import Transform

from rover_rl.envs.config import ActionConfig, EnvConfig
from rover_rl.envs.parts import ACTIONS, HEADING
from rover_rl.envs.specs import Bounds, bounded_spec
from rover_rl.envs.stages import checked_action
from rover_rl.robots.fleet import Fleet
from rover_rl.tensordicts import in_rows

_TURN = math.radians(60)  # largest heading offset by hand, rad


class Action(Transform):
    """Base class of actions. Subclasses define :meth:`bounds` and :meth:`command`.

    ``limits`` are the bounds for the robots, as ``EnvConfig.bounded_action`` has them, and ``fleet`` has the robot of
    each row. Actions that are not finite raise ``ValueError`` on the CPU; others are clipped to the bounds.

    Example:
        >>> class Throttle(Action):
        ...     '''Speed alone: the rover drives straight ahead.'''
        ...
        ...     @staticmethod
        ...     def bounds(limits):
        ...         return Bounds((0.0,), (limits.max_speed,))
        ...
        ...     def command(self, action, observation):
        ...         return torch.nn.functional.pad(action, (0, 1))
    """

    needs: ClassVar[tuple[str, ...]] = ()
    """Sensors that :meth:`command` reads. The environment has them."""
    steered: ClassVar[bool] = False
    """Whether :meth:`command` returns speed and heading offset, as the contract's action, in place of a command."""

    def __init__(self, limits: ActionConfig, fleet: Fleet) -> None:
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])
        self.limits, self.fleet = limits, fleet
        self._spec, name = self.bounds(limits), type(self).__name__
        if not isinstance(self._spec, Bounds) or not all(map(operator.lt, self._spec.low, self._spec.high)):
            raise ValueError(
                f"{name}.bounds must return Bounds whose low ends are below the high ones, got {self._spec}"
            )
        self._clip = self._spec.tensors(fleet.index.device)

    @staticmethod
    @abstractmethod
    def bounds(limits: ActionConfig) -> Bounds:
        """Returns the bounds of an action, whose number of features is up to the subclass."""

    @abstractmethod
    def command(self, action: Tensor, observation: TensorDictBase) -> Tensor:
        """Returns the commands of actions ``[N, A]`` within the bounds: speed (m/s) and yaw rate (rad/s), ``[N, 2]``.

        ``observation`` is the last one of the rows. With ``max_sideways``, commands have the speed to the left, too.
        """

    @classmethod
    def by_hand(cls, limits: ActionConfig, ahead: float, left: float) -> tuple[float, ...]:
        """Returns the action of a person, who asks for shares of the largest speed and turn, -1 to 1 each.

        By default, they are shares of the bounds of the first two features.
        """
        most = cls.bounds(limits).high
        return (*(share * end for share, end in zip((ahead, left), most, strict=False)), *(0.0 for _ in most[2:]))

    @staticmethod
    def mirror(action: Tensor) -> Tensor:
        """Returns the mirror image of actions ``[..., A]``, for training: by default all but the first change sign."""
        return torch.cat((action[..., :1], -action[..., 1:]), -1)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        rows = in_rows(tensordict)
        action, invalid = checked_action(rows.get("action"), rows.batch_size, self._clip)
        command = self.command(action, rows)
        if not isinstance(command, Tensor):
            raise ValueError(f"{type(self).__name__}.command must return commands, got {type(command).__name__}")
        command = command.masked_fill(invalid, torch.nan)
        command = command if tensordict.batch_dims else command[0]
        return tensordict.set("steering" if self.steered else "command", command)

    def transform_action_spec(self, action_spec: TensorSpec) -> TensorSpec:
        spec = action_spec["action"]
        action_spec["action"] = bounded_spec(self._spec, spec.shape[:-1], spec.device)
        return action_spec


class Heading(Action):
    """The contract's action: forward speed (m/s) and heading offset (rad), to which a PID turns the rover.

    With ``max_sideways``, the speed to the left (m/s) follows. The environment computes its commands itself.
    """

    steered = True

    @staticmethod
    def bounds(limits: ActionConfig) -> Bounds:
        return _with_sideways(limits, limits.max_turn)

    @classmethod
    def by_hand(cls, limits: ActionConfig, ahead: float, left: float) -> tuple[float, ...]:
        speed, _, *sideways = super().by_hand(limits, ahead, left)
        return (speed, left * _TURN, *sideways)

    def command(self, action: Tensor, observation: TensorDictBase) -> Tensor:
        return action


class Twist(Action):
    """Forward speed (m/s) and yaw rate (rad/s): the command itself, as of ``geometry_msgs/Twist``.

    With ``max_sideways``, the speed to the left (m/s) follows.
    """

    @staticmethod
    def bounds(limits: ActionConfig) -> Bounds:
        assert limits.max_yaw_rate is not None
        return _with_sideways(limits, limits.max_yaw_rate)

    def command(self, action: Tensor, observation: TensorDictBase) -> Tensor:
        return action


class WheelSpeeds(Action):
    """Speeds of the left and right wheels over the ground, m/s, for robots with wheels on two sides.

    With the track ``b`` of the drive's kinematics, ``v = (l + r) / 2`` and ``w = (r - l) / b``.

    Raises:
        ValueError: if a robot has another drive.
    """

    def __init__(self, limits: ActionConfig, fleet: Fleet) -> None:
        super().__init__(limits, fleet)
        others = [robot.name for robot in fleet.robots if not hasattr(robot.drive, "track")]
        if others:
            raise ValueError(f"the action 'wheels' needs robots with wheels on two sides, got {others}")
        self._turning = fleet.table(lambda robot: [robot.drive.track(robot.wheels), robot.drive.max_yaw_rate])  # type: ignore[attr-defined]

    @staticmethod
    def bounds(limits: ActionConfig) -> Bounds:
        assert limits.min_speed is not None
        assert limits.max_speed is not None
        return Bounds((limits.min_speed,) * 2, (limits.max_speed,) * 2)

    def command(self, action: Tensor, observation: TensorDictBase) -> Tensor:
        track, most = self._turning[self.fleet.index].split(1, -1)
        left, right = action.split(1, -1)
        return torch.cat(((left + right) / 2, torch.clamp((right - left) / track, -most, most)), -1)

    @classmethod
    def by_hand(cls, limits: ActionConfig, ahead: float, left: float) -> tuple[float, ...]:
        most = cls.bounds(limits).high[0]
        return tuple(most * max(-1.0, min(1.0, ahead + side * left)) for side in (-0.5, 0.5))

    @staticmethod
    def mirror(action: Tensor) -> Tensor:
        return action.flip(-1)


def _with_sideways(limits: ActionConfig, turn: float) -> Bounds:
    assert limits.min_speed is not None
    assert limits.max_speed is not None
    sideways = (limits.max_sideways,) if limits.max_sideways else ()
    low = (limits.min_speed, -turn, *(-side for side in sideways))
    return Bounds(low, (limits.max_speed, turn, *sideways))


def find_action(kind: str) -> type[Action]:
    """Returns the class of an action by its name or ``"module:attribute"``. Raises ``ValueError`` for anything else."""
    found = ACTIONS.find(kind)
    if not (isinstance(found, type) and issubclass(found, Action)):
        raise ValueError(f"action must be one of {ACTIONS.names()}, or an Action class, got {kind!r}")
    return found


def action_bounds(action: ActionConfig) -> Bounds:
    """Returns the bounds of an action: of the contract's, forward speed (m/s) and heading offset (rad).

    Where ``action`` states no speed, it is that of the default robot: see ``EnvConfig.bounded_action`` for others.
    """
    if action.min_speed is None or action.max_speed is None:
        action = action.for_robot(EnvConfig.robot)
    return find_action(action.kind).bounds(action)


ACTION = action_bounds(ActionConfig())
"""Bounds of the contract's action: forward speed (m/s) and heading offset (rad)."""


def action_transforms(config: EnvConfig, fleet: Fleet) -> list[Transform]:
    """Returns the transform of an environment's action: none for the contract's."""
    kind = config.action.kind
    return [] if kind == HEADING else [find_action(kind)(config.bounded_action, fleet)]
