"""Sensors of an environment and of a policy, by name. Importing this module does not import PyTorch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from rover_rl.envs.config import SCAN_POSE
from rover_rl.registry import Registry

if TYPE_CHECKING:
    from rover_rl.envs.config import EnvConfig, LidarConfig, SensorLike
    from rover_rl.envs.sensors.base import Sensor

LIDAR_MASK, MOVERS, ROUTE, SEEN_DISTANCES, ROBOT = "lidar_mask", "movers", "route", "seen_distances", "robot"
CONTACT_TIMES, VISITS = "contact_times", "visits"
_HERE = "rover_rl.envs.sensors"
BUILT_IN = {
    "lidar": f"{_HERE}.standard:Lidar",
    "pose": f"{_HERE}.standard:Pose",
    "imu": f"{_HERE}.standard:Imu",
    "target": f"{_HERE}.standard:Target",
    "velocities": f"{_HERE}.standard:WheelOdometry",
    SCAN_POSE: f"{_HERE}.standard:ScanPose",
    LIDAR_MASK: f"{_HERE}.standard:LidarMask",
    MOVERS: f"{_HERE}.movers:Movers",
    CONTACT_TIMES: f"{_HERE}.contact_times:ContactTimes",
    "past_scans": f"{_HERE}.past_scans:PastScans",
    VISITS: f"{_HERE}.visits:Visits",
    ROUTE: f"{_HERE}.route:Route",
    SEEN_DISTANCES: f"{_HERE}.route:SeenDistances",
    ROBOT: f"{_HERE}.robot:RobotBody",
    "heights": f"{_HERE}.heights:HeightScan",
    "depth": f"{_HERE}.cameras:DepthCamera",
    "colors": f"{_HERE}.cameras:ColorCamera",
    "segmentation": f"{_HERE}.cameras:SegmentationCamera",
    "lidar3d": f"{_HERE}.cameras:Lidar3D",
    "contact": f"{_HERE}.forces:ContactSensor",
    "effort": f"{_HERE}.forces:WheelEffort",
}
"""Class of each sensor of the package, by the key of its entry, in the order of the observation."""
OPTIONAL = {*BUILT_IN} - {"lidar", "pose", "imu", "target", "velocities"}
"""Sensors of the package that an environment has only if asked for."""
_REGISTRY = Registry("sensor", BUILT_IN)
_TAKEN = {*BUILT_IN, "action", "reward", "done", "terminated", "truncated", "outcome", "privileged"} - OPTIONAL
"""Keys that sensors of one's own cannot have."""


def register_sensor(name: str, sensor: Any) -> None:
    """Registers a sensor under a name, for ``make_env``, ``EnvConfig`` and ``--sensors``.

    Args:
        name: new name of letters, digits, ``_``, ``-`` and ``.``.
        sensor: :class:`Sensor`, function or class without arguments that makes one, or ``"module:attribute"`` of any
            of these.

    Raises:
        ValueError: if the name is taken or has other characters.
    """
    _REGISTRY.register(name, sensor)


def own_sensors(sensors: Sequence[SensorLike]) -> dict[str, Sensor]:
    """Returns the sensors that are given as objects or by name, by the key of their entry.

    A name may have settings, as in ``"depth(size=(24, 32))"``.

    Raises:
        ValueError: if a sensor is unknown or something else, or its key is taken.
    """
    if not sensors:
        return {}
    from rover_rl.envs.sensors.base import Sensor

    found: dict[str, Sensor] = {}
    for each in sensors:
        part = _REGISTRY.make(each, Sensor)
        if part.name in _TAKEN or part.name in found:
            raise ValueError(f"sensors cannot add {part.name!r}, which is there already: choose another name")
        found[part.name] = part
    return found


def policy_sensors(lidar: LidarConfig, own: Sequence[SensorLike] = ()) -> dict[str, Sensor]:
    """Returns the sensors that a policy can read, by key, with those of one's ``own``: see :func:`own_sensors`."""
    scans = {"points": lidar.points, "period": lidar.period}
    settings: dict[str, dict[str, Any]] = {"lidar": {**scans, "max_range": lidar.max_range}, LIDAR_MASK: scans}
    built_in = {name: _REGISTRY.find(name)(**settings.get(name, {})) for name in BUILT_IN}
    return built_in | {name: sensor for name, sensor in own_sensors(own).items() if name not in settings}


def environment_sensors(
    lidar: LidarConfig, own: Sequence[SensorLike] = (), late_scans: bool = False, hides_beams: bool = False
) -> dict[str, Sensor]:
    """Returns the sensors that an environment reads, by key: those of :data:`OPTIONAL` only if they are in ``own``.

    With ``late_scans``, the pose of the scan is one, and the lidar is read in each step: what arrives tells its period.
    With ``hides_beams``, the mask of the lidar is one.
    """
    sensors, asked = policy_sensors(replace(lidar, period=1) if late_scans else lidar, own), {*own_sensors(own)}
    asked |= ({SCAN_POSE} if late_scans else set()) | ({LIDAR_MASK} if hides_beams else set())
    return {name: sensor for name, sensor in sensors.items() if name not in OPTIONAL or name in asked}


def with_sensors(env: EnvConfig, entries: Sequence[str], period: int = 1) -> EnvConfig:
    """Returns a description of an environment that has the ``entries`` of the package's sensors.

    Those that take long are read once in a ``period`` of steps, if they are added.
    """
    there = {*environment_sensors(env.lidar, env.own_sensors, env.late_scans, env.randomization.hides_beams)}
    added = [name for name in BUILT_IN if name in entries and name not in there]
    settings = {name: f"(period={period})" if period > 1 and _REGISTRY.find(name).takes_long else "" for name in added}
    return replace(env, sensors=(*env.sensors, *(name + settings[name] for name in added))) if added else env


def require_entries(observation: Sequence[str], own: Sequence[SensorLike]) -> None:
    """Raises ``ValueError`` if names of entries that a policy reads are unknown or given twice, or there is none."""
    known = (*BUILT_IN, *own_sensors(own))
    if not observation or len(set(observation)) < len(observation) or not set(observation) <= set(known):
        raise ValueError(f"observation must be some of {known}, each once, got {observation}")
