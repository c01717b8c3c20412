"""The dynamic-window planner drives to goals, and takes no trajectory that hits a reading if one is free."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import pytest
import torch
from hypothesis import event, given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.policy.dwa import LIDAR, YAW_GAIN, DynamicWindowPolicy
from rover_rl.envs.config import EnvConfig, HeadingGains, LidarConfig
from rover_rl.robots.built_in import ROVER_ZERO
from rover_rl.rotations import quaternion_to_euler, wrap_angle

POLICY = DynamicWindowPolicy()
CLEAR = torch.full((1, 128), 12.0)


def observation(
    lidar: Tensor, distance: float = 5.0, degrees: float = 0.0, velocities: tuple[float, float] = (0, 0)
) -> TensorDict:
    target = torch.tensor([[distance, math.radians(degrees)]]).expand(len(lidar), -1)
    motion = torch.tensor([velocities], dtype=torch.float32).expand(len(lidar), -1)
    return TensorDict({"lidar": lidar, "target": target, "velocities": motion}, [len(lidar)])


def action(lidar: Tensor, policy: DynamicWindowPolicy = POLICY, **rest: object) -> Tensor:
    return policy(observation(lidar, **rest))["action"][0]  # type: ignore[arg-type]


def wall(distance: float, degrees: float = 0.0) -> Tensor:
    """Readings of a long wall ``distance`` m from the lidar, in the direction ``degrees``."""
    angle = torch.arange(128) * (2 * math.pi / 128) - math.radians(degrees)
    return torch.where(angle.cos() > 0.05, distance / angle.cos().clamp(min=0.05), 12.0).clamp(max=12.0)[None]


@pytest.mark.parametrize("degrees", [-150, -60, -20, 0, 20, 60, 150])
def test_it_drives_to_a_goal_on_open_ground(degrees: float) -> None:
    speed, heading = action(CLEAR, degrees=degrees).tolist()
    if degrees:
        assert heading * degrees > 0
    else:
        assert (speed, heading) == pytest.approx((1.0, 0.0), abs=1e-6)


def test_it_goes_around_a_wall_on_the_side_of_the_goal() -> None:
    for degrees in (-30, 30):
        speed, heading = action(wall(0.9), degrees=degrees, velocities=(0.5, 0.0))
        assert heading * degrees > 0
        assert speed < 1


def test_it_keeps_its_speed_beside_a_wall_and_towards_a_goal_in_front_of_one() -> None:
    assert action(wall(0.6, 90), velocities=(1.0, 0.0))[0] == pytest.approx(1.0)
    speed, heading = action(wall(1.5), distance=1.0)
    assert speed > 0.6
    assert abs(heading) < 0.2


def test_between_walls_it_backs_off_or_turns_on_the_spot() -> None:
    # Walls ahead and on both sides, closer than the corners of the turning rover.
    pocket = torch.stack([wall(0.2), wall(0.28, 90), wall(0.28, -90)]).amin(0)
    assert action(pocket)[0] < 0
    box = torch.stack([wall(0.4), wall(0.8, 180), wall(0.6, 90), wall(0.6, -90)]).amin(0)
    speed, heading = action(box, degrees=120)
    assert speed == 0
    assert abs(heading) > 0.1


def test_trajectories_are_those_of_the_simulated_rover() -> None:
    wanted = torch.tensor([[1.0, 0.5], [2 / 3, -0.5], [0.0, 0.6]])
    env = RoverEnv(world_n="maze", num_envs=3, backend="warp", seed=3, lidar_points=128)
    sampled = POLICY.trajectories(env.reset()["velocities"])
    pairs = torch.stack((sampled.speed, sampled.yaw_rate), -1)
    best = (pairs - wanted[:, None]).square().sum(-1).argmin(-1)
    rows, pose = torch.arange(3), 2
    actions = pairs[rows, best] / torch.tensor([1.0, YAW_GAIN * HeadingGains.kp])
    begin = env.rover_state
    for _ in range(round(float(sampled.time[pose]) / env.control_dt)):
        env.step(TensorDict({"action": actions}, [3]))
    end = env.rover_state
    yaw, turned = (quaternion_to_euler(state.orientation)[:, 2] for state in (begin, end))
    dx, dy = (end.position - begin.position)[:, :2].unbind(-1)
    moved = torch.stack((yaw.cos() * dx + yaw.sin() * dy, yaw.cos() * dy - yaw.sin() * dx), -1)
    expected = torch.stack((sampled.x, sampled.y), -1)[rows, best, pose]
    assert expected[:2].norm(dim=-1).min() > 0.4
    # The wheels follow a command with a delay of up to a step, in which the rover drives 5 cm.
    assert (moved - expected).norm(dim=-1).max() < 0.06
    assert wrap_angle(turned - yaw - sampled.heading[rows, best, pose]).abs().max() < 0.1
    env.close()


# --- any scan


def is_hit(points: Tensor, policy: DynamicWindowPolicy, motion: Tensor, margin: float) -> Tensor:
    """Whether the footprint, grown by ``margin`` (m), contains a point on each trajectory, bool ``[S]``."""
    back, front, right, left = ROVER_ZERO.footprint
    sampled = policy.trajectories(motion)
    x, y, heading = (value[0, ..., None] for value in (sampled.x, sampled.y, sampled.heading))
    dx, dy = points[0, :, 0] - x, points[0, :, 1] - y
    ahead, aside = heading.cos() * dx + heading.sin() * dy, heading.cos() * dy - heading.sin() * dx
    inside = (ahead > back - margin) & (ahead < front + margin) & (aside > right - margin) & (aside < left + margin)
    return inside.any(-1).any(-1)


SCANS = st.lists(st.floats(0.6, 3.0), min_size=16, max_size=16)
"""Readings of at least 0.6 m, so that the body is free where it is: its rear end is 0.44 m from the lidar."""


@settings(max_examples=60, deadline=None)
@given(SCANS, st.floats(-180, 180), st.floats(-0.3, 1.0), st.floats(-3.0, 3.0), st.sampled_from([16, 32, 128]))
def test_it_takes_no_trajectory_that_hits_a_reading_if_one_is_free(
    scan: list[float], degrees: float, speed: float, yaw_rate: float, count: int
) -> None:
    lidar = torch.tensor([scan]).repeat_interleave(count // 16, -1)
    policy = DynamicWindowPolicy(lidar=LidarConfig(points=count))
    motion = torch.tensor([[speed, yaw_rate]])
    points = policy.points(lidar)
    chosen = action(lidar, policy, degrees=degrees, velocities=(speed, yaw_rate))
    assert (chosen.abs() <= torch.tensor([1.0, math.pi])).all()
    sampled = policy.trajectories(motion)
    pairs = torch.stack((sampled.speed, sampled.yaw_rate / (YAW_GAIN * HeadingGains.kp)), -1)[0]
    taken = (pairs - chosen).abs().amax(-1).argmin()
    # The discs that cover the footprint reach up to 13 cm over its ends.
    is_free = ~is_hit(points, policy, motion, 0.14)
    if is_free.any():
        assert not is_hit(points, policy, motion, 0.0)[taken]
    event("a free trajectory" if is_free.any() else "none")


def test_rows_do_not_depend_on_one_another() -> None:
    draws = torch.Generator().manual_seed(0)
    count = 37
    lidar = 0.3 + 3 * torch.rand(count, 128, generator=draws)
    target = torch.rand(count, 2, generator=draws) * torch.tensor([6.0, 3.0])
    rows = TensorDict({"lidar": lidar, "target": target, "velocities": torch.rand(count, 2, generator=draws)}, [count])
    together = POLICY(rows.clone())["action"]
    assert len(together.unique(dim=0)) > 10
    for row in range(count):
        assert torch.equal(POLICY(rows[row : row + 1].clone())["action"][0], together[row])


def test_readings_are_points_of_the_beams_that_gave_them() -> None:
    x = ROVER_ZERO.lidar_position[0]
    every = POLICY.points(torch.tensor([[1.0] * 127 + [12.0]]))[0]
    torch.testing.assert_close(every[0], torch.tensor([1 + x, 0.0]))
    torch.testing.assert_close(every[32], torch.tensor([x, 1.0]))
    assert every[127].norm() > 100  # nothing within the range of the lidar
    # With 4 beams a reading, the middle of the first segment is one and a half beams to the left.
    pooled = DynamicWindowPolicy(lidar=LidarConfig(points=32)).points(torch.ones(1, 32))[0, 0]
    angle = 1.5 * 2 * math.pi / 128
    torch.testing.assert_close(pooled, torch.tensor([math.cos(angle) + x, math.sin(angle)]))


def test_results_stay_on_the_device_of_the_observation() -> None:
    assert POLICY(observation(CLEAR).to("meta"))["action"].device.type == "meta"


def test_robot_lidar_and_slip_are_settings() -> None:
    x, y, z = ROVER_ZERO.lidar_position
    rear = replace(ROVER_ZERO, lidar_position=(x - 0.2, y, z))
    assert DynamicWindowPolicy(rear).made_for.robot == rear
    assert POLICY.made_for == EnvConfig(robot="rover_zero", lidar=LIDAR)
    # The same reading is closer to the center of a rover whose lidar is farther back.
    moved = POLICY.points(wall(0.7)) - DynamicWindowPolicy(rear).points(wall(0.7))
    torch.testing.assert_close(moved[0, 0], torch.tensor([0.2, 0.0]))
    # The odometry of a rover that slips less is closer to its motion.
    turning = torch.tensor([[0.0, 1.0]])
    grip, slip = (policy.trajectories(turning).heading.amax() for policy in (DynamicWindowPolicy(yaw_gain=1.0), POLICY))
    assert grip > slip
    again = pickle.loads(pickle.dumps(POLICY))
    assert torch.equal(action(wall(0.7), again), action(wall(0.7)))


def test_slip_out_of_range_is_refused() -> None:
    for gain in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="yaw_gain must be a positive number"):
            DynamicWindowPolicy(yaw_gain=gain)


def test_it_finds_most_goals_in_mazes_without_a_contact() -> None:
    episodes = draw_episodes("maze:0-2", count=1)
    driven = evaluate(DynamicWindowPolicy(), episodes, seconds=20, env=EnvConfig(backend="warp", lidar=LIDAR))
    assert driven.metrics["contact_free_success_rate"].value >= 2 / 3
