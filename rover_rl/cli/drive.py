"""The command ``rover-rl drive``."""

from __future__ import annotations

import csv
import math
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, ClassVar

import tyro
from rich.console import Console
from rich.live import Live

from rover_rl.checks import MAX_COUNT, MAX_NUMBER, MAX_SECONDS, check_at_least, check_positive, check_seed
from rover_rl.cli.help_text import FLAT
from rover_rl.cli.policies import LIVE_POLICY, ROBOT_OPTIONS, ResolvedPolicy, read_env, resolve_policy
from rover_rl.envs.config import SCAN_POSE, EnvConfig, GuardConfig, Randomization
from rover_rl.envs.sensors.suite import LIDAR_MASK
from rover_rl.robots.options import RobotOptions, with_options
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.settings import Connection

if TYPE_CHECKING:
    from rover_rl.algos.deploy.driving import Moment
    from rover_rl.algos.evaluation.evaluate import Policy

GOAL_NOT_REACHED = 1
"""Exit code if a goal was not reached."""
UNLIMITED = 10**9
"""Effectively unlimited episode length, steps: the time limit ends a drive."""
SENSOR_TIMEOUT = 0.5
"""Time without a sensor message after which a drive ends, s. Without a scan, the rover stops after half of it."""
HIDDEN = {"model", "reset", "reset_topic", "reset_timeout", "pose_tolerance", "settle", "step_timeout", "control_dt"}
"""Settings that a drive chooses itself, or that are for resets, of which it has none."""


@dataclass(frozen=True)
class Drive:
    """Drive a live rover to one or several goals with a policy, at the rate of its lidar scans.

    A policy with memory decides as often as in training, and keeps its memory from goal to goal.

    The rover stops at each goal, and on Ctrl-C, SIGTERM, any error, a silent sensor, an unusable scan, a flip, a robot
    that restarts, or an obstacle that is too close. A separate process stops it if this process dies. The rover never
    drives in a direction that no lidar beam covers.
    """

    shown: ClassVar = {
        Ros2Settings: {*Ros2Settings.__dataclass_fields__} - HIDDEN - {"min_reversal", "unseen_range", "max_invalid"}
    }

    policy: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="POLICY", help=LIVE_POLICY)]
    goal: tuple[tuple[float, float], ...] = ()
    """Goals to drive to, in order: x y (m)."""
    goals: Path | None = None
    """CSV file of goals, one per line: x, y (m)."""
    random: int = 0
    """Number of random goals, drawn as in training."""
    world: str | None = None
    """World that the rover is in. Default: the world that the policy was trained in."""
    env: Path | None = None
    """YAML file of EnvConfig, or a run's config.yaml. Default: the environment that the policy was made for."""
    robot: str | None = None
    """Robot: a name, a URDF file, or module:attribute. Default: the robot that the policy was made for."""
    robot_options: Annotated[RobotOptions, ROBOT_OPTIONS] = field(default_factory=RobotOptions)
    """What a URDF does not tell of the robot."""
    clearance: float = 0.2
    """Lidar reading below which the drive ends, m."""
    patience: float = 30.0
    """Longest time to wait, before the drive to a goal, for whatever is nearer than --clearance to go, s."""
    seconds: float = 60.0
    """Time limit for each goal, s."""
    guard: GuardConfig = field(default_factory=GuardConfig)
    """Emergency brake: --guard.deceleration 2 brakes before what the scan shows in the way (docs/ros2.md)."""
    compensate_delay: bool = False
    """Carry late pose, heading and velocities on to now, by their stamps and the commands sent since (docs/ros2.md).
    Default: as in the training of the policy."""
    allow_unseen: bool = False
    """Accept a lidar with a smaller field of view than in training."""
    allow_other_world: bool = False
    """Accept a policy that recognizes the places of another world, by the pose or with north_up."""
    seed: int = 0
    """Seed of the random goals."""
    log: Path = Path("runs/drive.jsonl")
    """Log file that the drives are appended to. rover-rl evaluate reads it."""
    dry_run: bool = False
    """Print the commands instead of sending them."""
    view: bool = False
    """Open a page with the scan, a stop button and keys to drive by hand (needs the extra view)."""
    host: str = "127.0.0.1"
    """Address to serve the page on; 0.0.0.0 lets other machines reach it, and drive."""
    port: int = 8080
    """Port of the page; 0 takes a free one."""
    connection: Annotated[Connection, FLAT] = field(default_factory=Connection)
    settings: Annotated[Ros2Settings, FLAT] = field(default_factory=Ros2Settings)

    def __call__(self) -> int:
        self._check()
        endings = []
        with ExitStack() as stack:
            raise_if_interrupted = stack.enter_context(_interruptible())
            from rover_rl.algos.deploy.drive_log import DriveLog, check_log
            from rover_rl.algos.deploy.driving import drive_to
            from rover_rl.algos.driving import RESTARTED
            from rover_rl.algos.policy.runner import PolicyRunner
            from rover_rl.envs.config import name_of_part
            from rover_rl.envs.rover import RoverEnv
            from rover_rl.sims.ros2.simulator import Ros2Simulator

            check_log(self.log)
            policy = self._policy()
            assert policy.module is not None
            goals, settings = self._goals(policy.worlds[0]), self._settings(policy.module)
            described = self._description(policy, settings)
            page = None
            if self.view:
                # Before the rover moves.
                from rover_rl.view.live import LivePage

                page = stack.enter_context(LivePage(self.host, self.port))
                print(f"Page: {page.address}", flush=True)
            env = RoverEnv(described)
            stack.callback(env.close)
            assert isinstance(env.simulator, Ros2Simulator)
            if page is not None:
                page.on_stop = env.simulator.halt
            runner = PolicyRunner(policy.module, env=env) if page is None else page.runner(policy.module, env)
            log = stack.enter_context(
                DriveLog(self.log, policy.worlds[0], policy.name, self.seconds, name_of_part(described.robot))
            )
            show_status = stack.enter_context(_status_display(Console(), each_step=self.dry_run))
            for number, goal in enumerate(goals, 1):

                def on_step(moment: Moment | None, label: str = f"goal {number} of {len(goals)}") -> None:
                    raise_if_interrupted()
                    if page is not None:
                        page.check()
                    if moment is not None:
                        show_status(label, moment)
                        if page is not None:
                            page.show(env, moment)

                on_step(None)
                ending = drive_to(
                    env,
                    runner,
                    goal,
                    seconds=self.seconds,
                    clearance=self.clearance,
                    patience=self.patience,
                    allow_unseen=self.allow_unseen,
                    watch=on_step,
                    log=log,
                )
                print(f"goal {number}, {goal[0]:.2f} {goal[1]:.2f}: {ending}", flush=True)
                endings.append(ending)
                if ending == RESTARTED:
                    break  # the pose of a restarted robot is unknown
        print(f"Log: {self.log}; to evaluate it: rover-rl evaluate {self.log}")
        return 0 if set(endings) == {"goal"} else GOAL_NOT_REACHED

    def _check(self) -> None:
        if not all(math.isfinite(number) for goal in self.goal for number in goal):
            raise ValueError(f"--goal must be finite numbers, got {' '.join(f'{x:g} {y:g}' for x, y in self.goal)}")
        if not (self.goal or self.goals or self.random):
            raise ValueError("say where to drive: --goal X Y, --goals FILE or --random COUNT")
        check_positive(MAX_SECONDS, seconds=self.seconds)
        check_at_least(0, MAX_SECONDS, timeout=self.connection.timeout)
        check_at_least(0, MAX_NUMBER, clearance=self.clearance, patience=self.patience)
        check_at_least(0, MAX_COUNT, random=self.random)
        check_seed(self.seed)

    def _policy(self) -> ResolvedPolicy:
        from rover_rl.names import Name

        robot = None if self.robot is None else with_options(self.robot, self.robot_options)
        policy = resolve_policy(self.policy, (self.world,) if self.world else (), robot)
        if policy.module is None or not policy.worlds:
            raise ValueError(
                f"{self.policy} cannot drive a live rover; say which --world it is in, or name a checkpoint"
            )
        if policy.config is None or self.allow_other_world:
            return policy
        trained, network = policy.config.env.world_names, policy.config.network
        reads_place = "pose" in network.observation or network.north_up
        if reads_place and policy.worlds[0] not in trained and not any(Name.parse(world).is_range for world in trained):
            raise ValueError(
                f"{self.policy} recognizes the places of {', '.join(trained)}, where it was trained, and --world is "
                f"{policy.worlds[0]}; use another policy, or --allow-other-world"
            )
        return policy

    def _settings(self, policy: Policy) -> Ros2Settings:
        """Returns the settings of the connection to the rover, with the limits that a policy was trained with."""
        given = replace(self.settings, reset="none", step_timeout=SENSOR_TIMEOUT)
        trained: EnvConfig | None = getattr(policy, "made_for", None)
        if trained is not None and trained.limits.apply:
            limits = {name: value for name, value in vars(trained.limits).items() if name != "apply"}
            chosen = {name for name in limits if name != "min_reversal" and getattr(given, name) is not None}
            given = replace(given, **{name: value for name, value in limits.items() if name not in chosen})
        if _knows_coverage(policy):
            # As in training. The guard of unseen directions holds the rover nevertheless.
            given = replace(given, unseen_range=math.inf, max_invalid=given.max_invalid + _dead_share(trained))
        return replace(given, command="none") if self.dry_run else given

    def _description(self, policy: ResolvedPolicy, settings: Ros2Settings) -> EnvConfig:
        from rover_rl.algos.evaluation.evaluate import environment_for
        from rover_rl.algos.policy.runner import sensors_for

        made_for = environment_for(policy.module, None if self.env is None else read_env(self.env))
        # Scans are added to maps where they were taken, by their stamps.
        needed = (SCAN_POSE, LIDAR_MASK) if _knows_coverage(policy.module) else (SCAN_POSE,)
        described = replace(
            made_for,
            world=policy.worlds[0],
            sensors=(*made_for.sensors, *(name for name in needed if name not in made_for.sensors)),
            robot=self.robot or made_for.robot,
            robot_options=self.robot_options,
            backend=settings,
            randomization=Randomization(),
            guard=self.guard,
            compensate_delay=self.compensate_delay or made_for.compensate_delay,
            connection=self.connection,
            length=UNLIMITED,
            end_on_goal=True,
            seed=self.seed,
        )
        return sensors_for(policy.module, environment_for(policy.module, described))

    def _goals(self, world: str) -> list[tuple[float, float]]:
        from rover_rl.algos.evaluation.episodes import draw_episodes
        from rover_rl.worlds import get_world

        goals = list(self.goal)
        if self.goals is not None:
            with self.goals.open(newline="") as file:
                rows = [row for row in csv.reader(file) if row]
            try:
                goals += [(float(x), float(y)) for x, y in rows]
            except ValueError as error:
                raise ValueError(f"{self.goals} must have two numbers a line: x, y") from error
        if self.random:
            goals += [(x, y) for x, y in draw_episodes(world, self.random, self.seed).goal.tolist()]
        if not goals or not all(math.isfinite(number) for goal in goals for number in goal):
            raise ValueError(f"{self.goals} must have at least one goal, with finite coordinates")
        (left, right), (bottom, top) = get_world(world).bounds
        for x, y in goals:
            if not (left <= x <= right and bottom <= y <= top):
                raise ValueError(
                    f"the goal {x:g} {y:g} is outside of the bounds of {world}: x from {left:g} to {right:g} m, "
                    f"y from {bottom:g} to {top:g} m; name the --world that the rover is in"
                )
        return goals


def _knows_coverage(policy: Policy | None) -> bool:
    """Whether a policy was trained with lidars that see in part, or reads where they do."""
    trained: EnvConfig | None = getattr(policy, "made_for", None)
    hides_beams = trained is not None and trained.randomization.hides_beams
    return hides_beams or LIDAR_MASK in getattr(policy, "in_keys", ())


def _dead_share(trained: EnvConfig | None) -> float:
    """Returns the share of the beams that may be in the dead sectors of a policy's training."""
    noise = Randomization() if trained is None else trained.randomization
    return min(0.8, noise.dead_sectors * noise.dead_sector_width[1] / (noise.lidar_view or (2 * math.pi,))[0])


@contextmanager
def _interruptible() -> Iterator[Callable[[], None]]:
    """Raises ``KeyboardInterrupt`` on Ctrl-C and SIGTERM, and yields a function that raises it again.

    An exception that is raised in a callback of a library may be suppressed. The rover must stop nevertheless, so call
    the function at each step.
    """
    interrupted = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal interrupted
        interrupted = True
        raise KeyboardInterrupt

    def raise_if_interrupted() -> None:
        if interrupted:
            raise KeyboardInterrupt

    previous = {number: signal.signal(number, interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield raise_if_interrupted
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


@contextmanager
def _status_display(console: Console, each_step: bool) -> Iterator[Callable[[str, Moment], None]]:
    told = set()  # goals for which it is told that the drive waits for room
    with Live(console=console, refresh_per_second=10, transient=True, auto_refresh=console.is_terminal) as live:

        def show_status(label: str, moment: Moment) -> None:
            speed, turn = moment.command
            status = (
                f"{label}: {moment.distance:5.2f} m to go, {moment.speed:5.2f} m/s, nearest {moment.nearest:5.2f} m, "
                f"command {speed:5.2f} m/s {turn:5.2f} rad/s, latency {1000 * moment.latency:4.1f} ms"
                f"{', held: no lidar coverage' if moment.held else ''}"
            )
            if moment.seconds == 0 and not console.is_terminal and label not in told:
                told.add(label)
                print(f"{label}: waits for room, nearest {moment.nearest:.2f} m", flush=True)
            elif each_step:
                print(status, flush=True)
            else:
                live.update(status)

        yield show_status
