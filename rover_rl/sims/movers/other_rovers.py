"""``OtherRovers``: the other rovers of a group, as movers."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.robots import Robot
from rover_rl.rotations import angle_of, matrix_to_quaternion, quaternion_product, rotate, wrap_angle
from rover_rl.sims.rover_state import RoverState
from rover_rl.worlds.movers.mover import Kind, Part
from rover_rl.worlds.movers.parts import MAX_SPEED


class RoverSolids(NamedTuple):
    """RoverSolids of rovers, ``[N, Q]`` of each: see :class:`~rover_rl.worlds.movers.parts.Parts`."""

    position: Tensor
    orientation: Tensor
    velocity: Tensor
    turn: Tensor


class OtherRovers:
    """The other rovers of each row's group, ``agents`` consecutive rows, as solids that move.

    In a step of ``dt`` (s), each rover sees another one move on at the mean of their velocities in the last step, as if
    both were one body. So they share their momentum, as in an inelastic collision of equal masses. (If each moved on at
    its own velocity, they would bounce off as elastic balls do.) After the step, each is where it really is.

    Attributes:
        agents: number of rovers of a group.
        parts: solids of a rover, in its base frame.
        count: number of solids of the others of a row.
    """

    def __init__(self, robot: Robot, agents: int, rows: int, dt: float, device: torch.device) -> None:
        self.agents, self.parts, self._dt = agents, solids_of(robot), dt
        self.count = (agents - 1) * len(self.parts)
        numbers = torch.arange(agents, device=device)
        # The others of each rover of a group.
        self._others = torch.stack([numbers[numbers != number] for number in range(agents)])
        self._centers = torch.tensor([part.center for part in self.parts], device=device)
        self._turns = torch.tensor([part.orientation for part in self.parts], device=device)
        wheel = robot.wheels.radius, robot.wheels.width / 2 or robot.wheels.radius
        flat = np.array([wheel] * len(robot.wheels.hubs) + [[side / 2 for side in box.size[:2]] for box in robot.boxes])
        self._flat = torch.from_numpy(flat).float().to(device)
        points = torch.zeros(rows, 3, device=device)
        self._position, self._velocity, self._yaw = points, points, torch.zeros(rows, 1, device=device)
        # Where the solids of each rover are.
        solids = torch.zeros(rows, len(self.parts), 3, device=device)
        self._now = RoverSolids(solids, pad(solids, (0, 1)), solids, solids[..., 0])

    def follow(self, rover: RoverState, moved: Tensor | None, begins: Tensor) -> None:
        """Puts the rovers where they are.

        Rovers that have not ``moved`` (bool ``[N, 1]``; ``None``: all have) keep their velocities, and those that begin
        an episode are at rest.
        """
        position, attitude, last = rover.position.to(self._yaw), rover.orientation.to(self._yaw), self._now
        x, y, z, w = attitude.unbind(-1)
        yaw = angle_of(torch.stack((1 - 2 * (y * y + z * z), 2 * (w * z + x * y)), -1))[:, None]
        solid = attitude[:, None].expand(-1, len(self.parts), -1)
        centers = position[:, None] + rotate(solid, self._centers)
        velocity = (position - self._position) / self._dt
        rests = begins | (velocity.norm(dim=-1, keepdim=True) > MAX_SPEED)
        kept = torch.zeros_like(rests) if moved is None else ~(moved | rests)

        def changed(new: Tensor, old: Tensor) -> Tensor:
            rows = [len(new), *[1] * (new.ndim - 1)]
            return torch.where(kept.reshape(rows), old, new.masked_fill(rests.reshape(rows), 0.0))

        turn = (wrap_angle(yaw - self._yaw) / self._dt).expand_as(last.turn)
        self._velocity = changed(velocity, self._velocity)
        self._position, self._yaw = position, yaw
        self._now = RoverSolids(
            centers,
            quaternion_product(solid, self._turns.expand_as(solid)),
            changed((centers - last.position) / self._dt, last.velocity),
            changed(turn, last.turn),
        )

    def advance(self, active: Tensor | None) -> RoverSolids:
        """Returns the solids of the others of each row after a step in which rovers move on, ``[N, count]``.

        Rovers do not move if ``active`` (bool ``[N, 1]``; ``None``: all) is false.
        """
        position, orientation, velocity, turn = self.seen()
        offset = position - self._position[:, None]
        spin = self._now.turn[:, :1]
        across = torch.stack((-offset[..., 1], offset[..., 0], torch.zeros_like(offset[..., 0])), -1)
        velocity = (velocity + self._velocity[:, None] + spin[..., None] * across) / 2
        turn = (turn + spin) / 2
        if active is not None:
            drives = self._of_others(active).repeat_interleave(len(self.parts), 1).squeeze(-1)
            velocity, turn = velocity.masked_fill(~drives[..., None], 0.0), turn.masked_fill(~drives, 0.0)
        half = turn * (self._dt / 2)
        turned = pad(torch.stack((half.sin(), half.cos()), -1), (2, 0))
        return RoverSolids(position + velocity * self._dt, quaternion_product(turned, orientation), velocity, turn)

    def seen(self) -> RoverSolids:
        """Returns the solids of the others of each row where they are, ``[N, count]``."""
        return RoverSolids(*(self._of_others(values).flatten(1, 2) for values in self._now))

    def nearest(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the horizontal distance from points ``[N, 2]`` (m) to the nearest other rover, and its speed."""
        position, yaw, velocity = map(self._of_others, (self._position, self._yaw, self._velocity))
        offset, cos, sin = points[:, None] - position[..., :2], yaw.cos(), yaw.sin()
        x, y = offset[..., :1], offset[..., 1:]
        local = torch.cat((cos * x + sin * y, cos * y - sin * x), -1)
        # Seen from above, solids are rectangles.
        beside = ((local[:, :, None] - self._centers[:, :2]).abs() - self._flat).clamp(min=0)
        least, which = beside.norm(dim=-1).amin(-1).min(-1, keepdim=True)
        return least, velocity[..., :2].norm(dim=-1).gather(1, which)

    def center_distances(self, points: Tensor) -> Tensor:
        """Returns the horizontal distances from points ``[N, 2]`` to the other rovers, ``[N, agents - 1]``, m."""
        return (points[:, None] - self._of_others(self._position)[..., :2]).norm(dim=-1)

    def together(self, values: Tensor) -> Tensor:
        """Returns the values of all rovers of a row's group, ``[N, agents, ...]``, from ``values [N, ...]``."""
        return values.reshape(-1, self.agents, *values.shape[1:]).repeat_interleave(self.agents, 0)

    def _of_others(self, values: Tensor) -> Tensor:
        """Returns the values of the other rovers of each row, ``[N, agents - 1, ...]``, from ``values [N, ...]``."""
        groups = values.reshape(-1, self.agents, *values.shape[1:])
        return groups[:, self._others].flatten(0, 1)


def solids_of(robot: Robot) -> tuple[Part, ...]:
    """Returns the wheels of a robot, which point ahead, and its boxes, as parts in its base frame."""
    radius, width = robot.wheels.radius, robot.wheels.width
    # The axis of a cylinder is its z axis, and that of a wheel is y. A sphere is a capsule without a cylinder.
    turn = np.array(((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))) if width else np.eye(3)
    x, y, z, w = matrix_to_quaternion(torch.from_numpy(turn)).tolist()
    size = (2 * radius, 2 * radius, width or 2 * radius)
    kind: Kind = "cylinder" if width else "capsule"
    wheels = (Part(kind, size, hub, (x, y, z, w)) for hub in robot.wheels.hubs)
    return (*wheels, *(Part("box", box.size, box.center) for box in robot.boxes))
