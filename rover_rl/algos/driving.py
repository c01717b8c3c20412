"""A policy on a live rover, to one goal after another, stopped by whatever should stop it.

Example:
    >>> env = RoverEnv(backend=Ros2Settings(reset="none"), world_n="maze", end_on_goal=True)
    >>> with DriveLog(Path("drive.jsonl"), world="maze", policy="mine", seconds=60.0) as log:
    ...     for goal in [(1.0, 2.0), (-3.0, 0.5)]:
    ...         print(drive_to(env, policy, goal, log=log))
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.drive_log import DriveLog
from rover_rl.algos.evaluate import ENDINGS, Policy
from rover_rl.algos.metrics import STOPPED, TIME_LIMIT, TOO_NEAR
from rover_rl.algos.policy import single_threaded
from rover_rl.envs import Phase, RoverEnv
from rover_rl.sims.ros2.simulator import Ros2Simulator


@dataclass(frozen=True)
class Moment:
    """What is known after a step of a drive.

    Attributes:
        distance: to the goal, m.
        speed: by wheel odometry, m/s.
        nearest: the lidar's least reading, m.
        latency: from the scan's arrival to the command that answered it, s.
        command: forward speed (m/s) and yaw rate (rad/s) that were sent.
        seconds: since the drive to this goal began.
    """

    distance: float
    speed: float
    nearest: float
    latency: float
    command: tuple[float, float]
    seconds: float


@single_threaded()
def drive_to(
    env: RoverEnv,
    policy: Policy,
    goal: tuple[float, float],
    *,
    seconds: float = 60.0,
    clearance: float = 0.0,
    watch: Callable[[Moment], None] = lambda moment: None,
    log: DriveLog | None = None,
) -> str:
    """Drives to one goal, and stops the rover there, or wherever the drive ends, by an error too.

    Args:
        env: a live rover, with ``end_on_goal``.
        policy: as for :func:`~rover_rl.algos.evaluate.evaluate`.
        goal: x, y, m.
        seconds: for the drive.
        clearance: the drive ends where the lidar reads less than this, m.
        watch: is told of each step.
        log: is written to.

    Returns:
        How it ended: ``"goal"``, ``"time limit"``, ``"obstacle too near"``, or the kind of an early ending.

    Raises:
        RobotLostError: if the rover does not tell about itself any more.
        ValueError: for an environment of another backend.
    """
    rover = live_rover(env)
    ending, driven = "", 0.0
    try:
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            policy(env.fake_tensordict())  # the first call takes long: not while the rover waits
            now = env.reset(goal=torch.tensor([goal]))
            if log is not None:
                log.begin(env.rover_state, goal)
            while not ending:
                now = env.step(policy(now))["next"]
                driven += env.rover_state.dt.item()
                watch(_moment(rover, now, driven))
                if log is not None:
                    log.add(env.rover_state, now["outcome"], rover.last_command, rover.latency)
                ending = _ending(now, clearance, driven >= seconds)
    finally:
        rover.stop()
        if log is not None:
            log.end(ending or STOPPED)
    return ending


def live_rover(env: RoverEnv) -> Ros2Simulator:
    """The live rover of an environment.

    Raises:
        ValueError: for an environment of another backend.
    """
    if not isinstance(env.simulator, Ros2Simulator):
        raise ValueError(f"only backend 'ros2' has a live rover, got {type(env.simulator).__name__}")
    return env.simulator


def _ending(now: TensorDictBase, clearance: float, late: bool) -> str:
    """How the drive has ended; empty while it goes on."""
    if bool(now["terminated"]):
        return ENDINGS[Phase(int(now["outcome", "phase"]))]
    if bool(now["truncated"]) or late:
        return TIME_LIMIT
    return TOO_NEAR if now["lidar"].min().item() < clearance else ""


def _moment(rover: Ros2Simulator, now: TensorDictBase, seconds: float) -> Moment:
    return Moment(
        distance=now["target"][0, 0].item(),
        speed=now["velocities"][0, 0].item(),
        nearest=now["lidar"].min().item(),
        latency=rover.latency,
        command=rover.last_command,
        seconds=seconds,
    )
