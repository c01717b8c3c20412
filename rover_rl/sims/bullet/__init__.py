"""Bullet backend: rigid-body physics in PyBullet, which only building a simulator imports; lidar with its rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from rover_rl.sims.settings import CONTROL_DT, PhysicsSettings


@dataclass(frozen=True)
class BulletSettings(PhysicsSettings):
    """Settings of the Bullet physics.

    With the defaults a standing rover stays in place, and friction agrees with Coulomb's law within 5 %, except that
    rovers creep on slopes close to the limit. The presets are ``"default"``, ``"accurate"`` with steps of about 2 ms,
    and ``"fast"`` with fewer steps: ``docs/simulators.md`` lists their speed, and their error relative to 1 ms.

    Args:
        control_dt: duration of a control step, s. The contract controls at 20 Hz.
        substeps: physics steps per control step. The default, 10 steps of 5 ms, is that of the original inspect world.
            The number must be even because the friction directions are mirrored in half of the steps.
        solver_iterations: maximum number of iterations of the contact solver per substep.
        solver_residual: residual below which the solver stops early. With Bullet's default, 1e-7, a standing rover
            creeps by a millimeter in 30 seconds; with 1e-9, by a fifth of that.
        contact_threshold: gap above which the solver ignores a contact, m. Bullet's default is ``math.inf``.
        ground_friction: Coulomb friction coefficient between rover and ground.
        ground_stiffness: stiffness of a contact with the ground for Rover Zero, N/m. That of other robots and their
            damping are in proportion to their mass. The load on four rigid wheels is indeterminate, and the solver
            would put it on one diagonal: yaw rates would be up to 20 % off.
        ground_damping: damping of a contact with the ground for Rover Zero, N s/m.
        obstacle_friction: Coulomb friction coefficient between rover and obstacles. From 0.35 on, the wheels climb a
            wall that the rover pushes against, and the rover flips onto its back.

    Raises:
        ValueError: if a number is out of range.
    """

    positive: ClassVar[tuple[str, ...]] = ("control_dt", "ground_stiffness")
    substep_multiple: ClassVar[int] = 2
    by_mass: ClassVar[tuple[str, ...]] = ("ground_stiffness", "ground_damping")
    presets: ClassVar[dict[str, dict[str, Any]]] = {
        "default": {},
        "accurate": {"substeps": 26, "solver_iterations": 50},
        "fast": {"substeps": 6, "solver_iterations": 30},
    }

    control_dt: float = CONTROL_DT
    substeps: int = 10
    solver_iterations: int = 40
    solver_residual: float = 1e-9
    contact_threshold: float = 0.0
    ground_friction: float = 0.5
    ground_stiffness: float = 300e3
    ground_damping: float = 2e3
    obstacle_friction: float = 0.25

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.substeps % self.substep_multiple:
            raise ValueError(f"substeps must be an even number of at least 2, got {self.substeps}")
