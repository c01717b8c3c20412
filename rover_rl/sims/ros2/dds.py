"""ROS 2 without ROS: its topics are plain DDS, which Eclipse Cyclone DDS speaks.

Needs the package ``cyclonedds`` (``pip install "rover_rl[ros2]"``) and nothing else. Domain and reach are chosen as
in ROS 2, by ``ROS_DOMAIN_ID``, ``ROS_LOCALHOST_ONLY`` and ``ROS_AUTOMATIC_DISCOVERY_RANGE``; settings in
``CYCLONEDDS_URI`` come last and win. Where ``ROS_DISTRO`` is set, ``ros2 node list`` shows the nodes, too.
"""

from __future__ import annotations

import logging
import math
import os
import threading
import time
import weakref
from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

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
    raise ImportError('ROS 2 over DDS needs the package cyclonedds: pip install "rover_rl[ros2]"') from error

from rover_rl.sims.ros2.announce import TOPIC, NodeList, participant_message
from rover_rl.sims.ros2.cdr import MalformedError, decode, encode
from rover_rl.sims.ros2.messages import Array, Message
from rover_rl.sims.ros2.transport import Publisher

M = TypeVar("M", bound=Message)

LARGEST_DOMAIN = 232
"""Above it DDS has no port numbers left (DDSI-RTPS 2.3, 9.6.1)."""
WARN_EVERY = 5.0
"""Seconds between two warnings of messages on one topic."""
ACTIVE = 1.0
"""Seconds since its last message in which a publisher counts as active."""
_DEPTH = 5
"""Messages of a topic that wait to be read; the newest are kept."""

_log = logging.getLogger(__name__)


class DdsTransport:
    """A connection through Cyclone DDS: see :class:`~rover_rl.sims.ros2.transport.Transport`.

    Messages are read in a thread of its own, which ends with :meth:`close`. All connections of a process share one DDS
    participant for each domain.

    Args:
        node: name, for errors and warnings.
        environment: variables that choose domain and reach; ``None`` takes the process's.

    Raises:
        ValueError: for a ``ROS_DOMAIN_ID`` that is none.
        RuntimeError: in a process that was forked from one with connections: start it with ``spawn``.
    """

    def __init__(self, node: str, environment: Mapping[str, str] | None = None) -> None:
        self.node = node
        self._participant: _Participant | None = _participant(os.environ if environment is None else environment)
        self._topics: dict[str, tuple[type[Message], Topic[Any]]] = {}
        self._readers: list[_Reader] = []
        self._writers: dict[str, DataWriter[Any]] = {}
        self._announce()
        self._stop = GuardCondition(self._participant.entity)
        self._waiting = WaitSet(self._participant.entity)
        self._waiting.attach(self._stop)
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._read, name=f"{node} reads DDS", daemon=True)
        self._thread.start()

    def subscribe(self, topic: str, kind: type[M], receive: Callable[[M], object], *, reliable: bool = False) -> None:
        """Calls ``receive`` with each message on ``topic``: see :meth:`Transport.subscribe`."""
        # Best effort and volatile matches whatever a publisher offers; asking for more, deadlines included, does not.
        reliability = _RELIABLE if reliable else Policy.Reliability.BestEffort
        qos = Qos(reliability, Policy.Durability.Volatile, Policy.History.KeepLast(_DEPTH), _XCDR1)
        reader = DataReader(self._open().entity, self._topic(topic, kind), qos)
        condition = ReadCondition(reader, ViewState.Any | SampleState.Any | InstanceState.Any)
        with self._lock:
            self._readers.append(_Reader(topic, reader, condition, receive))
            self._waiting.attach(condition)
        self._announce()

    def publisher(self, topic: str, kind: type[M], *, reliable: bool = False) -> Publisher[M]:
        """A function that sends messages on ``topic``: see :meth:`Transport.publisher`."""
        writer = DataWriter(self._open().entity, self._topic(topic, kind), _writing(reliable))
        self._writers[topic] = writer
        self._announce()
        wire = _wire(kind)

        def publish(message: M) -> None:
            self._open()
            writer.write(wire.holding(encode(message)))

        return publish

    def subscribers(self, topic: str) -> int:
        """How many listen to ``topic``."""
        return self._writers[topic].get_publication_matched_status().current_count

    def publishers(self, topic: str) -> int:
        """How many publishers have sent usable messages on ``topic`` within the last second.

        DDS itself notices only after many seconds that a publisher was killed.
        """
        with self._lock:
            readers = [reader for reader in self._readers if reader.topic == topic]
        return max((reader.publishers() for reader in readers), default=0)

    def close(self) -> None:
        """Ends the thread and releases all resources. Idempotent."""
        if self._participant is None:
            return
        self._stop.set(True)
        if threading.current_thread() is not self._thread:
            self._thread.join()
        if self._participant.nodes is not None:
            self._participant.nodes.forget(id(self))
        # Entities go when nothing refers to them any more, the participant with the last connection.
        del self._waiting, self._stop
        self._readers.clear()
        self._writers.clear()
        self._topics.clear()
        self._participant = None

    def _open(self) -> _Participant:
        if self._participant is None:
            raise RuntimeError(f"the connection of {self.node} is closed")
        return self._participant

    def _topic(self, name: str, kind: type[Message]) -> Topic[Any]:
        if name not in self._topics:
            self._topics[name] = (kind, Topic(self._open().entity, _dds_name(name), _wire(kind)))
        known, topic = self._topics[name]
        if known is not kind:
            raise ValueError(f"topic {name} is of {known.ros_type}, and cannot be of {kind.ros_type}, too")
        return topic

    def _announce(self) -> None:
        """Tells ROS 2 what this node reads and writes now, where that is asked for."""
        nodes = self._open().nodes
        if nodes is not None:
            readers = [reader.reader.guid for reader in self._readers]
            nodes.tell(id(self), self.node, readers, [writer.guid for writer in self._writers.values()])

    def _read(self) -> None:
        stop, waiting = self._stop, self._waiting
        while True:
            waiting.wait(duration(infinite=True))
            if stop.read():
                return
            with self._lock:
                readers = list(self._readers)
            for reader in readers:
                reader.take()


class _Reader:
    """A subscription, and whom it tells."""

    def __init__(
        self, topic: str, reader: DataReader[Any], condition: ReadCondition, receive: Callable[[Any], object]
    ) -> None:
        self.topic, self.reader, self.condition, self.receive = topic, reader, condition, receive
        self._warned = -math.inf
        self._heard: dict[int, float] = {}

    def publishers(self) -> int:
        """How many publishers have sent usable messages within the last second."""
        now = time.monotonic()
        return sum(now - heard < ACTIVE for heard in list(self._heard.values()))

    def take(self) -> None:
        """Hands over what has come; what cannot be read, or makes ``receive`` fail, is left out with a warning."""
        for sample in self.reader.take(_DEPTH, self.condition):
            if isinstance(sample, _Unread):
                self._warn(sample.error)
            elif isinstance(sample, Message):
                try:
                    if self.receive(sample) is not False:
                        handle = sample.sample_info.publication_handle  # type: ignore[attr-defined]
                        self._heard[handle] = time.monotonic()
                except ValueError as error:
                    self._warn(error)
                except Exception:
                    _log.exception("%s: could not take in a message", self.topic)

    def _warn(self, error: ValueError) -> None:
        if time.monotonic() - self._warned > WARN_EVERY:
            self._warned = time.monotonic()
            _log.warning("%s: left out a message: %s", self.topic, error)


class _Unread:
    """Stands for a message that could not be read."""

    def __init__(self, error: MalformedError) -> None:
        self.error = error


class _Participant:
    """A process's participant in a domain, the domain that it keeps alive, and the nodes that it tells of."""

    def __init__(self, number: int, settings: str, distribution: str) -> None:
        self.pid = os.getpid()
        self._domain = Domain(number, settings)
        # As rmw_cyclonedds_cpp does: it names the security enclave, and tells ROS 2 tools that this is one of theirs.
        self.entity = DomainParticipant(number, Qos(Policy.Userdata(b"enclave=/;")))
        self.nodes = self._node_list(participant_message(distribution)) if distribution else None

    def _node_list(self, kind: type[Message]) -> NodeList:
        wire = _wire(kind)
        writer = DataWriter(self.entity, Topic(self.entity, TOPIC, wire), _writing(reliable=True, kept=True))
        return NodeList(kind, self.entity.guid, lambda message: writer.write(wire.holding(encode(message))))


_participants: dict[int, Any] = {}
_participants_lock = threading.Lock()


def _participant(environment: Mapping[str, str]) -> _Participant:
    """The participant of the environment's domain: the one that there is, or a new one."""
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
    """The domain that ``ROS_DOMAIN_ID`` names, 0 by default.

    Raises:
        ValueError: if it is no whole number from 0 to 232.
    """
    text = environment.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not text.isdecimal() or int(text) > LARGEST_DOMAIN:
        raise ValueError(f"ROS_DOMAIN_ID must be a whole number from 0 to {LARGEST_DOMAIN}, got {text!r}")
    return int(text)


def stays_on_this_machine(environment: Mapping[str, str]) -> bool:
    """Whether ROS 2's variables keep the domain to this machine."""
    reach = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").strip().upper()
    return environment.get("ROS_LOCALHOST_ONLY", "").strip() == "1" or reach == "LOCALHOST"


def domain_settings(environment: Mapping[str, str]) -> str:
    """Cyclone DDS's settings, as XML fragments and addresses of files, of which later ones win."""
    # Without it a Fast DDS peer that offers type objects does not match.
    own = ["<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"]
    if stays_on_this_machine(environment):
        # Multicast for discovery, and a short interval: else Fast DDS peers that start second are never met.
        own += [
            '<General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
            "<AllowMulticast>spdp</AllowMulticast></General>",
            "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
            '<SPDPInterval>1s</SPDPInterval><Peers><Peer address="localhost"/></Peers></Discovery>',
        ]
    given = environment.get("CYCLONEDDS_URI", "").strip()
    return ",".join(["".join(own), given] if given else ["".join(own)])


def _writing(reliable: bool, kept: bool = False) -> Qos:
    """How messages are sent: see :meth:`Transport.publisher`; ``kept``: the last goes to those who come later, too."""
    return Qos(
        _RELIABLE if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if kept else Policy.Durability.Volatile,
        Policy.History.KeepLast(1 if reliable else _DEPTH),
        Policy.WriterDataLifecycle(autodispose=False),
        _XCDR1,
    )


def _dds_name(topic: str) -> str:
    """The name on the wire: ``/scan`` is ``rt/scan``."""
    return "rt/" + topic.removeprefix("/")


class _Wire(IdlStruct):
    """A type of DDS whose samples are bytes that :mod:`~rover_rl.sims.ros2.cdr` has written or will read.

    Cyclone's own coding takes ten times as long, and gives objects of its own.
    """

    # Set for each type, and for each sample; annotated, they would be fields of the type.
    message = Message
    data = b""

    @classmethod
    def holding(cls, data: bytes) -> _Wire:
        sample = cls.__new__(cls)
        sample.data = data
        return sample

    def serialize(self, *_: Any, **__: Any) -> bytes:
        return self.data

    @classmethod
    def deserialize(cls, data: bytes, *_: Any, **__: Any) -> Any:
        try:
            return decode(cls.message, data)
        except MalformedError as error:
            return _Unread(error)


_RELIABLE = Policy.Reliability.Reliable(duration(milliseconds=100))
_XCDR1 = Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False)
# Of classes that make types when they are indexed, which type checkers do not know.
_SEQUENCE: Any = types.sequence
_ARRAY: Any = types.array
_NUMBERS = {"i": types.int32, "I": types.uint32, "f": types.float32, "d": types.float64, "B": types.uint8}


_wires: dict[type[Message], type[_Wire]] = {}
_parts: dict[type[Message], type[IdlStruct]] = {}


def _wire(kind: type[Message]) -> type[_Wire]:
    """The type of DDS for a message; ``sensor_msgs/msg/Imu`` is ``sensor_msgs::msg::dds_::Imu_``."""
    if kind not in _wires:
        made: Any = make_idl_struct(kind.__name__, _type_name(kind), _fields(kind), bases=(_Wire,))
        made.message = kind
        _wires[kind] = made
    return _wires[kind]


def _part(kind: type[Message]) -> type[IdlStruct]:
    """The type of DDS for a message in another."""
    if kind not in _parts:
        _parts[kind] = make_idl_struct(kind.__name__, _type_name(kind), _fields(kind))
    return _parts[kind]


def _type_name(kind: type[Message]) -> str:
    package, folder, name = kind.ros_type.split("/")
    return f"{package}.{folder}.dds_.{name}_"


def _fields(kind: type[Message]) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return {name: _idl(hint) for name, hint in hints.items() if name != "ros_type"}


def _idl(hint: Any) -> Any:
    """Cyclone's type for a field with that annotation."""
    if hint is str:
        return str
    if get_origin(hint) is Annotated:
        (form,) = hint.__metadata__
        if not isinstance(form, Array):
            return _NUMBERS[form]
        number = _NUMBERS[form.letter]
        return _SEQUENCE[number] if form.length is None else _ARRAY[number, form.length]
    if get_origin(hint) is list:
        (kind,) = get_args(hint)
        return _SEQUENCE[_part(kind)]
    return _part(hint)
