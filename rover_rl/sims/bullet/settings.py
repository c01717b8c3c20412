"""Settings of the Bullet physics."""

from __future__ import annotations

from dataclasses import dataclass


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
