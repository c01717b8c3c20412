"""Drives in bags of ROS 2: of ``rover-rl drive``, and of any robot that others have recorded."""

from __future__ import annotations

import logging
import math
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rover_rl.algos.deploy.bags import ENDING, GOAL, STEP, Bag
from rover_rl.algos.driving import REPLACED, STOPPED
from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.evaluate import Evaluation
from rover_rl.algos.evaluation.trajectory import Trajectory, count_reversals
from rover_rl.algos.video.recording import Recording, State, moments_of
from rover_rl.envs.config import ActionConfig, EnvConfig, LidarConfig, TaskConfig
from rover_rl.envs.gym import GymWrapper
from rover_rl.envs.make import make_env
from rover_rl.robots import get_robot
from rover_rl.rotations import euler_to_matrix, matrix_to_quaternion, quaternion_to_euler
from rover_rl.sims import RoverState, Simulator
from rover_rl.sims.free_space.paths import shortest_paths
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.poses import POSE_MESSAGES, MeasuredPose, read_finite, read_place
from rover_rl.sims.ros2.scans import aligned, read_scan
from rover_rl.sims.ros2.sensors import read_frame
from rover_rl.sims.ros2.settings import BagTopics
from rover_rl.sims.ros2.tf import MAP, TF_TOPIC, WORLD, RobotPose
from rover_rl.sims.rover_state import beam_angles
from rover_rl.sims.settings import CONTROL_DT
from rover_rl.worlds import Terrain, World, get_world
from rover_rl.worlds.pool import WorldPool

NO_WORLD = "none"  # stands for flat ground without obstacles, on which the lidar readings show what was there
BEAMS = 180  # number of readings around the robot, of scans of other recorders
LATE = 0.5  # time by which a message may be older than the one before it in the file, s
FASTEST, JUMP = 10.0, 1.0  # speed (m/s) and further distance (m) above which a pose has jumped
MOST_JUMPS = 5  # largest number of jumps of one robot, or a tenth of its poses, which a localization corrects
_MARGIN = 12.0  # size of that ground around the drive, m
_POSES = [kind for kind, _ in POSE_MESSAGES.values()]

_log = logging.getLogger(__name__)


class Sample(NamedTuple):
    """A rover ``dt`` (s) after the sample before: position (m), roll, pitch and yaw, and readings ``[beams]`` (m).

    ``command`` and ``wheels``, by odometry, are forward speeds and yaw rates, m/s and rad/s; nan if they are not known.
    """

    dt: float
    position: Sequence[float]
    angles: Sequence[float]
    ranges: Tensor
    collision: bool = False
    reached: bool = False
    command: tuple[float, float] = (math.nan, math.nan)
    wheels: tuple[float, float] = (math.nan, math.nan)


@dataclass
class RecordedDrive:
    """One drive of a bag: its goal (x, y, m), the samples at its start and after each step, and its ending."""

    goal: tuple[float, float]
    samples: list[Sample]
    ending: str = STOPPED

    @property
    def times(self) -> list[float]:
        """Time of each sample since the start, s."""
        return list(accumulate((sample.dt for sample in self.samples[1:]), initial=0.0))

    def trajectory(self) -> Trajectory:
        """Resamples the drive to 20 Hz. Late and missing steps are filled with the nearest pose."""
        nearest, after = self._nearest(), self.samples[1:]
        steps = len(nearest) - 1
        step_of = (torch.tensor(self.times[1:]) / CONTROL_DT).round().long().clamp(1, steps) - 1
        events = torch.tensor([(sample.collision, sample.reached) for sample in after]).float().reshape(-1, 2)
        collision, goal = (torch.bincount(step_of, column, steps) > 0 for column in events.T)
        position, angles = (torch.tensor([getattr(one, key) for one in nearest]) for key in ("position", "angles"))
        yaw_rates = [sample.command[1] for sample in after]
        reversals = math.nan if any(map(math.isnan, yaw_rates)) else count_reversals(yaw_rates)
        return Trajectory(position, angles, collision, goal, self.ending, reversals)

    def scans(self) -> Tensor:
        """Resamples the lidar readings like :meth:`trajectory`: ``[T + 1, beams]``, m, ``inf`` without a return."""
        return torch.stack([sample.ranges for sample in self._nearest()])

    def _nearest(self) -> list[Sample]:
        """Returns the sample nearest to each step of 20 Hz."""
        times = torch.tensor(self.times)
        grid = CONTROL_DT * torch.arange(max(1, round(times[-1].item() / CONTROL_DT)) + 1)
        after = torch.searchsorted(times, grid).clamp(max=len(times) - 1)
        before = (after - 1).clamp(min=0)
        nearest = torch.where(grid - times[before] <= times[after] - grid, before, after)
        return [self.samples[k] for k in nearest]


class Drives(NamedTuple):
    """The drives of a bag. ``world`` is ``None`` if the bag names none. ``seconds`` is the time limit of a drive."""

    policy: str
    world: str | None
    robot: str
    seconds: float
    drives: list[RecordedDrive]


def read_drives(
    path: Path, topics: BagTopics | None = None, world: str | None = None, robot: str | None = None
) -> Drives:
    """Reads the drives of a bag: of an MCAP file, an SQLite file, or a folder.

    ``topics`` are those of a bag that is not of ``rover-rl drive``. ``world`` and ``robot`` take the place of names in
    the bag. Raises ``ValueError`` if it is no bag, has no drives, or not the topics, its time goes back, or several
    robots sent.
    """
    bag, topics = Bag(path), topics or BagTopics()
    found, least = (_own(bag, topics), 1) if STEP in bag.types else (_foreign(bag, topics), 2)
    drives, about = [drive for drive in found if len(drive.samples) >= least], bag.about
    if not drives:
        raise ValueError(f"there is no drive in {path}: no goal is followed by poses; {bag.contents}")
    for key, given in (("world", world), ("robot", robot)):
        # Nothing that a file names is imported: module:attribute, with or without settings.
        if given is None and re.search(r":[^\W\d]", about.get(key, "")):
            raise ValueError(f"{path} names code as its {key}: if you trust it, add --{key} {about[key]}")
    policy, longest = about.get("policy", path.stem), math.ceil(max(drive.times[-1] for drive in drives))
    world, robot = world or about.get("world"), robot or about.get("robot", "rover_zero")
    return Drives(policy, world, robot, float(about.get("seconds", longest)), drives)


def evaluate_drives(bags: Sequence[Drives]) -> list[Evaluation]:
    """Evaluates drives, together those of the same policy, world, robot and time limit.

    The shortest path of a drive is computed on the map of the world. If the start or the goal is not free on the map,
    or no world is named, the straight line is used.
    """
    groups: dict[Drives, list[RecordedDrive]] = defaultdict(list)
    for bag in bags:
        groups[bag._replace(drives=())] += bag.drives  # type: ignore[arg-type]
    evaluations = []
    for bag, drives in groups.items():
        if bag.world is None:
            _log.warning("%s: no --world is named, so the shortest paths are straight lines", bag.policy)
        world = place_of(bag.world, drives)
        driven = [drive.trajectory() for drive in drives]
        start = torch.stack([torch.cat((one.path[0], one.angles[0, 2:])) for one in driven])
        goal = torch.tensor([drive.goal for drive in drives])
        straight = ((goal - start[:, :2]).norm(dim=-1) - TaskConfig().success_distance).clamp(min=0.0)
        shortest = shortest_paths(world, get_robot(bag.robot), start, goal)
        lengths = torch.where(shortest.isfinite(), shortest, straight)
        episodes = EpisodeSet(bag.world or NO_WORLD, WorldPool(world), 0, start, goal, lengths)
        named = bag.world if bag.world and world.name != NO_WORLD else world
        made_for = EnvConfig(world=named, robot=bag.robot, backend="ros2", end_on_goal=True)
        evaluations.append(Evaluation(bag.policy, episodes, 1, bag.seconds, driven, made_for))
    return evaluations


def recording_of_drive(bag: Drives, number: int | None = None) -> Recording:
    """Returns a drive, by default the last one, resampled to 20 Hz; on flat ground if its world cannot be loaded."""
    drives = bag.drives
    number = len(drives) - 1 if number is None else number
    if not 0 <= number < len(drives):
        raise ValueError(f"the bag has {len(drives)} drives: --episode must be at most {len(drives) - 1}, got {number}")
    drive = drives[number]
    driven, scans = drive.trajectory(), drive.scans()
    try:
        place = place_of(bag.world, [drive])
    except (ValueError, OSError, ImportError):
        place = place_of(NO_WORLD, [drive])
    position = driven.position.clone()
    if place.name == NO_WORLD:
        position[:, 2] = 0.0
    speed = torch.nn.functional.pad(driven.signed_speed, (1, 0))
    twist, dt = torch.stack((speed, torch.zeros_like(speed)), 1), torch.full_like(speed, driven.dt)
    rovers = _rovers(position, driven.angles, twist, dt, torch.zeros_like(speed))
    states: list[State] = [(rovers[step : step + 1], scans[step : step + 1], None) for step in range(len(scans))]
    moments = moments_of(states, torch.tensor([drive.goal]), driven.dt, drive.ending)
    angles = beam_angles(scans.shape[1]).float()
    return Recording(moments, place, get_robot(bag.robot), angles, driven.dt, drive.ending, number)


def _rovers(position: Tensor, angles: Tensor, twist: Tensor, dt: Tensor, stamp: Tensor) -> RoverState:
    return RoverState.pack(
        position=position,
        orientation=matrix_to_quaternion(euler_to_matrix(angles)),
        linear_velocity=twist[:, :1],
        angular_velocity=twist[:, 1:],
        dt=dt[:, None],
        stamp=stamp.double()[:, None],
        contact=torch.zeros(len(position), 1, dtype=torch.bool),
    )


def place_of(world: str | None, drives: Sequence[RecordedDrive]) -> World:
    """Returns a world by name; for none, flat ground around drives."""
    if world not in (None, NO_WORLD):
        return get_world(world)
    points = [point for drive in drives for point in (drive.goal, *(sample.position[:2] for sample in drive.samples))]
    side = float(math.ceil(2 * (np.abs(points).max() + _MARGIN)))
    return World(NO_WORLD, Terrain.flat((side, side)))


class Replay(Simulator):
    """Backend, simulator and lidar that go through the samples of a drive, whatever is commanded."""

    num_envs, control_dt, device = 1, CONTROL_DT, torch.device("cpu")
    features = frozenset({"contacts", "lidar"})

    def __init__(self, drive: RecordedDrive) -> None:
        self._drive, self._index, self.angles = drive, 0, beam_angles(len(drive.samples[0].ranges)).float()
        dts, position, angles, *_, wheels = zip(*drive.samples, strict=True)
        place, turn, twist = map(torch.tensor, (position, angles, wheels))
        steps, times = torch.tensor([dt or CONTROL_DT for dt in dts]), torch.tensor(drive.times, dtype=torch.float64)
        self._states = _rovers(place, turn, twist, steps, times)

    def make(self, **_: Any) -> Replay:
        return self

    def scanner(self, beams: int) -> Replay:
        return self

    def scan(self, rows: Tensor | None = None) -> Tensor:
        return self._drive.samples[self._index].ranges[None].float()

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        self._index = 0
        return self.state()

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        self._index += 1
        return self.state()

    def state(self) -> RoverState:
        return self._states[self._index : self._index + 1].clone()


def transitions(bag: Drives) -> Iterator[tuple[GymWrapper, dict[str, Any]]]:
    """Yields the environment of each drive that has a step, and the drive as the fields of Minari's ``EpisodeBuffer``.

    Actions are the commands that were sent, m/s and rad/s. The last step is truncated if it does not end the episode.
    Raises ``ValueError`` for bags that ``rover-rl drive`` has not recorded, or without wheel odometry.
    """
    for drive in (drive for drive in bag.drives if len(drive.samples) > 1):
        actions = np.array([sample.command for sample in drive.samples[1:]], dtype=np.float32)
        if not np.isfinite([*actions, *(sample.wheels for sample in drive.samples)]).all():
            raise ValueError("a data set needs bags of rover-rl drive with wheel odometry: see --topics.odometry")
        place: Any = {"world": place_of(bag.world, [drive]), "robot": bag.robot, "backend": Replay(drive)}
        lidar, action = LidarConfig(beams=len(drive.samples[0].ranges)), ActionConfig(kind="twist")
        env = GymWrapper(make_env(EnvConfig(**place, lidar=lidar, action=action, end_on_goal=True, length=10**9)))
        observations, rewards, terminations = [env.reset(options={"goal": drive.goal})[0]], list[float](), list[bool]()
        for command in actions:
            observation, reward, terminated, *_ = env.step(command)
            observations.append(observation)
            rewards.append(reward)
            terminations.append(terminated)
            if terminated:
                break
        env.close()
        episode = {
            "observations": {name: np.stack([each[name] for each in observations]) for name in observations[0]},
            "actions": actions[: len(rewards)],
            "rewards": rewards,
            "terminations": terminations,
            "truncations": [*[False] * (len(rewards) - 1), not terminations[-1]],
        }
        yield env, episode


def _own(bag: Bag, topics: BagTopics) -> list[RecordedDrive]:
    """Drives of a bag of ``rover-rl drive``."""
    drives, wheels = list[RecordedDrive](), (math.nan, math.nan)
    kinds = {topics.odometry: ros.Odometry, GOAL: ros.PoseStamped, STEP: ros.DriveStep, ENDING: ros.String}
    for topic, _, message in bag.messages(kinds):
        if topic == topics.odometry:
            wheels = message.twist.twist.linear.x, message.twist.twist.angular.z
        elif topic == GOAL:
            drives.append(RecordedDrive((message.pose.position.x, message.pose.position.y), []))
        elif drives and topic == ENDING:
            drives[-1].ending = message.data
        elif drives:
            angles = quaternion_to_euler(torch.tensor(astuple(message.pose.orientation))).tolist()
            command, events = message.command, (message.collision, message.reached)
            seen = astuple(message.pose.position), angles, torch.tensor(message.ranges), *events
            drives[-1].samples.append(Sample(message.dt, *seen, (command.linear.x, command.angular.z), wheels))
    return drives


def _foreign(bag: Bag, topics: BagTopics) -> list[RecordedDrive]:
    """Drives of a bag that others have recorded: see :class:`BagTopics`."""
    drives, pose_frames, goal_frames, jumps = list[RecordedDrive](), set[str](), set[str](), list[bool]()
    last: Sample | None = None
    time, angles, is_driving = 0.0, [0.0, 0.0, 0.0], False
    for at, frame, found, ranges in _goals_and_poses(bag, topics):
        if isinstance(found, MeasuredPose):
            pose_frames.add(frame)
            if found.orientation is not None:
                angles = quaternion_to_euler(found.orientation).tolist()
            position, dt = found.position.tolist(), max(0.0, at - time)
            jumps.append(last is not None and math.dist(position, last.position) > JUMP + FASTEST * dt)
            reached = is_driving and math.dist(position[:2], drives[-1].goal) <= TaskConfig().success_distance
            last, time = Sample(dt, position, angles, ranges, reached=reached), at
            if is_driving:
                drives[-1].samples.append(last)
            if reached:
                drives[-1].ending, is_driving = "goal", False
        elif not drives or drives[-1].goal != found:
            if is_driving:
                drives[-1].ending = REPLACED
            goal_frames.add(frame)
            drives.append(RecordedDrive(found, [] if last is None else [last._replace(ranges=ranges)]))
            time, is_driving = at, True
    path, frames = bag.path, sorted(pose_frames)
    if len(frames) > 1:
        raise ValueError(f"the poses on {topics.pose} in {path} are in the frames {frames}, as of several robots")
    if sum(jumps) > max(MOST_JUMPS, len(jumps) / 10):
        text = f"jumps {sum(jumps)} times by more than {JUMP:g} m, as of several robots"
        raise ValueError(f"the pose on {topics.pose} in {path} {text}")
    for frame in goal_frames:
        if frame and frames[:1] not in ([""], [frame]) and not {frame, *frames} <= {MAP, WORLD}:
            raise ValueError(f"the goals in {path} are in the frame {frame!r}, and the poses in {frames}")
    return drives


def _goals_and_poses(
    bag: Bag, topics: BagTopics
) -> Iterator[tuple[float, str, tuple[float, float] | MeasuredPose, Tensor]]:
    """Yields the time (s) and the frame of each goal (x, y, m) and pose that can be used, and the last readings."""
    kinds = {topics.goal: bag.require("goal", "--topics.goal", topics.goal, ros.PoseStamped)}
    kinds[topics.pose] = bag.require("pose", "--topics.pose", topics.pose, *_POSES)
    if topics.scan in bag.types or topics.scan != BagTopics.scan:
        kinds[topics.scan] = bag.require("scan", "--topics.scan", topics.scan, ros.LaserScan)
    tf, is_tf = RobotPose(topics.map_frame, topics.base_frame), kinds[topics.pose] is ros.TFMessage
    if is_tf:
        kinds[f"{TF_TOPIC}_static"] = ros.TFMessage
    latest, ranges = -math.inf, torch.full((BEAMS,), math.inf)
    for topic, at, message in bag.messages(kinds):
        if at < latest - LATE:
            text = f"goes back by {latest - at:.1f} s on {topic}, as of a simulation that has restarted"
            raise ValueError(f"the time in {bag.path} {text}: record a bag for each start")
        latest = max(latest, at)
        with suppress(ValueError):  # as on a live robot, a message that cannot be used is ignored
            if topic == topics.scan:
                ranges, _ = aligned(read_scan(message, max_invalid=1.0).mounted(topics.lidar_yaw), BEAMS)
            elif topic == topics.goal:
                x, y, _ = read_finite("goal", *astuple(message.pose.position)).tolist()
                yield at, read_frame(message), (x, y), ranges
            elif (pose := tf.after(message) if is_tf else message) is not None:
                yield at, read_frame(pose), read_place(pose), ranges
