"""The sensed pose: true, dead reckoning, or with the error of a localization."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl import RoverEnv
from rover_rl.envs.config import LidarConfig, PoseConfig, Randomization
from rover_rl.worlds import Terrain, World

LEVEL = World("level", Terrain.flat((16, 16)))
X = torch.arange(33) * 0.5 - 8
HILLSIDE = World("hillside", Terrain((math.tan(math.radians(12)) * X).expand(33, -1), 0.5))


def make(source="localized", world=LEVEL, num_envs=1, friction=1.0, **settings):
    options = {"pose": PoseConfig(source, **settings), "randomization": Randomization(friction=(friction, friction))}
    lidar = LidarConfig(points=8, beams=8)
    return RoverEnv(world=world, num_envs=num_envs, seed=0, backend="warp", lidar=lidar, **options)


def drive(env, steps, speed=0.0, turn=0.0, yaw=0.0):
    """Returns the sensed and the true positions ``[N, steps + 1, 2]`` of rovers that start in the middle."""
    rows = env.num_envs
    td = env.reset(start=torch.tensor([[0.0, 0.0, yaw]]).expand(rows, 3), goal=torch.full((rows, 2), 6.0))
    sensed, true = [td["pose"]], [env.rover_state.position]
    for _ in range(steps):
        td = env.step(td.set("action", torch.tensor([[speed, turn]]).expand(rows, 2)))["next"]
        sensed.append(td["pose"])
        true.append(env.rover_state.position)
    return torch.stack(sensed, 1)[..., :2], torch.stack(true, 1)[..., :2]


def test_dead_reckoning_agrees_with_the_truth_without_slip_and_drifts_with_it():
    sensed, true = drive(make("odometry"), 60, speed=1.0)
    way = (true[0, -1] - true[0, 0]).norm()
    assert way > 2.5
    assert (sensed - true)[0, -1].norm() < 0.01 * way
    # Across a slippery slope, the rover slides down, which no wheel notices.
    env = make("odometry", HILLSIDE, friction=0.25)
    sensed, true = drive(env, 140, speed=0.5, yaw=math.pi / 2)
    assert (sensed - true)[0, -1].norm() > 0.05
    assert (sensed - true)[0, -1].norm() > 2 * (sensed - true)[0, 50].norm()
    # A new episode begins at the true pose.
    assert torch.equal(*drive(env, 0, yaw=1.0))


def test_errors_of_localization_have_the_given_spread_and_drift_in_the_given_time():
    sensed, true = drive(make(num_envs=4096, drift=0.2, drift_time=0.5, jump=0.0), 10)
    error = sensed - true
    torch.testing.assert_close(error.std((0, 1)), torch.full((2,), 0.2), rtol=0.05, atol=0)
    # After 10 steps of 0.05 s, which is the drift time, 1/e is left.
    correlation = (error[:, 0] * error[:, 10])[:, 0].mean() / error[:, 0, 0].square().mean()
    assert correlation.item() == pytest.approx(math.exp(-1), abs=0.05)


def test_errors_of_localization_jump_at_the_given_rate_and_spread():
    sensed, true = drive(make(num_envs=2048, drift=0.0, drift_heading=0.0, jump=0.3, jump_rate=2.0), 20)
    error = (sensed - true)[..., 0]
    jumps = (error.diff(dim=1).abs() > 1e-5).float().mean()
    assert jumps.item() / 0.05 == pytest.approx(2.0, rel=0.05)
    assert error.std().item() == pytest.approx(0.3, rel=0.05)


@pytest.mark.parametrize("heading", ["drift_heading", "jump_heading"])
def test_the_heading_of_a_localization_turns_the_target(heading):
    exact = {"drift": 0.0, "drift_heading": 0.0, "jump": 0.0, "jump_rate": 0.0}
    env = make(num_envs=4096, **exact | {heading: 0.1})
    td = env.reset(start=torch.zeros(4096, 3), goal=torch.tensor([[5.0, 0.0]]).expand(4096, 2))
    assert td["target"][:, 1].std().item() == pytest.approx(0.1, rel=0.05)
    # The heading of the IMU is in the frame of the pose, as that of a live rover.
    assert td["imu"][:, 2].std().item() == pytest.approx(0.1, rel=0.05)


def test_either_source_is_drawn():
    sensed, true = drive(make("either", num_envs=64, drift=0.3, jump=0.0), 0)
    assert 16 < (sensed == true).all(-1).sum() < 48


@pytest.mark.parametrize("source", ["odometry", "localized"])
def test_a_policy_that_ignores_the_pose_is_unaffected(source):
    _, plain = drive(make("truth", "maze"), 20, 1.0, turn=0.4)
    _, other = drive(make(source, "maze"), 20, 1.0, turn=0.4)
    assert torch.equal(plain, other)


def test_the_target_is_that_of_the_sensed_pose_and_events_are_of_the_true_one():
    env = make(drift=2.0, drift_heading=0.0, jump=0.0)
    td = env.reset(start=torch.zeros(1, 3), goal=torch.tensor([[0.3, 0.0]]))
    offset = torch.tensor([[0.3, 0.0]]) - td["pose"][:, :2]
    torch.testing.assert_close(td["target"][:, 0], offset.norm(dim=-1))
    # The goal is within reach of the true pose, and not of the sensed one.
    td = env.step(td.set("action", torch.zeros(1, 2)))["next"]
    assert td["outcome", "goal_reached"].item()
