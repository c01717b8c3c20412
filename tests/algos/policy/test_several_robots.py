"""``SeveralRobots``: baselines that drive a batch of different robots."""

from __future__ import annotations

import pytest
import torch

from rover_rl import EnvConfig, RoverEnv
from rover_rl.algos.policy.names import make_baseline
from rover_rl.algos.policy.runner import PolicyRunner, sensors_for

ROBOTS = ("jackal", "racer")


@pytest.mark.parametrize("name", ["scripted", "gridplanner", "dwa", "expert"])
def test_each_robot_is_driven_as_by_the_baseline_for_it_alone(name):
    several = make_baseline(name, ROBOTS)
    env = RoverEnv(sensors_for(several, EnvConfig(robot=ROBOTS, world="forest:0", num_envs=8, seed=1, backend="warp")))
    observation = env.reset()
    action = PolicyRunner(several, env=env)(observation)
    alone = {robot: PolicyRunner(make_baseline(robot=robot, name=name), env=env)(observation) for robot in ROBOTS}
    drives = [robot.name for robot in env.fleet]
    assert {*drives} == {*ROBOTS}
    torch.testing.assert_close(action, torch.stack([alone[robot][row] for row, robot in enumerate(drives)]))
    env.close()
