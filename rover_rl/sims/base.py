"""Interface between the task and the simulation and hardware backends."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol, TypeAlias, runtime_checkable

import torch
from tensordict import TensorClass
from torch import Tensor

from rover_rl.tensordicts import unchecked_tensordict

if TYPE_CHECKING:
    from rover_rl.sims.movers.field import MoverField
    from rover_rl.worlds import World

View: TypeAlias = Literal["chase", "top"]
Report: TypeAlias = Literal["contact_force", "wheel_torque"]
"""Fields of :class:`RoverState` that a simulator measures only if asked: see :class:`Reporter`."""
Capability: TypeAlias = Literal["contacts", "dynamics", "lidar", "live", "movers", "robots"] | Report
"""What not every backend does: it reports contacts, scales the dynamics of each rover, has a lidar of its own (a
:class:`LidarCarrier`; else, rays are cast), drives a live rover, around which nothing is known but the map, lets movers
push the rovers (a :class:`MoverCarrier`), simulates different robots in one batch (a :class:`RobotChanger`), or
measures contact forces or motor torques if asked (a :class:`Reporter`)."""


class RoverState(TensorClass):
    """Batched rover state, with batch size ``[N]``. Tensors are float32 unless stated otherwise.

    Attributes:
        position: position of the base frame in the world frame, ``[N, 3]``, m.
        orientation: orientation of the base frame, unit quaternion (x, y, z, w), ``[N, 4]``.
        linear_velocity: forward speed from wheel odometry, ``[N, 1]``, m/s.
        angular_velocity: counter-clockwise yaw rate from wheel odometry, ``[N, 1]``, rad/s.
        dt: duration of the last step, ``[N, 1]``, s.
        stamp: time of the state, ``[N, 1]``, s, float64.
        contact: whether any part of the rover, chassis or wheel, touched an obstacle in the last control step, in any
            of its physics steps, bool ``[N, 1]``. The ground is no obstacle, whether it carries the wheels or scrapes
            the chassis. False after a reset. ``None`` if the backend does not report contacts.
        lateral_velocity: speed to the left from wheel odometry, ``[N, 1]``, m/s. ``None`` for a drive that does not
            move sideways.
        mover_contact: whether the rover touched a mover in the last control step, bool ``[N, 1]``. ``contact`` is true,
            too, then. ``None`` if the simulator has no movers.
        contact_force: horizontal normal forces on the rover by the side that they come from, front, left, back and
            right in the base frame: those of obstacles, then those of movers, ``[N, 8]``, N. Sums over the contacts,
            and means over the physics steps of the last control step. Zero after a reset. ``None`` unless asked for.
        wheel_torque: torque that the motor of each wheel exerts on it, in the order of ``Drive.wheels``,
            ``[N, W]``, N m, the mean over the physics steps of the last control step. Positive torques drive forward.
            Zero after a reset, for a wheel without a motor, and beyond the wheels of a robot that has fewer than others
            of the batch. ``None`` unless asked for.
    """

    position: Tensor
    orientation: Tensor
    linear_velocity: Tensor
    angular_velocity: Tensor
    dt: Tensor
    stamp: Tensor
    contact: Tensor | None = None
    lateral_velocity: Tensor | None = None
    mover_contact: Tensor | None = None
    contact_force: Tensor | None = None
    wheel_torque: Tensor | None = None

    @classmethod
    def pack(cls, **fields: Tensor) -> RoverState:
        """Creates a state without checking the shapes of its tensors, which saves time in every step."""
        return cls.from_tensordict(unchecked_tensordict(fields, fields["position"].shape[:1]))


@dataclass(frozen=True)
class Dynamics:
    """Scale factors of the dynamics of simulated rovers, relative to the robot description. Float32 ``[N]`` each.

    Attributes:
        friction: factor of all friction coefficients.
        chassis_mass: factor of the mass and inertia of the chassis. The wheels keep theirs.
        motor_torque: factor of the maximum torque of the wheel motors.
    """

    friction: Tensor
    chassis_mass: Tensor
    motor_torque: Tensor


def beam_angles(beams: int) -> Tensor:
    """Returns directions that are equally spaced over a full turn, from straight ahead, float64 ``[beams]``, rad."""
    return torch.arange(beams, dtype=torch.float64) * (2 * math.pi / beams)


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

        ``inf`` means no return, 0 a beam that starts inside a solid.

        Args:
            rows: rovers whose lidar scans, bool ``[N]``. The others keep their last scan. ``None``: all. A real lidar
                has its own period.
        """
        ...


@runtime_checkable
class StampedSensors(Protocol):
    """A live backend: the messages of its sensors have stamps, by which it knows how old they are."""

    @property
    def last_command(self) -> tuple[float, float]:
        """Forward speed (m/s) and yaw rate (rad/s) of the last command, within the limits."""
        ...

    def follow_clock(self) -> None:
        """Begins to read the clock that the stamps are of."""
        ...

    def state_age(self) -> Tensor:
        """Returns how old the state is, ``[N, 1]``, s, after :meth:`follow_clock`; at most :data:`MAX_AGE`."""
        ...

    def scan_pose(self) -> tuple[Tensor, Tensor]:
        """Returns position ``[N, 3]`` (m) and orientation ``[N, 4]`` of the rovers at the time of their last scans."""
        ...


@runtime_checkable
class ScanCarrier(Protocol):
    """A live backend that tells which directions its lidar covers."""

    def covered(self) -> Tensor:
        """Returns which beams of the latest scan a valid reading covers, bool ``[1, beams]``."""
        ...

    def ranges(self) -> Tensor:
        """Returns the beams of the latest scan, ``[1, beams]``, m."""
        ...

    def segments(self, points: int) -> Tensor | None:
        """Returns the nearest reading of each segment of the latest raw scan, ``[1, points]``, m; ``inf`` for none.

        ``None`` if it has fewer readings than segments.
        """
        ...


@runtime_checkable
class DepthCarrier(Protocol):
    """A live backend with depth cameras."""

    def depth_image(self, topic: str | None, size: tuple[int, int]) -> Tensor:
        """Returns the latest depth image in a size (rows and columns), ``[rows, columns]``, m.

        ``inf`` is a pixel without a return, and 0 one that is lost or too close. Before the first image, all are lost.
        ``topic`` is that of the camera; ``None``: that of :class:`~rover_rl.sims.connection.Connection`.
        """
        ...


@runtime_checkable
class ColorCarrier(Protocol):
    """A live backend with color cameras."""

    def color_image(self, topic: str | None, size: tuple[int, int]) -> Tensor:
        """Returns the latest color image in a size (rows and columns), 0 to 1, ``[3, rows, columns]``.

        Before the first image, all is black. ``topic`` is that of the camera; ``None``: that of
        :class:`~rover_rl.sims.connection.Connection`.
        """
        ...


@runtime_checkable
class PointCarrier(Protocol):
    """A live backend with point clouds and elevation maps. Topics may be ``None``: that of the connection."""

    def point_cloud(self, topic: str | None) -> Tensor | None:
        """Returns the latest points of a 3D lidar in its own frame, ``[P, 3]``, m; ``None`` before the first ones."""
        ...

    def ground_at(
        self, grid: Tensor, yaw: Tensor, cell: float, topic: str | None, layer: str, mount: tuple[float, float, float]
    ) -> Tensor:
        """Returns heights of the ground in the world frame, ``[rows, columns]``, m; NaN where none is known.

        Args:
            grid: points of a grid in the world frame, ``[rows, columns, 2]``, m. Rows follow one another backward, and
                columns to the right.
            yaw: direction that is ahead, ``[]``, rad.
            cell: distance between two neighbors, m.
            topic: topic of an elevation map, or of a point cloud.
            layer: layer of the elevation map.
            mount: position of the lidar whose frame the point cloud is in, in the frame of the robot, m.
        """
        ...


@runtime_checkable
class Simulator(Protocol):
    """Interface of a backend: a batch of simulated rovers, or one real rover.

    A backend that runs on a GPU takes and returns GPU tensors. A backend never writes to a tensor after returning it.

    Attributes:
        num_envs: number of rovers N, the number of rows of every tensor.
        control_dt: duration of a control step, s.
        device: device of the tensors.
        capabilities: what the backend does besides what every backend does.
    """

    num_envs: int
    control_dt: float
    device: torch.device
    capabilities: frozenset[Capability]

    @property
    def robot_connected(self) -> bool:
        """Whether the rovers are connected. Always true in simulation."""
        ...

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        """Places the selected rovers on the ground, at rest. The other rovers do not change.

        Args:
            mask: rovers to reset, bool ``[N]``.
            poses: planar poses ``[N, 3]``: x, y (m) and yaw (rad).

        Returns:
            The state of all rovers.
        """
        ...

    def state(self) -> RoverState:
        """Returns the current state without advancing time."""
        ...

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        """Advances the rovers by one control step.

        Args:
            commands: forward speed (m/s) and counter-clockwise yaw rate (rad/s), ``[N, 2]``; for a drive that moves
                sideways, also with the speed to the left (m/s), ``[N, 3]``.
            active: rovers to advance, bool ``[N]``. No time passes for the others. ``None`` advances all.

        Returns:
            The state of all rovers.
        """
        ...

    def render(self, row: int, view: View, width: int, height: int, goal: Tensor | None = None) -> Tensor:
        """Renders one rover and its goal.

        Args:
            row: index of the rover.
            view: ``"chase"`` (from behind) or ``"top"`` (from above).
            width: width of the image, pixels.
            height: height of the image, pixels.
            goal: position of the goal, ``[2]``, m. ``None`` draws no goal.

        Returns:
            RGB image, uint8 ``[height, width, 3]``.
        """
        ...

    def close(self) -> None:
        """Releases all resources. Idempotent."""
        ...


class LidarCarrier(Protocol):
    """Interface of a simulator with the capability ``"lidar"``."""

    def scanner(self, beams: int) -> Scanner:
        """Creates a lidar at the robot's ``lidar_position`` whose beams are equally spaced over a full turn."""
        ...


class MoverCarrier(Protocol):
    """Interface of a simulator with the capability ``"movers"``."""

    def meet(self, movers: MoverField) -> None:
        """Lets movers push the rovers from now on.

        Before each step, the caller moves them. In the step, each part goes from where it was before at its
        ``velocity`` and ``turn`` to where it is. Movers are too heavy to be pushed, and those of a row touch no rover
        of another row.
        """
        ...


class DynamicsChanger(Protocol):
    """Interface of a simulator with the capability ``"dynamics"``."""

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        """Sets the dynamics of the selected rovers, which the caller resets next.

        Args:
            mask: rovers to change, bool ``[N]``.
            dynamics: new scale factors of all rovers.
        """
        ...


class Reporter(Protocol):
    """Interface of a simulator with the capability ``"contact_force"`` or ``"wheel_torque"``."""

    def report(self, fields: Collection[Report]) -> None:
        """Adds these fields to the states from now on. Before, they cost nothing.

        It is called once, right after the simulator is built. The caller resets all rovers next.

        Raises:
            ValueError: if the simulator was not told where to get a field.
        """
        ...


class RobotChanger(Protocol):
    """Interface of a simulator with the capability ``"robots"``.

    The simulator is built with a :class:`~rover_rl.robots.fleet.Fleet`, whose rows change robots.
    """

    def enter_robots(self, mask: Tensor) -> None:
        """Gives the rovers of ``mask`` (bool ``[N]``) their robots of the fleet. The caller resets these rovers next.

        Their dynamics are those of the robot description again.
        """
        ...


@runtime_checkable
class WorldChanger(Protocol):
    """Interface of a simulator whose rovers can change worlds. With other simulators, a rover keeps its first world.

    The simulator is built with a :class:`~rover_rl.worlds.table.WorldTable`, whose rows change worlds. It holds
    worlds by slot. If a pool has no more worlds than rovers, all of them are in slots from the start, and a change of
    worlds is a new tensor of slots.
    """

    def enter_worlds(self) -> None:
        """Moves rovers to their worlds in the table, after these have changed. The caller resets these rovers next."""
        ...

    def prepare_world(self, world: World) -> None:
        """Prepares a world that rovers may move to soon, which makes :meth:`enter_worlds` faster.

        It may run in another thread, at the same time as the other methods.
        """
        ...
