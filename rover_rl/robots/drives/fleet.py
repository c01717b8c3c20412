"""``FleetDrive``: the drives of a batch of different robots, as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.robots.drives.base import Drive, Equations, Joints, Wheels
from rover_rl.robots.fleet import Fleet


class FleetDrive:
    """Drives of the rows of a batch, computed together for each kind of drive, for :class:`SimulatedDrives`.

    Robots whose drives have no :class:`~rover_rl.robots.drives.base.Equations` are a kind of their own each. Set
    points, joints and twists of all kinds have the size of the largest ones, and are 0 beyond their own.

    Args:
        fleet: robots of the rows.
        dt: duration of a control step, s.

    Attributes:
        motors, steering: numbers of motors and of steering joints.
        set_point_size: number of components of a set point.
        sideways: whether any robot moves sideways.
    """

    def __init__(self, fleet: Fleet, dt: float) -> None:
        drives = [robot.drive for robot in fleet.robots]
        self._fleet = fleet
        self.motors = max(len(drive.motors) for drive in drives)
        self.steering = max(len(drive.steering) for drive in drives)
        self.set_point_size = max(drive.set_point_size for drive in drives)
        self.sideways = any(drive.sideways for drive in drives)
        self._kinds = _kinds_of(fleet, dt)

    def advance(self, set_point: Tensor, command: Tensor) -> Tensor:
        """Returns the set points after a step, ``[N, set_point_size]``."""
        parts = [law.advance(set_point[:, : kind.size], command[:, : kind.twist_size]) for kind, law in self._laws()]
        return self._merged(parts, self.set_point_size)

    def targets(self, before: Tensor, after: Tensor) -> Joints:
        """Returns the targets of the joints in a step, ``[N, motors]`` and ``[N, steering]``."""
        parts = [law.targets(before[:, : kind.size], after[:, : kind.size]) for kind, law in self._laws()]
        speeds, angles = [joints.speeds for joints in parts], [joints.angles for joints in parts]
        return Joints(self._merged(speeds, self.motors), self._merged(angles, self.steering))

    def odometry(self, joints: Joints) -> Tensor:
        """Returns the twists that the joints report, ``[N, 3]`` if any robot moves sideways, else ``[N, 2]``."""
        parts = [
            law.odometry(Joints(joints.speeds[:, : kind.motors], joints.angles[:, : kind.steering]))
            for kind, law in self._laws()
        ]
        return self._merged(parts, 3 if self.sideways else 2)

    def _laws(self) -> list[tuple[_Kind, Equations | OneDrive]]:
        return [(kind, kind.law(self._fleet.index)) for kind in self._kinds]

    def _merged(self, parts: Sequence[Tensor], size: int) -> Tensor:
        """Returns what each kind has computed in its rows, with zeros up to ``size``, ``[N, size]``."""
        first, *others = (pad(part, (0, size - part.shape[-1])) for part in parts)
        for kind, part in zip(self._kinds[1:], others, strict=True):
            first = torch.where(kind.rows[:, None], part, first)
        return first


@dataclass(frozen=True)
class OneDrive:
    """The same drive in all rows, by the methods of :class:`Drive`."""

    drive: Drive
    wheels: Wheels
    dt: float

    @property
    def motors(self) -> int:
        """Number of motors."""
        return len(self.drive.motors)

    @property
    def set_point_size(self) -> int:
        """Number of components of a set point."""
        return self.drive.set_point_size

    @property
    def sideways(self) -> bool:
        """Whether the robot moves sideways."""
        return self.drive.sideways

    def advance(self, set_point: Tensor, command: Tensor) -> Tensor:
        """See :meth:`Drive.advance`."""
        return self.drive.advance(set_point, command, self.wheels, self.dt)

    def targets(self, before: Tensor, after: Tensor) -> Joints:
        """See :meth:`Drive.targets`."""
        return self.drive.targets(before, after, self.wheels)

    def odometry(self, joints: Joints) -> Tensor:
        """See :meth:`Drive.odometry`."""
        return self.drive.odometry(joints, self.wheels)


class _Kind:
    """Robots of a fleet whose drives are computed together.

    Args:
        drive: drive of one of them.
        law: its equations.
        number: position of each robot in the stack of equations, int64 ``[K]``; 0 for robots of other kinds.
        members: robots of this kind, bool ``[K]``.

    Attributes:
        rows: rows of this kind after :meth:`law`, bool ``[N]``.
    """

    def __init__(self, drive: Drive, law: Equations | OneDrive, number: Tensor, members: Tensor) -> None:
        self.size, self.twist_size = drive.set_point_size, 3 if drive.sideways else 2
        self.motors, self.steering = len(drive.motors), len(drive.steering)
        self._stack, self._number, self._members = law, number, members
        self._law, self._index = law, torch.empty(0)
        self.rows = members

    def law(self, index: Tensor) -> Equations | OneDrive:
        """Returns the equations of rows by the index of their robot, ``[N]``; meaningless for rows of other kinds."""
        if index is not self._index:
            self._index, self.rows = index, self._members[index]
            if isinstance(self._stack, Equations):
                self._law = self._stack.of_rows(self._number[index])
        return self._law


def _kinds_of(fleet: Fleet, dt: float) -> list[_Kind]:
    """Returns the kinds of drives in a fleet: by class and joints, or by robot for drives without equations."""
    device = fleet.index.device
    groups: dict[str, list[tuple[int, Equations | OneDrive]]] = {}
    for number, robot in enumerate(fleet.robots):
        law = robot.drive.equations(robot.wheels, dt, device) if _has_equations(type(robot.drive)) else None
        key: Any = (robot.drive, robot.wheels)
        if law is not None:
            key = type(law), {name: value.shape for name, value in vars(law).items()}
        groups.setdefault(repr(key), []).append((number, law or OneDrive(robot.drive, robot.wheels, dt)))
    return [_kind(fleet, [number for number, _ in members], [law for _, law in members]) for members in groups.values()]


def _kind(fleet: Fleet, members: Sequence[int], laws: Sequence[Any]) -> _Kind:
    """Returns the kind of some robots, by their numbers in the fleet."""
    chosen = torch.tensor(members, device=fleet.index.device)
    numbers = torch.zeros(len(fleet.robots), dtype=torch.int64, device=chosen.device)
    is_member = torch.zeros_like(numbers, dtype=torch.bool).index_fill(0, chosen, True)
    numbers[chosen] = torch.arange(len(members), device=chosen.device)
    law = laws[0].stacked_with(laws[1:]) if isinstance(laws[0], Equations) else laws[0]
    return _Kind(fleet.robots[members[0]].drive, law, numbers, is_member)


def _has_equations(kind: type[Drive]) -> bool:
    """Whether the equations of a class are those of its methods, which a subclass may have changed."""
    names = ("equations", "advance", "targets", "odometry")
    return len({next(base for base in kind.__mro__ if name in vars(base)) for name in names}) == 1
