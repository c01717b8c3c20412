"""Settings and presets of the Bullet physics."""

from __future__ import annotations

from dataclasses import dataclass

from rover_rl.registry import perhaps
from rover_rl.sims.timing import CONTROL_DT


@dataclass(frozen=True)
class BulletSettings:
    """Settings of the Bullet physics.

    With the defaults a standing rover stays in place, and friction agrees with Coulomb's law within 5 %, except that
    rovers creep on slopes close to the limit.
    ``docs/physics.md`` lists the speed of each preset and its error relative to steps of 1 ms.

    Args:
        control_dt: duration of a control step, s. The contract controls at 20 Hz.
        substeps: physics steps per control step. The default, 10 steps of 5 ms, is that of the original inspect world.
            The number must be even because the friction directions are mirrored in half of the steps.
        solver_iterations: maximum number of iterations of the contact solver per substep.
        solver_residual: residual below which the solver stops early. With Bullet's default, 1e-7, a standing rover
            creeps by a millimeter in 30 seconds; with 1e-9, by a fifth of that.
        contact_threshold: gap above which the solver ignores a contact, m. Bullet's default is ``math.inf``.
        ground_friction: Coulomb friction coefficient between rover and ground.
        ground_stiffness: stiffness of a contact with the ground, N/m. The load on four rigid wheels is indeterminate,
            and the solver would put it on one diagonal: yaw rates would be up to 20 % off.
        ground_damping: damping of a contact with the ground, N s/m.
        obstacle_friction: Coulomb friction coefficient between rover and obstacles. From 0.35 on, the wheels climb a
            wall that the rover pushes against, and the rover flips onto its back.

    Raises:
        ValueError: if a number is out of range.
    """

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
        if self.substeps < 2 or self.substeps % 2:
            raise ValueError(f"substeps must be an even number of at least 2, got {self.substeps}")
        if self.solver_iterations < 1:
            raise ValueError(f"solver_iterations must be at least 1, got {self.solver_iterations}")
        if not self.control_dt > 0:
            raise ValueError(f"control_dt must be positive, got {self.control_dt}")
        if not self.ground_stiffness > 0:
            raise ValueError(f"ground_stiffness must be positive, got {self.ground_stiffness}")
        for name in ("solver_residual", "contact_threshold", "ground_friction", "ground_damping", "obstacle_friction"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")

    @property
    def substep(self) -> float:
        """Duration of a physics step, s."""
        return self.control_dt / self.substeps

    @classmethod
    def preset(cls, name: str) -> BulletSettings:
        """Returns the settings of the given name in :data:`PRESETS`.

        Raises:
            ValueError: if the name is unknown.
        """
        if name not in PRESETS:
            raise ValueError(f"unknown physics {name!r}{perhaps(name, PRESETS)}; use one of {list(PRESETS)}")
        return PRESETS[name]


PRESETS: dict[str, BulletSettings] = {
    "default": BulletSettings(),
    "accurate": BulletSettings(substeps=26, solver_iterations=50),
    "fast": BulletSettings(substeps=6, solver_iterations=30),
}
"""Physics presets by name: the default, steps of about 2 ms, and fewer steps with a larger error."""
