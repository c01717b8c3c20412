"""Skid-steer: the wheels of each side turn together, and slip sideways in turns."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from rover_rl.robots.drives.base import Drive, Equations, Joints, Wheels


@dataclass(frozen=True, kw_only=True)
class SkidSteer(Drive):
    """Drive with a motor for the wheels of each side. With one wheel a side, it is a differential drive.

    Args:
        left: names of the joints of the left wheels.
        right: names of the joints of the right wheels.
        separation: effective distance between the left and right wheels in the kinematics, m. It differs from the
            distance in the URDF, which ``None`` takes, because the wheels slip in turns.
        casters: names of the joints of wheels that hold the robot up without friction.

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
    casters: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.separation is not None and not 0 < self.separation < float("inf"):
            raise ValueError(f"separation of a drive must be a positive number, got {self.separation}")

    @property
    def motors(self) -> tuple[tuple[str, ...], ...]:
        """Names of the wheel joints of the left and the right motor."""
        return self.left, self.right

    @property
    def passive(self) -> tuple[str, ...]:
        """Names of the joints of the casters."""
        return self.casters

    @property
    def rollers(self) -> tuple[float | None, ...]:
        """``None`` for the tires, and 0 for casters: such a wheel rolls ahead freely, and sideways on ideal rollers."""
        if not self.casters:
            return ()
        return (*(None for _ in (*self.left, *self.right)), *(0.0 for _ in self.casters))

    def check(self, wheels: Wheels) -> None:
        """Checks that the wheels are on their sides."""
        sides = [("left", 1)] * len(self.left) + [("right", -1)] * len(self.right)
        for name, hub, (side, sign) in zip(self.wheels, wheels.hubs, sides, strict=False):
            if not sign * hub[1] > 0:
                raise ValueError(
                    f"{side} wheel {name!r} is at y = {hub[1]:g} m; left wheels must be at y > 0, right wheels at y < 0"
                )

    def equations(self, wheels: Wheels, dt: float, device: torch.device | str | None = None) -> SkidSteerEquations:
        """Returns the equations of the drive: see :meth:`Drive.equations`."""
        limits = self.max_linear_acceleration, self.max_angular_acceleration
        return _equations(self.track(wheels), wheels.radius, limits, dt, torch.device(device or "cpu"))

    def advance(self, set_point: Tensor, command: Tensor, wheels: Wheels, dt: float) -> Tensor:
        """Returns the twist after ``dt``, limited in acceleration."""
        return self.equations(wheels, dt, command.device).advance(set_point, command)

    def targets(self, before: Tensor, after: Tensor, wheels: Wheels) -> Joints:
        """Returns the wheel speeds without slip, ``(v -+ w separation / 2) / r``.

        They are those of the mean twist, so that the distance driven matches the limited acceleration.
        """
        return self.equations(wheels, 0.0, before.device).targets(before, after)

    def odometry(self, joints: Joints, wheels: Wheels) -> Tensor:
        """Returns ``v = r (wR + wL) / 2`` (m/s) and ``w = r (wR - wL) / separation`` (rad/s), ``[N, 2]``."""
        return self.equations(wheels, 0.0, joints.speeds.device).odometry(joints)

    def track(self, wheels: Wheels) -> float:
        """Returns the distance of left and right wheels in the kinematics, m: ``separation``, or that of the hubs."""
        if self.separation is not None:
            return self.separation
        left, driven = len(self.left), len(self.left) + len(self.right)
        sides = [hub[1] for hub in wheels.hubs[:driven]]
        return sum(sides[:left]) / left - sum(sides[left:]) / len(self.right)


@dataclass(frozen=True)
class SkidSteerEquations(Equations):
    """Equations of a skid-steer drive: see :class:`Equations`.

    Attributes:
        limit: largest changes of speed (m/s) and yaw rate (rad/s) in a step.
        inverse_radius: inverse of the radius of a wheel, 1/m.
        left_right: speeds of the left and the right wheels per unit of yaw rate.
        from_left, from_right: speed and yaw rate per unit of the speed of the left and of the right wheels.
    """

    limit: Tensor
    inverse_radius: Tensor
    left_right: Tensor
    from_left: Tensor
    from_right: Tensor

    def advance(self, set_point: Tensor, command: Tensor) -> Tensor:
        """Returns the twist after a step, limited in acceleration."""
        return set_point + torch.clamp(command - set_point, -self.limit, self.limit)

    def targets(self, before: Tensor, after: Tensor) -> Joints:
        """Returns the wheel speeds of the mean twist."""
        twist = (before + after) * 0.5
        speeds = torch.addcmul(twist[:, :1] * self.inverse_radius, twist[:, 1:], self.left_right)
        return Joints(speeds, speeds[:, :0])

    def odometry(self, joints: Joints) -> Tensor:
        """Returns the twist of the wheel speeds."""
        return torch.addcmul(joints.speeds[:, :1] * self.from_left, joints.speeds[:, 1:], self.from_right)


@lru_cache(maxsize=64)
def _equations(
    separation: float, radius: float, limits: tuple[float, float], dt: float, device: torch.device
) -> SkidSteerEquations:
    """Copies the numbers of the equations to a device once: a copy from the host waits for the device."""
    linear, angular = radius / 2, radius / separation
    return SkidSteerEquations(
        limit=dt * torch.tensor(limits, device=device),
        inverse_radius=torch.tensor([1 / radius], device=device),
        left_right=torch.tensor((-separation / 2, separation / 2), device=device) / radius,
        from_left=torch.tensor((linear, -angular), device=device),
        from_right=torch.tensor((linear, angular), device=device),
    )
