"""What the sensors tell, what is true, and which of them events, rewards and critics know."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from rover_rl import RewardComponent, RoverEnv, make_env
from rover_rl.envs.config import Randomization
from rover_rl.rotations import quaternion_to_euler

NOISY = Randomization(range_noise=0.3, dropout=0.2, odometry_noise=0.3, imu_noise=0.2)
ROWS = 8


def rollouts(**settings):
    """A rollout of random actions, and the states after its last step."""
    env = RoverEnv(world_n="maze", num_envs=ROWS, seed=3, backend="warp", **settings)
    generator = torch.Generator().manual_seed(0)

    def policy(td):
        return td.set("action", torch.rand(ROWS, 2, generator=generator) * 2 - 1)

    return env.rollout(40, policy, break_when_any_done=False), env


def test_states_are_the_same_without_noise():
    env = RoverEnv(world_n="maze", num_envs=ROWS, seed=3, backend="warp")
    env.step(env.rand_action(env.reset()))
    assert env.state.sensed.rover is env.rover_state


def test_observations_are_sensed_and_outcomes_are_true_or_follow_the_sensors_as_on_a_live_robot():
    by_truth, env = rollouts(randomization=NOISY)
    truth, sensed = env.rover_state, env.state.sensed.rover
    assert not torch.equal(env.scan, env.state.sensed.ranges)
    assert torch.equal(truth.position, sensed.position)
    last = by_truth[:, -1]["next"]
    assert torch.equal(last["velocities"][:, :1], sensed.linear_velocity)
    assert torch.equal(last["outcome", "linear_velocity"], truth.linear_velocity)
    assert torch.equal(last["lidar"], env.lidar(env.state.sensed.ranges))
    collision = env.lidar(env.scan).amin(-1, keepdim=True) < env.config.task.collision_threshold
    assert torch.equal(last["outcome", "collision"], collision)
    by_sensors, env = rollouts(randomization=NOISY, outcome_from="sensors")
    last = by_sensors[:, -1]["next"]
    assert torch.equal(last["outcome", "linear_velocity"], env.state.sensed.rover.linear_velocity)
    collision = last["lidar"].amin(-1, keepdim=True) < env.config.task.collision_threshold
    assert torch.equal(last["outcome", "collision"], collision)
    assert not torch.equal(env.state.sensed.rover.linear_velocity, env.rover_state.linear_velocity)
    # The source of the outcome changes nothing else.
    ended = (by_truth["next", "done"] | by_sensors["next", "done"]).squeeze(-1)
    running = ended.cumsum(1) - ended.long() == 0
    assert running.sum() > ROWS
    for key in ("lidar", "imu", "velocities"):
        assert torch.equal(by_truth[key][running], by_sensors[key][running])


def test_the_privileged_observation_holds_the_truth():
    drawn = Randomization(
        friction=(0.5, 1.5), chassis_mass=(0.8, 1.2), motor_torque=(0.5, 1.0), latency=(1, 3), imu_noise=0.2
    )
    settings = {"num_envs": ROWS, "seed": 0, "backend": "warp", "randomization": drawn}
    env = make_env(world_n=["maze", "moon"], privileged=True, **settings)
    check_env_specs(env)
    td = env.reset()
    privileged = td["privileged"]
    rovers = env.base_env
    assert torch.equal(privileged["position"], rovers.rover_state.position)
    assert not torch.equal(privileged["attitude"][:, 2:], td["imu"][:, 2:])
    straight = (rovers.goal - rovers.rover_state.position[:, :2]).norm(dim=-1, keepdim=True)
    torch.testing.assert_close(privileged["target"][:, :1], straight)
    # Distances end at the nearest of points 0.5 m apart, and begin in the middle of a cell.
    assert (privileged["path_distance"] > straight - 0.6).all()
    assert (privileged["path_distance"] > straight + 1.0).any()
    for key, (low, high) in (("friction", (0.5, 1.5)), ("chassis_mass", (0.8, 1.2)), ("motor_torque", (0.5, 1.0))):
        assert ((privileged[key] >= low) & (privileged[key] <= high)).all()
        assert privileged[key].std() > 0
    assert set(privileged["latency"].flatten().tolist()) == {1.0, 2.0, 3.0}


def test_the_privileged_observation_tells_what_moves():
    env = RoverEnv(world_n=["field:3@1", "maze"], num_envs=4, seed=0, backend="warp", privileged=True)
    movers = env.reset()["privileged", "movers"].unflatten(-1, (-1, 5))
    assert not movers[2:].any()
    state, rover = env.movers.state, env.rover_state
    for row in range(2):
        yaw = quaternion_to_euler(rover.orientation)[row, 2]
        for x, y, speed_x, speed_y, radius in movers[row].tolist():
            turn = torch.stack((torch.stack((yaw.cos(), -yaw.sin())), torch.stack((yaw.sin(), yaw.cos()))))
            place = turn @ torch.tensor([x, y]) + rover.position[row, :2]
            nearest = (state.position[row] - place).norm(dim=-1).argmin()
            torch.testing.assert_close(state.position[row, nearest], place, atol=1e-4, rtol=0)
            expected = turn @ torch.tensor([speed_x, speed_y])
            torch.testing.assert_close(state.velocity[row, nearest], expected, atol=1e-4, rtol=0)
            assert radius == pytest.approx(env.movers.radius[row, nearest].item())
    distance = movers[:2, :, :2].norm(dim=-1) - movers[:2, :, 4]
    assert distance.amin(1).tolist() == pytest.approx(
        env.movers.nearest(rover.position[:, :2])[0][:2, 0].tolist(), abs=0.3
    )


def test_there_is_no_privileged_observation_unless_asked_for():
    assert "privileged" not in RoverEnv(world_n="maze", backend="warp").observation_spec.keys()  # noqa: SIM118
    single = RoverEnv(world_n="maze", num_envs=None, backend="warp", privileged=True).reset()
    assert single["privileged", "path_distance"].shape == (1,)


def test_a_reward_follows_the_truth():
    class Speed(RewardComponent):
        name = "speed"

        def value(self, outcome, observation):
            return outcome["linear_velocity"]

    env = make_env(world_n="maze", num_envs=ROWS, seed=3, backend="warp", reward=[Speed()], randomization=NOISY)
    td = env.step(env.reset().set("action", torch.ones(ROWS, 2)))["next"]
    assert torch.equal(td["reward"], env.base_env.rover_state.linear_velocity)
