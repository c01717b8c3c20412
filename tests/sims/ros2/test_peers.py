"""Interoperability with Fast DDS and Gazebo's command, if they are installed."""

from __future__ import annotations

import os
import shutil
import subprocess
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from rover_rl.sims.ros2 import PoseResetError
from rover_rl.sims.ros2.dds import DdsTransport
from rover_rl.sims.ros2.messages import Header, LaserScan, Time, Twist, Vector3, encode
from rover_rl.sims.ros2.pose_reset import TargetPose, place_in_gazebo
from tests.sims.ros2.processes import until

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


@needs_fast_dds
@pytest.mark.parametrize("peer_first", [True, False])
def test_messages_are_exchanged_with_fast_dds(program, domain, peer_first):
    scan = LaserScan(Header(Time(3, 4), "lidar"), range_max=10.0, ranges=np.arange(640, dtype=np.float32))
    twist = Twist(Vector3(x=0.5), Vector3(z=-0.25))
    received: list[LaserScan] = []

    def start_peer() -> subprocess.Popen[str]:
        """Starts a peer that sends the scan at 20 Hz, and prints the twists that it receives."""
        command = [str(program), domain["ROS_DOMAIN_ID"], encode(scan).hex()]
        peer = stack.enter_context(
            subprocess.Popen(command, env={**os.environ, **domain}, stdout=subprocess.PIPE, text=True)
        )
        stack.callback(peer.kill)
        assert peer.stdout is not None
        assert peer.stdout.readline() == "up\n"
        return peer

    with ExitStack() as stack:
        early = start_peer() if peer_first else None
        transport = DdsTransport("rover_rl", domain)
        stack.callback(transport.close)
        transport.subscribe("/scan", LaserScan, received.append)
        publish = transport.publisher("/cmd_vel", Twist, reliable=True)
        peer = early or start_peer()
        until(lambda: received and transport.subscribers("/cmd_vel"))
        assert (received[0].header, received[0].range_max) == (scan.header, 10.0)
        np.testing.assert_array_equal(received[0].ranges, scan.ranges)
        publish(twist)
        assert peer.stdout is not None
        assert peer.stdout.readline().strip() == encode(twist).hex()


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
