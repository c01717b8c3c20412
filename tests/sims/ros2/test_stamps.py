"""A step has the IMU and odometry of its scan, over the network, before ROS 2's own rclpy and on busy cores."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from contextlib import ExitStack

import pytest
import torch

from rover_rl.robots import get_robot
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims import make_simulator
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.settings import Connection
from rover_rl.worlds import get_world
from tests.sims.ros2.peer import Peer

STEPS = 1_000
WRAP = 600


@pytest.mark.ros2
@pytest.mark.slow
@pytest.mark.parametrize("scan", ["first", "last"])
def test_imu_and_odometry_are_those_of_the_scan_on_busy_cores(peer, in_domain, scan):
    with ExitStack() as stack:
        rover = Peer(peer, {**os.environ, **in_domain}, "numbered", scan)
        stack.callback(rover.kill)
        assert rover.read() == "up"
        for _ in range(2):
            busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(busy.kill)
        settings = Ros2Settings(reset="none", step_timeout=20.0)
        connection = Connection(timeout=60)
        simulator = make_simulator(
            settings, worlds=[get_world("maze")], robot=get_robot("rover_zero"), connection=connection
        )
        stack.callback(simulator.close)
        simulator.step(torch.zeros(1, 2))  # the first messages of a new connection may be lost
        wrong = []
        for _ in range(STEPS):
            state = simulator.step(torch.zeros(1, 2))
            number = round(20 * state.stamp.item()) % WRAP
            yaw = quaternion_to_euler(state.orientation)[0, 2].item()
            heading_is_of_it = abs(math.remainder(yaw - 0.01 * number, 2 * math.pi)) < 1e-3
            if not (heading_is_of_it and abs(state.linear_velocity.item() - 0.001 * number) < 1e-5):
                wrong.append(number)
        assert wrong == []
