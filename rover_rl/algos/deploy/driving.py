"""Driving of a live rover with a policy, one goal at a time, with safety stops.

Example:
    With a rover that runs:

    >>> env = RoverEnv(backend=Ros2Settings(reset="none"), world_n="maze", end_on_goal=True)  # doctest: +SKIP
    >>> runner = PolicyRunner(policy)  # doctest: +SKIP
    >>> with DriveBag(Path("drive.mcap"), world="maze", policy="mine", seconds=60.0) as bag:  # doctest: +SKIP
    ...     env.simulator.tap(bag.add)  # also records what is received and sent
    ...     for goal in [(1.0, 2.0), (-3.0, 0.5)]:
    ...         print(drive_to(env, runner, goal, bag=bag))
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase

from rover_rl.algos.deploy.bags import DriveBag
from rover_rl.algos.driving import RESTARTED, STOPPED, TIME_LIMIT, TOO_NEAR, Drive, ending_of
from rover_rl.algos.policy.runner import Policy, PolicyRunner
from rover_rl.envs.config import EnvConfig, require_match
from rover_rl.envs.make import add_terms
from rover_rl.envs.rover import RoverEnv
from rover_rl.native.threads import single_threaded
from rover_rl.sims import RoverState
from rover_rl.sims.ros2.simulator import Ros2Simulator
from rover_rl.sims.ros2.tf import MAP

_log = logging.getLogger(__name__)

VIEW_TOLERANCE = math.radians(10)  # largest difference of two fields of view that count as the same, rad
CLOCK_TOLERANCE = 0.5  # largest backward jump of a robot's clock that does not count as a restart, s
POSE_TOLERANCE = 1.0
"""Largest jump of a pose, beyond the distance that the robot can drive, that does not count as a restart, m."""


@dataclass(frozen=True)
class Moment:
    """Status of a drive after a step."""

    distance: float  #: Distance to the goal, m.
    speed: float  #: Forward speed from the wheel odometry, m/s.
    nearest: float  #: Smallest lidar reading, m.
    latency: float  #: Time from the arrival of the scan to the command that was computed from it, s.
    command: tuple[float, float]  #: Forward speed (m/s) and yaw rate (rad/s) that were sent.
    held: bool  #: Whether the forward speed was set to 0, because no lidar beam covers the direction of travel.
    seconds: float  #: Time since the drive to this goal began, s.


@single_threaded()
def drive_to(
    env: RoverEnv,
    policy: Policy | PolicyRunner,
    goal: tuple[float, float],
    *,
    seconds: float = 60.0,
    clearance: float = 0.0,
    patience: float = 30.0,
    allow_unseen: bool = False,
    watch: Callable[[Moment], None] = lambda moment: None,
    bag: DriveBag | None = None,
) -> str:
    """Drives to one goal and stops the rover at the end of the drive, also after an error.

    A policy with memory decides at the times at which it did in training, whatever the rate of the scans. While
    something is nearer than ``clearance``, such as a person who stands at the rover, the drive does not begin.

    Args:
        env: environment of a live rover, with ``end_on_goal``.
        policy: module that maps observations to actions, used without exploration; or its runner, which keeps the
            memory of a policy from goal to goal.
        goal: x, y, m.
        seconds: time limit of the drive, s.
        clearance: lidar reading below which the drive ends, m.
        patience: longest time to wait for the beginning of the drive, s; it ends if something is still too near then.
        allow_unseen: whether to accept a lidar with a smaller field of view than the least that the training drew.
        bag: where the goal, the steps and the ending are recorded.

    Returns:
        The ending: ``"goal"``, ``"time limit"``, ``"obstacle too near"``, ``"robot restarted"``, or one of
        :data:`~rover_rl.algos.driving.ENDINGS`.

    Raises:
        RobotLostError: if the rover's sensors stop sending, or several robots answer.
        ValueError: if the environment has another backend, the policy was made for another environment, or the lidar
            covers less than in training.
    """
    rover = env.simulator
    if not isinstance(rover, Ros2Simulator):
        raise ValueError(f"only backend 'ros2' has a live rover, got {type(rover).__name__}")
    drive = Drive(add_terms(env), policy)
    _require_rover(rover, env, drive.runner, allow_unseen)
    ending, elapsed = "", 0.0
    try:
        with torch.no_grad():
            PolicyRunner(drive.runner.policy, env=env)(env.fake_tensordict())  # warm-up: the first call is slow
        # The memory of the runner is kept from goal to goal.
        drive.observation = drive.env.reset(goal=torch.tensor([goal]))
        if bag is not None:
            bag.begin(env.rover_state, env.scan, goal, rover.pose_frame or MAP)
        first = env.rover_state.stamp
        while drive.observation["lidar"].min() < clearance and env.rover_state.stamp - first < patience:
            watch(_moment(rover, drive.observation, 0.0))
            drive.observation = drive.env.reset(goal=env.goal)
        while not ending:
            before = env.rover_state
            # Maps and tracks have been read at the same times.
            now = drive.step(drive.decide(env.observer.inputs.due(drive.runner.action_repeat))).observation
            elapsed += env.rover_state.dt.item()
            moment = _moment(rover, now, elapsed)
            watch(moment)
            if bag is not None:
                told = {name: getattr(moment, name) for name in ("command", "latency", "distance", "held")}
                bag.step(env.rover_state, env.scan, now["outcome"], **told)
            if reason := _restart(before, env.rover_state):
                _log.warning("the robot seems to have been restarted: %s", reason)
                ending = RESTARTED
            elif bool(now["done"]):
                ending = ending_of(now)
            elif elapsed >= seconds:
                ending = TIME_LIMIT
            elif moment.nearest < clearance:
                ending = TOO_NEAR
    finally:
        rover.stop()
        if bag is not None:
            bag.end(ending or STOPPED)
    return ending


def _require_rover(rover: Ros2Simulator, env: RoverEnv, runner: PolicyRunner, allow_unseen: bool) -> None:
    made_for: EnvConfig | None = getattr(runner.policy, "made_for", None)
    trained_view = env.robot.lidar_view
    if made_for:
        require_match(made_for, env.config)
        trained_view = min(trained_view, *(made_for.randomization.lidar_view or (trained_view,)))
    rover.require_robot()
    if not allow_unseen and rover.field_of_view < trained_view - VIEW_TOLERANCE:
        raise ValueError(
            f"the scan covers {math.degrees(rover.field_of_view):.0f} degrees, and the policy was trained with "
            f"{math.degrees(trained_view):.0f}; --allow-unseen accepts it, but the rover does not drive in uncovered "
            "directions"
        )


def _moment(rover: Ros2Simulator, tensordict: TensorDictBase, seconds: float) -> Moment:
    return Moment(
        distance=tensordict["target"][0, 0].item(),
        speed=tensordict["velocities"][0, 0].item(),
        nearest=tensordict["lidar"].min().item(),
        latency=rover.latency,
        command=rover.last_command,
        held=rover.held,
        seconds=seconds,
    )


def _restart(before: RoverState, after: RoverState) -> str:
    """Returns why the robot seems to have been restarted or moved by hand between two steps; empty if it does not."""
    elapsed = (after.stamp - before.stamp).item()
    if elapsed < -CLOCK_TOLERANCE:
        return f"its clock went back by {-elapsed:.1f} s"
    moved = torch.dist(before.position, after.position).item()
    if moved > POSE_TOLERANCE + 2 * max(elapsed, 0.0):  # 2 m/s, twice the top speed
        return f"its pose jumped by {moved:.1f} m"
    return ""
