"""``SimulatedDrives``: the drives and clocks of a batch of simulated rovers."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.robots.drives import Joints
from rover_rl.robots.fleet import Fleet
from rover_rl.robots.kinematics import Kinematics
from rover_rl.sims.rover_state import RoverState


class SimulatedDrives:
    """Drives and clocks of a batch of simulated rovers, for steps of ``dt`` (s). Changes of the index are followed."""

    def __init__(self, fleet: Fleet, dt: float) -> None:
        self._kinematics, self._step = Kinematics(fleet, dt), dt
        self._first_angle = 7 + self._kinematics.motors
        count, device = len(fleet), fleet.index.device
        self._dt = torch.full((count, 1), dt, device=device)
        self._set_point = torch.zeros(count, self._kinematics.size, device=device)
        self._stamp = torch.zeros(count, 1, dtype=torch.float64, device=device)

    def reset(self, mask: Tensor) -> None:
        """Sets the drives of the rovers in ``mask`` (bool ``[N]``) to rest. Their clocks continue."""
        self._set_point = torch.where(mask[:, None], torch.zeros_like(self._set_point), self._set_point)

    def advance(self, commands: Tensor, active: Tensor | None) -> Joints:
        """Advances the drives and clocks by one control step, and returns the targets of the joints for this step.

        The arguments are those of :meth:`Simulator.step`.
        """
        if self._kinematics.sideways and commands.shape[-1] == 2:
            commands = pad(commands, (0, 1))
        set_point = self._kinematics.advance(self._set_point, commands)
        targets = self._kinematics.joints(self._set_point, set_point)
        stamp = self._stamp + self._step
        if active is not None:
            set_point = torch.where(active[:, None], set_point, self._set_point)
            stamp = torch.where(active[:, None], stamp, self._stamp)
        self._set_point, self._stamp = set_point, stamp
        return targets

    def odometry(self, joints: Joints) -> Tensor:
        return self._kinematics.odometry(joints)

    def state(
        self, body: Tensor, contact: Tensor | None = None, mover_contact: Tensor | None = None, **reports: Tensor
    ) -> RoverState:
        """Returns the state of the rovers, with what else the simulator knows.

        ``body`` is position (m), orientation (x, y, z, w), speed of each motor (rad/s) and angle of each steering joint
        (rad), ``[N, 7 + M + S]``.
        """
        twist = self.odometry(Joints(body[:, 7 : self._first_angle], body[:, self._first_angle :]))
        optional = {"contact": contact, "mover_contact": mover_contact}
        if self._kinematics.sideways:
            optional["lateral_velocity"] = twist[:, 2:]
        return RoverState.pack(
            position=body[:, :3],
            orientation=body[:, 3:7],
            linear_velocity=twist[:, :1],
            angular_velocity=twist[:, 1:2],
            dt=self._dt,
            stamp=self._stamp,
            **{name: value for name, value in optional.items() if value is not None},
            **reports,
        )
