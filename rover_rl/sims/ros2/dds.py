"""ROS 2 transport through Eclipse Cyclone DDS, without a ROS installation: ROS 2 topics are plain DDS topics.

Requires the packages ``cyclonedds`` and ``rosbags`` (``pip install "rover_rl[ros2]"``). Domain and discovery range are
selected as in ROS 2, by ``ROS_DOMAIN_ID``, ``ROS_LOCALHOST_ONLY`` and ``ROS_AUTOMATIC_DISCOVERY_RANGE``. Settings in
``CYCLONEDDS_URI`` take precedence. If ``ROS_DISTRO`` is set, ``ros2 node list`` also shows the nodes.
"""

from __future__ import annotations

import logging
import os
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, TypeVar

try:
    from cyclonedds.core import GuardCondition, InstanceState, ReadCondition, SampleState, ViewState, WaitSet
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.idl import IdlStruct, make_idl_struct, types
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration
except ImportError as error:  # pragma: no cover
    raise ImportError('ROS 2 over DDS requires the package cyclonedds: pip install "rover_rl[ros2]"') from error

from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from rover_rl.sims.ros2.announce import TOPIC, NodeList, Participant, announcement_types
from rover_rl.sims.ros2.cdr import COMMON_TYPES, MalformedError, decode, encode
from rover_rl.sims.ros2.messages import Message
from rover_rl.sims.ros2.throttle import ThrottledLogger
from rover_rl.sims.ros2.transport import Publisher

M = TypeVar("M", bound=Message)

MAX_DOMAIN_ID = 232
"""Highest domain ID. Higher ones exceed the range of port numbers (DDSI-RTPS 2.3, 9.6.1)."""
ACTIVE_TIME = 1.0
"""Time since its last message during which a publisher counts as active, s."""
_HISTORY_DEPTH = 5
"""Number of unread messages that a topic keeps."""

_log = logging.getLogger(__name__)


class DdsTransport:
    """Transport through Cyclone DDS: see :class:`~rover_rl.sims.ros2.transport.Transport`.

    Messages are read in a thread of its own, which :meth:`close` stops. All connections of a process share one DDS
    participant for each domain.

    Args:
        node: name of the node.
        environment: environment variables that select domain and discovery range; ``None``: those of the process.

    Raises:
        ValueError: if ``ROS_DOMAIN_ID`` is invalid.
        RuntimeError: if the process was forked from a process with connections. Use the start method ``spawn``.
    """

    def __init__(self, node: str, environment: Mapping[str, str] | None = None) -> None:
        self.node = node
        self._participant: _Participant | None = _participant(os.environ if environment is None else environment)
        self._topics: dict[str, tuple[type[Message], Topic[Any]]] = {}
        self._readers: list[_Reader] = []
        self._writers: dict[str, DataWriter[Any]] = {}
        self._announce()
        self._stop = GuardCondition(self._participant.entity)
        self._wait_set = WaitSet(self._participant.entity)
        self._wait_set.attach(self._stop)
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._read, name=f"{node} DDS reader", daemon=True)
        self._thread.start()

    def subscribe(self, topic: str, kind: type[M], receive: Callable[[M], object], *, reliable: bool = False) -> None:
        """Subscribes to a topic: see :meth:`Transport.subscribe`."""
        # Best effort and volatile matches every publisher. Further policies, such as deadlines, may not match.
        reliability = _RELIABLE if reliable else Policy.Reliability.BestEffort
        qos = Qos(reliability, Policy.Durability.Volatile, Policy.History.KeepLast(_HISTORY_DEPTH), _XCDR1)
        reader = DataReader(self._require_open().entity, self._topic(topic, kind), qos)
        condition = ReadCondition(reader, ViewState.Any | SampleState.Any | InstanceState.Any)
        with self._lock:
            self._readers.append(_Reader(topic, reader, condition, receive))
            self._wait_set.attach(condition)
        self._announce()

    def publisher(self, topic: str, kind: type[M], *, reliable: bool = False) -> Publisher[M]:
        """Creates a publisher: see :meth:`Transport.publisher`."""
        writer = DataWriter(self._require_open().entity, self._topic(topic, kind), _writer_qos(reliable))
        self._writers[topic] = writer
        self._announce()
        sample_type = _sample_type(kind)

        def publish(message: M) -> None:
            self._require_open()
            writer.write(sample_type.from_bytes(encode(message)))

        return publish

    def subscribers(self, topic: str) -> int:
        """Returns the number of subscribers of ``topic``."""
        return self._writers[topic].get_publication_matched_status().current_count

    def publishers(self, topic: str) -> int:
        """Returns the number of publishers that have sent usable messages on ``topic`` within the last second.

        DDS itself detects only after many seconds that a publisher was killed.
        """
        with self._lock:
            readers = [reader for reader in self._readers if reader.topic == topic]
        return max((reader.publishers() for reader in readers), default=0)

    def close(self) -> None:
        """Stops the thread and releases all resources. Idempotent."""
        if self._participant is None:
            return
        self._stop.set(True)
        if threading.current_thread() is not self._thread:
            self._thread.join()
        if self._participant.nodes is not None:
            self._participant.nodes.remove(id(self))
        # Cyclone deletes entities without references: the participant when the last connection is closed.
        del self._wait_set, self._stop
        self._readers.clear()
        self._writers.clear()
        self._topics.clear()
        self._participant = None

    def _require_open(self) -> _Participant:
        if self._participant is None:
            raise RuntimeError(f"the connection of {self.node} is closed")
        return self._participant

    def _topic(self, name: str, kind: type[Message]) -> Topic[Any]:
        if name not in self._topics:
            self._topics[name] = (kind, Topic(self._require_open().entity, _dds_name(name), _sample_type(kind)))
        known, topic = self._topics[name]
        if known is not kind:
            raise ValueError(f"topic {name} has type {known.ros_type}, and cannot also have type {kind.ros_type}")
        return topic

    def _announce(self) -> None:
        """Announces this node's readers and writers to ROS 2, if the participant announces nodes."""
        nodes = self._require_open().nodes
        if nodes is not None:
            readers = [reader.reader.guid for reader in self._readers]
            nodes.update(id(self), self.node, readers, [writer.guid for writer in self._writers.values()])

    def _read(self) -> None:
        stop, wait_set = self._stop, self._wait_set
        while True:
            wait_set.wait(duration(infinite=True))
            if stop.read():
                return
            with self._lock:
                readers = list(self._readers)
            for reader in readers:
                reader.take()


class _Reader:
    """A subscription and its callback."""

    def __init__(
        self, topic: str, reader: DataReader[Any], condition: ReadCondition, receive: Callable[[Any], object]
    ) -> None:
        self.topic, self.reader, self.condition, self.receive = topic, reader, condition, receive
        self._throttled_log = ThrottledLogger(_log)
        self._last_heard: dict[int, float] = {}

    def publishers(self) -> int:
        """Returns the number of publishers that have sent usable messages within the last second."""
        now = time.monotonic()
        return sum(now - last_heard < ACTIVE_TIME for last_heard in list(self._last_heard.values()))

    def take(self) -> None:
        """Passes new messages to ``receive``.

        A message that is malformed, or for which ``receive`` raises an error, is ignored with a warning.
        """
        for sample in self.reader.take(_HISTORY_DEPTH, self.condition):
            if isinstance(sample, _MalformedSample):
                self._warn(sample.error)
            elif isinstance(sample, Message):
                try:
                    if self.receive(sample) is not False:
                        handle = sample.sample_info.publication_handle  # type: ignore[attr-defined]
                        self._last_heard[handle] = time.monotonic()
                except ValueError as error:
                    self._warn(error)
                except Exception:
                    _log.exception("%s: the callback failed", self.topic)

    def _warn(self, error: ValueError) -> None:
        self._throttled_log.warning(self.topic, "%s: ignored a message: %s", self.topic, error)


class _MalformedSample:
    """Placeholder for a sample that is not a message of the expected type."""

    def __init__(self, error: MalformedError) -> None:
        self.error = error


class _Participant:
    """A process's DDS participant in a domain, with the list of its nodes."""

    def __init__(self, number: int, settings: str, distribution: str) -> None:
        self.pid = os.getpid()
        self._domain = Domain(number, settings)
        # As in rmw_cyclonedds_cpp: the user data names the security enclave and marks the participant as one of ROS 2.
        self.entity = DomainParticipant(number, Qos(Policy.Userdata(b"enclave=/;")))
        self.nodes = self._node_list(distribution) if distribution else None

    def _node_list(self, distribution: str) -> NodeList:
        types = announcement_types(distribution)
        sample_type = _sample_type(Participant, types)
        qos = _writer_qos(reliable=True, transient_local=True)
        writer = DataWriter(self.entity, Topic(self.entity, TOPIC, sample_type), qos)

        def publish(message: Participant) -> None:
            writer.write(sample_type.from_bytes(encode(message, types)))

        return NodeList(distribution, self.entity.guid, publish)


_participants: dict[int, Any] = {}
_participants_lock = threading.Lock()


def _participant(environment: Mapping[str, str]) -> _Participant:
    """Returns the participant of the environment's domain, and creates it if there is none."""
    number = domain_id(environment)
    with _participants_lock:
        known = _participants.get(number)
        participant = known() if known else None
        if participant is None:
            participant = _Participant(number, domain_settings(environment), environment.get("ROS_DISTRO", ""))
            _participants[number] = weakref.ref(participant)
        if participant.pid != os.getpid():
            raise RuntimeError("DDS does not survive a fork: start processes with the method 'spawn' or 'forkserver'")
        return participant


def domain_id(environment: Mapping[str, str]) -> int:
    """Returns the domain ID from ``ROS_DOMAIN_ID``, 0 by default.

    Raises:
        ValueError: if it is not a whole number from 0 to 232.
    """
    text = environment.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not text.isdecimal() or int(text) > MAX_DOMAIN_ID:
        raise ValueError(f"ROS_DOMAIN_ID must be a whole number from 0 to {MAX_DOMAIN_ID}, got {text!r}")
    return int(text)


def is_localhost_only(environment: Mapping[str, str]) -> bool:
    """Whether ROS 2's variables limit discovery to this machine."""
    discovery_range = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").strip().upper()
    return environment.get("ROS_LOCALHOST_ONLY", "").strip() == "1" or discovery_range == "LOCALHOST"


def domain_settings(environment: Mapping[str, str]) -> str:
    """Returns Cyclone DDS's settings: XML fragments and file URIs, of which later ones take precedence."""
    # Fast DDS peers that offer type objects do not match without it.
    own = ["<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"]
    if is_localhost_only(environment):
        # Fast DDS peers that start second are not discovered without multicast and a short interval.
        own += [
            '<General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
            "<AllowMulticast>spdp</AllowMulticast></General>",
            "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
            '<SPDPInterval>1s</SPDPInterval><Peers><Peer address="localhost"/></Peers></Discovery>',
        ]
    given = environment.get("CYCLONEDDS_URI", "").strip()
    return ",".join(["".join(own), given] if given else ["".join(own)])


def _writer_qos(reliable: bool, transient_local: bool = False) -> Qos:
    """Returns the quality of service of a writer.

    Args:
        reliable: whether the writer is reliable, with a history of one message.
        transient_local: whether late subscribers receive the last message.
    """
    return Qos(
        _RELIABLE if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if transient_local else Policy.Durability.Volatile,
        Policy.History.KeepLast(1 if reliable else _HISTORY_DEPTH),
        Policy.WriterDataLifecycle(autodispose=False),
        _XCDR1,
    )


def _dds_name(topic: str) -> str:
    """Returns the DDS name of a ROS topic: ``rt/scan`` for ``/scan``."""
    return "rt/" + topic.removeprefix("/")


class _SerializedSample(IdlStruct):
    """Base of DDS types whose samples are serialized by :mod:`~rover_rl.sims.ros2.cdr`.

    Cyclone's own serialization takes ten times as long, and produces objects of its own classes.
    """

    # Not annotated, as annotations declare fields of the DDS type. Subclasses set the first two, samples set ``data``.
    message = Message
    types = COMMON_TYPES
    data = b""

    @classmethod
    def from_bytes(cls, data: bytes) -> _SerializedSample:
        sample = cls.__new__(cls)
        sample.data = data
        return sample

    def serialize(self, *_: Any, **__: Any) -> bytes:
        return self.data

    @classmethod
    def deserialize(cls, data: bytes, *_: Any, **__: Any) -> Any:
        try:
            return decode(cls.message, data, cls.types)
        except MalformedError as error:
            return _MalformedSample(error)


_RELIABLE = Policy.Reliability.Reliable(duration(milliseconds=100))
_XCDR1 = Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False)
# Indexing these classes creates types, which type checkers do not support.
_SEQUENCE: Any = types.sequence
_ARRAY: Any = types.array
_BASE_TYPES: dict[str, Any] = {"string": str, "char": types.uint8} | {
    name: getattr(types, name) for name in ("int32", "uint32", "uint8", "float32", "float64")
}


def _sample_type(kind: type[Message], definitions: Typestore = COMMON_TYPES) -> type[_SerializedSample]:
    """Returns the DDS type of a message; ``sensor_msgs/msg/Imu`` becomes ``sensor_msgs::msg::dds_::Imu_``."""
    sample_type: Any = _struct(kind.ros_type, definitions, _SerializedSample)
    sample_type.message, sample_type.types = kind, definitions
    return sample_type


@cache
def _struct(ros_type: str, definitions: Typestore, *bases: type) -> type[IdlStruct]:
    """Returns Cyclone's type of a message."""
    package, folder, name = ros_type.split("/")
    fields = {field: _idl(layout, definitions) for field, layout in definitions.fielddefs[ros_type][1]}
    return make_idl_struct(name, f"{package}.{folder}.dds_.{name}_", fields, bases=bases)


def _idl(layout: Any, definitions: Typestore) -> Any:
    """Returns Cyclone's type of a field from its definition."""
    node, content = layout
    if node == Nodetype.BASE:
        return _BASE_TYPES[content[0]]
    if node == Nodetype.NAME:
        return _struct(content, definitions)
    element, length = content
    element = _idl(element, definitions)
    return _ARRAY[element, length] if node == Nodetype.ARRAY else _SEQUENCE[element]
