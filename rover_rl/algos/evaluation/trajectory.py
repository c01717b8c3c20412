"""Records of episodes, and the contacts of the body in them, computed from poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rover_rl.robots import Robot
from rover_rl.rotations import euler_to_matrix, wrap_angle
from rover_rl.sims.settings import CONTROL_DT
from rover_rl.worlds import World
from rover_rl.worlds.solids import Solids

TOUCH = 0.01  # largest distance between the body and an obstacle that counts as a contact, m
_OUTLINE_SPACING = 0.02  # largest distance between neighboring points of the rover's outline, m
_CHUNK = 4096  # number of poses that are tested against an obstacle at once: about 100 MB


class Encounters(NamedTuple):
    """What happens between the rover and movers at the start and after each of T steps. Distances are horizontal."""

    contact: Tensor  #: Whether the rover touched a mover in the step, bool ``[T + 1]``.
    gap: Tensor  #: Distance from the disc of the robot's radius to the nearest mover, at least 0, ``[T + 1]``, m.
    center_distance: Tensor  #: Distance between the origins of rover and nearest mover, ``[T + 1]``, m.


class MoverTrack(NamedTuple):
    """Where the P solids of the movers are, at the start and after each step, or after the last steps of an episode."""

    kind: Tensor  #: Index in ``rover_rl.worlds.movers.mover.KINDS``, int32 ``[P]``.
    half: Tensor  #: Half of the length, width and height, float32 ``[P, 3]``, m.
    mover: Tensor  #: Index of the solid's mover in the world's ``movers``, int64 ``[P]``.
    position: Tensor  #: Centers, float32 ``[T + 1, P, 3]``, m.
    orientation: Tensor  #: Unit quaternions (x, y, z, w), float32 ``[T + 1, P, 4]``.


@dataclass(frozen=True)
class Trajectory:
    """Record of one episode of T steps."""

    position: Tensor  #: Positions at the start and after each step, float32 ``[T + 1, 3]``, m.
    angles: Tensor  #: Roll, pitch and yaw at the start and after each step, float32 ``[T + 1, 3]``, rad.
    collision: Tensor  #: Whether each step ends in a collision, as the task defines it, bool ``[T]``.
    goal: Tensor  #: Whether each step reaches a goal, bool ``[T]``.
    ending: str  #: ``"goal"``, or another one of ``rover_rl.algos.driving``.
    reversals: float = math.nan  #: Changes of the commanded turning direction; nan if commands are not recorded.
    dt: float = CONTROL_DT  #: Duration of a step, s.
    encounters: Encounters | None = None  #: What happens between the rover and movers; ``None`` without movers.
    movers: MoverTrack | None = None  #: Where the movers are; ``None`` without movers, or if it was not asked for.

    def __len__(self) -> int:
        return len(self.collision)

    def touching(self, walls: Tensor) -> Tensor:
        """Contacts with anything, bool ``[T + 1]``: those of :func:`find_body_contacts`, and with movers."""
        return walls if self.encounters is None else walls | self.encounters.contact

    def until(self, steps: int, ending: str) -> Trajectory:
        states: dict[str, Any] = {key: getattr(self, key)[: steps + 1] for key in ("position", "angles")}
        events = {key: getattr(self, key)[:steps] for key in ("collision", "goal")}
        if self.encounters is not None:
            states["encounters"] = Encounters(*(values[: steps + 1] for values in self.encounters))
        if self.movers is not None:
            kept = max(0, len(self.movers.position) - (len(self) - steps))
            places = {key: getattr(self.movers, key)[:kept] for key in ("position", "orientation")}
            states["movers"] = self.movers._replace(**places)
        return replace(self, **states, **events, ending=ending)

    @property
    def seconds(self) -> float:
        return len(self) * self.dt

    @property
    def path(self) -> Tensor:
        """Positions seen from above, ``[T + 1, 2]``, m."""
        return self.position[:, :2]

    @property
    def length(self) -> float:
        """Length of the path seen from above, m."""
        return self.path.double().diff(dim=0).norm(dim=1).sum().item()

    @cached_property
    def speed(self) -> Tensor:
        """Mean speed of the body (not of the wheels) over ground in each step, ``[T]``, m/s."""
        return self.position.diff(dim=0).norm(dim=1) / self.dt

    @property
    def signed_speed(self) -> Tensor:
        """:attr:`speed`, negative in steps in which the rover moves backward, ``[T]``, m/s."""
        yaw = self.angles[:-1, 2]
        forward = (self.path.diff(dim=0) * torch.stack((yaw.cos(), yaw.sin()), -1)).sum(-1)
        return torch.copysign(self.speed, forward)

    @property
    def tilt(self) -> Tensor:
        """Angle between the vertical axes of the rover and the world after each step, ``[T]``, rad."""
        roll, pitch, _ = self.angles[1:].unbind(-1)
        return torch.arccos((roll.cos() * pitch.cos()).clamp(-1, 1))

    @property
    def turns(self) -> float:
        """Number of full turns: the sum of all absolute changes of heading, divided by 2 pi."""
        return wrap_angle(self.angles[:, 2].double().diff()).abs().sum().item() / (2 * math.pi)


def count_runs(flags: Tensor) -> int:
    flags = flags.to(torch.int8)
    return int(flags[:1].sum() + (flags.diff() > 0).sum())


def count_reversals(yaw_rates: Sequence[float]) -> int:
    """Counts the changes of sign in successive yaw rates (rad/s), ignoring zeros."""
    return sum(a * b < 0 for a, b in pairwise(filter(None, yaw_rates)))


def find_body_contacts(
    trajectories: Sequence[Trajectory], worlds: Sequence[World], robots: Sequence[Robot]
) -> list[Tensor]:
    """Finds the poses at which the rover's body touches an obstacle at rest: bool ``[T + 1]`` for each episode.

    A contact (:func:`is_touching`) need not be a lidar collision: at the sides and at the rear, the outline may be
    farther from the lidar.
    """
    together: dict[tuple[World, Robot], list[int]] = {}
    for episode, pair in enumerate(zip(worlds, robots, strict=True)):
        together.setdefault(pair, []).append(episode)
    contacts: dict[int, Tensor] = {}
    for (world, robot), episodes in together.items():
        members = [trajectories[episode] for episode in episodes]
        position, angles = (torch.cat([getattr(t, key) for t in members]) for key in ("position", "angles"))
        touched = is_touching(position, angles, world, robot)
        contacts |= zip(episodes, touched.split([len(t.position) for t in members]), strict=True)
    return [contacts[episode] for episode in range(len(trajectories))]


def is_touching(position: Tensor, angles: Tensor, world: World, robot: Robot) -> Tensor:
    """Whether the rover's body touches an obstacle at poses of ``position [P, 3]`` (m) and ``angles [P, 3]`` (rad).

    The body touches an obstacle if its footprint (``Robot.footprint``), at the height of the wheel hubs, is within 1 cm
    of it. Obstacles below the wheel hubs count as ground. ``angles`` are roll, pitch and yaw. Returns bool ``[P]``.
    """
    outline = _outline(robot)
    reach = outline[:, :2].norm(dim=1).max().item() + TOUCH
    touched = torch.zeros(len(position), dtype=torch.bool)
    for obstacle in world.obstacles:
        near = (_near(position[:, :2], obstacle, reach) & ~touched).nonzero().squeeze(-1)
        normals, offsets = obstacle.planes.to(position).split((3, 1), -1)
        for poses in near.split(_CHUNK):
            points = position[poses, None] + outline @ euler_to_matrix(angles[poses]).mT
            touched[poses] = ((points @ normals.T + offsets.T).amax(-1) <= TOUCH).any(-1)
    return touched


def _outline(robot: Robot) -> Tensor:
    """Points on the footprint at the height of the wheel hubs, in the base frame, ``[P, 3]``, m."""
    back, front, right, left = robot.footprint
    height = sum(hub[2] for hub in robot.wheels.hubs) / len(robot.wheels.hubs)
    x, y = (torch.linspace(a, b, math.ceil((b - a) / _OUTLINE_SPACING) + 1) for a, b in ((back, front), (right, left)))
    sides = torch.cartesian_prod(x, torch.tensor((right, left)))
    ends = torch.cartesian_prod(torch.tensor((back, front)), y)
    return torch.nn.functional.pad(torch.cat((sides, ends)), (0, 1), value=height)


def _near(path: Tensor, obstacle: Solids, reach: float) -> Tensor:
    """Whether each point of ``path [P, 2]`` is within ``reach`` (m) of the obstacle seen from above, bool ``[P]``."""
    outline = obstacle.footprint.to(path)  # a convex polygon, counter-clockwise
    near = ((path >= outline.amin(0) - reach) & (path <= outline.amax(0) + reach)).all(-1)
    edges, offsets = outline.roll(-1, 0) - outline, path[near, None, :] - outline
    along = ((offsets * edges).sum(-1) / (edges**2).sum(-1)).clamp(0, 1)
    distance = (offsets - along[..., None] * edges).norm(dim=-1).amin(-1)
    inside = (edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0] >= 0).all(-1)
    near[near.clone()] = inside | (distance <= reach)
    return near
