"""The dynamic-window planner drives to goals, and takes no trajectory that hits a reading if one is free."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.algos.policy.dwa import LIDAR, DynamicWindowPolicy
from rover_rl.envs.config import EnvConfig, HeadingGains, LidarConfig
from rover_rl.robots.built_in import ROVER_ZERO
from rover_rl.robots.turning import YAW_GAIN
from rover_rl.rotations import quaternion_to_euler, wrap_angle
from tests.algos.policy.crossings import reached

POLICY = DynamicWindowPolicy()
CLEAR = torch.full((1, 128), 12.0)


def action(lidar: Tensor, distance=5.0, degrees=0.0, velocities=(0.0, 0.0), policy=POLICY) -> Tensor:
    target, motion = torch.tensor([[distance, math.radians(degrees)]]), torch.tensor([velocities])
    return policy(TensorDict({"lidar": lidar, "target": target, "velocities": motion}, [1]))["action"][0]


def wall(distance: float, degrees: float = 0.0) -> Tensor:
    """Readings of a long wall ``distance`` m from the lidar, in the direction ``degrees``."""
    angle = torch.arange(128) * (2 * math.pi / 128) - math.radians(degrees)
    return torch.where(angle.cos() > 0.05, distance / angle.cos().clamp(min=0.05), 12.0).clamp(max=12.0)[None]


@pytest.mark.parametrize("degrees", [-150, -20, 0, 60])
def test_it_drives_to_a_goal_on_open_ground_and_around_a_wall_on_its_side(degrees: float) -> None:
    speed, heading = action(CLEAR, degrees=degrees).tolist()
    assert heading * degrees > 0 or (speed, heading) == pytest.approx((1.0, 0.0), abs=1e-6)
    if abs(degrees) == 20:
        speed, heading = action(wall(0.9), degrees=degrees, velocities=(0.5, 0.0))
        assert heading * degrees > 0
        assert speed < 1


def test_it_keeps_its_speed_beside_a_wall_and_backs_off_or_turns_on_the_spot_between_walls() -> None:
    assert action(wall(0.6, 90), velocities=(1.0, 0.0))[0] == pytest.approx(1.0)
    speed, heading = action(wall(1.5), distance=1.0)
    assert speed > 0.6, "the goal is in front of the wall"
    assert abs(heading) < 0.2
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


def is_hit(points: Tensor, policy: DynamicWindowPolicy, motion: Tensor, margin: float) -> Tensor:
    """Whether the footprint, grown by ``margin`` (m), contains a point on each trajectory, bool ``[N, S]``."""
    back, front, right, left = ROVER_ZERO.footprint
    sampled = policy.trajectories(motion)
    x, y, heading = (value[..., None] for value in (sampled.x, sampled.y, sampled.heading))
    dx, dy = points[:, None, None, :, 0] - x, points[:, None, None, :, 1] - y
    ahead, aside = heading.cos() * dx + heading.sin() * dy, heading.cos() * dy - heading.sin() * dx
    inside = (ahead > back - margin) & (ahead < front + margin) & (aside > right - margin) & (aside < left + margin)
    return inside.any(-1).any(-1)


@pytest.mark.parametrize("count", [16, 128])
def test_it_takes_no_trajectory_that_hits_a_reading_if_one_is_free_and_rows_are_independent(count: int) -> None:
    draws = torch.Generator().manual_seed(count)
    # Readings of at least 0.6 m, so that the body is free where it is: its rear end is 0.44 m from the lidar.
    lidar = (0.6 + 2.4 * torch.rand(60, 16, generator=draws)).repeat_interleave(count // 16, -1)
    target, motion = torch.rand(2, 60, 2, generator=draws)
    target, motion = target * torch.tensor([6.0, 6.2]), motion * torch.tensor([1.3, 6.0]) - torch.tensor([0.3, 3.0])
    policy = DynamicWindowPolicy(lidar=LidarConfig(points=count))
    rows = TensorDict({"lidar": lidar, "target": target, "velocities": motion}, [60])
    chosen = policy(rows.clone())["action"]
    assert (chosen.abs() <= torch.tensor([1.0, math.pi])).all()
    sampled, points = policy.trajectories(motion), policy.points(lidar)
    pairs = torch.stack((sampled.speed, sampled.yaw_rate / (YAW_GAIN * HeadingGains.kp)), -1)
    taken = (pairs - chosen[:, None]).abs().amax(-1).argmin(-1, keepdim=True)
    # The discs that cover the footprint reach up to 13 cm over its ends.
    is_free, hits = (~is_hit(points, policy, motion, 0.14)).any(-1), is_hit(points, policy, motion, 0.0)
    assert is_free.any()
    assert hits.any(-1).sum() > 5
    assert not hits.gather(-1, taken)[is_free].any()
    assert len(chosen.unique(dim=0)) > 10
    for row in range(0, 60, 7):
        assert torch.equal(policy(rows[row : row + 1].clone())["action"][0], chosen[row])


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


def test_robot_lidar_and_slip_are_settings() -> None:
    x, y, z = ROVER_ZERO.lidar_position
    rear = DynamicWindowPolicy(replace(ROVER_ZERO, lidar_position=(x - 0.2, y, z)))
    assert POLICY.made_for == EnvConfig(robot="rover_zero", lidar=LIDAR)
    # The same reading is closer to the center of a rover whose lidar is farther back.
    torch.testing.assert_close((POLICY.points(CLEAR / 2) - rear.points(CLEAR / 2))[0, 0], torch.tensor([0.2, 0.0]))
    # The odometry of a rover that slips less is closer to its motion.
    turning = torch.tensor([[0.0, 1.0]])
    grip, slip = (policy.trajectories(turning).heading.amax() for policy in (DynamicWindowPolicy(yaw_gain=1.0), POLICY))
    assert grip > slip
    assert torch.equal(action(wall(0.7), policy=pickle.loads(pickle.dumps(POLICY))), action(wall(0.7)))
    for gain in (0.0, math.inf, math.nan):
        with pytest.raises(ValueError, match="yaw_gain must be a positive number"):
            DynamicWindowPolicy(yaw_gain=gain)


def test_it_reaches_goals_in_mazes_without_a_contact() -> None:
    assert reached(POLICY, "maze:0-1", 2, 20.0) >= 1
