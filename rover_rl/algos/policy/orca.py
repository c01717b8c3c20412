"""``OrcaPolicy``: optimal reciprocal collision avoidance (ORCA) among what the lidar tracks.

Source: J. van den Berg, S. J. Guy, M. Lin, D. Manocha, "Reciprocal n-body collision avoidance", ISRR 2011. Each
obstacle allows a half-plane of velocities: those without a contact in the coming seconds. What moves does not make room
here, so that the rover takes the whole change of velocity. It takes the allowed velocity that is nearest to full speed
towards the goal, of a set of 16 speeds and 64 directions, or, if none is allowed, the one that violates least.

The rover is no point: the velocity becomes a speed and a heading, backward if it points far enough to the rear.

Example:
    >>> evaluate(OrcaPolicy(), draw_episodes("forest:10000", count=2), name="orca", seconds=2)
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from rover_rl.algos.policy.dwa import LIDAR
from rover_rl.envs.config import EnvConfig, RobotLike
from rover_rl.envs.mover_tracker import MoverTracker, Tracks
from rover_rl.robots import get_robot
from rover_rl.rotations import wrap_angle
from rover_rl.sims.settings import CONTROL_DT

SECONDS, STATIC_SECONDS = 3.0, 1.0  # time without a contact with what moves, and with what does not, s
MARGIN = 0.1  # added to the robot's radius, m
NARROW = -0.05  # the same for what does not move, which the robot passes with its side, m
SPEEDS, DIRECTIONS = 16, 64  # numbers of candidate velocities
BACKWARD = math.radians(110)  # angle of a velocity above which the rover drives backward, rad
_STEP = 0.2  # time in which a contact that is there already must end, s
_FAR = 1e3


class OrcaPolicy(TensorDictModuleBase):
    """Optimal reciprocal collision avoidance among tracked obstacles: see the module ``orca``.

    The policy reads ``lidar``, ``pose``, ``imu``, ``target`` and ``velocities``, and remembers tracks.

    ``made_for`` is the environment that it drives in, with ``robot`` and a lidar of 128 readings. It decides every
    ``trained_action_repeat`` steps.
    """

    trained_action_repeat = 2

    def __init__(self, robot: RobotLike = "rover_zero") -> None:
        super().__init__()
        self._robot = get_robot(robot)
        self.made_for = EnvConfig(robot=robot, lidar=LIDAR)
        self.in_keys = ["lidar", "pose", "imu", "target", "velocities", "is_init", "tracks"]
        self.out_keys = ["action", ("next", "tracks")]
        self._tracker = MoverTracker(self._robot, LIDAR, self.trained_action_repeat * CONTROL_DT)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        state, tracks = self._tracker.remembered(tensordict)
        lidar, target, velocities = (tensordict[key] for key in ("lidar", "target", "velocities"))
        velocity = self._velocity(lidar, target, velocities, tracks.in_base_frame(tensordict))
        speed, angle = velocity.norm(dim=-1, keepdim=True), torch.atan2(velocity[:, 1:], velocity[:, :1])
        backward = angle.abs() > BACKWARD
        angle = torch.where(backward, wrap_angle(angle + math.pi), angle)
        ahead = speed * angle.cos().clamp(min=0)
        action = torch.cat((torch.where(backward, -ahead, ahead), (2 * angle).clamp(-math.pi, math.pi)), -1)
        return tensordict.set("action", action).set(("next", "tracks"), state)

    def _velocity(self, lidar: Tensor, target: Tensor, velocities: Tensor, moving: Tracks) -> Tensor:
        gone = moving.readings | (lidar >= LIDAR.max_range - 1e-3)
        x, y = ((lidar * wave).masked_fill(gone, _FAR) for wave in _waves(lidar.shape[-1], lidar))
        fixed = torch.stack((x + self._robot.lidar_position[0], y + self._robot.lidar_position[1]), -1)
        present = moving.position.masked_fill(~moving.moves[..., None], _FAR)
        position = torch.cat((present, fixed), 1)
        velocity = torch.cat((moving.velocity * moving.moves[..., None], torch.zeros_like(fixed)), 1)
        radius = torch.cat((moving.radius + MARGIN, torch.full_like(lidar, NARROW)), 1) + self._robot.radius
        seconds = torch.cat((torch.full_like(moving.radius, SECONDS), torch.full_like(lidar, STATIC_SECONDS)), 1)
        own = torch.cat((velocities[:, :1], torch.zeros_like(velocities[:, :1])), -1)
        point, normal = half_planes(position, velocity, radius, seconds, own)
        most = self._robot.drive.max_speed
        wanted = most * torch.cat((target[:, 1:].cos(), target[:, 1:].sin()), -1)
        candidates = torch.cat((_candidates(most, lidar).expand(len(lidar), -1, -1), wanted[:, None]), 1)
        # Signed distance of each candidate into each half-plane, [N, V, O].
        inside = candidates @ normal.mT - (point * normal).sum(-1)[:, None]
        violation = (-inside).amax(-1).clamp(min=0)
        cost = (candidates - wanted[:, None]).norm(dim=-1) + 100 * violation
        best = cost.argmin(-1)[:, None, None].expand(-1, 1, 2)
        return candidates.gather(1, best)[:, 0]


def half_planes(
    position: Tensor, velocity: Tensor, radius: Tensor, seconds: Tensor, own: Tensor
) -> tuple[Tensor, Tensor]:
    """Returns the half-planes of allowed velocities: points on their edges and unit normals that point inside.

    Args:
        position: positions of obstacles relative to the rover, ``[N, O, 2]``, m.
        velocity: their velocities, ``[N, O, 2]``, m/s.
        radius: sums of their radii and the rover's, ``[N, O]``, m.
        seconds: times without a contact, ``[N, O]``, s.
        own: velocity of the rover, ``[N, 2]``, m/s.
    """
    relative = own[:, None] - velocity
    distance = position.norm(dim=-1)
    inside = distance <= radius
    time = torch.where(inside, _STEP, seconds)[..., None]
    # From the center of the disc at the end of the cone to the relative velocity.
    w = relative - position / time
    length = w.norm(dim=-1).clamp(min=1e-6)
    along = (w * position).sum(-1)
    on_disc = inside | ((along < 0) & (along.square() > radius.square() * length.square()))
    unit = w / length[..., None]
    from_disc = (radius / time[..., 0] - length)[..., None] * unit
    # The leg of the cone on the side of the relative velocity.
    leg = (distance.square() - radius.square()).clamp(min=1e-9).sqrt()
    left = position[..., 0] * w[..., 1] - position[..., 1] * w[..., 0] > 0
    x, y = position.unbind(-1)
    square = distance.square().clamp(min=1e-9)
    side = torch.where(left, 1.0, -1.0)
    direction = torch.stack((x * leg - side * y * radius, side * x * radius + y * leg), -1) / square[..., None]
    normal_leg = torch.stack((-side * direction[..., 1], side * direction[..., 0]), -1)
    from_leg = (relative * direction).sum(-1, keepdim=True) * direction - relative
    change = torch.where(on_disc[..., None], from_disc, from_leg)
    normal = torch.where(on_disc[..., None], unit, normal_leg)
    return own[:, None] + change, normal


def _waves(count: int, like: Tensor) -> tuple[Tensor, Tensor]:
    angles = torch.arange(count, dtype=like.dtype, device=like.device) * (2 * math.pi / count)
    return angles.cos(), angles.sin()


def _candidates(most: float, like: Tensor) -> Tensor:
    speeds = torch.linspace(0, most, SPEEDS, dtype=like.dtype, device=like.device)
    return (speeds[:, None, None] * torch.stack(_waves(DIRECTIONS, like), -1)).flatten(0, 1)
