"""MuJoCo backend: rigid-body physics on CPUs, in MuJoCo, which only building a simulator imports."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from rover_rl.sims.settings import CONTROL_DT, PhysicsSettings


@dataclass(frozen=True)
class MujocoSettings(PhysicsSettings):
    """Settings of the MuJoCo backend.

    The defaults are chosen to reproduce Coulomb's law of friction, not to match another simulator:

    - **Elliptic friction cones** and Newton's method. Pyramidal cones make friction depend on the heading.
    - **Compliant contacts** (``stiffness``, ``damping``) of low impedance. MuJoCo's contact model lifts a sliding body
      by an amount that grows with its speed and with the rate at which friction constraints correct slip. Stiff
      contacts (MuJoCo's default) then open, the wheels hop, and a commanded spin of 2 rad/s turns the body at 0.4
      instead of 0.8 rad/s. Compliant contacts stay closed.
    - **Separate friction constraints** of wheels and ground (``solreffriction``) correct slip with a time constant of
      7 ms, a compromise between that lift and a quick transition from slip to grip. ``impratio`` of 100,000 keeps a
      standing rover from creeping.
    - **Motors as bounded constraints**: dry friction (``frictionloss`` of a tendon) of at most the motor's torque
      couples each wheel to a shaft that turns at the commanded speed, and the solver finds motor torques and contact
      forces together. The force of a velocity actuator follows from the speed at the start of a step. With a gain
      that holds a rover on a slope, it is at one of its limits in every step and shakes the wheels.
    - **Treads for the ground**: the ground carries each wheel at two points, ``width / sqrt(3)`` apart (Gauss-Legendre
      quadrature), whose friction equals that of a load spread evenly over the width. Contacts at the outer edges would
      turn the rover 3 % slower. Obstacles collide with the full width.

    Args:
        control_dt: duration of a control step, s; the contract controls at 20 Hz.
        substeps: number of physics steps per control step. The default stiffness needs 8 or more to be stable.
        solver_iterations: maximum number of iterations of Newton's method per substep. Most substeps take 1 to 3.
        solver_tolerance: improvement of an iteration below which the solver stops, relative to the mass of the rover.
            With MuJoCo's default, 1e-8, a standing rover vibrates and creeps.
        stiffness: contact stiffness of a wheel of Rover Zero, N/m, which sinks in by 0.5 mm. That of other robots and
            their damping are in proportion to their mass. The load on four rigid wheels is indeterminate; compliant
            wheels share it according to the shape of the ground.
        damping: contact damping of a wheel of Rover Zero, N s/m.
        ground_friction: Coulomb coefficient between rover and ground, the same in every direction.
        obstacle_friction: Coulomb coefficient between rover and obstacles, the same in every direction.
        threads: number of CPU threads; ``None`` uses as many as torch. Results do not depend on it.

    Raises:
        ValueError: for a number that is out of range.
    """

    positive: ClassVar[tuple[str, ...]] = ("control_dt", "stiffness", "damping")

    control_dt: float = CONTROL_DT
    substeps: int = 10
    solver_iterations: int = 50
    solver_tolerance: float = 1e-12
    stiffness: float = 60_000.0
    damping: float = 500.0
    ground_friction: float = 0.5
    obstacle_friction: float = 0.25
    threads: int | None = None
