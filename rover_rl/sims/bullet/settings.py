"""Settings of the Bullet physics."""

from __future__ import annotations

from dataclasses import dataclass

from rover_rl.sims.timing import CONTROL_DT


@dataclass(frozen=True)
class BulletSettings:
    """How Bullet simulates. The defaults keep a standing rover where it is, and turn it alike in every heading.

    ``docs/physics.md`` tells what each preset costs and how far it is from steps of 1 ms.

    Args:
        control_dt: duration of a control step, s; the contract controls at 20 Hz.
        substeps: physics steps in a control step; 10 of 5 ms are those of the original's inspect world. Their number is
            even, since friction takes turns with them.
        solver_iterations: at most so many iterations of the contact solver in a substep.
        solver_residual: the solver stops early below this residual. Bullet's own 1e-7 lets a standing rover creep by a
            millimetre in 30 seconds; 1e-9 holds it to a fifth of that.
        contact_threshold: contacts that are open farther than this, m, are left out of the solver. Bullet by itself
            takes all in (``math.inf``).
        ground_friction: Coulomb coefficient between rover and ground.
        obstacle_friction: the same for obstacles. At 0.35 and more the wheels climb up a wall that they push against,
            and the rover falls on its back.

    Raises:
        ValueError: for a number that is out of range.
    """

    control_dt: float = CONTROL_DT
    substeps: int = 10
    solver_iterations: int = 50
    solver_residual: float = 1e-9
    contact_threshold: float = 0.0
    ground_friction: float = 0.5
    obstacle_friction: float = 0.25

    def __post_init__(self) -> None:
        if self.substeps < 2 or self.substeps % 2:
            raise ValueError(f"substeps must be an even number of at least 2, got {self.substeps}")
        if self.solver_iterations < 1:
            raise ValueError(f"solver_iterations must be at least 1, got {self.solver_iterations}")
        if not self.control_dt > 0:
            raise ValueError(f"control_dt must be positive, got {self.control_dt}")
        for name in ("solver_residual", "contact_threshold", "ground_friction", "obstacle_friction"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")

    @property
    def substep(self) -> float:
        """Duration of a physics step, s."""
        return self.control_dt / self.substeps

    @classmethod
    def preset(cls, name: str) -> BulletSettings:
        """The settings of that name in :data:`PRESETS`.

        Raises:
            ValueError: for an unknown name.
        """
        if name not in PRESETS:
            raise ValueError(f"unknown physics {name!r}; use one of {list(PRESETS)}")
        return PRESETS[name]


PRESETS: dict[str, BulletSettings] = {
    "default": BulletSettings(),
    "accurate": BulletSettings(substeps=26),
    "fast": BulletSettings(substeps=6, solver_iterations=30),
}
"""Settings by name: the default, steps of about 2 ms, and what is cheaper and somewhat farther from the truth."""
