"""ROS 2 transport through Eclipse Cyclone DDS, without a ROS installation: ROS 2 topics are plain DDS topics.

Domain and discovery range are selected as in ROS 2, by ``ROS_DOMAIN_ID``, ``ROS_LOCALHOST_ONLY`` and
``ROS_AUTOMATIC_DISCOVERY_RANGE``. Settings in ``CYCLONEDDS_URI`` take precedence. If ``ROS_DISTRO`` is set,
``ros2 node list`` also shows the nodes.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import Any
from weakref import WeakValueDictionary

import numpy as np

try:
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
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
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from rover_rl.sims.ros2.messages import Message, decode, encode, message_class
from rover_rl.sims.ros2.transport import HISTORY_DEPTH, Publisher, ThrottledLogger

MAX_PUBLISHERS = 10_000
"""Largest number of publishers in a domain among which those of a topic are looked up."""
MAX_DOMAIN_ID = 232
"""Highest domain ID. Higher ones exceed the range of port numbers (DDSI-RTPS 2.3, 9.6.1)."""
ACTIVE_TIME = 1.0
"""Time since its last message during which a publisher counts as active, s."""
NODE_LIST = "ros_discovery_info"
"""DDS name of the topic that announces nodes. Unlike the names of ROS topics, it has no prefix."""
LONG_IDENTIFIERS = ("foxy", "galactic", "humble")
"""Distributions with identifiers of 24 bytes; later ones have 16. Only their names distinguish them."""

_log = logging.getLogger(__name__)


class DdsTransport:
    """:class:`Transport` through Cyclone DDS.

    Messages are read in a thread of its own, which :meth:`close` stops. All connections of a process share one DDS
    participant for each domain. ``environment`` has the variables that select it, by default those of the process.

    Raises:
        ValueError: if ``ROS_DOMAIN_ID`` is invalid.
        RuntimeError: if the process was forked from a process with connections. Use the start method ``spawn``.
    """

    def __init__(self, node: str, environment: Mapping[str, str] | None = None) -> None:
        self.node = node
        self._participant: _Participant | None = _participant(os.environ if environment is None else environment)
        self._topics: dict[str, tuple[str, Topic[Any]]] = {}
        self._readers: list[_Reader] = []
        self._writers: dict[str, DataWriter[Any]] = {}
        self._announce()
        self._stop = GuardCondition(self._participant.entity)
        self._wait_set = WaitSet(self._participant.entity)
        self._wait_set.attach(self._stop)
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._read, name=f"{node} DDS reader", daemon=True)
        self._thread.start()

    def subscribe(self, topic: str, kind: Any, receive: Callable[[Any], object], *, reliable: bool = False) -> None:
        """See :meth:`Transport.subscribe`."""
        # Best effort and volatile matches every publisher. Further policies, such as deadlines, may not match.
        qos = _qos(reliable, HISTORY_DEPTH)
        reader = _Reader(topic, DataReader(self._require_open().entity, self._topic(topic, kind), qos), receive)
        with self._lock:
            self._readers.append(reader)
            self._wait_set.attach(reader.condition)
        self._announce()

    def publisher(self, topic: str, kind: Any, *, reliable: bool = False) -> Publisher:
        """See :meth:`Transport.publisher`."""
        qos = _qos(reliable, 1 if reliable else HISTORY_DEPTH)
        writer = DataWriter(self._require_open().entity, self._topic(topic, kind), qos)
        self._writers[topic] = writer
        self._announce()

        def publish(message: Any) -> None:
            self._require_open()
            _write(writer, message)

        return publish

    def subscribers(self, topic: str) -> int:
        """See :meth:`Transport.subscribers`."""
        return self._writers[topic].get_publication_matched_status().current_count

    def publishers(self, topic: str) -> int:
        """Returns the number of publishers that have sent usable messages on ``topic`` within the last second.

        DDS itself detects only after many seconds that a publisher was killed.
        """
        with self._lock:
            readers = [reader for reader in self._readers if reader.topic == topic]
        return max((reader.publishers() for reader in readers), default=0)

    def types(self, topic: str) -> set[str]:
        """See :meth:`Transport.types`."""
        reader = BuiltinDataReader(self._require_open().entity, BuiltinTopicDcpsPublication)
        found = (sample for sample in reader.read(MAX_PUBLISHERS) if sample.topic_name == _dds_name(topic))
        return {sample.type_name.replace("::dds_::", "::").replace("::", "/").removesuffix("_") for sample in found}

    def close(self) -> None:
        """See :meth:`Transport.close`."""
        if self._participant is None:
            return
        self._stop.set(True)
        if threading.current_thread() is not self._thread:
            self._thread.join()
        self._participant.announce(id(self), None)
        # Cyclone deletes entities without references: the participant when the last connection is closed.
        del self._wait_set, self._stop
        for entities in (self._readers, self._writers, self._topics):
            entities.clear()
        self._participant = None

    def _require_open(self) -> _Participant:
        if self._participant is None:
            raise RuntimeError(f"the connection of {self.node} is closed")
        return self._participant

    def _topic(self, name: str, kind: Any) -> Topic[Any]:
        if name not in self._topics:
            topic = Topic(self._require_open().entity, _dds_name(name), _sample_type(kind))
            self._topics[name] = (kind.ros_type, topic)
        known, topic = self._topics[name]
        if known != kind.ros_type:
            raise ValueError(f"topic {name} has type {known}, and cannot also have type {kind.ros_type}")
        return topic

    def _announce(self) -> None:
        readers = [reader.reader for reader in self._readers]
        self._require_open().announce(id(self), self.node, readers, self._writers.values())

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


def _dds_name(topic: str) -> str:
    return "rt/" + topic.removeprefix("/")


class _Reader:
    """A subscription and its callback."""

    def __init__(self, topic: str, reader: DataReader[Any], receive: Callable[[Any], object]) -> None:
        self.topic, self.reader, self._receive = topic, reader, receive
        self.condition = ReadCondition(reader, ViewState.Any | SampleState.Any | InstanceState.Any)
        self._throttled_log = ThrottledLogger(_log)
        self._last_heard: dict[int, float] = {}

    def publishers(self) -> int:
        now = time.monotonic()
        return sum(now - last_heard < ACTIVE_TIME for last_heard in list(self._last_heard.values()))

    def take(self) -> None:
        """Passes new messages on. One that is malformed, or raises an error there, is ignored with a warning."""
        for sample in self.reader.take(HISTORY_DEPTH, self.condition):
            if not sample.sample_info.valid_data:
                continue
            try:
                if isinstance(sample, ValueError):
                    raise sample
                if self._receive(sample) is not False:
                    self._last_heard[sample.sample_info.publication_handle] = time.monotonic()
            except ValueError as error:
                self._throttled_log.warning(self.topic, "%s: ignored a message: %s", self.topic, error)
            except Exception:
                _log.exception("%s: the callback failed", self.topic)


class _Participant:
    """A process's DDS participant in a domain.

    In a ROS distribution it announces its nodes for ``ros2 node list``, at each change. Topics work without that.
    """

    def __init__(self, number: int, settings: str, distribution: str) -> None:
        self.pid = os.getpid()
        self._domain = Domain(number, settings)
        # As in rmw_cyclonedds_cpp: the user data names the security enclave and marks the participant as one of ROS 2.
        self.entity = DomainParticipant(number, Qos(Policy.Userdata(b"enclave=/;")))
        self._nodes: dict[int, Any] = {}
        self._distribution = distribution
        if distribution:
            self._gid, self._node, self._message = announcement_messages(distribution)
            topic = Topic(self.entity, NODE_LIST, _sample_type(self._message))
            # Late subscribers receive the last announcement.
            self._writer = DataWriter(self.entity, topic, _qos(True, 1, Policy.Durability.TransientLocal))

    def announce(self, owner: int, name: str | None, readers: Iterable[Any] = (), writers: Iterable[Any] = ()) -> None:
        """Announces the node of a transport with its DDS entities, or the end of the node if ``name`` is ``None``."""
        if not self._distribution:
            return
        if name is None:
            del self._nodes[owner]
        else:
            gids = ([self._identifier(entity) for entity in entities] for entities in (readers, writers))
            self._nodes[owner] = self._node("/", name, *gids)
        _write(self._writer, self._message(self._identifier(self.entity), [*self._nodes.values()]))

    def _identifier(self, entity: Any) -> Any:
        size = 24 if self._distribution in LONG_IDENTIFIERS else 16
        return self._gid(np.frombuffer(entity.guid.bytes.ljust(size, b"\0"), np.uint8))


@cache
def announcement_messages(distribution: str) -> tuple[Any, Any, Any]:
    """Returns the classes of an identifier, a node and a participant in a ROS distribution, such as ``"jazzy"``."""
    types = get_typestore(Stores.ROS2_HUMBLE if distribution in LONG_IDENTIFIERS else Stores.ROS2_JAZZY)
    gid, node, participant = (
        message_class(f"rmw_dds_common/msg/{name}", types)
        for name in ("Gid", "NodeEntitiesInfo", "ParticipantEntitiesInfo")
    )
    return gid, node, participant


_participants: WeakValueDictionary[int, _Participant] = WeakValueDictionary()
_participants_lock = threading.Lock()


def _participant(environment: Mapping[str, str]) -> _Participant:
    """Returns the participant of the environment's domain, and creates it if there is none."""
    number = domain_id(environment)
    with _participants_lock:
        participant = _participants.get(number)
        if participant is None:
            participant = _Participant(number, domain_settings(environment), environment.get("ROS_DISTRO", ""))
            _participants[number] = participant
        if participant.pid != os.getpid():
            raise RuntimeError("DDS does not survive a fork: start processes with the method 'spawn' or 'forkserver'")
        return participant


def domain_id(environment: Mapping[str, str]) -> int:
    """Returns the domain ID from ``ROS_DOMAIN_ID``, 0 by default; raises ``ValueError`` if it is out of range."""
    text = environment.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not text.isdecimal() or int(text) > MAX_DOMAIN_ID:
        raise ValueError(f"ROS_DOMAIN_ID must be a whole number from 0 to {MAX_DOMAIN_ID}, got {text!r}")
    return int(text)


def domain_settings(environment: Mapping[str, str]) -> str:
    """Returns Cyclone DDS's settings: XML fragments and file URIs, of which later ones take precedence."""
    # Fast DDS peers that offer type objects do not match without it.
    own = "<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
    discovery_range = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").strip().upper()
    if environment.get("ROS_LOCALHOST_ONLY", "").strip() == "1" or discovery_range == "LOCALHOST":
        # Fast DDS peers that start second are not discovered without multicast and a short interval.
        own += (
            '<General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
            "<AllowMulticast>spdp</AllowMulticast></General>"
            "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
            '<SPDPInterval>1s</SPDPInterval><Peers><Peer address="localhost"/></Peers></Discovery>'
        )
    return ",".join(filter(None, (own, environment.get("CYCLONEDDS_URI", "").strip())))


def _qos(reliable: bool, depth: int, durability: Any = Policy.Durability.Volatile) -> Qos:
    """Returns the quality of service of a reader or a writer that keeps ``depth`` messages."""
    return Qos(
        Policy.Reliability.Reliable(duration(milliseconds=100)) if reliable else Policy.Reliability.BestEffort,
        durability,
        Policy.History.KeepLast(depth),
        Policy.WriterDataLifecycle(autodispose=False),
        Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
    )


class _SerializedSample(IdlStruct):
    """Base of DDS types whose samples are serialized by :mod:`~rover_rl.sims.ros2.messages`.

    Cyclone's own serialization takes ten times as long, and produces objects of its own classes.
    """

    # Not annotated, as annotations declare fields of the DDS type, and named as no field of a ROS message can be, whose
    # default they would become. Subclasses set the class, samples their data.
    _kind = Message
    _data = b""

    def serialize(self, *_: Any, **__: Any) -> bytes:
        return self._data

    @classmethod
    def deserialize(cls, data: bytes, *_: Any, **__: Any) -> Any:
        """Returns the message, or the error of a malformed one."""
        try:
            return decode(cls._kind, data)
        except ValueError as error:
            return error


def _write(writer: DataWriter[Any], message: Any) -> None:
    kind: Any = type(message)
    sample_type = _sample_type(kind)
    sample = sample_type.__new__(sample_type)
    sample._data = encode(message)
    writer.write(sample)


# Indexing these classes creates types, which type checkers do not support.
_SEQUENCE: Any = types.sequence
_ARRAY: Any = types.array
_BASE_TYPES: dict[str, Any] = {"string": str, "bool": bool, "char": types.uint8} | {
    name: getattr(types, name) for name in ("int32", "uint64", "uint32", "uint16", "uint8", "float32", "float64")
}


@cache
def _sample_type(kind: type[Message]) -> type[_SerializedSample]:
    """Returns the DDS type of a message; ``sensor_msgs/msg/Imu`` becomes ``sensor_msgs::msg::dds_::Imu_``."""
    sample_type: Any = _struct(kind.ros_type, kind.types, _SerializedSample)
    sample_type._kind = kind
    return sample_type


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
