"""Recordings of the drives in a log of ``rover-rl drive``."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from rover_rl.algos.deploy.drive_log import LoggedDrive, logged_drives
from rover_rl.algos.evaluation.metrics import Trajectory
from rover_rl.algos.video.recording import Recording, moments_of
from rover_rl.sims.base import RoverState
from rover_rl.sims.robots import get_robot
from rover_rl.sims.rotations import euler_to_matrix, matrix_to_quaternion
from rover_rl.sims.worlds import Terrain, World, get_world

NO_WORLD = "none"
"""Name that stands for flat ground without obstacles, on which the lidar readings show what was there."""
_MARGIN = 12.0
"""Size of that ground around the drive, m."""


def recording_of_log(path: Path, number: int | None = None, world: str | None = None) -> Recording:
    """Reads a drive of a log, resampled to 20 Hz."""
    drives = logged_drives(path)
    number = len(drives) - 1 if number is None else number
    if not 0 <= number < len(drives):
        raise ValueError(f"{path} has {len(drives)} drives: --episode must be at most {len(drives) - 1}, got {number}")
    drive = drives[number]
    driven, scans, goal = drive.trajectory(), drive.scans(), torch.tensor([drive.goal])
    place = _world(drive, world, torch.cat((driven.path, goal)))
    position = driven.position.clone()
    if place.name == NO_WORLD:
        position[:, 2] = 0.0
    orientation = matrix_to_quaternion(euler_to_matrix(driven.angles))
    poses = zip(position, orientation, _speeds(driven), strict=True)
    states = [(_state(*pose, driven.dt), scan[None]) for pose, scan in zip(poses, scans, strict=True)]
    angles = torch.arange(scans.shape[1]) * (2 * math.pi / max(1, scans.shape[1]))
    moments = moments_of(states, goal, driven.dt, drive.ending)
    return Recording(moments, place, get_robot(drive.robot), angles, driven.dt, drive.ending, number)


def _world(drive: LoggedDrive, world: str | None, points: Tensor) -> World:
    """Returns the world to show: see :func:`recording_of_log`. Flat ground surrounds ``points [P, 2]``."""
    if world not in (None, NO_WORLD):
        return get_world(world)
    if world is None:
        try:
            return get_world(drive.world)
        except (ValueError, OSError, ImportError):
            pass
    side = math.ceil(2 * (points.abs().max().item() + _MARGIN))
    return World(NO_WORLD, Terrain.flat((float(side), float(side))))


def _speeds(driven: Trajectory) -> Tensor:
    """Forward speeds at the start and after each step, m/s. The log holds no wheel odometry."""
    return torch.cat((torch.zeros(1), driven.signed_speed))


def _state(position: Tensor, orientation: Tensor, speed: Tensor, dt: float) -> RoverState:
    nothing = torch.zeros(1, 1)
    return RoverState.pack(
        position=position[None],
        orientation=orientation[None],
        linear_velocity=speed.reshape(1, 1),
        angular_velocity=nothing,
        dt=torch.full((1, 1), dt),
        stamp=nothing.double(),
    )
