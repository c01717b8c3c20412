"""Settings of the Bullet physics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rover_rl.sims.bullet.simulator import BulletSimulator
    from rover_rl.sims.connection import Connection
    from rover_rl.sims.robots import Robot
    from rover_rl.sims.worlds import World


@dataclass(frozen=True)
class BulletSettings:
    """How Bullet simulates. The defaults keep a standing rover where it is, and turn it alike in every heading.

    Args:
        substep: one physics step in seconds (the original's inspect world: 5 ms).
        substeps: physics steps in a control step; 10 of 5 ms give the contract's 20 Hz.
        solver_iterations: at most so many iterations of the contact solver in a substep.
        solver_residual: the solver stops early below this residual. Bullet's own 1e-7 lets a standing rover creep by a
            millimetre in 30 seconds; 1e-9 holds it to a fifth of that.
        ground_friction: Coulomb coefficient between wheels and ground.
        obstacle_friction: the same for obstacles. At 0.7 and more the wheels climb up a wall that they push against,
            and the rover falls on its back.
    """

    substep: float = 0.005
    substeps: int = 10
    solver_iterations: int = 50
    solver_residual: float = 1e-9
    ground_friction: float = 1.0
    obstacle_friction: float = 0.5

    @property
    def control_dt(self) -> float:
        """Duration of a control step in seconds."""
        return self.substep * self.substeps

    def make(
        self, *, worlds: Sequence[World], robot: Robot, lidar_beams: int, connection: Connection | None = None
    ) -> BulletSimulator:
        """The simulator with these settings: see :func:`rover_rl.sims.make_simulator`."""
        from rover_rl.sims.bullet.simulator import BulletSimulator

        return BulletSimulator(worlds, robot, lidar_beams, self)
