"""Bags of ROS 2: those that drives with a live rover are recorded to, and reading of these and others.

The MCAP files of drives open in ``ros2 bag``, Foxglove and PlotJuggler.
"""

from __future__ import annotations

import logging
import time
from collections import defaultdict, deque
from collections.abc import Iterator, Mapping
from contextlib import suppress
from io import BufferedReader
from pathlib import Path
from queue import Full, Queue
from threading import Thread
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from rover_rl.sims import RoverState
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.settings import BAG
from rover_rl.sims.ros2.tf import MAP
from rover_rl.sims.ros2.transport import short

try:
    from mcap.exceptions import EndOfFile
    from mcap.records import Channel, Message, Metadata, Schema
    from mcap.stream_reader import StreamReader
    from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
except ImportError as error:  # pragma: no cover
    raise ImportError('bags of drives require the package mcap: pip install "rover_rl[ros2]"') from error

GOAL, STEP, ENDING = "/rover_rl/goal", "/rover_rl/step", "/rover_rl/ending"
"""Topics of the goal of a drive, of its start and steps, and of its ending."""
ABOUT = "rover_rl drive"  # name of the metadata
WAITING = 500  # largest number of messages that wait for the disk
CLOSE_TIMEOUT = 5.0  # longest time to wait at the end until all messages are written, s

_log = logging.getLogger(__name__)


class DriveBag:
    """Context manager that records drives to an MCAP file, for ``rover-rl evaluate``, ``film`` and ``view``.

    Besides the messages that :meth:`add` gets, it has the goal (``geometry_msgs/PoseStamped``) of each drive, its steps
    (``rover_rl_msgs/DriveStep``) and its ending (``std_msgs/String``). A thread writes, so that a disk that is slow or
    full never delays a drive: a warning says that messages are missing. If the program is killed, the file is read up
    to its last message. The names of world, policy and robot, and the time limit of each drive (s), are metadata.

    Raises ``FileExistsError`` if there is such a file.
    """

    def __init__(self, path: Path, world: str, policy: str, seconds: float, robot: str = "rover_zero") -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path, self._file = path, path.open("xb")
        self._about = {"world": world, "policy": policy, "robot": robot, "seconds": repr(float(seconds))}
        self._waiting: Queue[tuple[str, Any, Any, int] | None] = Queue(WAITING)
        self._is_open, self._has_lost = True, False
        self._thread = Thread(target=self._write, name=f"writer of {path.name}", daemon=True)
        self._thread.start()

    def __enter__(self) -> DriveBag:
        return self

    def __exit__(self, *_: object) -> None:
        self._is_open = False
        with suppress(Full):
            self._waiting.put(None, timeout=CLOSE_TIMEOUT)
        self._thread.join(CLOSE_TIMEOUT)

    def add(self, topic: str, kind: Any, message: Any) -> None:
        """Adds a message of the class ``kind``, which has just arrived or been sent. Never blocks."""
        try:
            if self._is_open:
                self._waiting.put_nowait((topic, kind, message, time.time_ns()))
        except Full:
            if not self._has_lost:
                _log.warning("%s lacks messages: the disk is too slow", self._path)
            self._has_lost = True

    def begin(self, rover: RoverState, scan: Tensor, goal: tuple[float, float], frame: str = MAP) -> None:
        """Adds the goal of a drive (x, y, m), which is in ``frame``, and the rover and the raw scan at its start."""
        stamp = ros.Time.from_seconds(rover.stamp.item())
        self.add(GOAL, ros.PoseStamped, ros.PoseStamped(ros.Header(stamp, frame), ros.Pose(ros.Point(*goal))))
        self._add_step(rover, scan)

    def step(
        self, rover: RoverState, scan: Tensor, outcome: TensorDictBase, command: tuple[float, float], **more: Any
    ) -> None:
        """Adds a step: the rover and the raw scan after it, ``[1, beams]`` (m), and its ``"outcome"``.

        ``command``, ``latency``, ``distance`` and ``held`` are those of
        :class:`~rover_rl.algos.deploy.driving.Moment`.
        """
        twist = ros.Twist(ros.Vector3(x=command[0]), ros.Vector3(z=command[1]))
        events = {"collision": bool(outcome["collision"]), "reached": bool(outcome["goal_reached"])}
        self._add_step(rover, scan, command=twist, dt=rover.dt.item(), **events, **more)

    def end(self, ending: str) -> None:
        self.add(ENDING, ros.String, ros.String(ending))

    def _add_step(self, rover: RoverState, scan: Tensor, **more: Any) -> None:
        place = ros.Pose(ros.Point(*rover.position[0].tolist()), ros.Quaternion(*rover.orientation[0].tolist()))
        header, ranges = ros.Header(ros.Time.from_seconds(rover.stamp.item())), scan[0].float().cpu().numpy().copy()
        self.add(STEP, ros.DriveStep, ros.DriveStep(header, place, ranges=ranges, **more))

    def _write(self) -> None:
        messages = iter(self._waiting.get, None)
        try:
            with self._file:
                # With a chunk for each message, a file that was cut off loses only its last message.
                writer = Writer(self._file, chunk_size=0, compression=CompressionType.NONE)
                writer.start(profile="ros2", library="rover_rl")
                writer.add_metadata(ABOUT, self._about)
                channels: dict[str, int] = {}
                for topic, kind, message, at in messages:
                    if topic not in channels:
                        definition, _ = ros.TYPES.generate_msgdef(kind.ros_type, ros_version=2)
                        schema = writer.register_schema(kind.ros_type, "ros2msg", definition.encode())
                        channels[topic] = writer.register_channel(topic, "cdr", schema)
                    writer.add_message(channels[topic], at, _serialized(message), at)
                    self._file.flush()
                writer.finish()
            self._path.stat()  # fails if the file has been removed
        except Exception as error:  # whatever it is, the drive goes on
            _log.warning("%s: the drive is no longer recorded: %s", self._path, error)
            deque(messages, maxlen=0)


def _serialized(message: Any) -> bytes:
    if isinstance(message, ros.Message):
        return ros.encode(message)
    from rclpy.serialization import serialize_message  # for a message of ROS's own classes

    return bytes(serialize_message(message))


class Bag:
    """Messages of a bag: an MCAP file, of which a torn end is ignored, an SQLite file (``.db3``), or a folder.

    ``types`` are those on each topic, and ``about`` is what ``rover-rl drive`` adds.
    """

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

    def require(self, what: str, option: str, topic: str, *kinds: Any) -> Any:
        """Returns the class, of ``kinds``, of messages on the topic of an option. Raises ``ValueError`` for others."""
        found, allowed = sorted(self.types.get(topic, ())), {kind.ros_type: kind for kind in kinds}
        if not found:
            raise ValueError(f"{self.path} has no {what} on {topic}: name the topic with {option}; {self.contents}")
        if len(found) > 1 or found[0] not in allowed:
            types, needed = (" or ".join(map(short, names)) for names in (found, allowed))
            raise ValueError(f"{topic} in {self.path} has {types}, and {option} takes {needed}; {self.contents}")
        return allowed[found[0]]

    def messages(self, kinds: Mapping[str, Any]) -> Iterator[tuple[str, float, Any]]:
        """Yields topic, time (s) and message of the topics of ``kinds``. Messages that are malformed are ignored."""
        for topic, ros_type, nanoseconds, data in self._records():
            if topic in kinds and ros_type == kinds[topic].ros_type:
                with suppress(ValueError):
                    yield topic, 1e-9 * nanoseconds, ros.decode(kinds[topic], data)

    def _records(self) -> Iterator[tuple[str, str, int, bytes]]:
        """Yields topic, type, time (ns) and content of each message. Raises ``ValueError`` for a damaged file."""
        try:
            if self.path.suffix == BAG and self.path.is_file():
                yield from self._of_mcap()
            else:
                from rosbags.highlevel import AnyReader  # takes 0.3 seconds

                with AnyReader([self.path], default_typestore=ros.TYPES) as reader:
                    for connection, at, data in reader.messages():
                        yield connection.topic, connection.msgtype, at, bytes(data)
        except Exception as error:  # libraries of databases and compressions have errors of their own
            raise ValueError(f"{self.path} cannot be read: {str(error) or type(error).__name__}") from error

    def _of_mcap(self) -> Iterator[tuple[str, str, int, bytes]]:
        schemas, channels = dict[int, str](), dict[int, tuple[str, str]]()
        with _WholeReads(self.path.open("rb", buffering=0)) as file, suppress(EndOfFile):  # where it was cut off
            if not file.peek(len(MCAP0_MAGIC)).startswith(MCAP0_MAGIC):
                raise ValueError("it is no MCAP file")
            for record in StreamReader(file, record_size_limit=self.path.stat().st_size).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    coding = "" if record.message_encoding == "cdr" else f" in {record.message_encoding}"
                    channels[record.id] = record.topic, schemas.get(record.schema_id, "no type") + coding
                elif isinstance(record, Metadata) and record.name == ABOUT:
                    self.about = record.metadata
                elif isinstance(record, Message) and record.channel_id in channels:
                    yield *channels[record.channel_id], record.log_time, record.data


class _WholeReads(BufferedReader):
    """Reads all bytes that are asked for or none, as mcap does not tell them apart at the end of a file."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if len(data) < (size or 0):
            raise EndOfFile
        return data
