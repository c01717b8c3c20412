from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from cyclonedds import core
from cyclonedds.domain import DomainParticipant
from cyclonedds.qos import Policy
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from rover_rl import RoverEnv
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.ros2.dds import (
    NODE_LIST,
    DdsTransport,
    _qos,
    _sample_type,
    announcement_messages,
    domain_id,
    domain_settings,
)
from rover_rl.sims.ros2.messages import Clock, LaserScan, Twist, encode
from tests.sims.ros2.processes import until
from tests.sims.ros2.test_messages import SENT

pytestmark = pytest.mark.ros2


@pytest.fixture
def pair(domain) -> Iterator[tuple[DdsTransport, DdsTransport]]:
    talker, listener = DdsTransport("talker", domain), DdsTransport("listener", domain)
    yield talker, listener
    talker.close()
    listener.close()


@pytest.mark.parametrize("message", SENT, ids=lambda message: message.ros_type)
def test_messages_arrive_unchanged_and_their_type_and_the_node_of_their_publisher_are_known(pair, message):
    talker, listener = pair
    received: list[Any] = []
    listener.overhear("/sent", type(message), lambda *heard: received.append(heard))
    talker.overhear("/sent", type(message), lambda *heard: received.append(heard))  # does not hear itself
    publish = talker.publisher("/sent", type(message))
    until(lambda: talker.subscribers("/sent"))
    publish(message)
    until(lambda: received)
    ((heard, sender),) = received
    assert encode(heard) == encode(message)
    until(lambda: listener.types("/sent") == {message.ros_type})
    assert listener.types("/nothing") == set()
    assert listener.name_of(sender, "/sent") == "/talker"


def test_a_topic_has_one_type_and_a_closed_connection_raises_an_error(domain):
    transport = DdsTransport("gone", domain)
    publish = transport.publisher("/cmd_vel", Twist)
    with pytest.raises(ValueError, match=r"/cmd_vel has type geometry_msgs/msg/Twist, and cannot also have type"):
        transport.subscribe("/cmd_vel", Clock, print)
    transport.close()
    transport.close()
    with pytest.raises(RuntimeError, match="connection of gone is closed"):
        publish(Twist())
    with pytest.raises(RuntimeError, match="connection of gone is closed"):
        transport.subscribe("/scan", LaserScan, print)


def test_a_topic_that_cannot_be_created_is_tried_again(domain, monkeypatch):
    tried = []

    def created(*arguments):
        tried.append(arguments[1])
        if len(tried) < 3:
            raise core.DDSException(-1)
        return Topic(*arguments)

    monkeypatch.setattr("rover_rl.sims.ros2.dds.Topic", created)
    DdsTransport("late", domain).close()
    assert tried == ["ros_discovery_info"] * 3


def test_a_forked_process_is_rejected(domain):
    transport = DdsTransport("parent", domain)
    child = os.fork()
    if not child:
        try:
            DdsTransport("child", domain)
        except RuntimeError as error:
            os._exit(0 if "does not survive a fork" in str(error) else 1)
        os._exit(2)
    _, status = os.waitpid(child, 0)
    transport.close()
    assert os.waitstatus_to_exitcode(status) == 0


def test_domain_and_discovery_follow_ros_variables(caplog):
    def found(**variables: str) -> str:
        return domain_settings({f"ROS_{name}": value for name, value in variables.items()})

    assert [domain_id({"ROS_DOMAIN_ID": text} if text else {}) for text in ("", " ", "42")] == [0, 0, 42]
    for text in ("-1", "233", "five"):
        with pytest.raises(ValueError, match="ROS_DOMAIN_ID must be a whole number from 0 to 232"):
            domain_id({"ROS_DOMAIN_ID": text})
    default = found()
    assert "127.0.0.1" not in default
    assert found(AUTOMATIC_DISCOVERY_RANGE="SYSTEM_DEFAULT", STATIC_PEERS="10.0.0.1") == default
    assert f"<Tag>ros_discovery_off_{os.getpid()}</Tag>" in found(AUTOMATIC_DISCOVERY_RANGE="OFF")
    peers = found(STATIC_PEERS="10.0.0.1; robot.local;")
    assert '<Peers><Peer address="10.0.0.1"/><Peer address="robot.local"/></Peers>' in peers
    local = found(AUTOMATIC_DISCOVERY_RANGE="localhost", STATIC_PEERS="10.0.0.1")
    assert '<Peer address="localhost"/><Peer address="10.0.0.1"/>' in local
    assert "127.0.0.1" in local
    assert "127.0.0.1" in found(LOCALHOST_ONLY="1", AUTOMATIC_DISCOVERY_RANGE="OFF")
    assert domain_settings({"CYCLONEDDS_URI": "file:///mine.xml"}).endswith(",file:///mine.xml")
    assert "127.0.0.1" in found(AUTOMATIC_DISCOVERY_RANGE="subnets")
    assert "ROS_AUTOMATIC_DISCOVERY_RANGE=subnets is none of SUBNET, LOCALHOST, OFF" in caplog.text


def open_resources() -> tuple[int, int, int]:
    """Returns the numbers of Python threads, open files and sockets, and all threads of this process."""
    return threading.active_count(), len(os.listdir("/proc/self/fd")), len(os.listdir("/proc/self/task"))


def test_environments_release_threads_and_files(in_domain):
    def once() -> None:
        env = RoverEnv(world_n="maze", backend=Ros2Settings(reset="none"), connection_check_timeout=0.0)
        assert not env.robot_connected
        env.close()

    once()
    before = open_resources()
    for _ in range(3):
        once()
    # Those of earlier tests may end in between.
    until(lambda: all(now <= then for now, then in zip(open_resources(), before, strict=True)))


def node_reader(participant: DomainParticipant, distribution: str) -> DataReader:
    """Returns a reader of node announcements, as ``ros2 node list``, that also receives earlier ones."""
    *_, kind = announcement_messages(distribution)
    qos = _qos(True, 1, Policy.Durability.TransientLocal)
    return DataReader(participant, Topic(participant, NODE_LIST, _sample_type(kind)), qos)


def nodes(reader: DataReader):
    """Returns the next announcement of nodes and the names in it."""
    samples: list = []
    until(lambda: samples.extend(reader.take(10)) or samples)
    return samples[-1], {node.node_name for node in samples[-1].node_entities_info_seq}


@pytest.mark.parametrize(("distribution", "length"), [("humble", 24), ("jazzy", 16)])
def test_nodes_are_announced_with_their_readers_and_writers(domain, distribution, length):
    transport = DdsTransport("rover_rl", {**domain, "ROS_DISTRO": distribution})
    transport.subscribe("/scan", LaserScan, print)
    transport.publisher("/cmd_vel", Twist)
    transport.publisher("/cmd_vel_2", Twist)
    reader = node_reader(DomainParticipant(int(domain["ROS_DOMAIN_ID"])), distribution)
    participant, _ = nodes(reader)
    (node,) = participant.node_entities_info_seq
    assert (node.node_namespace, node.node_name) == ("/", "rover_rl")
    assert (len(node.reader_gid_seq), len(node.writer_gid_seq)) == (1, 2)
    assert participant.gid.data.shape == (length,)
    entities = [participant.gid, *node.reader_gid_seq, *node.writer_gid_seq]
    # Identifiers of one participant share their first twelve bytes (DDSI-RTPS 2.3, 8.2.4.1).
    assert len({gid.data[:12].tobytes() for gid in entities}) == 1
    assert len({gid.data.tobytes() for gid in entities}) == 4
    assert not np.any(participant.gid.data[16:])
    other = DdsTransport("other", domain)  # keeps the domain
    transport.close()
    assert nodes(reader)[1] == set()
    other.close()
