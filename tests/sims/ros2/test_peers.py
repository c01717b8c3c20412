"""With what others make: Fast DDS and Gazebo's command, where they are installed."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed")

from rover_rl.sims.ros2.cdr import encode
from rover_rl.sims.ros2.dds import DdsTransport
from rover_rl.sims.ros2.messages import Header, LaserScan, Time, Twist, Vector3
from rover_rl.sims.ros2.pose_reset import GazeboPlacer, PoseResetError, Target
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


@needs_fast_dds
@pytest.mark.parametrize("peer_first", [True, False])
def test_fast_dds_is_understood_and_understands(tmp_path, domain, peer_first):
    program = tmp_path / "peer"
    subprocess.run(["g++", "-O0", "-o", program, PEER, "-lfastrtps", "-lfastcdr"], check=True)
    scan = LaserScan(Header(Time(3, 4), "lidar"), range_max=10.0, ranges=np.arange(640, dtype=np.float32))
    twist = Twist(Vector3(x=0.5), Vector3(z=-0.25))
    command = [str(program), domain["ROS_DOMAIN_ID"], encode(scan).hex()]

    def start() -> subprocess.Popen[str]:
        peer = subprocess.Popen(command, env={**os.environ, **domain}, stdout=subprocess.PIPE, text=True)
        assert peer.stdout is not None
        assert peer.stdout.readline() == "up\n"
        return peer

    early = start() if peer_first else None
    transport = DdsTransport("rover_rl", domain)
    received: list[LaserScan] = []
    transport.subscribe("/scan", LaserScan, received.append)
    publish = transport.publisher("/cmd_vel", Twist, reliable=True)
    peer = early or start()
    try:
        until(lambda: received and transport.subscribers("/cmd_vel"))
        assert (received[0].header, received[0].range_max) == (scan.header, 10.0)
        np.testing.assert_array_equal(received[0].ranges, scan.ranges)
        publish(twist)
        assert peer.stdout is not None
        assert peer.stdout.readline().strip() == encode(twist).hex()
    finally:
        peer.kill()
        peer.communicate()
        transport.close()


@needs_gazebo
def test_gazebos_command_without_gazebo_is_no_success(tmp_path, monkeypatch):
    # Debian's own wrapper, ``ign``, looks for the command where it is not.
    wrapper = tmp_path / "ign"
    wrapper.write_text(f'#!/bin/sh\nshift\nexec {SERVICE} "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setenv("IGN_PARTITION", str(tmp_path))
    with pytest.raises(PoseResetError, match="Service call timed out"):
        GazeboPlacer("ign", "maze", "rover_zero4wd").place(Target(1.0, 2.0, 0.5, 0.0))
