"""Warp backend: a simulator specialized for this rover, for CPUs and NVIDIA GPUs; see ``docs/warp.md``.

Only building a simulator imports Warp.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from rover_rl.sims.settings import CONTROL_DT, PhysicsSettings


@dataclass(frozen=True)
class WarpSettings(PhysicsSettings):
    """Settings of the Warp backend. The defaults match the default preset of the Bullet backend as closely as possible.

    Args:
        control_dt: duration of a control step, s; the contract controls at 20 Hz.
        substeps: number of physics steps per control step.
        solver_iterations: iterations of the contact solver per substep, warm-started with the last substep's impulses.
        stiffness: contact stiffness of a wheel, N/m. The load on four rigid wheels is indeterminate; compliant wheels
            share it according to the shape of the ground.
        damping: contact damping of a wheel, N s/m.
        max_correction: maximum speed at which a penetration is removed, m/s: a deep one does not launch a rover.
        margin: gap above which a wheel contact is ignored by the solver, m.
        ground_friction: Coulomb coefficient between rover and ground, the same in every direction.
        obstacle_friction: Coulomb coefficient between rover and obstacles, the same in every direction.
        threads: number of CPU threads; ``None`` uses as many as torch. Results do not depend on it.
        lidar_lanes: number of threads that scan for one rover, a power of two up to 32: to tune the speed on a GPU.
            ``None`` uses 8 on a GPU and 1 on the CPU. Ranges are the same for all numbers but 1, whose ranges differ
            in the last bit where two surfaces meet.
        block_size: threads per block on a GPU, a multiple of 32: to tune the speed there. ``None`` uses 32.
        planar: simulate level worlds with three degrees of freedom, several times as fast. The preset ``"planar"``
            has fewer substeps and iterations, too.

    Raises:
        ValueError: if a number is out of range.
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
    lidar_lanes: int | None = None
    block_size: int | None = None
    planar: bool = False

    presets: ClassVar[dict[str, dict[str, Any]]] = {
        "default": {},
        "full": {},
        "planar": {"planar": True, "substeps": 2, "solver_iterations": 3},
    }

    @property
    def simulator(self) -> str:
        """Simulator of these settings, as ``"module:attribute"``."""
        return "rover_rl.sims.warp." + (
            "planar.simulator:PlanarSimulator" if self.planar else "simulator:WarpSimulator"
        )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.lidar_lanes not in (None, 1, 2, 4, 8, 16, 32):
            raise ValueError(f"lidar_lanes must be 1, 2, 4, 8, 16 or 32, got {self.lidar_lanes}")
        if self.block_size is not None and not (32 <= self.block_size <= 1024 and self.block_size % 32 == 0):
            raise ValueError(f"block_size must be a multiple of 32 from 32 to 1024, got {self.block_size}")
