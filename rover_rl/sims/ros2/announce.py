"""Announcement of nodes to ROS 2, so that ``ros2 node list`` and ``ros2 node info`` show them.

Topics work without it. ROS 2 keeps a list of nodes for each DDS participant (``rmw_dds_common``). Identifiers have 24
bytes up to Humble and 16 bytes since Iron; only the name of the distribution distinguishes them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any
from uuid import UUID

import numpy as np

from rover_rl.sims.ros2.messages import Bytes16, Bytes24, Message

TOPIC = "ros_discovery_info"
"""DDS name of the topic. Unlike the names of ROS topics, it has no prefix."""
LONG_IDENTIFIERS = ("foxy", "galactic", "humble")
"""Distributions with identifiers of 24 bytes."""


@dataclass
class LongGid(Message):
    """Identifier of a DDS entity, up to Humble."""

    ros_type = "rmw_dds_common/msg/Gid"
    data: Bytes24 = field(default_factory=lambda: np.zeros(24, np.uint8))


@dataclass
class Gid(Message):
    """Identifier of a DDS entity, since Iron."""

    ros_type = "rmw_dds_common/msg/Gid"
    data: Bytes16 = field(default_factory=lambda: np.zeros(16, np.uint8))


@dataclass
class LongNode(Message):
    """A node with its readers and writers, up to Humble."""

    ros_type = "rmw_dds_common/msg/NodeEntitiesInfo"
    node_namespace: str = "/"
    node_name: str = ""
    reader_gid_seq: list[LongGid] = field(default_factory=list)
    writer_gid_seq: list[LongGid] = field(default_factory=list)


@dataclass
class Node(Message):
    """A node with its readers and writers, since Iron."""

    ros_type = "rmw_dds_common/msg/NodeEntitiesInfo"
    node_namespace: str = "/"
    node_name: str = ""
    reader_gid_seq: list[Gid] = field(default_factory=list)
    writer_gid_seq: list[Gid] = field(default_factory=list)


@dataclass
class LongParticipant(Message):
    """Nodes of a participant, up to Humble."""

    ros_type = "rmw_dds_common/msg/ParticipantEntitiesInfo"
    gid: LongGid = field(default_factory=LongGid)
    node_entities_info_seq: list[LongNode] = field(default_factory=list)


@dataclass
class Participant(Message):
    """Nodes of a participant, since Iron."""

    ros_type = "rmw_dds_common/msg/ParticipantEntitiesInfo"
    gid: Gid = field(default_factory=Gid)
    node_entities_info_seq: list[Node] = field(default_factory=list)


def participant_message(distribution: str) -> type[Message]:
    """Returns the message type that announces nodes in a ROS distribution, for example ``"jazzy"``."""
    return LongParticipant if distribution in LONG_IDENTIFIERS else Participant


class NodeList:
    """List of a participant's nodes, published at each change.

    Args:
        kind: message type from :func:`participant_message`.
        identifier: identifier of the participant.
        publish: function that publishes messages of that type with transient-local durability.
    """

    def __init__(self, kind: type[Message], identifier: UUID, publish: Callable[[Any], None]) -> None:
        types: tuple[Any, Any] = (LongGid, LongNode) if kind is LongParticipant else (Gid, Node)
        self._kind: Any = kind
        self._gid_type, self._node_type = types
        self._identifier, self._publish = identifier, publish
        self._nodes: dict[int, Any] = {}

    def update(self, owner: int, name: str, readers: Iterable[UUID], writers: Iterable[UUID]) -> None:
        """Adds or replaces a node.

        Args:
            owner: key of the node.
            name: name of the node.
            readers: identifiers of its readers.
            writers: identifiers of its writers.
        """
        reader_gids, writer_gids = ([self._gid(entity) for entity in entities] for entities in (readers, writers))
        self._nodes[owner] = self._node_type("/", name, reader_gids, writer_gids)
        self._publish_nodes()

    def remove(self, owner: int) -> None:
        """Removes the node of ``owner``, if any."""
        if self._nodes.pop(owner, None) is not None:
            self._publish_nodes()

    def _publish_nodes(self) -> None:
        self._publish(self._kind(self._gid(self._identifier), [*self._nodes.values()]))

    def _gid(self, identifier: UUID) -> Any:
        gid = self._gid_type()
        gid.data[:16] = np.frombuffer(identifier.bytes, np.uint8)
        return gid
