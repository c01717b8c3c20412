"""What the robot feels: contact forces by side, and the torques of its wheel motors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import zip_longest

import torch
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.checks import MAX_NUMBER, check_at_least, check_positive
from rover_rl.envs.sensors.base import Sensor, SensorInput, SensorSetup
from rover_rl.envs.specs import Bounds
from rover_rl.robots import Robot
from rover_rl.sims.rover_state import SIDES

MAX_WHEELS = 64
"""Largest number of wheels of an entry."""


@dataclass(frozen=True, kw_only=True)
class ContactSensor(Sensor):
    """Forces of obstacles and of movers on the front, left, back and right of the robot, ``[N, 8]``, N.

    The first four numbers are of obstacles, the last four of movers, other rovers of a group among them. They are
    horizontal normal forces in the base frame, without friction: what pushes backward is in front, what pushes to the
    right is on the left, and a force at an angle counts on two sides, by its components. Forces of all contacts add up.
    Values are means over the physics steps of the last control step, and 0 after a reset. The ground is no contact.

    Args:
        max_force: largest force, to which forces are clipped, N.

    Example:
        >>> env = RoverEnv(world_n="maze", num_envs=2, seed=0, sensors=["contact"])
        >>> env.reset()["contact"].shape
        torch.Size([2, 8])
    """

    name: str = "contact"
    max_force: float = 2000.0
    needs = ("contact_force",)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive(MAX_NUMBER, max_force=self.max_force)

    @property
    def bounds(self) -> Bounds:
        count = 2 * len(SIDES)
        return Bounds((0.0,) * count, (self.max_force,) * count)

    def read(self, inputs: SensorInput) -> Tensor:
        force = inputs.truth.rover.contact_force
        assert force is not None
        return force

    def encode(self, value: Tensor) -> Tensor:
        """Returns a third of the logarithm: 0 without a contact, 1.3 at 50 N, 2.5 at 2000 N."""
        return value.log1p() / 3

    def mirror(self, value: Tensor) -> Tensor:
        return value.unflatten(-1, (2, len(SIDES))).flip(-1).roll(1, -1).flatten(-2)


@dataclass(frozen=True, kw_only=True)
class WheelEffort(Sensor):
    """Torque of the motor of each wheel, ``[N, wheels]``, N m; positive torques drive forward.

    Wheels are in pairs from front to back, the left one first: front left, front right, rear left, rear right. A wheel
    without a motor reads 0, and so do numbers beyond the wheels of the robot. Values are means over the physics steps
    of the last control step, and 0 after a reset.

    Args:
        wheels: number of values, at least that of the robot's wheels. With several robots, the largest of theirs.
        max_torque: largest absolute torque, to which torques are clipped, N m. Motors have limits of their own:
            ``Drive.torque``.

    Example:
        >>> env = RoverEnv(num_envs=2, seed=0, sensors=["effort"])
        >>> env.reset()["effort"].shape
        torch.Size([2, 4])
    """

    name: str = "effort"
    wheels: int = 4
    max_torque: float = 50.0
    needs = ("wheel_torque",)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(1, MAX_WHEELS, wheels=self.wheels)
        check_positive(MAX_NUMBER, max_torque=self.max_torque)

    @property
    def bounds(self) -> Bounds:
        return Bounds((-self.max_torque,) * self.wheels, (self.max_torque,) * self.wheels)

    def reader(self, setup: SensorSetup) -> Callable[[SensorInput], Tensor]:
        """Returns a reader of the wheels of the rows. Raises ``ValueError`` if a robot has more wheels."""
        fleet = setup.fleet
        most = max(len(robot.drive.wheels) for robot in fleet.robots)
        if most > self.wheels:
            raise ValueError(f"sensor {self.name!r} has wheels={self.wheels}, a robot has {most}: set wheels={most}")
        # The simulator has as many columns as the largest number of wheels. One of zeros follows.
        columns = fleet.table(lambda robot: _columns(robot, self.wheels, most), dtype=torch.int64)

        def read(inputs: SensorInput) -> Tensor:
            torque = inputs.truth.rover.wheel_torque
            assert torque is not None
            return pad(torque, (0, 1)).gather(-1, columns[fleet.index])

        return read

    def encode(self, value: Tensor) -> Tensor:
        """Returns half the logarithm of the absolute torque with its sign: 0.9 at 5 N m."""
        return value.sign() * value.abs().log1p() / 2

    def mirror(self, value: Tensor) -> Tensor:
        """Swaps left and right. Raises ``ValueError`` for an odd number of wheels."""
        if self.wheels % 2:
            raise ValueError(
                f"sensor {self.name!r} has no mirror image with wheels={self.wheels}: set an even number, or train "
                "with --no-mirror-augmentation"
            )
        return value.unflatten(-1, (-1, 2)).flip(-1).flatten(-2)


def _columns(robot: Robot, count: int, empty: int) -> list[int]:
    """Returns the indices of a robot's wheels in the order of the entry, ``[count]``; ``empty`` for no wheel."""
    hubs = robot.wheels.hubs
    ahead = sorted(range(len(hubs)), key=lambda wheel: -hubs[wheel][0])
    left, right = ([wheel for wheel in ahead if sign * hubs[wheel][1] > 0] for sign in (1, -1))
    pairs = [wheel for pair in zip_longest(left, right, fillvalue=empty) for wheel in pair]
    order = pairs + [wheel for wheel in ahead if hubs[wheel][1] == 0]
    return (order + [empty] * count)[:count]
