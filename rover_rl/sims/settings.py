"""What the settings of all simulators share. Does not import PyTorch."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, ClassVar

from rover_rl.plain import take_numbers
from rover_rl.registry import perhaps

if TYPE_CHECKING:
    from typing_extensions import Self


REFERENCE_MASS = 12.486
"""Mass of the robot that stiffness and damping are stated for, Rover Zero, kg."""


class PhysicsSettings:
    """Base of the settings of a simulator, which are frozen dataclasses.

    Whole numbers must be at least 1, the numbers in ``positive`` positive, and no other number negative. ``None`` is
    left out. ``presets`` holds what each preset changes, by name, and ``by_mass`` names what is in proportion to the
    mass of the robot.
    """

    positive: ClassVar[tuple[str, ...]] = ("control_dt", "stiffness")
    presets: ClassVar[dict[str, dict[str, Any]]] = {"default": {}}
    by_mass: ClassVar[tuple[str, ...]] = ("stiffness", "damping")

    control_dt: float
    substeps: int

    def __post_init__(self) -> None:
        take_numbers(self)
        for name, kind in ((field.name, str(field.type)) for field in fields(self)):  # type: ignore[arg-type]
            value = getattr(self, name)
            if value is None:
                continue
            if kind.startswith("int") and not value >= 1:
                raise ValueError(f"{name} must be at least 1, got {value}")
            if name in self.positive and not value > 0:
                raise ValueError(f"{name} must be positive, got {value}")
            if not value >= 0:
                raise ValueError(f"{name} must not be negative, got {value}")

    @property
    def substep(self) -> float:
        """Duration of a physics step, s."""
        return self.control_dt / self.substeps

    def for_mass(self, mass: float) -> Self:
        """Returns the settings for a robot of a mass, kg: its wheels sink in as far as those of Rover Zero."""
        share = mass / REFERENCE_MASS
        scaled = {name: share * getattr(self, name) for name in self.by_mass}
        return replace(self, **scaled)  # type: ignore[type-var]

    @classmethod
    def preset(cls, name: str) -> Self:
        """Returns the settings of a preset by name.

        Raises:
            ValueError: if the name is unknown.
        """
        if name not in cls.presets:
            raise ValueError(f"unknown physics {name!r}{perhaps(name, cls.presets)}; use one of {list(cls.presets)}")
        return cls(**cls.presets[name])
