"""Driving a live rover with a policy, from goal to goal, with every reason to stop it.

Example:
    >>> env = RoverEnv(backend=Ros2Settings(reset="none"), world_n="maze", end_on_goal=True)
    >>> with DriveLog(Path("drive.jsonl"), world="maze", policy="mine", seconds=60.0) as log:
    ...     for goal in [(1.0, 2.0), (-3.0, 0.5)]:
    ...         print(drive_to(env, policy, goal, log=log))
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.deploy.drive_log import DriveLog
from rover_rl.algos.evaluation.evaluate import ENDINGS, Policy
from rover_rl.algos.evaluation.metrics import RESTARTED, STOPPED, TIME_LIMIT, TOO_NEAR
from rover_rl.algos.policy.networks import single_threaded
from rover_rl.envs import RoverEnv, StepEvent
from rover_rl.envs.config import require_match
from rover_rl.sims import RoverState
from rover_rl.sims.ros2.simulator import Ros2Simulator

_log = logging.getLogger(__name__)

TRAINED_VIEW = 2 * math.pi
"""Field of view of the lidar in simulation, where policies are trained, rad."""
VIEW_TOLERANCE = math.radians(10)
"""A lidar that covers this much less counts as one with the same view."""
CLOCK_TOLERANCE = 0.5
"""Seconds that a robot's clock may go back before it counts as restarted."""
POSE_TOLERANCE = 1.0
"""Metres that a pose may jump before the robot counts as restarted, beside what it can have driven."""


@dataclass(frozen=True)
class Moment:
    """A step of a drive.

    Attributes:
        distance: to the goal, m.
        speed: by wheel odometry, m/s.
        nearest: the lidar's least reading, m.
        latency: from the scan's arrival to the command that answered it, s.
        command: forward speed (m/s) and yaw rate (rad/s) that were sent.
        held: whether the forward speed was cancelled, as it led towards what no lidar beam covers.
        seconds: since the drive to this goal began.
    """

    distance: float
    speed: float
    nearest: float
    latency: float
    command: tuple[float, float]
    held: bool
    seconds: float


@single_threaded()
def drive_to(
    env: RoverEnv,
    policy: Policy,
    goal: tuple[float, float],
    *,
    seconds: float = 60.0,
    clearance: float = 0.0,
    allow_unseen: bool = False,
    watch: Callable[[Moment], None] = lambda moment: None,
    log: DriveLog | None = None,
) -> str:
    """Drives to one goal, and stops the rover there or wherever the drive ends, also by an error.

    Args:
        env: a live rover, with ``end_on_goal``.
        policy: as for :func:`~rover_rl.algos.evaluation.evaluate.evaluate`.
        goal: x, y, m.
        seconds: time limit of the drive.
        clearance: the drive ends where the lidar reads less than this, m.
        allow_unseen: whether to drive with a lidar that covers less than the policy was trained with.
        watch: called after each step.
        log: written to at each step.

    Returns:
        The ending: ``"goal"``, ``"time limit"``, ``"obstacle too near"``, ``"robot restarted"``, or the kind of an
        early ending.

    Raises:
        RobotLostError: if the rover's sensors fall silent, or several robots answer.
        ValueError: for an environment of another backend, a policy made for another environment, or a lidar that covers
            less than the policy was trained with.
    """
    rover = live_rover(env)
    if made_for := getattr(policy, "made_for", None):
        require_match(made_for, env.config)
    rover.require_robot()
    if not allow_unseen:
        require_view(rover.field_of_view)
    ending, driven = "", 0.0
    try:
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            policy(env.fake_tensordict())  # the first call takes long: not while the rover waits
            now = env.reset(goal=torch.tensor([goal]))
            if log is not None:
                log.begin(env.rover_state, goal)
            while not ending:
                before = env.rover_state
                now = env.step(policy(now))["next"]
                driven += env.rover_state.dt.item()
                moment = _moment(rover, now, driven)
                watch(moment)
                if log is not None:
                    log.add(env.rover_state, now["outcome"], moment.command, moment.latency, moment.held)
                if reason := restart(before, env.rover_state):
                    _log.warning("the robot seems to have been restarted: %s", reason)
                ending = RESTARTED if reason else _ending(now, clearance, driven >= seconds)
    finally:
        rover.stop()
        if log is not None:
            log.end(ending or STOPPED)
    return ending


def require_view(field_of_view: float) -> None:
    """Refuses a lidar that covers less (rad) than policies are trained with.

    Raises:
        ValueError: if it does.
    """
    if field_of_view < TRAINED_VIEW - VIEW_TOLERANCE:
        raise ValueError(
            f"the scan covers {math.degrees(field_of_view):.0f} degrees, and the policy was trained with "
            f"{math.degrees(TRAINED_VIEW):.0f}; --allow-unseen drives all the same, but not towards what no beam covers"
        )


def restart(before: RoverState, after: RoverState) -> str:
    """Why a robot seems to have been restarted or carried between two steps; empty if it does not."""
    elapsed = (after.stamp - before.stamp).item()
    if elapsed < -CLOCK_TOLERANCE:
        return f"its clock went back by {-elapsed:.1f} s"
    moved = torch.dist(before.position, after.position).item()
    if moved > POSE_TOLERANCE + 2 * max(elapsed, 0.0):  # twice as fast as it drives
        return f"its pose jumped by {moved:.1f} m"
    return ""


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
        return ENDINGS[StepEvent(int(now["outcome", "phase"]))]
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
        held=rover.held,
        seconds=seconds,
    )
