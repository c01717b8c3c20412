"""Telling ROS 2 which nodes are here, so that ``ros2 node list`` and ``ros2 node info`` show them.

Topics need none of this. ROS 2 keeps a list of nodes for each DDS participant (``rmw_dds_common``), with identifiers of
24 bytes up to Humble and of 16 from Iron on; which it is, only the name of the distribution tells.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any
from uuid import UUID

import numpy as np

from rover_rl.sims.ros2.messages import Bytes16, Bytes24, Message

TOPIC = "ros_discovery_info"
"""Name of the DDS topic; it has no prefix, as ROS's own topics have."""
LONG_IDENTIFIERS = ("foxy", "galactic", "humble")
"""Distributions whose identifiers have 24 bytes."""


@dataclass
class LongGid(Message):
    """An identifier up to Humble."""

    ros_type = "rmw_dds_common/msg/Gid"
    data: Bytes24 = field(default_factory=lambda: np.zeros(24, np.uint8))


@dataclass
class Gid(Message):
    """An identifier from Iron on."""

    ros_type = "rmw_dds_common/msg/Gid"
    data: Bytes16 = field(default_factory=lambda: np.zeros(16, np.uint8))


@dataclass
class LongNode(Message):
    """A node, and what it reads and writes, up to Humble."""

    ros_type = "rmw_dds_common/msg/NodeEntitiesInfo"
    node_namespace: str = "/"
    node_name: str = ""
    reader_gid_seq: list[LongGid] = field(default_factory=list)
    writer_gid_seq: list[LongGid] = field(default_factory=list)


@dataclass
class Node(Message):
    """A node, and what it reads and writes, from Iron on."""

    ros_type = "rmw_dds_common/msg/NodeEntitiesInfo"
    node_namespace: str = "/"
    node_name: str = ""
    reader_gid_seq: list[Gid] = field(default_factory=list)
    writer_gid_seq: list[Gid] = field(default_factory=list)


@dataclass
class LongParticipant(Message):
    """A participant's nodes, up to Humble."""

    ros_type = "rmw_dds_common/msg/ParticipantEntitiesInfo"
    gid: LongGid = field(default_factory=LongGid)
    node_entities_info_seq: list[LongNode] = field(default_factory=list)


@dataclass
class Participant(Message):
    """A participant's nodes, from Iron on."""

    ros_type = "rmw_dds_common/msg/ParticipantEntitiesInfo"
    gid: Gid = field(default_factory=Gid)
    node_entities_info_seq: list[Node] = field(default_factory=list)


def participant_message(distribution: str) -> type[Message]:
    """The message that a ROS distribution, for example ``"jazzy"``, tells a participant's nodes with."""
    return LongParticipant if distribution in LONG_IDENTIFIERS else Participant


class NodeList:
    """The nodes of one participant; whenever they change, everybody is told.

    Args:
        kind: as :func:`participant_message` gives it.
        identifier: of the participant.
        publish: sends messages of that kind, and keeps the last for those who come later.
    """

    def __init__(self, kind: type[Message], identifier: UUID, publish: Callable[[Any], None]) -> None:
        forms: tuple[Any, Any] = (LongGid, LongNode) if kind is LongParticipant else (Gid, Node)
        self._kind: Any = kind
        self._gid, self._node = forms
        self._identifier, self._publish = identifier, publish
        self._nodes: dict[int, Any] = {}

    def tell(self, owner: int, name: str, readers: Iterable[UUID], writers: Iterable[UUID]) -> None:
        """What the node of ``owner`` reads and writes now."""
        reads, writes = ([self._of(entity) for entity in entities] for entities in (readers, writers))
        self._nodes[owner] = self._node("/", name, reads, writes)
        self._send()

    def forget(self, owner: int) -> None:
        """The node of ``owner`` is gone."""
        if self._nodes.pop(owner, None) is not None:
            self._send()

    def _send(self) -> None:
        self._publish(self._kind(self._of(self._identifier), [*self._nodes.values()]))

    def _of(self, identifier: UUID) -> Any:
        gid = self._gid()
        gid.data[:16] = np.frombuffer(identifier.bytes, np.uint8)
        return gid
