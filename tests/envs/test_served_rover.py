"""A served rover: what arrives from its sensors has the stamp of its time, and its lidar sees what moves."""

from __future__ import annotations

import pytest
import torch

from rover_rl import Randomization, World
from rover_rl.envs.config import EnvConfig, LidarConfig, PoseConfig
from rover_rl.envs.imperfections import imperfect
from rover_rl.envs.served_rover import ServedRover
from rover_rl.worlds import Terrain
from rover_rl.worlds.movers import Cylinder, Mover, Waypoints

# A cylinder comes along the x axis from 8 m away at 1 m/s.
COMING = Mover(Waypoints([(0.0, 8.0, 0.0, 0.0), (6.0, 2.0, 0.0, 0.0)], repeat="once"), Cylinder(0.3, 1.0))
STREET = World("street", Terrain.flat((20.0, 20.0)), movers=[COMING])


def served(steps=30, command=(0.0, 0.0), **settings):
    """Returns what arrives after each step."""
    config = EnvConfig(world=STREET, backend="warp", seed=0, lidar=LidarConfig(beams=64), **settings)
    rover = ServedRover(config)
    rover.reset((0.0, 0.0, 0.0))
    reports = [rover.step(command) for _ in range(steps)]
    rover.close()
    return reports


def test_an_exact_rover_tells_all_in_each_step_and_sees_what_moves():
    reports = served()
    assert all(each.state.stamp.item() == each.time == each.scan_stamp for each in reports)
    ahead = torch.stack([each.ranges[0] for each in reports])
    assert (ahead[9:-1:10] - ahead[19::10]).tolist() == pytest.approx([0.5, 0.5], abs=0.02)


def test_late_reports_have_the_stamp_of_their_time():
    late = Randomization(scan_latency=(3, 3), state_latency=(1, 1))
    exact, reports = served(command=(0.5, 0.0)), served(command=(0.5, 0.0), randomization=late)
    for step in range(5, 30):
        one = reports[step]
        assert one.time - one.state.stamp.item() == pytest.approx(0.05)
        assert one.time - one.scan_stamp == pytest.approx(0.15)
        assert torch.equal(one.state.position, exact[step - 1].state.position)
        assert torch.equal(one.ranges, exact[step - 3].ranges)


def test_lost_scans_never_arrive_and_headings_jump():
    pose = PoseConfig("localized", drift=0, drift_heading=0, jump=0, jump_rate=20.0, jump_heading=0.2)
    reports = served(100, randomization=Randomization(lost_scans=0.3), pose=pose)
    assert 12 < sum(each.ranges is None for each in reports) < 48
    assert 2 * torch.stack([each.state.orientation[0, 2] for each in reports]).std() > 0.1


def test_a_harsh_rover_is_served():
    config = imperfect(EnvConfig(world=STREET, backend="warp", seed=0), "harsh")
    rover = ServedRover(config)
    for _ in range(2):
        rover.reset((0.0, 0.0, 0.0))
        stamps = [rover.step((0.5, 0.0)).state.stamp.item() for _ in range(20)]
        assert stamps == sorted(stamps)
    rover.close()
