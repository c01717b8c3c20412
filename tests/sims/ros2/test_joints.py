"""Motor torques of a live rover."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rover_rl import EnvConfig, RoverEnv
from rover_rl.envs.served_rover import ServedRover
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.ros2.joints import joint_state_message, read_efforts
from rover_rl.sims.ros2.messages import Header, JointState, decode, encode
from rover_rl.sims.ros2.robot import RobotNode
from rover_rl.worlds import get_world

LIVE = Ros2Settings(reset="none", settle=0.05, step_timeout=20.0)


def test_a_live_rover_reads_the_torques_of_a_simulated_one(wire):
    world, start = get_world("hills:3"), (1.0, 2.0, 0.7)
    robot = ServedRover(EnvConfig(world=world, seed=0, backend="warp", sensors=("effort",)))
    wire.rovers.append(RobotNode(robot, wire, 12.0, start=start).step)
    env = RoverEnv(world_n=world, backend=LIVE, seed=0, sensors=["effort"])
    env.reset()
    for _ in range(15):
        effort = env.step_commands(torch.tensor([[0.5, 0.0]]))["effort"]
        assert torch.equal(effort, robot.env.rover_state.wheel_torque[:, [0, 2, 1, 3]])
    assert effort.abs().max() > 0.5
    env.close(), robot.close()


def test_wheels_are_told_by_their_names():
    sent = joint_state_message(("front_left", "rear_left"), torch.tensor([1.5, -2.0]), Header().stamp)
    received = decode(JointState, encode(sent))
    received.name, received.effort = ["arm", *received.name], np.array([9.0, *received.effort])
    assert read_efforts(received, ("rear_left", "front_left")).tolist() == [-2.0, 1.5]


@pytest.mark.parametrize(
    ("joints", "message"),
    [
        ({"name": ["a"], "effort": [1.0]}, r"^the joint state lacks the wheels \['b'\]: it has \['a'\]$"),
        ({"name": ["a", "b"], "effort": []}, "^the joint state has 0 efforts of 2 joints$"),
        ({"name": ["a", "b"], "effort": [1.0, float("nan")]}, "^a torque must be finite"),
    ],
)
def test_unusable_joint_states_are_refused(joints, message):
    with pytest.raises(ValueError, match=message):
        read_efforts(JointState(**joints), ("a", "b"))
