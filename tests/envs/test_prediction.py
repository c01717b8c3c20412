"""Late sensors that are carried on to now: the predicted state is near the true one, and scans are where they were."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from rover_rl import Randomization, RoverEnv
from rover_rl.envs.config import LidarConfig
from rover_rl.envs.sensors.standard import taken_at
from rover_rl.rotations import wrap_angle
from rover_rl.worlds import Terrain, World

FLAT = World("flat", Terrain.flat((24.0, 24.0)))
LATE = Randomization(scan_latency=(0, 5), state_latency=(0, 3), latency=(1, 1))
KEYS = ("pose", "imu", "velocities", "target", "lidar", "scan_pose")
STEPS = 24


def driven(rows: int = 12, randomization: Randomization = LATE, **settings: Any) -> tuple[TensorDict, Tensor, Tensor]:
    """Observations ``[STEPS, rows]`` on curves that change, true x, y, yaw, speed and yaw rate, and delays of poses."""
    lidar = LidarConfig(points=8, beams=8)
    options = {"world": FLAT, "backend": "warp", "seed": 3, "lidar": lidar, "randomization": randomization, **settings}
    env = RoverEnv(num_envs=rows, **options)
    td, seen, truth = env.reset(), [], []
    for step in range(STEPS):
        turn = 1.2 if step < STEPS // 2 else -0.8
        td = env.step(td.set("action", torch.tensor([(0.9, turn)]).expand(rows, 2)))["next"]
        state, pose = env.state.sensed.rover, env.state.pose
        seen.append(td.select(*KEYS, "outcome", strict=False))
        truth.append(torch.cat((pose.position[:, :2], pose.yaw, state.linear_velocity, state.angular_velocity), -1))
    delay = torch.zeros(rows) if env.delays is None else env.delays.state.squeeze(-1)
    return torch.stack(seen), torch.stack(truth), delay


def errors(seen: TensorDict, truth: Tensor) -> Tensor:
    """Root mean square errors of place, heading, speed and yaw rate of each row, ``[rows, 4]``."""
    place = (seen["pose"][..., :2] - truth[..., :2]).norm(dim=-1, keepdim=True)
    heading = wrap_angle(seen["imu"][..., 2:] - truth[..., 2:3])
    return torch.cat((place, heading, seen["velocities"] - truth[..., 3:]), -1).square().mean(0).sqrt()


@pytest.mark.parametrize("robot", ["rover_zero", "hunter"])
def test_the_predicted_state_is_near_the_true_one(robot):
    late, truth, delay = driven(robot=robot)
    predicted, same, _ = driven(robot=robot, compensate_delay=True)
    assert torch.equal(truth, same)
    is_late = delay > 0
    assert {*delay.tolist()} == {0.0, 1.0, 2.0, 3.0}
    assert (errors(predicted, truth)[is_late] < 0.25 * errors(late, truth)[is_late]).all()
    assert torch.allclose(predicted["pose"][:, ~is_late], late["pose"][:, ~is_late])
    # The goal is where it is from there: as far and in the direction in which it is from the true pose.
    exact = driven(robot=robot, randomization=Randomization(latency=(1, 1)))[0]["target"]
    assert (predicted["target"][..., 0] - exact[..., 0]).abs().mean() < 0.02
    # Late scans are where they were, as seen from the predicted pose.
    (place, attitude), (then, tilt) = taken_at(predicted), taken_at(late)
    assert torch.allclose(place, then, atol=1e-4)
    assert wrap_angle(attitude - tilt).abs().max() < 1e-4


def test_a_row_is_predicted_as_alone_also_of_several_robots():
    together, alone = driven(4, compensate_delay=True)[0], driven(1, compensate_delay=True)[0]
    assert all(torch.equal(together[key][:, :1], alone[key]) for key in KEYS)
    robots = {"robot": ("leo", "hunter"), "world": "maze:10001"}
    (late, _, delay), (predicted, truth, _) = (driven(6, compensate_delay=on, **robots) for on in (False, True))
    is_late = delay > 0
    assert (errors(predicted, truth)[is_late, 2:] < 0.25 * errors(late, truth)[is_late, 2:]).all()


def test_without_late_sensors_nothing_changes():
    plain, on = (driven(2, Randomization(), compensate_delay=on)[0] for on in (False, True))
    assert all(torch.equal(plain[key], on[key]) for key in KEYS[:-1])


def test_a_reset_of_some_rows_begins_there_anew():
    env = RoverEnv(world=FLAT, num_envs=2, backend="warp", seed=0, randomization=LATE, compensate_delay=True)
    td = env.reset()
    for _ in range(6):
        td = env.step(td.set("action", torch.tensor([(1.0, 1.0)]).expand(2, 2)))["next"]
    before = td.clone()
    td = env.reset(td.set("_reset", torch.tensor([[True], [False]])))
    assert torch.allclose(td["pose"][0], env.rover_state.position[0], atol=1e-5)
    assert td["velocities"][0].abs().max() < 1e-5
    assert torch.equal(td["pose"][1], before["pose"][1])
