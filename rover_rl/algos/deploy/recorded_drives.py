"""Drives in bags of ROS 2: of ``rover-rl drive``, and of any robot that others have recorded.

A bag is an MCAP file, of which a torn end is ignored, an SQLite file (``.db3``), or a folder of ``ros2 bag record``.
"""

from __future__ import annotations

import logging
import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import IO, Any, NamedTuple

import torch
from mcap.exceptions import EndOfFile
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC
from rosbags.highlevel import AnyReader
from torch import Tensor

from rover_rl.algos.deploy.bags import ABOUT, ENDING, GOAL, STEP
from rover_rl.algos.driving import REPLACED, STOPPED
from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.evaluate import Evaluation
from rover_rl.algos.evaluation.trajectory import Trajectory, count_reversals
from rover_rl.algos.video.recording import Recording, State, moments_of
from rover_rl.envs.config import EnvConfig, TaskConfig
from rover_rl.robots import get_robot
from rover_rl.rotations import euler_to_matrix, matrix_to_quaternion, quaternion_to_euler
from rover_rl.sims import RoverState
from rover_rl.sims.free_space.paths import shortest_paths
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.frames import MAP, WORLD
from rover_rl.sims.ros2.poses import POSE_MESSAGES, MeasuredPose, read_finite, read_place
from rover_rl.sims.ros2.scans import aligned, read_scan
from rover_rl.sims.ros2.sensors import read_frame
from rover_rl.sims.ros2.settings import BAG, BagTopics
from rover_rl.sims.ros2.tf import TF_TOPIC, RobotPose
from rover_rl.sims.ros2.transport import short
from rover_rl.sims.settings import CONTROL_DT
from rover_rl.worlds import Terrain, World, get_world
from rover_rl.worlds.pool import WorldPool

NO_WORLD = "none"  # stands for flat ground without obstacles, on which the lidar readings show what was there
BEAMS = 180  # number of readings around the robot, of scans of other recorders
LATE = 0.5  # time by which a message may be older than the one before it in the file, s
FASTEST, JUMP = 10.0, 1.0  # speed (m/s) and further distance (m) above which a pose has jumped
MOST_JUMPS = 5  # largest number of jumps of one robot, or a tenth of its poses, which a localization corrects
_MARGIN = 12.0  # size of that ground around the drive, m
_POSES = {kind.ros_type: kind for kind, _ in POSE_MESSAGES.values()}

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

        def in_steps(events: list[bool]) -> Tensor:
            happened = torch.zeros(steps, dtype=torch.bool)
            happened[step_of[torch.tensor(events, dtype=torch.bool)]] = True
            return happened

        yaw_rates = [sample.command[1] for sample in after]
        return Trajectory(
            position=torch.tensor([sample.position for sample in self.samples])[nearest],
            angles=torch.tensor([sample.angles for sample in self.samples])[nearest],
            collision=in_steps([sample.collision for sample in after]),
            goal=in_steps([sample.reached for sample in after]),
            ending=self.ending,
            reversals=math.nan if any(map(math.isnan, yaw_rates)) else count_reversals(yaw_rates),
        )

    def scans(self) -> Tensor:
        """Resamples the lidar readings like :meth:`trajectory`: ``[T + 1, beams]``, m, ``inf`` without a return."""
        return torch.stack([self.samples[k].ranges for k in self._nearest()])

    def _nearest(self) -> Tensor:
        """Index of the sample nearest to each step of 20 Hz, int64 ``[T + 1]``."""
        times = torch.tensor(self.times)
        grid = CONTROL_DT * torch.arange(max(1, round(times[-1].item() / CONTROL_DT)) + 1)
        after = torch.searchsorted(times, grid).clamp(max=len(times) - 1)
        before = (after - 1).clamp(min=0)
        return torch.where(grid - times[before] <= times[after] - grid, before, after)


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
    """Reads the drives of a bag.

    Args:
        path: MCAP file, SQLite file, or folder of a bag.
        topics: topics of a bag that is not of ``rover-rl drive``.
        world, robot: names, in place of those in the bag.

    Raises:
        ValueError: if it is no bag, has no drives, or not the topics, its time goes back, or several robots sent.
    """
    bag, topics = Bag(path), topics or BagTopics()
    found, least = (_own(bag, topics), 1) if STEP in bag.types else (_Foreign(bag, topics).read(), 2)
    drives, about = [drive for drive in found if len(drive.samples) >= least], bag.about
    if not drives:
        raise ValueError(f"there is no drive in {path}: no goal is followed by poses; {bag.contents}")
    for key, given in (("world", world), ("robot", robot)):
        # Nothing that a file names is imported: module:attribute, with or without settings.
        if given is None and re.search(r":[^\W\d]", about.get(key, "")):
            raise ValueError(f"{path} names code as its {key}: if you trust it, add --{key} {about[key]}")
    longest = math.ceil(max(drive.times[-1] for drive in drives))
    return Drives(
        policy=about.get("policy", path.stem),
        world=world or about.get("world"),
        robot=robot or about.get("robot", "rover_zero"),
        seconds=float(about.get("seconds", longest)),
        drives=drives,
    )


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
    count = len(scans)
    rovers = RoverState.pack(
        position=position,
        orientation=matrix_to_quaternion(euler_to_matrix(driven.angles)),
        linear_velocity=torch.cat((torch.zeros(1), driven.signed_speed))[:, None],
        angular_velocity=torch.zeros(count, 1),
        dt=torch.full((count, 1), driven.dt),
        stamp=torch.zeros(count, 1).double(),
    )
    states: list[State] = [(rovers[step : step + 1], scans[step : step + 1], None) for step in range(count)]
    angles = torch.arange(scans.shape[1]) * (2 * math.pi / max(1, scans.shape[1]))
    moments = moments_of(states, torch.tensor([drive.goal]), driven.dt, drive.ending)
    return Recording(moments, place, get_robot(bag.robot), angles, driven.dt, drive.ending, number)


def place_of(world: str | None, drives: Sequence[RecordedDrive]) -> World:
    """Returns a world by name; for none, flat ground around drives."""
    if world not in (None, NO_WORLD):
        return get_world(world)
    points = [point for drive in drives for point in (drive.goal, *(sample.position[:2] for sample in drive.samples))]
    side = float(math.ceil(2 * (max(max(map(abs, point)) for point in points) + _MARGIN)))
    return World(NO_WORLD, Terrain.flat((side, side)))


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
            point, turn, twist = message.pose.position, message.pose.orientation, message.command
            angles = quaternion_to_euler(torch.tensor([turn.x, turn.y, turn.z, turn.w])).tolist()
            ranges, events = torch.tensor(message.ranges), (message.collision, message.reached)
            place, command = (point.x, point.y, point.z), (twist.linear.x, twist.angular.z)
            drives[-1].samples.append(Sample(message.dt, place, angles, ranges, *events, command, wheels))
    return drives


class _Foreign:
    """Reader of the drives of a bag that others have recorded: see :class:`BagTopics`."""

    def __init__(self, bag: Bag, topics: BagTopics) -> None:
        bag.require("goal", "--topics.goal", topics.goal, ros.PoseStamped.ros_type)
        kind = _POSES[bag.require("pose", "--topics.pose", topics.pose, *_POSES)]
        self._bag, self._topics, self._kinds = bag, topics, {topics.pose: kind, topics.goal: ros.PoseStamped}
        if topics.scan in bag.types or topics.scan != BagTopics.scan:
            bag.require("scan", "--topics.scan", topics.scan, ros.LaserScan.ros_type)
            self._kinds[topics.scan] = ros.LaserScan
        self._tf = RobotPose(topics.map_frame, topics.base_frame) if kind is ros.TFMessage else None
        if self._tf is not None:
            self._kinds[f"{TF_TOPIC}_static"] = kind
        self._ranges, self._angles = torch.full((BEAMS,), math.inf), [0.0, 0.0, 0.0]
        self._pose_frames, self._goal_frames = set[str](), set[str]()
        self._poses = self._jumps = 0
        self._last: Sample | None = None
        self._time, self._is_driving = 0.0, False
        self._drives: list[RecordedDrive] = []

    def read(self) -> list[RecordedDrive]:
        latest = -math.inf
        for topic, at, message in self._bag.messages(self._kinds):
            if at < latest - LATE:
                text = f"goes back by {latest - at:.1f} s on {topic}, as of a simulation that has restarted"
                raise ValueError(f"the time in {self._bag.path} {text}: record a bag for each start")
            latest = max(latest, at)
            with suppress(ValueError):  # as on a live robot, a message that cannot be used is ignored
                if topic == self._topics.scan:
                    scan = read_scan(message, max_invalid=1.0).mounted(self._topics.lidar_yaw)
                    self._ranges, _ = aligned(scan, BEAMS)
                elif topic == self._topics.goal:
                    self._take_goal(at, message)
                elif (pose := message if self._tf is None else self._tf.after(message)) is not None:
                    self._take_pose(at, read_place(pose), read_frame(pose))
        self._check()
        return self._drives

    def _take_goal(self, at: float, message: Any) -> None:
        x, y, _ = read_finite("goal", *(getattr(message.pose.position, axis) for axis in "xyz")).tolist()
        if self._drives and self._drives[-1].goal == (x, y):
            return
        if self._is_driving:
            self._drives[-1].ending = REPLACED
        self._goal_frames.add(read_frame(message))
        start = [] if self._last is None else [self._last._replace(ranges=self._ranges)]
        self._drives.append(RecordedDrive((x, y), start))
        self._time, self._is_driving = at, True

    def _take_pose(self, at: float, pose: MeasuredPose, frame: str) -> None:
        self._pose_frames.add(frame)
        if pose.orientation is not None:
            self._angles = quaternion_to_euler(pose.orientation).tolist()
        position, dt = pose.position.tolist(), max(0.0, at - self._time)
        reached = self._is_driving and math.dist(position[:2], self._drives[-1].goal) <= TaskConfig().success_distance
        self._poses += 1
        self._jumps += self._last is not None and math.dist(position, self._last.position) > JUMP + FASTEST * dt
        self._last, self._time = Sample(dt, position, self._angles, self._ranges, reached=reached), at
        if self._is_driving:
            self._drives[-1].samples.append(self._last)
        if reached:
            self._drives[-1].ending, self._is_driving = "goal", False

    def _check(self) -> None:
        path, pose, frames = self._bag.path, self._topics.pose, sorted(self._pose_frames)
        if len(frames) > 1:
            raise ValueError(f"the poses on {pose} in {path} are in the frames {frames}, as of several robots")
        if self._jumps > max(MOST_JUMPS, self._poses / 10):
            text = f"jumps {self._jumps} times by more than {JUMP:g} m, as of several robots"
            raise ValueError(f"the pose on {pose} in {path} {text}")
        for frame in self._goal_frames:
            if frame and frames[:1] not in ([""], [frame]) and not {frame, *frames} <= {MAP, WORLD}:
                raise ValueError(f"the goals in {path} are in the frame {frame!r}, and the poses in {frames}")


class Bag:
    """Messages of a bag. ``types`` are those on each topic, and ``about`` is what ``rover-rl drive`` adds."""

    def __init__(self, path: Path) -> None:
        path.stat()  # says that there is none
        self.path, self.about = path, dict[str, str]()
        self.types: defaultdict[str, set[str]] = defaultdict(set)
        for topic, ros_type, _, _ in self._records():
            self.types[topic].add(ros_type)

    @property
    def contents(self) -> str:
        """What is in the bag, as half a sentence."""
        named = (f"{topic} ({' and '.join(map(short, sorted(types)))})" for topic, types in sorted(self.types.items()))
        return f"it has {', '.join(named) or 'no messages'}"

    def require(self, what: str, option: str, topic: str, *allowed: str) -> str:
        """Returns the type on a topic, which is the value of an option. Raises ``ValueError`` for another."""
        found = sorted(self.types.get(topic, ()))
        if not found:
            raise ValueError(f"{self.path} has no {what} on {topic}: name the topic with {option}; {self.contents}")
        if len(found) > 1 or found[0] not in allowed:
            types, needed = (" or ".join(map(short, names)) for names in (found, allowed))
            raise ValueError(f"{topic} in {self.path} has {types}, and {option} takes {needed}; {self.contents}")
        return found[0]

    def messages(self, kinds: Mapping[str, Any]) -> Iterator[tuple[str, float, Any]]:
        """Yields topic, time (s) and message of the topics of ``kinds``. Messages that are malformed are ignored."""
        for topic, ros_type, nanoseconds, data in self._records():
            if topic in kinds and ros_type == kinds[topic].ros_type:
                with suppress(ValueError):
                    yield topic, 1e-9 * nanoseconds, ros.decode(kinds[topic], data)

    def _records(self) -> Iterator[tuple[str, str, int, bytes]]:
        """Yields topic, type, time (ns) and content of each message. Raises ``ValueError`` for a damaged file."""
        try:
            yield from self._of_rosbag2() if self.path.is_dir() or self.path.suffix != BAG else self._of_mcap()
        except Exception as error:
            # Libraries of databases and compressions have errors of their own.
            raise ValueError(f"{self.path} cannot be read: {str(error) or type(error).__name__}") from error

    def _of_mcap(self) -> Iterator[tuple[str, str, int, bytes]]:
        channels: dict[int, Channel] = {}
        schemas: dict[int, str] = {}
        with self.path.open("rb") as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise ValueError("it is no MCAP file")
            whole: Any = _WholeReads(file)
            records = StreamReader(whole, skip_magic=True, record_size_limit=self.path.stat().st_size).records
            with suppress(EndOfFile):  # the file was cut off here
                for record in records:
                    if isinstance(record, Schema):
                        schemas[record.id] = record.name
                    elif isinstance(record, Channel):
                        channels[record.id] = record
                    elif isinstance(record, Metadata) and record.name == ABOUT:
                        self.about = record.metadata
                    elif isinstance(record, Message) and record.channel_id in channels:
                        channel = channels[record.channel_id]
                        coding = "" if channel.message_encoding == "cdr" else f" in {channel.message_encoding}"
                        name = schemas.get(channel.schema_id, "no type") + coding
                        yield channel.topic, name, record.log_time, record.data

    def _of_rosbag2(self) -> Iterator[tuple[str, str, int, bytes]]:
        with AnyReader([self.path], default_typestore=ros.TYPES) as reader:
            for connection, at, data in reader.messages():
                yield connection.topic, connection.msgtype, at, bytes(data)


class _WholeReads:
    """Reads all bytes that are asked for or none, as mcap does not tell them apart at the end of a file."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file

    def read(self, size: int) -> bytes:
        data = self._file.read(size)
        if len(data) < size:
            raise EndOfFile
        return data
