from __future__ import annotations

import time

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed")

from cyclonedds.domain import DomainParticipant
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from rover_rl.sims.ros2.announce import TOPIC, participant_message
from rover_rl.sims.ros2.dds import DdsTransport, _wire
from rover_rl.sims.ros2.messages import LaserScan, Twist

pytestmark = pytest.mark.ros2


class NodeReader:
    """What ``ros2 node list`` hears, from whoever was there before it, too."""

    def __init__(self, domain: dict[str, str], distribution: str) -> None:
        self._participant = DomainParticipant(int(domain["ROS_DOMAIN_ID"]))
        topic = Topic(self._participant, TOPIC, _wire(participant_message(distribution)))
        quality = Qos(
            Policy.Reliability.Reliable(10**9),
            Policy.Durability.TransientLocal,
            Policy.History.KeepLast(1),
            Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
        )
        self._reader = DataReader(self._participant, topic, quality)

    def newest(self, seconds: float = 10.0):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.05)
            if heard := self._reader.take(10):
                return heard[-1]
        raise AssertionError("nothing was told of nodes")


@pytest.mark.parametrize(("distribution", "length"), [("humble", 24), ("jazzy", 16)])
def test_nodes_and_what_they_read_and_write_are_told(domain, distribution, length):
    transport = DdsTransport("rover_rl", {**domain, "ROS_DISTRO": distribution})
    transport.subscribe("/scan", LaserScan, print)
    transport.publisher("/cmd_vel", Twist)
    transport.publisher("/cmd_vel_2", Twist)
    reader = NodeReader(domain, distribution)
    told = reader.newest()
    (node,) = told.node_entities_info_seq
    assert (node.node_namespace, node.node_name) == ("/", "rover_rl")
    assert (len(node.reader_gid_seq), len(node.writer_gid_seq)) == (1, 2)
    assert told.gid.data.shape == (length,)
    entities = [told.gid, *node.reader_gid_seq, *node.writer_gid_seq]
    # What belongs to one participant begins with the same twelve bytes (DDSI-RTPS 2.3, 8.2.4.1).
    assert len({gid.data[:12].tobytes() for gid in entities}) == 1
    assert len({gid.data.tobytes() for gid in entities}) == 4
    assert not np.any(told.gid.data[16:])
    other = DdsTransport("other", {**domain, "ROS_DISTRO": distribution})
    assert {node.node_name for node in reader.newest().node_entities_info_seq} == {"rover_rl", "other"}
    transport.close()
    assert [node.node_name for node in reader.newest().node_entities_info_seq] == ["other"]
    other.close()


def test_nothing_is_told_where_no_distribution_is_named(domain):
    transport = DdsTransport("quiet", domain)
    with pytest.raises(AssertionError, match="nothing was told"):
        NodeReader(domain, "jazzy").newest(seconds=1.5)
    transport.close()
