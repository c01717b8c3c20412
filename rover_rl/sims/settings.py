"""What the settings of all simulators share. Does not import PyTorch."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any, ClassVar

from rover_rl.registry import perhaps

if TYPE_CHECKING:
    from typing_extensions import Self


class PhysicsSettings:
    """Base of the settings of a simulator, which are frozen dataclasses.

    Whole numbers must be at least 1, the numbers in ``positive`` positive, and no other number negative. ``None`` is
    left out. ``presets`` holds what each preset changes, by name.
    """

    positive: ClassVar[tuple[str, ...]] = ("control_dt", "stiffness")
    presets: ClassVar[dict[str, dict[str, Any]]] = {"default": {}}

    control_dt: float
    substeps: int

    def __post_init__(self) -> None:
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

    @classmethod
    def preset(cls, name: str) -> Self:
        """Returns the settings of a preset by name.

        Raises:
            ValueError: if the name is unknown.
        """
        if name not in cls.presets:
            raise ValueError(f"unknown physics {name!r}{perhaps(name, cls.presets)}; use one of {list(cls.presets)}")
        return cls(**cls.presets[name])
