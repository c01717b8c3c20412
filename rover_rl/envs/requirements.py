"""What an environment needs of its simulator and its robot."""

from __future__ import annotations

from rover_rl.envs.config import EnvConfig
from rover_rl.sims.base import Capability, Simulator
from rover_rl.sims.robots import Robot


def check_requirements(config: EnvConfig, robot: Robot, simulator: Simulator) -> None:
    """Checks that a simulator and a robot can do what an environment needs.

    Raises:
        ValueError: for the first thing that one of them cannot do.
    """
    needs: dict[Capability, str] = {}
    if config.task.collision_from == "contact":
        needs["contacts"] = "a task with collision_from='contact' needs a backend that reports contacts"
    if config.lidar.period > 1:
        needs["scan_period"] = f"lidar_period must be 1, got {config.lidar.period}, or the backend must take scanned"
    if config.randomization.varies_dynamics:
        needs["dynamics"] = "randomized friction, mass and motors need a backend in which they can be varied"
    for capability, need in needs.items():
        if capability not in simulator.capabilities:
            raise ValueError(f"{need}: {type(simulator).__name__} does not state the capability {capability!r}")
    if config.action.max_sideways and "live" in simulator.capabilities:
        raise ValueError("max_sideways must be 0 with a live rover, whose commands are speed and yaw rate")
    if config.action.max_sideways and not robot.drive.sideways:
        drive = type(robot.drive).__name__
        raise ValueError(f"max_sideways needs a drive that moves sideways, and robot {robot.name!r} has a {drive}")
