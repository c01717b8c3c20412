"""Settings of the Warp backend."""

from __future__ import annotations

from dataclasses import dataclass

from rover_rl.sims.timing import CONTROL_DT


@dataclass(frozen=True)
class WarpSettings:
    """How the Warp backend simulates. The defaults are as near to Bullet's default as the two can be.

    Args:
        control_dt: duration of a control step, s; the contract controls at 20 Hz.
        substeps: physics steps in a control step.
        solver_iterations: of the contact solver in a substep; it begins with the impulses of the one before.
        stiffness: of a wheel on the ground, N/m. Four rigid wheels could share the load in any way; these share it as
            the ground has it.
        damping: of the same, N s/m.
        max_correction: greatest speed at which a penetration is taken away, m/s, so that nothing is thrown up.
        margin: gap from which on a wheel's contact is left out of the solver, m.
        ground_friction: Coulomb coefficient between rover and ground, the same in every direction.
        obstacle_friction: the same for obstacles.
        threads: of the CPU; ``None``: as many as torch uses. They change no number.

    Raises:
        ValueError: for a number that is out of range.
    """

    control_dt: float = CONTROL_DT
    substeps: int = 5
    solver_iterations: int = 4
    stiffness: float = 30_000.0
    damping: float = 420.0
    max_correction: float = 1.0
    margin: float = 0.005
    ground_friction: float = 0.5
    obstacle_friction: float = 0.25
    threads: int | None = None

    def __post_init__(self) -> None:
        for name in ("substeps", "solver_iterations"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"threads must be at least 1, got {self.threads}")
        if not self.control_dt > 0:
            raise ValueError(f"control_dt must be positive, got {self.control_dt}")
        if not self.stiffness > 0:
            raise ValueError(f"stiffness must be positive, got {self.stiffness}")
        for name in ("damping", "max_correction", "margin", "ground_friction", "obstacle_friction"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must not be negative, got {getattr(self, name)}")

    @property
    def substep(self) -> float:
        """Duration of a physics step, s."""
        return self.control_dt / self.substeps

    @classmethod
    def preset(cls, name: str) -> WarpSettings:
        """The settings of that name: there is ``"default"``.

        Raises:
            ValueError: for an unknown name.
        """
        if name != "default":
            raise ValueError(f"unknown physics {name!r}; backend 'warp' has one preset, 'default'")
        return cls()
