"""URDFs as public ones are written: any base frame, axes of either sign, rotated joint frames, dummy links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

INERTIA = '<inertia ixx="{0}" ixy="0" ixz="0" iyy="{0}" iyz="0" izz="{0}"/>'


def inertial(mass: float, moment: float = 0.01) -> str:
    return f'<inertial><mass value="{mass}"/>{INERTIA.format(moment)}</inertial>'


def shape(kind: str, geometry: str, xyz: str = "0 0 0", rpy: str = "0 0 0") -> str:
    return f'<{kind}><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{geometry}</geometry></{kind}>'


def box(size: str, xyz: str = "0 0 0", kind: str = "collision") -> str:
    return shape(kind, f'<box size="{size}"/>', xyz)


def link(name: str, content: str = "") -> str:
    return f'<link name="{name}">{content}</link>'


def joint(name: str, kind: str, parent: str, child: str, xyz: str = "0 0 0", more: str = "", rpy: str = "0 0 0") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/>{more}</joint>'
    )


@dataclass
class Machine:
    """A URDF in the making, whose base link is ``height`` above the ground."""

    height: float = 0.1
    radius: float = 0.1
    width: float = 0.05
    wheel_mass: float = 0.6
    sign: int = 1
    steering: int = -1
    """Direction of the steering axes along z."""
    parts: list[str] = field(default_factory=list)

    def body(self, mass: float = 10.0, size: str = "0.6 0.3 0.1", more: str = "") -> Machine:
        """Adds a base without mass at the ground, and the base link with the mass and a box."""
        self.parts += [
            link("base_footprint"),
            link("base_link", inertial(mass, 0.2) + box(size, "0 0 0.1") + more),
            joint("base_joint", "fixed", "base_footprint", "base_link", f"0 0 {self.height}"),
        ]
        return self

    def wheel(self, name: str, x: float, y: float, parent: str = "base_link", content: str | None = None) -> Machine:
        """Adds a wheel whose joint frame is rotated, so that its axle is z of the frame."""
        turn = f"{-1.5707963267948966 * self.sign} 0 0"
        disc = shape("collision", f'<cylinder radius="{self.radius}" length="{self.width}"/>')
        z = self.radius - self.height if parent == "base_link" else 0.0
        moment = 0.4 * self.wheel_mass * self.radius**2
        self.parts += [
            link(f"{name}_link", inertial(self.wheel_mass, moment) + (disc if content is None else content)),
            joint(name, "continuous", parent, f"{name}_link", f"{x} {y} {z}", '<axis xyz="0 0 1"/>', turn),
        ]
        return self

    def wheels(self, xs: Sequence[float], y: float = 0.2) -> Machine:
        """Adds pairs of wheels."""
        for number, x in enumerate(xs):
            for side, place in (("left", y), ("right", -y)):
                self.wheel(f"{side}_{number}", x, place)
        return self

    def knuckle(self, name: str, x: float, y: float, limit: float = 0.6) -> Machine:
        """Adds a steering joint with a wheel."""
        limits = f'<axis xyz="0 0 {self.steering}"/><limit lower="{-limit}" upper="{limit}" effort="1" velocity="1"/>'
        place = f"{x} {y} {self.radius - self.height}"
        self.parts += [
            link(f"{name}_knuckle", inertial(0.1, 1e-4)),
            joint(f"{name}_steering", "revolute", "base_link", f"{name}_knuckle", place, limits),
        ]
        return self.wheel(f"{name}_wheel", 0.0, 0.0, f"{name}_knuckle")

    def ball(self, name: str, x: float, y: float = 0.0, radius: float = 0.02, mass: float = 0.05) -> Machine:
        """Adds a ball that is fixed to the base and touches the ground."""
        ball = shape("collision", f'<sphere radius="{radius}"/>')
        place = f"{x} {y} {radius - self.height}"
        self.parts += [
            link(f"{name}_link", inertial(mass, 1e-5) + ball),
            joint(name, "fixed", "base_link", f"{name}_link", place),
        ]
        return self

    def add(self, *parts: str) -> Machine:
        self.parts += parts
        return self

    def write(self, folder: Path, name: str = "machine") -> Path:
        path = folder / f"{name}.urdf"
        path.write_text(f'<?xml version="1.0"?><robot name="{name}">{"".join(self.parts)}</robot>')
        return path


def car(**settings: float) -> Machine:
    machine = Machine(**settings).body()  # type: ignore[arg-type]
    machine.knuckle("left", 0.25, 0.2).knuckle("right", 0.25, -0.2)
    return machine.wheel("rear_left", -0.25, 0.2).wheel("rear_right", -0.25, -0.2)
