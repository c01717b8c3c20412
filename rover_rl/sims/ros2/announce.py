"""Announcement of nodes to ROS 2, so that ``ros2 node list`` and ``ros2 node info`` show them.

Topics work without it. ROS 2 keeps a list of nodes for each DDS participant (``rmw_dds_common``). Identifiers have 24
bytes up to Humble and 16 bytes since Iron; only the name of the distribution distinguishes them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores
from rosbags.typesys.store import Typestore

from rover_rl.sims.ros2.cdr import message_types
from rover_rl.sims.ros2.messages import Message

TOPIC = "ros_discovery_info"
"""DDS name of the topic. Unlike the names of ROS topics, it has no prefix."""
LONG_IDENTIFIERS = ("foxy", "galactic", "humble")
"""Distributions with identifiers of 24 bytes."""


@dataclass
class Gid(Message):
    """Identifier of a DDS entity, uint8 ``[24]`` up to Humble and ``[16]`` since Iron."""

    ros_type = "rmw_dds_common/msg/Gid"
    data: NDArray[np.uint8]


@dataclass
class Node(Message):
    """A node with its readers and writers."""

    ros_type = "rmw_dds_common/msg/NodeEntitiesInfo"
    node_namespace: str
    node_name: str
    reader_gid_seq: list[Gid]
    writer_gid_seq: list[Gid]


@dataclass
class Participant(Message):
    """Nodes of a participant."""

    ros_type = "rmw_dds_common/msg/ParticipantEntitiesInfo"
    gid: Gid
    node_entities_info_seq: list[Node]


@cache
def announcement_types(distribution: str) -> Typestore:
    """Returns the message definitions that announce nodes in a ROS distribution, for example ``"jazzy"``."""
    release = Stores.ROS2_HUMBLE if distribution in LONG_IDENTIFIERS else Stores.ROS2_JAZZY
    return message_types(release, (Gid, Node, Participant))


class NodeList:
    """List of a participant's nodes, published at each change.

    Args:
        distribution: name of the ROS distribution.
        identifier: identifier of the participant.
        publish: function that publishes a message with transient-local durability.
    """

    def __init__(self, distribution: str, identifier: UUID, publish: Callable[[Participant], None]) -> None:
        self._size = 24 if distribution in LONG_IDENTIFIERS else 16
        self._identifier, self._publish = identifier, publish
        self._nodes: dict[int, Node] = {}

    def update(self, owner: int, name: str, readers: Iterable[UUID], writers: Iterable[UUID]) -> None:
        """Adds or replaces a node.

        Args:
            owner: key of the node.
            name: name of the node.
            readers: identifiers of its readers.
            writers: identifiers of its writers.
        """
        reader_gids, writer_gids = ([self._gid(entity) for entity in entities] for entities in (readers, writers))
        self._nodes[owner] = Node("/", name, reader_gids, writer_gids)
        self._publish_nodes()

    def remove(self, owner: int) -> None:
        """Removes the node of ``owner``, if any."""
        if self._nodes.pop(owner, None) is not None:
            self._publish_nodes()

    def _publish_nodes(self) -> None:
        self._publish(Participant(self._gid(self._identifier), [*self._nodes.values()]))

    def _gid(self, identifier: UUID) -> Gid:
        return Gid(np.frombuffer(identifier.bytes.ljust(self._size, b"\0"), np.uint8))
