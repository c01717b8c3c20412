"""Skid-steer: the wheels of each side turn together, and slip sideways in turns."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from rover_rl.sims.drives.base import Drive, Joints, Wheels


@dataclass(frozen=True, kw_only=True)
class SkidSteer(Drive):
    """Drive with a motor for the wheels of each side. With one wheel a side, it is a differential drive.

    Args:
        left: names of the joints of the left wheels.
        right: names of the joints of the right wheels.
        separation: effective distance between the left and right wheels in the kinematics, m. It differs from the
            distance in the URDF, which ``None`` takes, because the wheels slip in turns.

    Raises:
        ValueError: as :class:`Drive`, or if the separation is not positive.

    Example:
        >>> drive = SkidSteer(left=("left",), right=("right",), torque=2.0)
        >>> wheels = Wheels(hubs=((0.0, 0.2, 0.1), (0.0, -0.2, 0.1)), radius=0.1, width=0.05)
        >>> drive.odometry(Joints(torch.tensor([[8.0, 12.0]]), torch.zeros(1, 0)), wheels)
        tensor([[1., 1.]])
    """

    left: tuple[str, ...]
    right: tuple[str, ...]
    separation: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.separation is not None and not 0 < self.separation < float("inf"):
            raise ValueError(f"separation of a drive must be a positive number, got {self.separation}")

    @property
    def motors(self) -> tuple[tuple[str, ...], ...]:
        """Names of the wheel joints of the left and the right motor."""
        return self.left, self.right

    def check(self, wheels: Wheels) -> None:
        """Checks that the wheels are on their sides."""
        sides = [("left", 1)] * len(self.left) + [("right", -1)] * len(self.right)
        for name, hub, (side, sign) in zip(self.wheels, wheels.hubs, sides, strict=True):
            if not sign * hub[1] > 0:
                raise ValueError(
                    f"{side} wheel {name!r} is at y = {hub[1]:g} m; left wheels must be at y > 0, right wheels at y < 0"
                )

    def advance(self, set_point: Tensor, command: Tensor, wheels: Wheels, dt: float) -> Tensor:
        """Returns the twist after ``dt``, limited in acceleration."""
        limit = _limit(self.max_linear_acceleration, self.max_angular_acceleration, dt, command.device)
        return set_point + torch.clamp(command - set_point, -limit, limit)

    def targets(self, before: Tensor, after: Tensor, wheels: Wheels) -> Joints:
        """Returns the wheel speeds without slip, ``(v -+ w separation / 2) / r``.

        They are those of the mean twist, so that the distance driven matches the limited acceleration.
        """
        twist = (before + after) * 0.5
        inverse_radius, left_right, _, _ = _factors(self.separation_of(wheels), wheels.radius, twist.device)
        speeds = torch.addcmul(twist[:, :1] * inverse_radius, twist[:, 1:], left_right)
        return Joints(speeds, speeds[:, :0])

    def odometry(self, joints: Joints, wheels: Wheels) -> Tensor:
        """Returns ``v = r (wR + wL) / 2`` (m/s) and ``w = r (wR - wL) / separation`` (rad/s), ``[N, 2]``."""
        speeds = joints.speeds
        _, _, from_left, from_right = _factors(self.separation_of(wheels), wheels.radius, speeds.device)
        return torch.addcmul(speeds[:, :1] * from_left, speeds[:, 1:], from_right)

    def separation_of(self, wheels: Wheels) -> float:
        """Returns the effective distance between the left and right wheels, m."""
        if self.separation is not None:
            return self.separation
        sides = [hub[1] for hub in wheels.hubs]
        left = len(self.left)
        return sum(sides[:left]) / left - sum(sides[left:]) / len(self.right)


@lru_cache(maxsize=32)
def _factors(separation: float, radius: float, device: torch.device) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Copies the factors of the wheel speeds in the twist, and of the twist in the wheel speeds, to a device once."""
    linear, angular = radius / 2, radius / separation
    return (
        torch.tensor(1 / radius, device=device),
        torch.tensor((-separation / 2, separation / 2), device=device) / radius,
        torch.tensor((linear, -angular), device=device),
        torch.tensor((linear, angular), device=device),
    )


@lru_cache(maxsize=32)
def _limit(linear: float, angular: float, dt: float, device: torch.device) -> Tensor:
    return dt * torch.tensor((linear, angular), device=device)
