"""``Simulator``: the interface between the environment and its simulators, one of which is a real rover."""

from __future__ import annotations

from collections.abc import Collection
from typing import Literal, Protocol, TypeAlias

import torch
from torch import Tensor

from rover_rl.sims.movers.field import MoverField
from rover_rl.sims.rover_state import Dynamics, Force, RoverState
from rover_rl.sims.sensor_report import ImageKind
from rover_rl.worlds import World

View: TypeAlias = Literal["chase", "top"]
Feature: TypeAlias = Literal["contacts", "dynamics", "lidar", "movers", "robots", "worlds"] | Force
"""Optional feature of a simulator, which has the method of :class:`Simulator` that names it.

With ``"contacts"``, states have :attr:`RoverState.contact`."""
MAX_AGE = 1.0
"""Age of messages above which their stamps are of another clock, s."""


class Scanner(Protocol):
    """A planar lidar on every rover.

    Attributes:
        angles: direction of each beam in the rover's frame, counter-clockwise from straight ahead, ``[beams]``, rad.
    """

    angles: Tensor

    def scan(self, rows: Tensor | None = None) -> Tensor:
        """Scans from where the rovers are, and returns the ranges, ``[N, beams]``, m, in a new tensor.

        ``inf`` means no return, 0 a beam that starts inside a solid. ``rows`` are the rovers whose lidar scans, bool
        ``[N]``; ``None``: all. The others keep their last scan. A real lidar has its own period.
        """


class LiveRover(Scanner, Protocol):
    """What a real rover has and a simulated one does not: messages, which have an age, and what is in them.

    A ``topic`` of ``None`` is that of the connection. Images have ``size`` rows and columns.

    Attributes:
        last_command: forward speed (m/s) and yaw rate (rad/s) of the last command, within the limits.
    """

    @property
    def last_command(self) -> tuple[float, float]: ...

    def state_age(self) -> Tensor:
        """Age of the state, ``[N, 1]``, s; at most ``MAX_AGE``."""

    def scan_pose(self) -> tuple[Tensor, Tensor]:
        """Position ``[N, 3]`` (m) and orientation ``[N, 4]`` of the rovers at the time of their last scans."""

    def covered(self) -> Tensor:
        """Which beams of the latest scan a valid reading covers, bool ``[1, beams]``."""

    def segments(self, points: int) -> Tensor | None:
        """Nearest reading of each segment of the latest raw scan, ``[1, points]``, m; ``inf`` for none.

        ``None`` if it has fewer readings than segments.
        """

    def image(self, of: ImageKind, topic: str | None, size: tuple[int, int]) -> Tensor:
        """Latest image, zeros before the first one. Distances are ``inf`` without a return, 0 if lost or too near."""

    def point_cloud(self, topic: str | None) -> Tensor | None:
        """Latest points of a 3D lidar in its own frame, ``[P, 3]``, m; ``None`` before the first ones."""

    def ground_at(
        self, grid: Tensor, yaw: Tensor, cell: float, topic: str | None, layer: str, mount: tuple[float, float, float]
    ) -> Tensor:
        """Heights of the ground in the world frame, ``[rows, columns]``, m; NaN where none is known.

        Args:
            grid: points of a grid in the world frame, ``[rows, columns, 2]``, m. Rows follow one another backward, and
                columns to the right.
            yaw: direction that is ahead, ``[]``, rad.
            cell: distance between two neighbors, m.
            topic: topic of an elevation map with ``layer``, or of a point cloud.
            mount: position of the lidar whose frame the point cloud is in, in the frame of the robot, m.
        """


class Simulator:
    """Base of all simulators: a batch of simulated rovers, or one real rover.

    A simulator that runs on a GPU takes and returns GPU tensors. It never writes to a tensor after returning it. What
    ``features`` does not name need not be there.

    Attributes:
        num_envs: number of rovers N, the number of rows of every tensor.
        control_dt: duration of a control step, s.
        device: device of the tensors.
        features: optional features.
        is_level: whether rovers never pitch or roll.
        live: the real rover, around which nothing is known but the map. ``None`` in simulation.
        robot_connected: whether the rovers are connected. Always true in simulation.
    """

    num_envs: int
    control_dt: float
    device: torch.device
    features: frozenset[Feature] = frozenset()
    is_level: bool = False

    @property
    def live(self) -> LiveRover | None:
        return None

    @property
    def robot_connected(self) -> bool:
        return True

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        """Places the rovers of ``mask`` (bool ``[N]``) on the ground, at rest, and returns the state of all rovers.

        ``poses`` are x, y (m) and yaw (rad), ``[N, 3]``. The other rovers do not change.
        """
        raise NotImplementedError

    def state(self) -> RoverState:
        """Returns the current state without advancing time."""
        raise NotImplementedError

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        """Advances the rovers by one control step, and returns the state of all rovers.

        Args:
            commands: forward speed (m/s) and counter-clockwise yaw rate (rad/s), ``[N, 2]``; for a drive that moves
                sideways, also with the speed to the left (m/s), ``[N, 3]``.
            active: rovers to advance, bool ``[N]``. No time passes for the others. ``None`` advances all.
        """
        raise NotImplementedError

    def render(self, row: int, view: View, width: int, height: int, goal: Tensor | None = None) -> Tensor:
        """Renders one rover, from behind (``"chase"``) or above (``"top"``): uint8 ``[height, width, 3]``.

        ``goal`` is the position of its goal, ``[2]``, m. ``None`` draws no goal.
        """
        raise NotImplementedError(f"{type(self).__name__} has no rendering")

    def close(self) -> None:
        """Releases all resources. Idempotent."""

    def scanner(self, beams: int) -> Scanner:
        """Creates a lidar at the robot's ``lidar_position`` whose beams are equally spaced over a full turn.

        Feature ``"lidar"``. Without it, rays are cast.
        """
        raise NotImplementedError

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        """Sets the dynamics of the rovers of ``mask`` (bool ``[N]``), which the caller resets next.

        Feature ``"dynamics"``. ``dynamics`` holds the factors of all rovers.
        """
        raise NotImplementedError

    def add_movers(self, movers: MoverField) -> None:
        """Lets movers push the rovers from now on. Feature ``"movers"``.

        Before each step, the caller moves them. In the step, each part goes from where it was before at its
        ``velocity`` and ``turn`` to where it is. Movers are too heavy to be pushed, and those of a row touch no rover
        of another row.
        """
        raise NotImplementedError

    def measure(self, fields: Collection[Force]) -> None:
        """Adds these fields to the states from now on, each a feature. Before, they cost nothing.

        It is called once, right after the simulator is built. The caller resets all rovers next.
        """
        raise NotImplementedError

    def enter_robots(self, mask: Tensor) -> None:
        """Gives the rovers of ``mask`` (bool ``[N]``) their robots of the fleet, with the dynamics of these.

        Feature ``"robots"``: the simulator is built with a :class:`~rover_rl.robots.fleet.Fleet`, whose rows change
        robots. The caller resets these rovers next.
        """
        raise NotImplementedError

    def enter_worlds(self) -> None:
        """Moves rovers to their worlds in the table, after these have changed. The caller resets these rovers next.

        Feature ``"worlds"``; without it, a rover keeps its first world. The simulator is built with a
        :class:`~rover_rl.worlds.table.WorldTable`, whose rows change worlds. It holds worlds by slot. If a pool has no
        more worlds than rovers, all of them are in slots from the start.
        """
        raise NotImplementedError

    def prepare_world(self, world: World) -> None:
        """Prepares a world that rovers may move to soon, which makes :meth:`enter_worlds` faster.

        It may run in another thread, at the same time as the other methods.
        """
