"""``rover-rl drive``."""

from __future__ import annotations

import csv
import math
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

import tyro
from rich.console import Console
from rich.live import Live

from rover_rl.checks import MAX_COUNT, MAX_NUMBER, MAX_SECONDS, check_at_least, check_positive, check_seed
from rover_rl.sims.connection import Connection
from rover_rl.sims.ros2.settings import Command, PoseSource, Ros2Settings, TransportName

if TYPE_CHECKING:
    from rover_rl.algos.deploy.driving import Moment
    from rover_rl.cli.policies import ResolvedPolicy
    from rover_rl.envs import RoverEnv

NOT_REACHED = 1
"""Exit code where a goal was not reached."""
UNLIMITED = 10**9
"""Effectively unlimited step budget: the time limit ends a drive."""
STALE = 0.5
"""Seconds without a message from a sensor after which a drive ends; without a scan the rover is stopped after half."""


@dataclass(frozen=True)
class Drive:
    """Drive a live rover with a trained policy, from goal to goal, at the rate of its scans.

    The rover is stopped at each goal, and on Ctrl-C, SIGTERM, any error, a silent sensor, an unusable scan, a flip, a
    robot that restarts, or an obstacle that is too close; a separate process stops it if this one dies. It is never
    driven towards directions that no lidar beam covers.
    """

    policy: tyro.conf.Positional[str]
    """Folder of a run, a checkpoint or ONNX file, pretrained:NAME, or scripted."""
    goal: tuple[tuple[float, float], ...] = ()
    """Goals to drive to, one after the other: x y, m."""
    goals: Path | None = None
    """File of goals, a line each: x, y."""
    random: int = 0
    """Number of goals drawn at random, as in training."""
    world: str | None = None
    """World that the rover is in. Default: the one that the policy was trained in."""
    robot: str | None = None
    """Robot that is driven. Default: the one that the policy was made for."""
    wait: float = 30.0
    """Time to wait for the rover's first scan, s."""
    clearance: float = 0.2
    """Stop where the lidar reads less than this, m."""
    seconds: float = 60.0
    """Time limit for each goal, s."""
    max_speed: float | None = None
    """Highest forward speed that is sent, m/s; by default the robot's (Rover Zero: 1)."""
    max_yaw_rate: float | None = None
    """Highest yaw rate that is sent, rad/s; by default the robot's (Rover Zero: 7)."""
    max_acceleration: float | None = None
    """Largest change of the forward speed, m/s^2; by default the robot's (Rover Zero: 5). Stops are sent at once."""
    max_yaw_acceleration: float | None = None
    """Largest change of the yaw rate, rad/s^2; by default the robot's (Rover Zero: 4)."""
    allow_unseen: bool = False
    """Drive with a lidar that covers less than the policy was trained with."""
    pose: PoseSource = "pose_array"
    """Source of the pose: see Ros2Settings."""
    pose_topic: str = Ros2Settings.pose_topic
    """Topic of the pose."""
    odometry_topic: str = Ros2Settings.odometry_topic
    """Topic of the wheel odometry."""
    scan_topic: str = Connection.scan_topic
    """Topic of the scan."""
    imu_topic: str = Connection.imu_topic
    """Topic of the IMU."""
    cmd_vel_topic: str = Connection.cmd_vel_topic
    """Topic of the command."""
    stamped: bool = False
    """Send TwistStamped instead of Twist."""
    lidar_yaw: float = Ros2Settings.lidar_yaw
    """Direction of the zero of the scan's angles, rad; the original's lidar looks backwards."""
    transport: TransportName = Ros2Settings.transport
    """dds needs no ROS; rclpy uses a ROS that is sourced."""
    seed: int = 0
    """Seed of random goals."""
    log: Path = Path("runs/drive.jsonl")
    """File that the drives are appended to; rover-rl evaluate reads it."""
    dry_run: bool = False
    """Send nothing, and print what would be sent."""

    def __call__(self) -> int:
        """Drives, and says how each drive ended; 0 if every goal was reached.

        Raises:
            ValueError: for an option out of its range, before anything is announced or waited for.
        """
        self._check()
        endings = []
        with ExitStack() as stack:
            stop_if_asked = stack.enter_context(_interruptible())
            from rover_rl.algos.deploy.drive_log import DriveLog
            from rover_rl.algos.deploy.driving import drive_to
            from rover_rl.algos.evaluation.metrics import RESTARTED
            from rover_rl.sims.ros2.watchdog import Watchdog

            policy = self._policy()
            assert policy.module is not None
            goals, settings = self._goals(policy.worlds[0]), self._settings()
            watchdog = None if self.dry_run else stack.enter_context(Watchdog(self.cmd_vel_topic, settings, STALE))
            env = self._env(policy, settings)
            stack.callback(env.close)
            log = stack.enter_context(DriveLog(self.log, policy.worlds[0], policy.name, self.seconds, env.robot.name))
            show = stack.enter_context(_display(Console(), each_step=self.dry_run))
            for number, goal in enumerate(goals, 1):

                def watch(moment: Moment, label: str = f"goal {number} of {len(goals)}") -> None:
                    stop_if_asked()
                    if watchdog is not None:
                        watchdog.alive()
                    show(label, moment)

                stop_if_asked()
                if watchdog is not None:
                    watchdog.alive()  # from here on it stops the rover where the next sign stays away
                ending = drive_to(
                    env,
                    policy.module,
                    goal,
                    seconds=self.seconds,
                    clearance=self.clearance,
                    allow_unseen=self.allow_unseen,
                    watch=watch,
                    log=log,
                )
                print(f"goal {number}, {goal[0]:.2f} {goal[1]:.2f}: {ending}", flush=True)
                endings.append(ending)
                if ending == RESTARTED:
                    break  # where it is now, nobody knows
        print(f"Log: {self.log}; rover-rl evaluate {self.log} measures it")
        return 0 if set(endings) == {"goal"} else NOT_REACHED

    def _check(self) -> None:
        """Refuses options that are out of range.

        Raises:
            ValueError: naming the option.
        """
        if not all(math.isfinite(number) for goal in self.goal for number in goal):
            raise ValueError(f"--goal must be finite numbers, got {' '.join(f'{x:g} {y:g}' for x, y in self.goal)}")
        if not (self.goal or self.goals or self.random):
            raise ValueError("say where to: --goal X Y, --goals FILE or --random COUNT")
        check_positive(MAX_SECONDS, seconds=self.seconds)
        check_at_least(0, MAX_SECONDS, wait=self.wait)
        check_at_least(0, MAX_NUMBER, clearance=self.clearance)
        check_at_least(0, MAX_COUNT, random=self.random)
        check_seed(self.seed)
        self._settings()

    def _policy(self) -> ResolvedPolicy:
        """The policy, and where it is.

        Raises:
            ValueError: if there is none to drive with, or its world is not known.
        """
        from rover_rl.cli.policies import resolve_policy

        policy = resolve_policy(self.policy, (self.world,) if self.world else (), self.robot)
        if policy.module is None or not policy.worlds:
            raise ValueError(
                f"{self.policy} cannot drive a live rover; say which --world it is in, or name a checkpoint"
            )
        return policy

    def _settings(self) -> Ros2Settings:
        """How the rover is reached."""
        command: Command = "twist_stamped" if self.stamped else "twist"
        return Ros2Settings(
            transport=self.transport,
            odometry_topic=self.odometry_topic,
            pose=self.pose,
            pose_topic=self.pose_topic,
            command="none" if self.dry_run else command,
            lidar_yaw=self.lidar_yaw,
            max_speed=self.max_speed,
            max_yaw_rate=self.max_yaw_rate,
            max_acceleration=self.max_acceleration,
            max_yaw_acceleration=self.max_yaw_acceleration,
            reset="none",
            step_timeout=STALE,
        )

    def _env(self, policy: ResolvedPolicy, settings: Ros2Settings) -> RoverEnv:
        """The live rover, as an environment without a limit of its own to the steps of a drive."""
        from rover_rl.algos.evaluation.evaluate import environment_for
        from rover_rl.envs import RoverEnv

        made_for = environment_for(policy.module, None)
        described = replace(
            made_for,
            world=policy.worlds[0],
            robot=self.robot or made_for.robot,
            backend=settings,
            connection=Connection(self.scan_topic, self.imu_topic, self.cmd_vel_topic, timeout=self.wait),
            length=UNLIMITED,
            end_on_goal=True,
            seed=self.seed,
        )
        return RoverEnv(**environment_for(policy.module, described).arguments())

    def _goals(self, world: str) -> list[tuple[float, float]]:
        """All goals that were asked for.

        Raises:
            ValueError: if there is none, or the file holds something else.
        """
        goals = list(self.goal)
        if self.goals is not None:
            with self.goals.open(newline="") as file:
                rows = [row for row in csv.reader(file) if row]
            try:
                goals += [(float(x), float(y)) for x, y in rows]
            except ValueError as error:
                raise ValueError(f"{self.goals} must have two numbers a line: x, y") from error
        if self.random:
            from rover_rl.algos.evaluation.episodes import draw_episodes

            goals += [(x, y) for x, y in draw_episodes(world, self.random, self.seed).goal.tolist()]
        if not goals or not all(math.isfinite(number) for goal in goals for number in goal):
            raise ValueError(f"{self.goals} must have at least one goal, of finite numbers")
        return goals


@contextmanager
def _interruptible() -> Iterator[Callable[[], None]]:
    """Ctrl-C and SIGTERM end it: at once, or where the function that this gives is called.

    An exception that is raised while a library calls back into Python may be lost; a rover must stop all the same.
    """
    asked = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        asked = True
        raise KeyboardInterrupt

    def stop_if_asked() -> None:
        if asked:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop_if_asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _display(console: Console, each_step: bool) -> Iterator[Callable[[str, Moment], None]]:
    """Tells of the drive: on one line of a terminal, or in a line for each step."""
    with Live(console=console, refresh_per_second=10, transient=True, auto_refresh=console.is_terminal) as live:

        def show(label: str, moment: Moment) -> None:
            speed, turn = moment.command
            told = (
                f"{label}: {moment.distance:5.2f} m to go, {moment.speed:5.2f} m/s, nearest {moment.nearest:5.2f} m, "
                f"command {speed:5.2f} m/s {turn:5.2f} rad/s, latency {1000 * moment.latency:4.1f} ms"
                f"{', held: unseen direction' if moment.held else ''}"
            )
            if each_step:
                print(told, flush=True)
            else:
                live.update(told)

        yield show
