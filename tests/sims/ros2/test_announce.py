from __future__ import annotations

import time

import numpy as np
import pytest
from cyclonedds.domain import DomainParticipant
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from rover_rl.sims.ros2.dds import NODE_LIST, DdsTransport, _sample_type, announcement_types
from rover_rl.sims.ros2.messages import LaserScan, Twist

pytestmark = pytest.mark.ros2


class NodeReader:
    """Subscriber of node announcements, as ``ros2 node list``, including earlier announcements."""

    def __init__(self, domain: dict[str, str], distribution: str) -> None:
        self._participant = DomainParticipant(int(domain["ROS_DOMAIN_ID"]))
        sample_type = _sample_type("rmw_dds_common/msg/ParticipantEntitiesInfo", announcement_types(distribution))
        topic = Topic(self._participant, NODE_LIST, sample_type)
        qos = Qos(
            Policy.Reliability.Reliable(10**9),
            Policy.Durability.TransientLocal,
            Policy.History.KeepLast(1),
            Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
        )
        self._reader = DataReader(self._participant, topic, qos)

    def newest(self, seconds: float = 10.0):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.05)
            if samples := self._reader.take(10):
                return samples[-1]
        raise AssertionError("no node was announced")


@pytest.mark.parametrize(("distribution", "length"), [("humble", 24), ("jazzy", 16)])
def test_nodes_are_announced_with_their_readers_and_writers(domain, distribution, length):
    transport = DdsTransport("rover_rl", {**domain, "ROS_DISTRO": distribution})
    transport.subscribe("/scan", LaserScan, print)
    transport.publisher("/cmd_vel", Twist)
    transport.publisher("/cmd_vel_2", Twist)
    reader = NodeReader(domain, distribution)
    participant = reader.newest()
    (node,) = participant.node_entities_info_seq
    assert (node.node_namespace, node.node_name) == ("/", "rover_rl")
    assert (len(node.reader_gid_seq), len(node.writer_gid_seq)) == (1, 2)
    assert participant.gid.data.shape == (length,)
    entities = [participant.gid, *node.reader_gid_seq, *node.writer_gid_seq]
    # Identifiers of one participant share their first twelve bytes (DDSI-RTPS 2.3, 8.2.4.1).
    assert len({gid.data[:12].tobytes() for gid in entities}) == 1
    assert len({gid.data.tobytes() for gid in entities}) == 4
    assert not np.any(participant.gid.data[16:])
    other = DdsTransport("other", {**domain, "ROS_DISTRO": distribution})
    assert {node.node_name for node in reader.newest().node_entities_info_seq} == {"rover_rl", "other"}
    transport.close()
    assert [node.node_name for node in reader.newest().node_entities_info_seq] == ["other"]
    other.close()


def test_nothing_is_announced_without_a_distribution(domain):
    transport = DdsTransport("quiet", domain)
    with pytest.raises(AssertionError, match="no node was announced"):
        NodeReader(domain, "jazzy").newest(seconds=1.5)
    transport.close()
