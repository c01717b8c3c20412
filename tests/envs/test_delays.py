"""Late sensors, lost scans and the pose of a scan: what arrives is what was, also from a served rover."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch

from rover_rl import Bounds, Randomization, RoverEnv, Sensor, World
from rover_rl.envs.config import EnvConfig, LidarConfig, LimitsConfig, PoseConfig
from rover_rl.envs.imperfections import IMPERFECTIONS, imperfect
from rover_rl.envs.sensors.standard import taken_at
from rover_rl.envs.served_rover import ServedRover
from rover_rl.rotations import wrap_angle
from rover_rl.worlds import Terrain
from rover_rl.worlds.movers import Cylinder, Mover, Waypoints

ROWS, STEPS = 2, 14


@dataclass(frozen=True, kw_only=True)
class Clock(Sensor):
    """A sensor of one's own: the number of steps of the episode."""

    name: str = "clock"
    bounds = Bounds((0.0,), (1000.0,))

    def read(self, inputs):
        return inputs.steps.float()


def driven(steps=STEPS, rows=ROWS, period=1, sensors=(), action=(0.4, 0.3), pose=None, limited=None, **noise):
    """Observations ``[rows, steps + 1]`` of rovers that drive on a fixed arc."""
    parts = {"pose": pose or PoseConfig(), "limits": limited or LimitsConfig(), "randomization": Randomization(**noise)}
    lidar = LidarConfig(points=16, beams=64, period=period)
    env = RoverEnv(world="maze", num_envs=rows, seed=0, backend="warp", lidar=lidar, sensors=sensors, **parts)
    td = env.reset()
    keys = [*td.keys()]
    seen = [td.select(*keys)]
    for _ in range(steps):
        td = env.step(td.set("action", torch.tensor([action]).expand(rows, 2)))["next"]
        seen.append(td.select(*keys))
    return torch.stack(seen, 1)


def test_what_sensors_tell_arrives_as_late_as_was_asked_for():
    plain = driven(sensors=[Clock()])
    late = driven(sensors=[Clock()], scan_latency=(3, 3), state_latency=(2, 2))
    for key, delay in (("lidar", 3), ("pose", 2), ("imu", 2), ("velocities", 2), ("clock", 2), ("target", 2)):
        assert torch.allclose(late[key][:, delay:], plain[key][:, :-delay], atol=1e-5), key
        # Before the first reading has arrived, it is that of the start.
        assert torch.allclose(late[key][:, :delay], plain[key][:, :1].expand_as(late[key][:, :delay]), atol=1e-5), key
    # What happens is not late.
    assert torch.equal(late["outcome", "progress"], plain["outcome", "progress"])


def test_delays_are_drawn_for_each_row_from_their_range():
    clock = driven(4, 128, sensors=[Clock()], state_latency=(0, 3))["clock"]
    assert {*(4 - clock[:, -1]).flatten().tolist()} == {0.0, 1.0, 2.0, 3.0}
    assert torch.equal(clock[:1], driven(4, 1, sensors=[Clock()], state_latency=(0, 3))["clock"])


def test_a_late_scan_arrives_when_policies_decide_and_tells_where_it_was_taken():
    plain, late, rare = driven(), driven(scan_latency=(3, 3)), driven(period=4, scan_latency=(3, 3))
    for arrival in (4, 8):
        assert torch.equal(rare["lidar"][:, arrival], plain["lidar"][:, arrival - 3])
        assert torch.equal(rare["lidar"][:, arrival + 3], plain["lidar"][:, arrival - 3])
    position, attitude = taken_at(late[:, 10])
    assert torch.allclose(position, plain["pose"][:, 7], atol=1e-5)
    assert torch.allclose(attitude, plain["imu"][:, 7], atol=1e-5)
    assert (late["scan_pose"][:, 10, 0] < -0.01).any()
    # A scan waits for the pose of its time.
    assert driven(scan_latency=(1, 1), state_latency=(3, 3))["scan_pose"][:, 4:, [0, 1, 5]].abs().max() < 1e-5


def test_lost_scans_leave_the_last_one():
    changed = driven(30, 32, lost_scans=0.3)["lidar"].diff(dim=1).abs().amax(-1) > 0
    assert 0.6 < changed[:, 5:].float().mean() < 0.75


def test_a_map_of_late_scans_is_where_they_were_taken():
    """A route on late scans that are aligned is nearer to that on exact ones than without their pose."""
    exact, late = (driven(24, 8, sensors=["route"], action=(0.6, 1.5), scan_latency=(k, k)) for k in (0, 4))
    assert (late["route"][:, 10:, 4] - exact["route"][:, 10:, 4]).abs().median() < 0.2


def test_the_severity_scales_noise():
    def spread(*severity: float) -> torch.Tensor:
        noisy = driven(2, 64, range_noise=0.05, severity=severity)
        return (noisy["lidar"] - driven(2, 64)["lidar"])[:, 0].std(dim=-1)

    assert spread(0.0, 0.0).max() == 0
    drawn = spread(0.0, 1.0)
    assert drawn.min() < 0.01 < 0.03 < drawn.max()


def test_wheels_and_headings_that_drift():
    plain, off = (
        driven(pose=PoseConfig("odometry"), odometry_scale=(scale, scale), yaw_bias=(bias, bias))
        for scale, bias in ((1.0, 0.0), (1.1, 0.1))
    )
    assert torch.allclose(off["velocities"], 1.1 * plain["velocities"], atol=1e-5)
    turned = torch.arange(STEPS + 1) * 0.05 * 0.1
    assert torch.allclose(wrap_angle(off["imu"][..., 2] - plain["imu"][..., 2]), turned.expand(ROWS, -1), atol=1e-4)
    way = [(each["pose"].diff(dim=1)[..., :2].norm(dim=-1)).sum(1) for each in (off, plain)]
    assert torch.allclose(way[0], 1.1 * way[1], rtol=1e-3)


def test_limits_of_commands_are_those_of_a_live_rover():
    limits = LimitsConfig(apply=True, max_speed=0.2, max_acceleration=0.5)
    speed = driven(limited=limits, action=(1.0, 0.0))["velocities"][..., 0]
    assert speed.max() < 0.21
    assert (speed.diff(dim=1) < 0.5 * 0.05 + 0.01).all()
    drawn = driven(20, 32, limited=limits, action=(1.0, 0.0), limits=(0.5, 1.0))["velocities"][:, -1, 0]
    assert 0.09 < drawn.min() < 0.13 < 0.17 < drawn.max() < 0.21


def test_imperfections_by_name():
    config = EnvConfig(world="maze", control_rate=50.0, compensate_delay=True)
    assert imperfect(config, "late").randomization.scan_latency == (8, 8)  # 150 ms
    assert imperfect(config, "late").compensate_delay
    assert imperfect(config, "jumps").pose.source == "localized"
    assert imperfect(config, "harsh").limits.apply
    assert Randomization.typical() == IMPERFECTIONS["typical"](0.05)["randomization"]
    with pytest.raises(ValueError, match="unknown imperfection 'latte', perhaps 'late'"):
        imperfect(config, "latte")


# A served rover: what arrives from its sensors has the stamp of its time, and its lidar sees what moves.


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
