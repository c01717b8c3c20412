"""What the settings of all simulators share, and the topics of a live rover. Does not import PyTorch."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

from rover_rl.checks import check_topics
from rover_rl.plain import take_numbers
from rover_rl.registry import perhaps

if TYPE_CHECKING:
    from typing_extensions import Self

CONTROL_DT = 0.05
"""Default duration of a control step, s: the control rate of the contract, 20 Hz.

``Simulator.control_dt`` is the value that a simulator uses.
"""
MIN_REVERSAL = 0.5
"""Smallest desired yaw rate that changes the turning direction of a live rover, rad/s. The heading PID outputs it at a
heading error of 14 degrees."""
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
        """Returns the settings of a preset. Raises ``ValueError`` if the name is unknown."""
        if name not in cls.presets:
            raise ValueError(f"unknown physics {name!r}{perhaps(name, cls.presets)}; use one of {list(cls.presets)}")
        return cls(**cls.presets[name])


def at_rate(settings: Any, rate: float) -> Any:
    """Returns the settings of a simulator at another control rate, Hz.

    A control step has so many physics steps that none lasts longer than before. ``substep_multiple`` of a class of
    settings is a number that divides theirs. Raises ``ValueError`` if the settings have no field ``control_dt``.
    """
    names = [field.name for field in fields(settings)] if is_dataclass(settings) else []
    if "control_dt" not in names:
        raise ValueError(f"control_rate needs a backend whose settings have a control_dt, and {settings!r} has none")
    changes: dict[str, Any] = {"control_dt": 1 / rate}
    if "substeps" in names:
        multiple = getattr(settings, "substep_multiple", 1)
        steps = vars(settings)["substeps"] / rate / vars(settings)["control_dt"]
        changes["substeps"] = max(1, math.ceil(steps / multiple - 1e-9)) * multiple
    return replace(settings, **changes)


@dataclass(frozen=True)
class Connection:
    """Topics and timeout of the connection to a live rover, as in the original environment's arguments.

    Simulators that generate their own sensor data ignore it. Raises ``ValueError`` if ROS 2 does not allow a topic.
    """

    scan_topic: str = "/scan"
    """Topic of the lidar scan, a sensor_msgs/LaserScan."""
    imu_topic: str = "/imu/data"
    """Topic of the IMU, a sensor_msgs/Imu."""
    cmd_vel_topic: str = "/cmd_vel"
    """Topic of the velocity command, a geometry_msgs/Twist."""
    camera_topic: str = "/camera/image_raw"
    """Topic of the depth image, a sensor_msgs/Image, for policies that read one. One that ends in /compressed or
    /compressedDepth has a sensor_msgs/CompressedImage."""
    color_topic: str = "/camera/color/image_raw"
    """Topic of the color image, likewise."""
    timeout: float = 30.0
    """Time to wait for the rover's first scan, s."""
    elevation_topic: str = "/elevation_map"
    """Topic of the ground, a grid_map_msgs/GridMap or sensor_msgs/PointCloud2, for policies that read heights."""
    points_topic: str = "/points"
    """Topic of a 3D lidar, a sensor_msgs/PointCloud2, for policies that read one."""

    def __post_init__(self) -> None:
        take_numbers(self)
        check_topics(**{name: topic for name, topic in vars(self).items() if name.endswith("_topic")})

    @property
    def image_topics(self) -> dict[str, str]:
        """Topics of the images, by what they show."""
        return {"depth": self.camera_topic, "colors": self.color_topic}
