"""Different robots in the rows of one batch: draws, company, limits, worlds, and what a policy is told."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl import RoverEnv
from rover_rl.algos.config import training_config
from rover_rl.algos.train.run import prepare
from rover_rl.envs.config import ActionConfig, EnvConfig, Randomization, require_match
from rover_rl.envs.sensors.robot import RobotBody
from rover_rl.robots import get_robot, get_robots
from rover_rl.robots.turning import yaw_gain
from rover_rl.sims.free_space.fitting import passage_scale
from rover_rl.worlds import Terrain, World, box, get_world

ROBOTS = ("any:0-5", "leo", "husky", "racer", "rover_zero")
PLAIN = World("plain", Terrain.flat((24.0, 24.0)), [box((2.5, 1.5, 0.5), (1, 1, 1)), box((-2, 2.5, 0.5), (1, 2, 1))])


def make(rows: int, seed: int = 3, robot=ROBOTS, **settings) -> RoverEnv:
    return RoverEnv(**{"world_n": PLAIN, "num_envs": rows, "seed": seed, "backend": "warp", "robot": robot} | settings)


def drive(env: RoverEnv, actions: torch.Tensor, **places: torch.Tensor) -> torch.Tensor:
    """Returns poses and readings of each step, ``[steps, N, k]``."""
    td, records = env.reset(**places), []
    for action in actions:
        td = env.step(td.set("action", action))["next"]
        rover = env.rover_state
        records.append(torch.cat((rover.position, rover.orientation, td["velocities"], td["lidar"]), -1))
    return torch.stack(records)


def random_actions(steps: int, rows: int) -> torch.Tensor:
    unit = torch.rand(steps // 10, rows, 2, generator=torch.Generator().manual_seed(1)).repeat_interleave(10, 0)
    return torch.stack((3 * unit[..., 0] - 0.5, unit[..., 1] - 0.5), -1)


@pytest.mark.parametrize("world", [PLAIN, get_world("maze+walkers:3")])
def test_a_rover_drives_the_same_to_the_last_bit_alone_and_in_any_company(world):
    settings = {"world_n": world, "randomization": Randomization.typical(), "sensors": ["route"]}
    rows, actions = 4, random_actions(20, 4)
    env = make(rows, **settings)
    td = env.reset()
    start, goal = torch.cat((env.rover_state.position[:, :2], td["imu"][:, 2:]), -1), env.goal
    names = [robot.name for robot in env.fleet]
    assert len(set(names)) > 2
    together = drive(make(rows, **settings), actions, start=start, goal=goal)
    for row in (1, 3):
        places = {"start": start[row : row + 1], "goal": goal[row : row + 1]}
        # Movers keep a distance that is that of the largest robot.
        for robot in (ROBOTS, names[row])[: 2 if world is PLAIN else 1]:
            alone = drive(make(1, 3 + row, robot, **settings), actions[:, row : row + 1], **places)
            assert torch.equal(alone, together[:, row : row + 1])


def test_each_episode_draws_a_robot_by_its_seed_and_number():
    env, other = make(64), make(16, 3 + 8)
    seen = []
    for _ in range(3):
        td, _ = env.reset(), other.reset()
        assert list(other.fleet) == list(env.fleet)[8:24]
        seen.append([robot.name for robot in env.fleet])
    assert {name for names in seen for name in names} == {robot.name for robot in get_robots(ROBOTS)}
    assert len({tuple(names) for names in seen}) == 3
    env.reset(td.set("_reset", torch.arange(64)[:, None] < 8))
    now = [robot.name for robot in env.fleet]
    assert now[8:] == seen[-1][8:], "rows that are not reset keep their robots"
    assert now[:8] != seen[-1][:8]


@pytest.mark.parametrize("world", [PLAIN, ("maze:0-3", "rooms:0-3")])
def test_the_entries_of_a_list_have_equal_shares_of_the_episodes_and_a_range_shares_its_own(world):
    names = [robot.name for robot in make(1024, robot=("any:0-7", "leo", "racer"), world_n=world).fleet]
    counts = {name: names.count(name) for name in {*names}}
    assert counts.pop("leo") == pytest.approx(1024 / 3, abs=60)
    assert counts.pop("racer") == pytest.approx(1024 / 3, abs=60)
    assert len(counts) == 8
    assert all(20 <= count <= 70 for count in counts.values())


def test_actions_reach_the_speed_of_the_fastest_robot_and_each_robot_keeps_its_limits():
    env = make(12)
    space = env.action_spec.space
    assert space.high[0, 0] == max(robot.drive.max_speed for robot in get_robots(ROBOTS)) == -space.low[0, 0]
    td = env.reset()
    for _ in range(40):
        td = env.step(td.set("action", torch.tensor([10.0, 2.0]).expand(12, 2)))["next"]
        for row, robot in enumerate(env.fleet):
            speed, rate = td["velocities"][row].abs().tolist()
            assert speed <= 1.05 * robot.drive.max_speed
            assert rate <= 1.1 * robot.drive.max_yaw_rate + 0.1


def test_generated_worlds_are_as_wide_as_their_robots_need():
    env = RoverEnv(world_n="maze:0-1", num_envs=24, seed=0, backend="warp", robot="any:0-15")
    td = env.reset()
    scales = [float(name.partition("*")[2]) for name in env.pool.entries]
    assert len(scales) == 4
    for robot, index in zip(env.fleet, td["outcome", "world"].flatten().tolist(), strict=True):
        scale = float(env.pool.name(index).partition("*")[2])
        group = scales.index(scale)
        assert passage_scale(robot) <= scale
        assert group == 0 or passage_scale(robot) > scales[group - 1]
        assert robot.radius <= env.robot_in(env.pool[index]).radius
    narrow = RoverEnv(world_n="maze:0*1.3", num_envs=32, seed=0, backend="warp", robot="any:0-15")
    assert {passage_scale(robot) <= 1.3 for robot in narrow.fleet} == {True}


def test_the_sensor_tells_size_and_limits_of_each_robot():
    env = make(8, sensors=["robot"])
    told = env.reset()["robot"]
    for row, robot in enumerate(env.fleet):
        outline, drive = robot.footprint, robot.drive
        size = (-outline.back, outline.front, outline.half_width)
        limits = (drive.max_speed, drive.fastest_turn(robot.wheels), drive.min_radius(robot.wheels))
        turns = (drive.pivot(robot.wheels), yaw_gain(robot))
        assert told[row].tolist() == pytest.approx((*size, *limits, *turns, *robot.lidar_position, robot.lidar_view))
    alone = RoverEnv(sensors=["robot"], seed=0, backend="warp").reset()["robot"][0]
    rest = (yaw_gain(get_robot("rover_zero")), *get_robot("rover_zero").lidar_position, 2 * math.pi)
    assert alone[3:].tolist() == pytest.approx((1.0, 7.0, 0.0, 0.0, *rest))
    sensor, aside = RobotBody(), alone.clone()
    aside[9] = 0.1
    assert torch.equal(sensor.mirror(aside)[9], -aside[9])
    assert torch.equal(sensor.mirror(alone), alone)
    assert sensor.encode(told).abs().max() < 10


def test_a_policy_for_several_robots_drives_any_and_one_for_a_robot_does_not():
    several, one = EnvConfig(robot="any:0-3", sensors=("robot",)), EnvConfig(robot="husky", sensors=("robot",))
    require_match(several, one)
    with pytest.raises(ValueError, match=r"made for the robot husky, and the environment has any:0-3"):
        require_match(one, several)
    with pytest.raises(ValueError, match=r"made for actions of"):
        require_match(several, EnvConfig(robot="husky", sensors=("robot",), action=ActionConfig(max_speed=0.5)))
    config = training_config("ppo", robot="any:9998-10001", backend="warp", seed=0)
    with pytest.raises(ValueError, match=r"seeds from 10000 up are for evaluation.*'any:0-255', got 'any:10000'"):
        prepare(config)


@pytest.mark.parametrize(
    ("robot", "settings", "message"),
    [
        ("any:0-3", {"backend": "bullet"}, "several robots in one batch need a backend that simulates them: Bullet"),
        ("any:3-0", {}, "the ends of 'any:3-0' must be in order"),
        ("any:0-1024", {}, "robot must give 1 to 1024 robots, as 'any:0-255' does, got 1025"),
        ((), {}, "robot must be a name or a Robot, got tuple"),
        (("leo", "tank"), {}, "unknown robot 'tank'"),
        ("husky:3", {}, "robot 'husky:3' has a seed, and 'husky' is one robot"),
        ("any:0-3", {"action": ActionConfig(max_sideways=0.5)}, "max_sideways needs a drive that moves sideways"),
    ],
)
def test_robots_that_cannot_share_a_batch_are_refused_in_one_sentence(robot, settings, message):
    with pytest.raises(ValueError, match=message):
        make(2, robot=robot, **settings)


def test_each_seed_is_another_robot_and_always_the_same():
    robots = get_robots("any:0-15")
    assert len({robot.boxes for robot in robots}) == 16
    assert {type(robot.drive).__name__ for robot in robots} == {"SkidSteer", "Ackermann"}
    assert robots[7] == get_robot("any:7")
    with pytest.raises(ValueError, match="'any:0-15' names several robots, and one is needed here"):
        get_robot("any:0-15")
