"""The command ``rover-rl drive``."""

from __future__ import annotations

import csv
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro
from rich.console import Console
from rich.live import Live

from rover_rl import checks
from rover_rl.algos.policy.names import NO_POLICY, ResolvedPolicy, resolve_policy
from rover_rl.cli.help_text import FLAT
from rover_rl.cli.options import LIVE_POLICY, OptionsOfRobot, Port, read_env
from rover_rl.cli.ros_arguments import RosArguments, renamed
from rover_rl.envs.config import SCAN_POSE, EnvConfig, GuardConfig, LimitsConfig, Randomization, name_of_part
from rover_rl.envs.sensors.suite import LIDAR_MASK
from rover_rl.files import check_writable
from rover_rl.names import Name
from rover_rl.robots.options import RobotOptions, with_options
from rover_rl.sims.ros2.settings import BAG, Ros2Settings
from rover_rl.sims.settings import Connection

if TYPE_CHECKING:
    from rover_rl.algos.deploy.driving import Moment
    from rover_rl.algos.evaluation.evaluate import Policy
    from rover_rl.sims.ros2.simulator import Ros2Simulator

GOAL_NOT_REACHED = 1  # exit code
SENSOR_TIMEOUT = 0.5  # time without a sensor message after which a drive ends, s; without a scan, it stops before
HIDDEN = {"model", "reset", "reset_topic", "reset_timeout", "pose_tolerance", "settle", "step_timeout", "control_dt"}
HIDDEN |= {"description_topic", "map_topic", "min_reversal", "unseen_range", "max_invalid"}
"""Settings that a drive chooses itself, or that are for resets, of which it has none, for simulated robots or rare."""


@dataclass(frozen=True)
class Drive:
    """Drive a live rover to one or several goals with a policy, at the rate of its lidar scans.

    A policy with memory decides as often as in training, and keeps its memory from goal to goal.

    The rover stops at each goal, and on Ctrl-C, SIGTERM, any error, a silent sensor, an unusable scan, a flip, a robot
    that restarts, or an obstacle that is too close. A separate process stops it if this process dies. The rover never
    drives in a direction that no lidar beam covers.

    ROS's own remaps end the line: --ros-args -r /scan:=/front/scan -r __ns:=/robot1 -r __node:=driver (docs/ros2.md).
    """

    shown: ClassVar = {Ros2Settings: {*Ros2Settings.__dataclass_fields__} - HIDDEN}

    policy: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="POLICY", help=LIVE_POLICY)] = ""
    goal: tuple[tuple[float, float], ...] = ()
    """Goals to drive to, in order: x y (m)."""
    goals: Path | None = None
    """CSV file of goals, one per line: x, y (m)."""
    goal_topic: str | None = None
    """Topic of goals, such as RViz's /goal_pose: drive to each geometry_msgs/PoseStamped on it, until Ctrl-C. A new one
    replaces the last; a std_msgs/Empty on TOPIC/cancel gives it up, and TOPIC/status tells what is done. One in another
    frame than the pose, such as odom, is transformed by tf."""
    random: int = 0
    """Number of random goals, drawn as in training."""
    excite: bool = False
    """Drive what tells the robot's numbers, for rover-rl calibrate, about two minutes in a clear area, without a
    policy (docs/calibration.md)."""
    radius: float = 2.0
    """Distance from the start that --excite stays within, m."""
    world: str | None = None
    """World that the rover is in. Default: the world that the policy was trained in."""
    env: Path | None = None
    """YAML file of EnvConfig, or a run's config.yaml. Default: the environment that the policy was made for."""
    robot: str | None = None
    """Robot: a name, a URDF file, or module:attribute. Default: the robot that the policy was made for."""
    robot_options: OptionsOfRobot = field(default_factory=RobotOptions)
    clearance: float = 0.2
    """Lidar reading below which the drive ends, m; at least 0.5 with --excite."""
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
    bag: Path | None = None
    """MCAP file to record the drives to, for ros2 bag, Foxglove and rover-rl evaluate.
    Default: runs/drive-TIME.mcap, with the time in UTC."""
    dry_run: bool = False
    """Print the commands instead of sending them."""
    view: bool = False
    """Open a page with the scan, a stop button and keys to drive by hand (needs the extra view)."""
    host: str = "127.0.0.1"
    """Address to serve the page on; 0.0.0.0 lets other machines reach it, and drive."""
    port: Port = 8080
    connection: Annotated[Connection, FLAT] = field(default_factory=Connection)
    settings: Annotated[Ros2Settings, FLAT] = field(default_factory=Ros2Settings)
    ros_args: RosArguments = field(default_factory=dict)

    def __call__(self) -> int:
        self._check()
        if self.ros_args:
            own, connection, settings = renamed(self.ros_args, self, self.connection, self.settings)
            return int(replace(own, connection=connection, settings=settings, ros_args={})())
        with ExitStack() as stack:
            raise_if_interrupted = stack.enter_context(_interruptible())
            from rover_rl.algos.deploy import bags, driving, excitation, outputs
            from rover_rl.algos.driving import TIME_LIMIT
            from rover_rl.algos.policy.runner import PolicyRunner
            from rover_rl.envs.rover import RoverEnv
            from rover_rl.sims.ros2.simulator import Ros2Simulator

            path = self.bag or Path(time.strftime("runs/drive-%Y%m%dT%H%M%SZ.mcap", time.gmtime()))
            check_writable(path, "--bag")
            if path.exists():
                raise FileExistsError(f"{path} is there already: name another --bag")
            policy = self._policy()
            world, module, page = policy.worlds[0], policy.module, None
            assert module is not None
            goals, described = self._goals(world), self._description(module, world)
            if self.view:
                # Before the rover moves.
                from rover_rl.view.live import LivePage

                page = stack.enter_context(LivePage(self.host, self.port))
                print(f"Page: {page.address}", flush=True)
            env = RoverEnv(described)
            stack.callback(env.close)
            rover = env.simulator
            assert isinstance(rover, Ros2Simulator)
            if page is not None:
                page.on_stop = rover.halt
            runner = PolicyRunner(module, env=env) if page is None else page.runner(module, env)
            robot = name_of_part(described.robot)
            bag = stack.enter_context(bags.DriveBag(path, world, policy.name, self.seconds, robot))
            rover.tap(bag.add)
            stack.callback(outputs.DriveOutputs(env).close)
            show_status = stack.enter_context(_status_display(Console(), each_step=self.dry_run))

            def go_on() -> None:
                raise_if_interrupted()
                if page is not None:
                    page.check()

            def show(label: str, moment: Moment) -> None:
                go_on()
                show_status(label, moment)
                if page is not None:
                    page.show(env, moment)

            limits = {name: getattr(self, name) for name in ("seconds", "clearance", "patience", "allow_unseen")}
            drive: Any = partial(driving.drive_to, env, runner, bag=bag, **limits)
            if isinstance(module, excitation.Excitation):
                limits = {"clearance": max(self.clearance, excitation.CLEARANCE), "allow_unseen": True}
                begin, seconds = module.start(), module.seconds - 1e-3
                ending = drive(begin, seconds=seconds, watch=partial(show, "excite"), **limits)
                print(f"excite: {'complete' if ending == TIME_LIMIT else ending}", flush=True)
                reached = ending == TIME_LIMIT
            else:
                reached = self._drive(drive, rover, world, goals, go_on, show)
        what = "calibrate" if self.excite else "evaluate"
        print(f"Bag: {path}; to {what} it: rover-rl {what} {path}")
        return 0 if reached else GOAL_NOT_REACHED

    def _drive(
        self, drive: Any, rover: Ros2Simulator, world: str, goals: list[tuple[float, float]], go_on: Any, show: Any
    ) -> bool:
        """Drives to the goals, and then to those of the topic, and returns whether all were reached."""
        from rover_rl.algos.deploy.goals import GoalGivenUp, GoalTopic
        from rover_rl.algos.driving import RESTARTED

        topic, endings = None, list[str]()
        if self.goal_topic is not None:
            inside = partial(_require_inside, world)
            topic = GoalTopic(rover.transport, self.goal_topic, inside, lambda: rover.pose_frame, rover.follow_tf())
            print(f"Waits for goals on {self.goal_topic}", flush=True)

        def watch(moment: Moment) -> None:
            if topic is not None:
                topic.check()
            show(f"goal {len(endings) + 1}" + (f" of {len(goals)}" if topic is None else ""), moment)

        for goal in goals if topic is None else chain(goals, topic.goals(go_on)):
            go_on()
            try:
                ending = drive(goal, watch=watch)
            except GoalGivenUp as reason:
                ending = str(reason)
            endings.append(ending)
            print(f"goal {len(endings)}, {goal[0]:.2f} {goal[1]:.2f}: {ending}", flush=True)
            if topic is not None:
                topic.tell(ending)
            if ending == RESTARTED:
                break  # the pose of a restarted robot is unknown
        return set(endings) == {"goal"}

    def _check(self) -> None:
        if not all(math.isfinite(number) for goal in self.goal for number in goal):
            raise ValueError(f"--goal must be finite numbers, got {' '.join(f'{x:g} {y:g}' for x, y in self.goal)}")
        goals = [name for name in ("goal", "goals", "random", "goal_topic") if getattr(self, name)]
        if self.excite and (goals or self.policy):
            raise ValueError("--excite drives on its own: leave out the policy and the goals")
        checks.check_positive(checks.MAX_NUMBER, radius=self.radius)
        if not (self.policy or self.excite):
            raise ValueError(f"{NO_POLICY}, or drive with --excite")
        if not (goals or self.excite):
            raise ValueError("say where to drive: --goal X Y, --goals FILE, --random COUNT or --goal-topic TOPIC")
        if self.bag is not None and self.bag.suffix != BAG:
            raise ValueError(f"--bag takes a file whose name ends in {BAG}, got {self.bag}")
        if self.goal_topic is not None:
            checks.check_topics(goal_topic=self.goal_topic)
        checks.check_positive(checks.MAX_SECONDS, seconds=self.seconds)
        checks.check_at_least(0, checks.MAX_SECONDS, timeout=self.connection.timeout)
        checks.check_at_least(0, checks.MAX_NUMBER, clearance=self.clearance, patience=self.patience)
        checks.check_at_least(0, checks.MAX_COUNT, random=self.random)
        checks.check_seed(self.seed)

    def _policy(self) -> ResolvedPolicy:
        if self.excite:
            from rover_rl.algos.deploy.excitation import ANYWHERE, Excitation

            return ResolvedPolicy("excite", Excitation(self.radius, self.settings), (self.world or ANYWHERE.name,))
        robot = None if self.robot is None else with_options(self.robot, self.robot_options)
        policy = resolve_policy(self.policy, (self.world,) if self.world else (), robot)
        if policy.module is None or not policy.worlds:
            text = "cannot drive a live rover; say which --world it is in, or name a checkpoint"
            raise ValueError(f"{self.policy} {text}")
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

    def _description(self, policy: Policy, world: str) -> EnvConfig:
        """Returns the environment of a live rover, with the limits that the policy was trained with."""
        from rover_rl.algos.deploy.excitation import Excitation
        from rover_rl.algos.evaluation.evaluate import environment_for
        from rover_rl.algos.policy.runner import sensors_for

        settings = replace(self.settings, reset="none", step_timeout=SENSOR_TIMEOUT)
        made_for = environment_for(policy, None if self.env is None else read_env(self.env))
        trained: EnvConfig = getattr(policy, "made_for", None) or EnvConfig()
        noise = trained.randomization
        if trained.limits.apply:
            own = {name for name in LimitsConfig.positive if getattr(settings, name) is not None}
            limits = {name: value for name, value in vars(trained.limits).items() if name not in {"apply", *own}}
            settings = replace(settings, **limits)
        # Scans are added to maps where they were taken, by their stamps.
        needed = [SCAN_POSE]
        if LIDAR_MASK in getattr(policy, "in_keys", ()) or noise.hides_beams:
            # As in training. The guard of unseen directions holds the rover nevertheless.
            dead = noise.dead_sectors * noise.dead_sector_width[1] / (noise.lidar_view or (2 * math.pi,))[0]
            settings = replace(settings, unseen_range=math.inf, max_invalid=settings.max_invalid + min(0.8, dead))
            needed.append(LIDAR_MASK)
        described = replace(
            made_for,
            world=world,
            sensors=(*made_for.sensors, *(name for name in needed if name not in made_for.sensors)),
            robot=self.robot or made_for.robot,
            robot_options=self.robot_options,
            backend=replace(settings, command="none") if self.dry_run else settings,
            randomization=Randomization(),
            guard=self.guard,
            compensate_delay=self.compensate_delay or made_for.compensate_delay,
            connection=self.connection,
            length=10**9,  # the time limit ends a drive
            end_on_goal=True,
            seed=self.seed,
        )
        if isinstance(policy, Excitation):
            described = policy.described(described)
        return sensors_for(policy, environment_for(policy, described))

    def _goals(self, world: str) -> list[tuple[float, float]]:
        from rover_rl.algos.evaluation.episodes import draw_episodes

        goals = list(self.goal)
        if self.goals is not None:
            try:
                with self.goals.open(newline="") as file:
                    goals += [(float(x), float(y)) for x, y in filter(None, csv.reader(file))]
            except ValueError as error:
                raise ValueError(f"{self.goals} must have two numbers a line: x, y") from error
        if self.random:
            goals += [(x, y) for x, y in draw_episodes(world, self.random, self.seed).goal.tolist()]
        if self.goals is not None and (not goals or not all(math.isfinite(part) for goal in goals for part in goal)):
            raise ValueError(f"{self.goals} must have at least one goal, with finite coordinates")
        for goal in goals:
            _require_inside(world, goal)
        return goals


def _require_inside(world: str, goal: tuple[float, float]) -> None:
    from rover_rl.worlds import get_world

    (x, y), ((left, right), (bottom, top)) = goal, get_world(world).bounds
    if not (left <= x <= right and bottom <= y <= top):
        raise ValueError(
            f"the goal {x:g} {y:g} is outside of the bounds of {world}: x from {left:g} to {right:g} m, "
            f"y from {bottom:g} to {top:g} m; name the --world that the rover is in"
        )


@contextmanager
def _interruptible() -> Iterator[Callable[[], None]]:
    """Raises ``KeyboardInterrupt`` on Ctrl-C and SIGTERM, and yields a function that raises it again, for each step.

    An exception that is raised in a callback of a library may be suppressed. The rover must stop nevertheless.
    """
    interrupted = False

    def interrupt(*_: object) -> None:
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
    waiting = set()  # goals for which it is said that the drive waits for room
    with Live(console=console, refresh_per_second=10, transient=True, auto_refresh=console.is_terminal) as live:

        def show_status(label: str, moment: Moment) -> None:
            speed, turn = moment.command
            status = (
                f"{label}: {moment.distance:5.2f} m to go, {moment.speed:5.2f} m/s, nearest {moment.nearest:5.2f} m, "
                f"command {speed:5.2f} m/s {turn:5.2f} rad/s, latency {1000 * moment.latency:4.1f} ms"
                f"{', held: no lidar coverage' if moment.held else ''}"
            )
            if moment.seconds == 0 and not console.is_terminal and label not in waiting:
                waiting.add(label)
                print(f"{label}: waits for room, nearest {moment.nearest:.2f} m", flush=True)
            elif each_step:
                print(status, flush=True)
            else:
                live.update(status)

        yield show_status
