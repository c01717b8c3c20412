"""ROS 2 transport through Eclipse Cyclone DDS, without a ROS installation: ROS 2 topics are plain DDS topics.

Domain and discovery range are selected as in ROS 2, by ``ROS_DOMAIN_ID``, ``ROS_AUTOMATIC_DISCOVERY_RANGE``,
``ROS_STATIC_PEERS`` and ``ROS_LOCALHOST_ONLY``. Settings in ``CYCLONEDDS_URI`` take precedence. ``ros2 node list``
shows the nodes; that of Humble and older distributions does if ``ROS_DISTRO`` names them.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from typing import Any
from weakref import WeakValueDictionary
from xml.sax.saxutils import quoteattr

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

try:
    from cyclonedds import builtin, core, idl
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration
except ImportError as error:  # pragma: no cover
    raise ImportError('ROS 2 over DDS requires the package cyclonedds: pip install "rover_rl[ros2]"') from error

from rover_rl.sims.ros2.messages import Message, decode, encode, message_class
from rover_rl.sims.ros2.transport import HISTORY_DEPTH, NAMING_TIME, ActiveSenders, Publisher, Receive, ThrottledLogger

MAX_ENDPOINTS = 10_000  # publishers or subscribers in a domain among which those of a topic are looked up
TOPIC_TRIES = 5  # to create a topic
MAX_PASSES = 8  # looks for messages that have arrived before those that were found are passed on
MAX_DOMAIN_ID = 232  # higher ones exceed the range of port numbers (DDSI-RTPS 2.3, 9.6.1)
NODE_LIST = "ros_discovery_info"  # topic that announces nodes, without the prefix of ROS topics
LONG_IDENTIFIERS = ("foxy", "galactic", "humble")
"""Distributions with identifiers of 24 bytes; later ones have 16. Only their names distinguish them."""
DISCOVERY_RANGES = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
"""Values of ``ROS_AUTOMATIC_DISCOVERY_RANGE``. As in ROS 2, any other one is taken for ``LOCALHOST``."""

_log = logging.getLogger(__name__)


class DdsTransport:
    """:class:`Transport` through Cyclone DDS: a participant, which announces its node for ``ros2 node list``.

    Raises ``ValueError`` if ``ROS_DOMAIN_ID`` is invalid, and ``RuntimeError`` in a process that was forked from one
    with connections: use the start method ``spawn``.
    """

    def __init__(self, node: str, environment: Mapping[str, str] = os.environ) -> None:
        self.node, self._domain = node, _domain(environment)
        # As in rmw_cyclonedds_cpp: the user data names the security enclave and marks the participant as one of ROS 2.
        self._participant: Any = DomainParticipant(domain_id(environment), Qos(Policy.Userdata(b"enclave=/;")))
        self._topics: dict[str, Topic[Any]] = {}
        self._readers: list[_Reader] = []
        self._writers: dict[str, DataWriter[Any]] = {}
        distribution = environment.get("ROS_DISTRO", "")
        self._identifier_size = 24 if distribution in LONG_IDENTIFIERS else 16
        self._gid, self._node, self._announcement = announcement_messages(distribution)
        self._nodes = _topic(self._participant, NODE_LIST, _sample_type(self._announcement))
        # Late subscribers receive the last announcement.
        self._announcer = DataWriter(self._participant, self._nodes, _qos(True, 1, latched=True))
        self._announce()
        self._stop, self._wait_set = core.GuardCondition(self._participant), core.WaitSet(self._participant)
        self._wait_set.attach(self._stop)
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._read, name=f"{node} DDS reader", daemon=True)
        self._thread.start()

    def subscribe(self, topic: str, kind: Any, receive: Receive, reliable: bool = False, latched: bool = False) -> None:
        self._listen(topic, kind, _qos(reliable, HISTORY_DEPTH, latched), lambda message, _: receive(message))

    def overhear(self, topic: str, kind: Any, receive: Callable[[Any, str], object]) -> None:
        own, qos = _writers_of_node[self.node], _qos(False, HISTORY_DEPTH)
        self._listen(topic, kind, qos, lambda message, sender: sender in own or receive(message, sender))

    def _listen(self, topic: str, kind: Any, qos: Qos, receive: Callable[[Any, str], object]) -> None:
        # Best effort and volatile matches every publisher. Further policies, such as deadlines, may not match.
        reader = _Reader(topic, DataReader(*self._on(topic, kind), qos), receive)
        with self._lock:
            self._readers.append(reader)
            self._wait_set.attach(reader.condition)
        self._announce()

    def publisher(self, topic: str, kind: Any, *, latched: bool = False) -> Publisher:
        self._writers[topic] = writer = DataWriter(*self._on(topic, kind), _qos(True, 1, latched))
        _writers_of_node[self.node].add(writer.guid.hex)
        self._announce()

        def publish(message: Any) -> None:
            self._require_open()
            _write(writer, message)

        return publish

    def subscribers(self, topic: str) -> int:
        own = len(self._readers_of(topic))
        return max(0, self._writers[topic].get_publication_matched_status().current_count - own)

    def publishers(self, topic: str) -> int:
        return max((len(reader.senders.active()) for reader in self._readers_of(topic)), default=0)

    def _readers_of(self, topic: str) -> list[_Reader]:
        with self._lock:
            return [reader for reader in self._readers if reader.topic == topic]

    def types(self, topic: str, receivers: bool = False) -> set[str]:
        endpoints = builtin.BuiltinTopicDcpsSubscription if receivers else builtin.BuiltinTopicDcpsPublication
        reader = builtin.BuiltinDataReader(self._require_open(), endpoints)
        names = {found.type_name for found in reader.read(MAX_ENDPOINTS) if found.topic_name == _dds_name(topic)}
        return {name.replace("::dds_::", "::").replace("::", "/").removesuffix("_") for name in names}

    def name_of(self, sender: str, topic: str) -> str:
        qos = _qos(True, 1, latched=True) + Qos(Policy.History.KeepAll)
        reader: DataReader[Any] = DataReader(self._require_open(), self._nodes, qos)
        deadline = time.monotonic() + NAMING_TIME
        while sender and time.monotonic() < deadline:
            for sample in reader.take(MAX_ENDPOINTS):
                for node in getattr(sample, "node_entities_info_seq", ()):  # none if malformed, or of one that has left
                    if any(gid.data.tobytes().hex().startswith(sender) for gid in node.writer_gid_seq):
                        return f"{node.node_namespace.rstrip('/')}/{node.node_name}"
            time.sleep(0.01)
        return "a publisher of no known node"

    def close(self) -> None:
        if self._participant is None:
            return
        self._stop.set(True)
        if threading.current_thread() is not self._thread:
            self._thread.join()
        _write(self._announcer, self._announcement(self._identifier(self._participant)))
        _writers_of_node[self.node] -= {writer.guid.hex for writer in self._writers.values()}
        # Cyclone deletes entities without references.
        del self._wait_set, self._stop, self._announcer, self._nodes, self._domain
        for entities in (self._readers, self._writers, self._topics):
            entities.clear()
        self._participant = None

    def _require_open(self) -> DomainParticipant:
        if self._participant is None:
            raise RuntimeError(f"the connection of {self.node} is closed")
        return self._participant

    def _on(self, name: str, kind: Any) -> tuple[DomainParticipant, Topic[Any]]:
        """Returns the participant and a topic, to which a reader or writer is added."""
        participant, sample_type = self._require_open(), _sample_type(kind)
        if name not in self._topics:
            self._topics[name] = _topic(participant, _dds_name(name), sample_type)
        if (known := self._topics[name].data_type) is not sample_type:
            types = known._kind.ros_type, kind.ros_type
            raise ValueError(f"topic {name} has type {types[0]}, and cannot also have type {types[1]}")
        return participant, self._topics[name]

    def _announce(self) -> None:
        entities = [reader.reader for reader in self._readers], self._writers.values()
        namespace, _, name = self.node.strip("/").rpartition("/")
        node = self._node(f"/{namespace}", name, *([self._identifier(one) for one in group] for group in entities))
        _write(self._announcer, self._announcement(self._identifier(self._require_open()), [node]))

    def _identifier(self, entity: Any) -> Any:
        return self._gid(np.frombuffer(entity.guid.bytes.ljust(self._identifier_size, b"\0"), np.uint8))

    def _read(self) -> None:
        stop, wait_set = self._stop, self._wait_set
        while True:
            wait_set.wait(duration(infinite=True))
            if stop.read():
                return
            with self._lock:
                readers = list(self._readers)
            # Of two messages, the first may arrive after its reader was looked at, and the second before its own is.
            # Another look finds it.
            found: list[tuple[_Reader, Any]] = []
            for _ in range(MAX_PASSES):
                new = [(reader, sample) for reader in readers for sample in reader.take()]
                if not new:
                    break
                found += new
            for reader, sample in sorted(found, key=lambda pair: pair[1].sample_info.source_timestamp):
                reader.deliver(sample)


_writers_of_node: defaultdict[str, set[str]] = defaultdict(set)
"""Identifiers of the publishers of this process, in hexadecimal digits, by the name of their node."""


def _topic(participant: DomainParticipant, name: str, sample_type: Any) -> Topic[Any]:
    """Creates a topic, in several tries.

    Cyclone sometimes fails without a reason, which was seen while other connections of the process opened and closed.
    The next try then succeeded.
    """
    for _ in range(TOPIC_TRIES - 1):
        with suppress(core.DDSException):
            return Topic(participant, name, sample_type)
        time.sleep(0.05)
    return Topic(participant, name, sample_type)


def _dds_name(topic: str) -> str:
    return "rt/" + topic.removeprefix("/")


class _Reader:
    """A subscription and its callback, which gets messages and the identifiers of their publishers."""

    def __init__(self, topic: str, reader: DataReader[Any], receive: Callable[[Any, str], object]) -> None:
        self.topic, self.reader, self._receive = topic, reader, receive
        self.condition = core.ReadCondition(reader, core.ViewState.Any | core.SampleState.Any | core.InstanceState.Any)
        self.senders = ActiveSenders()
        self._throttled_log = ThrottledLogger(_log)
        self._identifiers: dict[int, str] = {}

    def take(self) -> list[Any]:
        return [sample for sample in self.reader.take(HISTORY_DEPTH, self.condition) if sample.sample_info.valid_data]

    def deliver(self, sample: Any) -> None:
        """Passes a message on. One that is malformed, or raises an error there, is ignored with a warning."""
        handle = sample.sample_info.publication_handle
        try:
            if isinstance(sample, ValueError):
                raise sample
            if self._receive(sample, self._identifier(handle)) is not False:
                self.senders.heard(handle)
        except ValueError as error:
            self._throttled_log.warning(self.topic, "%s: ignored a message: %s", self.topic, error)
        except Exception:
            _log.exception("%s: the callback failed", self.topic)

    def _identifier(self, handle: int) -> str:
        """Returns the identifier of a publisher as hexadecimal digits; empty if it has left before it was known."""
        if handle not in self._identifiers:
            publisher = self.reader.get_matched_publication_data(handle)
            self._identifiers[handle] = "" if publisher is None else publisher.key.hex
        return self._identifiers[handle]


@cache
def announcement_messages(distribution: str) -> list[Any]:
    """Returns the classes of an identifier, a node and a participant in a ROS distribution, such as ``"jazzy"``."""
    types = get_typestore(Stores.ROS2_HUMBLE if distribution in LONG_IDENTIFIERS else Stores.ROS2_JAZZY)
    names = ("Gid", "NodeEntitiesInfo", "ParticipantEntitiesInfo")
    return [message_class(f"rmw_dds_common/msg/{name}", types) for name in names]


_domains: WeakValueDictionary[int, Domain] = WeakValueDictionary()
_domains_lock = threading.Lock()


def _domain(environment: Mapping[str, str]) -> Domain:
    number = domain_id(environment)
    with _domains_lock:
        domain: Any = _domains.get(number)
        if domain is None:
            domain = _domains[number] = Domain(number, domain_settings(environment))
            domain.process = os.getpid()
        if domain.process != os.getpid():
            raise RuntimeError("DDS does not survive a fork: start processes with the method 'spawn' or 'forkserver'")
        return domain


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
    return ",".join(filter(None, (own + _discovery(environment), environment.get("CYCLONEDDS_URI", "").strip())))


def _discovery(environment: Mapping[str, str]) -> str:
    """Returns the settings of the automatic discovery, as in rmw_cyclonedds."""
    given = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").strip()
    addresses = (address.strip() for address in environment.get("ROS_STATIC_PEERS", "").split(";"))
    found, peers = given.upper() or DISCOVERY_RANGES[0], [address for address in addresses if address]
    if environment.get("ROS_LOCALHOST_ONLY", "").strip() == "1":
        found, peers = "LOCALHOST", []
    elif found not in DISCOVERY_RANGES:
        text = "ROS_AUTOMATIC_DISCOVERY_RANGE=%s is none of %s: assuming LOCALHOST"
        _log.warning(text, given, ", ".join(DISCOVERY_RANGES))
        found = "LOCALHOST"
    if found == "OFF":  # the tag separates the process from all others
        return (
            "<General><AllowMulticast>false</AllowMulticast></General><Discovery>"
            f"<ParticipantIndex>none</ParticipantIndex><Tag>ros_discovery_off_{os.getpid()}</Tag></Discovery>"
        )
    general = ""
    if found == "LOCALHOST":
        # Fast DDS peers that start second are not discovered without multicast and a short interval.
        others = '<NetworkInterface autodetermine="true" multicast="false"/>' if peers else ""
        general = (
            f'<General><Interfaces><NetworkInterface address="127.0.0.1"/>{others}</Interfaces>'
            "<AllowMulticast>spdp</AllowMulticast></General>"
        )
        peers = ["localhost", *peers]
    if not peers or found == "SYSTEM_DEFAULT":
        return ""
    listed = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in peers)
    return (
        f"{general}<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32"
        f"</MaxAutoParticipantIndex><SPDPInterval>1s</SPDPInterval><Peers>{listed}</Peers></Discovery>"
    )


def _qos(reliable: bool, depth: int, latched: bool = False) -> Qos:
    return Qos(
        Policy.Reliability.Reliable(duration(milliseconds=100)) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
        Policy.WriterDataLifecycle(autodispose=False),
        Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
    )


class _SerializedSample(idl.IdlStruct):
    """Base of DDS types whose samples are serialized by :mod:`~rover_rl.sims.ros2.messages`.

    Cyclone's own serialization takes ten times as long, and produces objects of its own classes.
    """

    # Neither annotated, which would declare fields of the DDS type, nor named as fields of ROS messages can be.
    _kind = Message
    _data = b""

    def serialize(self, *_: Any, **__: Any) -> bytes:
        return self._data

    @classmethod
    def deserialize(cls, data: bytes, *_: Any, **__: Any) -> Any:
        # The error of a malformed message is passed on in its place.
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


_TYPES: Any = idl.types  # indexing its sequences and arrays creates types, which type checkers do not support
_OTHER_NAMES = {"string": str, "bool": bool, "byte": idl.types.uint8, "char": idl.types.uint8}


@cache
def _sample_type(kind: type[Message]) -> type[_SerializedSample]:
    """Returns the DDS type of a message; ``sensor_msgs/msg/Imu`` becomes ``sensor_msgs::msg::dds_::Imu_``."""
    sample_type: Any = _struct(kind.ros_type, kind.types, _SerializedSample)
    sample_type._kind = kind
    return sample_type


def _struct(ros_type: str, definitions: Typestore, *bases: type) -> type[idl.IdlStruct]:
    package, folder, name = ros_type.split("/")
    fields = {field: _idl(layout, definitions) for field, layout in definitions.fielddefs[ros_type][1]}
    return idl.make_idl_struct(name, f"{package}.{folder}.dds_.{name}_", fields, bases=bases)


def _idl(layout: Any, definitions: Typestore) -> Any:
    node, content = layout
    if node == Nodetype.BASE:
        return _OTHER_NAMES.get(content[0]) or getattr(_TYPES, content[0])
    if node == Nodetype.NAME:
        return _struct(content, definitions)
    element, length = _idl(content[0], definitions), content[1]
    return _TYPES.array[element, length] if node == Nodetype.ARRAY else _TYPES.sequence[element]
