"""Late sensors, lost scans and the pose of a scan: what arrives is what was, and the map is where it was seen."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch

from rover_rl import Bounds, Randomization, RoverEnv, Sensor
from rover_rl.envs.config import EnvConfig, LidarConfig, LimitsConfig, PoseConfig
from rover_rl.envs.imperfections import IMPERFECTIONS, imperfect
from rover_rl.envs.sensors.standard import taken_at
from rover_rl.rotations import wrap_angle

ROWS, STEPS = 4, 16


@dataclass(frozen=True, kw_only=True)
class Clock(Sensor):
    """A sensor of one's own: the number of steps of the episode."""

    name: str = "clock"
    bounds = Bounds((0.0,), (1000.0,))

    def read(self, inputs):
        return inputs.steps.float()


def driven(steps=STEPS, rows=ROWS, period=1, sensors=(), action=(0.4, 0.3), seed=0, **settings):
    """Observations ``[rows, steps + 1]`` of rovers that drive on a fixed arc."""
    lidar = LidarConfig(points=16, beams=64, period=period)
    env = RoverEnv(world="maze", num_envs=rows, seed=seed, backend="warp", lidar=lidar, sensors=sensors, **settings)
    td = env.reset()
    keys = [*td.keys()]
    seen = [td.select(*keys)]
    for _ in range(steps):
        td = env.step(td.set("action", torch.tensor([action]).expand(rows, 2)))["next"]
        seen.append(td.select(*keys))
    env.close()
    return torch.stack(seen, 1)


def test_what_sensors_tell_arrives_as_late_as_was_asked_for():
    plain = driven(sensors=[Clock()])
    late = driven(sensors=[Clock()], randomization=Randomization(scan_latency=(3, 3), state_latency=(2, 2)))
    for key, delay in (("lidar", 3), ("pose", 2), ("imu", 2), ("velocities", 2), ("clock", 2), ("target", 2)):
        assert torch.allclose(late[key][:, delay:], plain[key][:, :-delay], atol=1e-5), key
        # Before the first reading has arrived, it is that of the start.
        assert torch.allclose(late[key][:, :delay], plain[key][:, :1].expand_as(late[key][:, :delay]), atol=1e-5), key
    # What happens is not late.
    assert torch.equal(late["outcome", "progress"], plain["outcome", "progress"])


def test_delays_are_drawn_for_each_row_from_their_range():
    late = Randomization(state_latency=(0, 3))
    clock = driven(5, 256, sensors=[Clock()], randomization=late)["clock"]
    ages = 5 - clock[:, -1]
    assert {*ages.flatten().tolist()} == {0.0, 1.0, 2.0, 3.0}
    assert torch.equal(clock[:1], driven(5, 1, sensors=[Clock()], randomization=late)["clock"])


def test_scans_arrive_when_policies_decide():
    plain = driven(period=1)
    late = driven(period=4, randomization=Randomization(scan_latency=(3, 3)))
    for arrival in (4, 8, 12):
        assert torch.equal(late["lidar"][:, arrival], plain["lidar"][:, arrival - 3])
        assert torch.equal(late["lidar"][:, arrival + 3], plain["lidar"][:, arrival - 3])


def test_a_late_scan_tells_where_it_was_taken():
    plain = driven()
    late = driven(randomization=Randomization(scan_latency=(3, 3)))
    position, attitude = taken_at(late[:, 10])
    assert torch.allclose(position, plain["pose"][:, 7], atol=1e-5)
    assert torch.allclose(attitude, plain["imu"][:, 7], atol=1e-5)
    assert (late["scan_pose"][:, 10, 0] < -0.01).any()


def test_a_scan_waits_for_the_pose_of_its_time():
    late = driven(randomization=Randomization(scan_latency=(1, 1), state_latency=(3, 3)))
    assert late["scan_pose"][:, 4:, [0, 1, 5]].abs().max() < 1e-5


def test_lost_scans_leave_the_last_one():
    rows, steps = 32, 40
    changed = driven(steps, rows, randomization=Randomization(lost_scans=0.3))["lidar"].diff(dim=1).abs().amax(-1) > 0
    assert 0.6 < changed[:, 5:].float().mean() < 0.75


def test_a_map_of_late_scans_is_where_they_were_taken():
    """A route on late scans that are aligned is nearer to that on exact ones than without their pose."""
    exact = driven(40, 8, sensors=["route"], action=(0.6, 1.5))
    late = driven(40, 8, sensors=["route"], action=(0.6, 1.5), randomization=Randomization(scan_latency=(4, 4)))
    length = late["route"][:, 10:, 4] - exact["route"][:, 10:, 4]
    assert length.abs().median() < 0.2


def test_the_severity_scales_noise():
    def spread(**settings):
        noise = Randomization(range_noise=0.05, **settings)
        return (driven(2, 64, randomization=noise)["lidar"] - driven(2, 64)["lidar"])[:, 0].std(dim=-1)

    assert spread(severity=(0.0, 0.0)).max() == 0
    drawn = spread(severity=(0.0, 1.0))
    assert drawn.min() < 0.01 < 0.03 < drawn.max()


def test_wheels_and_headings_that_drift():
    drift = Randomization(odometry_scale=(1.1, 1.1), yaw_bias=(0.1, 0.1))
    plain = driven(pose=PoseConfig("odometry"))
    off = driven(pose=PoseConfig("odometry"), randomization=drift)
    assert torch.allclose(off["velocities"], 1.1 * plain["velocities"], atol=1e-5)
    turned = torch.arange(STEPS + 1) * 0.05 * 0.1
    assert torch.allclose(wrap_angle(off["imu"][..., 2] - plain["imu"][..., 2]), turned.expand(ROWS, -1), atol=1e-4)
    way = [(each["pose"].diff(dim=1)[..., :2].norm(dim=-1)).sum(1) for each in (off, plain)]
    assert torch.allclose(way[0], 1.1 * way[1], rtol=1e-3)


def test_either_source_is_drawn():
    pose = PoseConfig("either", drift=0.3, jump=0.0)
    start = driven(0, 64, pose=pose)["pose"][:, 0] - driven(0, 64)["pose"][:, 0]
    exact = (start == 0).all(-1)
    assert 16 < exact.sum() < 48


def test_the_heading_jumps_with_the_pose_also_in_the_imu():
    pose = PoseConfig("localized", drift=0, drift_heading=0, jump=0, jump_rate=0, jump_heading=0.1)
    turned = wrap_angle(driven(0, 512, pose=pose)["imu"][:, 0, 2] - driven(0, 512)["imu"][:, 0, 2])
    assert turned.std().item() == pytest.approx(0.1, rel=0.1)


def test_limits_of_commands_are_those_of_a_live_rover():
    limits = LimitsConfig(apply=True, max_speed=0.2, max_acceleration=0.5)
    speed = driven(limits=limits, action=(1.0, 0.0))["velocities"][..., 0]
    assert speed.max() < 0.21
    assert (speed.diff(dim=1) < 0.5 * 0.05 + 0.01).all()
    factors = Randomization(limits=(0.5, 1.0))
    drawn = driven(30, 32, limits=limits, action=(1.0, 0.0), randomization=factors)["velocities"][:, -1, 0]
    assert 0.09 < drawn.min() < 0.13 < 0.17 < drawn.max() < 0.21


def test_imperfections_by_name():
    config = EnvConfig(world="maze", control_rate=50.0)
    assert imperfect(config, "late").randomization.scan_latency == (8, 8)  # 150 ms
    assert imperfect(config, "jumps").pose.source == "localized"
    assert imperfect(config, "harsh").limits.apply
    assert Randomization.typical() == IMPERFECTIONS["typical"](0.05)["randomization"]
    with pytest.raises(ValueError, match="unknown imperfection 'latte', perhaps 'late'"):
        imperfect(config, "latte")
