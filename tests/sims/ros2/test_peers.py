"""Interoperability with Fast DDS and Gazebo's command, if they are installed."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from rover_rl.sims.ros2 import PoseResetError
from rover_rl.sims.ros2.dds import DdsTransport
from rover_rl.sims.ros2.messages import Header, LaserScan, Time, Twist, Vector3, encode
from rover_rl.sims.ros2.pose_reset import TargetPose, place_in_gazebo
from tests.sims.ros2.processes import Command, until

pytestmark = [pytest.mark.ros2, pytest.mark.slow]

PEER = Path(__file__).with_name("fastdds_peer.cpp")
SERVICE = Path("/usr/libexec/ignition/transport11/ign-transport-service")
needs_fast_dds = pytest.mark.skipif(
    not Path("/usr/include/fastrtps").is_dir() or shutil.which("g++") is None,
    reason="Fast DDS is not installed (Debian: libfastrtps-dev and g++)",
)
needs_gazebo = pytest.mark.skipif(
    not SERVICE.is_file(), reason="Gazebo's command is not installed (Debian: ignition-transport-cli)"
)


@pytest.fixture(scope="module")
def program(tmp_path_factory) -> Path:
    """Compiled peer."""
    program = tmp_path_factory.mktemp("peer") / "peer"
    subprocess.run(["g++", "-O0", "-o", program, PEER, "-lfastrtps", "-lfastcdr"], check=True)
    return program


@pytest.fixture
def start_peer(program, domain) -> Iterator[Callable[[LaserScan], subprocess.Popen[str]]]:
    """Starts a peer that sends a scan at 20 Hz, and prints the twists that it receives."""
    started: list[subprocess.Popen[str]] = []

    def start_peer(scan: LaserScan) -> subprocess.Popen[str]:
        command = [str(program), domain["ROS_DOMAIN_ID"], encode(scan).hex()]
        peer = subprocess.Popen(command, env={**os.environ, **domain}, stdout=subprocess.PIPE, text=True)
        started.append(peer)
        assert peer.stdout is not None
        assert peer.stdout.readline() == "up\n"
        return peer

    yield start_peer
    for peer in started:
        peer.kill()
        peer.wait()
        assert peer.stdout is not None
        peer.stdout.close()


@needs_fast_dds
@pytest.mark.parametrize("peer_first", [True, False])
def test_messages_are_exchanged_with_fast_dds(start_peer, domain, peer_first):
    scan = LaserScan(Header(Time(3, 4), "lidar"), range_max=10.0, ranges=np.arange(640, dtype=np.float32))
    twist = Twist(Vector3(x=0.5), Vector3(z=-0.25))
    early = start_peer(scan) if peer_first else None
    transport = DdsTransport("rover_rl", domain)
    received: list[LaserScan] = []
    transport.subscribe("/scan", LaserScan, received.append)
    publish = transport.publisher("/cmd_vel", Twist, reliable=True)
    peer = early or start_peer(scan)
    try:
        until(lambda: received and transport.subscribers("/cmd_vel"))
        assert (received[0].header, received[0].range_max) == (scan.header, 10.0)
        np.testing.assert_array_equal(received[0].ranges, scan.ranges)
        publish(twist)
        assert peer.stdout is not None
        assert peer.stdout.readline().strip() == encode(twist).hex()
    finally:
        transport.close()


def bad_scan(ranges: list[float], increment: float = 2 * math.pi / 640, announced: int = 640) -> LaserScan:
    return LaserScan(
        Header(Time(3, 4), "lidar"),
        angle_min=-math.pi,
        angle_max=-math.pi + (announced - 1) * increment,
        angle_increment=increment,
        range_min=0.15,
        range_max=12.0,
        ranges=np.array(ranges, np.float32),
    )


@needs_fast_dds
@pytest.mark.parametrize(
    ("scan", "message"),
    [
        (bad_scan([math.nan] * 640), "640 of 640 readings of the scan are missing, NaN or outside of its limits"),
        (bad_scan([1.0] * 7), "633 of 640 readings of the scan are missing"),
        (bad_scan([1.0] * 640, increment=0.0), "a scan must have a finite angle_min"),
        (bad_scan([5.0] * 320, announced=320), "the scan covers 180 degrees, and the policy was trained with 360"),
    ],
    ids=["all NaN", "7 of 640", "increment 0", "180 degrees"],
)
def test_a_drive_with_unusable_scans_from_fast_dds_is_rejected(start_peer, domain, tmp_path, scan, message):
    peer = start_peer(scan)
    options = ("--world", "maze", "--goal", "1", "1", "--wait", "20", "--log", str(tmp_path / "drive.jsonl"))
    drive = Command({**os.environ, **domain}, "drive", "scripted", *options)
    assert drive.wait(60) == 2, drive.output
    assert [message in line for line in drive.output.splitlines() if line.startswith("rover-rl:")] == [True]
    peer.kill()
    twists, _ = peer.communicate()
    assert set(twists.split()) <= {encode(Twist()).hex()}


@needs_gazebo
def test_gazebos_command_fails_without_gazebo(tmp_path, monkeypatch):
    # Debian's own wrapper, ``ign``, looks for the command in the wrong folder.
    wrapper = tmp_path / "ign"
    wrapper.write_text(f'#!/bin/sh\nshift\nexec {SERVICE} "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setenv("IGN_PARTITION", str(tmp_path))
    with pytest.raises(PoseResetError, match="Service call timed out"):
        place_in_gazebo("ign", "maze", "rover_zero4wd", TargetPose(1.0, 2.0, 0.5, 0.0))
