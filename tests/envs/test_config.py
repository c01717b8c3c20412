"""``EnvConfig``: its names, checks, files, and the policies that match it."""

from __future__ import annotations

import inspect
import math
import pickle
import subprocess
import sys
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl import RewardConfig, RoverEnv, contract_reward, make_env
from rover_rl.envs import config as settings_of
from rover_rl.envs.config import (
    ActionConfig,
    EnvConfig,
    GuardConfig,
    HeadingGains,
    LidarConfig,
    PoseConfig,
    Randomization,
    TaskConfig,
    env_from_plain,
    plain_env,
    require_match,
)
from rover_rl.robots import RobotOptions, get_robot
from rover_rl.sims.bullet import BulletSettings
from rover_rl.sims.settings import Connection
from rover_rl.worlds import get_world
from tests.traced import files_that

factors = st.floats(0.1, 10.0).flatmap(lambda low: st.tuples(st.just(low), st.floats(low, 20.0)))
tasks = st.builds(TaskConfig, stuck_window=st.integers(1, 1000), collision_from=st.sampled_from(["lidar", "contact"]))
views = st.none() | st.just((2.0, 3.0))
configs = st.builds(
    EnvConfig,
    world=st.sampled_from(["maze", "moon:7", ("maze", "inspect")]),
    lidar=st.builds(LidarConfig, st.integers(1, 64), st.integers(64, 640), st.floats(0.1, 100.0)),
    action=st.builds(ActionConfig, st.none() | st.floats(-3.0, 0.0), st.none() | st.floats(0.1, 3.0)),
    task=tasks,
    reward=st.sampled_from(["contract", "task", ("contract", "my_package:tilt")]),
    contract_reward=st.builds(RewardConfig, st.floats(-1e3, 1e3), clearance_penalty=st.floats(-1.0, 0.0)),
    randomization=st.builds(Randomization, friction=factors, lidar_view=views, dead_sectors=st.integers(0, 3)),
    backend=st.sampled_from(["bullet", "warp", "my_package:Slow", BulletSettings(substeps=20)]),
    num_envs=st.none() | st.integers(1, 100),
    seed=st.none() | st.integers(0, 2**40),
    device=st.none() | st.just("cuda:1"),
)


@settings(deadline=None, max_examples=25)
@given(configs)
def test_a_description_comes_back_from_yaml_and_from_pickle(config: EnvConfig) -> None:
    assert env_from_plain(yaml.safe_load(yaml.safe_dump(plain_env(config))), "text") == config
    assert pickle.loads(pickle.dumps(config)) == config


def test_a_description_and_arguments_by_either_name_make_the_same_environment() -> None:
    parts: dict[str, Any] = {"lidar": LidarConfig(16, 64, 9.0), "connection": Connection("/front/scan", timeout=3.0)}
    task, common = TaskConfig(success_distance=0.7), {"num_envs": 3, "seed": 5, "length": 7, "backend": "warp"}
    config = EnvConfig(world="maze", task=task, **parts, **common)
    lidar = {"lidar_points": 16, "lidar_beams": 64, "max_lidar_range": 9.0}
    live = {"scan_topic": "/front/scan", "connection_check_timeout": 3.0}
    described, argued = make_env(config), make_env(world_n="maze", task=task, **lidar, **live, **common)
    assert described.config == argued.config == config
    stated = replace(task, collision_threshold=0.3)
    torch.manual_seed(0)
    expected = described.rollout(10, break_when_any_done=False)
    torch.manual_seed(0)
    assert (argued.rollout(10, break_when_any_done=False) == expected).all()
    # The bare environment has the threshold of its robot.
    bare = described.base_env.config
    assert RoverEnv(bare).config == bare == replace(config, reward="task", task=stated)
    rewarded = make_env(world_n="maze", backend="warp", reward=RewardConfig(goal_reward=7.0))
    assert rewarded.config.contract_reward == RewardConfig(goal_reward=7.0)


def test_help_has_the_description_of_every_setting() -> None:
    text = RoverEnv.__doc__ or ""
    assert all(f"\n- ``{item.name}``: " in text for item in fields(EnvConfig))
    assert "\n- ``lidar.points``: Number of readings in an observation" in text
    shown = inspect.signature(make_env).parameters
    assert {item.name for item in fields(EnvConfig)} <= shown.keys()
    assert (shown["lidar_points"].default, shown["length"].default) == (32, 2000)


def test_a_description_passes_few_files_on_its_way_to_the_first_observation() -> None:
    """Of those files, each handles the description, or a part of it."""
    parts = (settings_of.Settings, RobotOptions, Connection)
    config = EnvConfig(world="moon", backend="warp", num_envs=2, seed=0)
    files = files_that(lambda: make_env(config).reset(), lambda values: any(isinstance(one, parts) for one in values))
    assert "envs/config.py" in files
    assert len(files) <= 20, sorted(files)


@pytest.mark.parametrize(
    ("make", "config", "arguments", "message"),
    [
        (make_env, (), {"world": "maze", "world_n": "moon"}, "world_n and another argument set world: give one of"),
        (make_env, (), {"lidar": LidarConfig(), "lidar_points": 16}, "lidar_points and another argument set lidar"),
        (make_env, (), {"wrld": "maze"}, "there is no setting 'wrld', perhaps 'world'"),
        (RoverEnv, (EnvConfig(),), {"num_envs": 4}, "an EnvConfig is given alone"),
    ],
)
def test_arguments_that_do_not_go_together_are_refused(make: Any, config: Any, arguments: Any, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        make(*config, **arguments)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: EnvConfig(lidar=[1, 2]), "^lidar must be a LidarConfig, got list "),
        (lambda: EnvConfig(connection=None), "^connection must be a Connection, got NoneType "),
        (lambda: EnvConfig(outcome_from="luck"), "outcome_from must be one of"),
        (lambda: EnvConfig(world=3), "^world must be a name, a World, or a list of them, got 3$"),
        (lambda: get_robot(3), "^robot must be a name or a Robot, got int 3$"),
        (lambda: EnvConfig(num_envs=2.0), "num_envs must be a whole number or None, got 2.0"),
        (lambda: EnvConfig(num_envs=np.bool_(True)), "num_envs must be a whole number or None"),
        (lambda: EnvConfig(end_on_goal="yes"), "end_on_goal must be True or False, got 'yes'"),
        (lambda: EnvConfig(control_rate=True), "control_rate must be a number or None, got True"),
        (lambda: LidarConfig(beams=np.float32(128)), "beams must be a whole number"),
        (lambda: TaskConfig(success_distance="0.5"), "success_distance must be a number, got '0.5'"),
        (lambda: Randomization(friction=(1, 2, 3)), "friction must be two numbers"),
        (lambda: HeadingGains(kp=np.ones(1)), "kp must be a number"),
        (lambda: BulletSettings(substeps=2.5), "substeps must be a whole number, got 2.5"),
        (lambda: Randomization(friction=(1.5, 0.5)), "friction must be a range .* of positive factors"),
        (lambda: Randomization(chassis_mass=(0.0, 1.0)), "chassis_mass must be a range .* of positive factors"),
        (lambda: Randomization(motor_torque=(1.0, math.inf)), "motor_torque must be a range .* of positive factors"),
        (lambda: Randomization(latency=(-1, 2)), "latency must be a range .* of control steps"),
        (lambda: Randomization(latency=(0.5, 1.5)), "latency must be two whole numbers"),
        (lambda: Randomization(range_noise=-0.1), "range_noise must be at least 0 and at most 1e.30, got -0.1"),
        (lambda: Randomization(imu_noise=math.nan), "imu_noise must be at least 0 and at most 1e.30, got nan"),
        (lambda: Randomization(dropout=1.0), "dropout must be at least 0 and less than 1, got 1.0"),
        (
            lambda: Randomization(lidar_view=(3.0, 2.0)),
            r"^lidar_view must be a range .* of at most 2 pi rad, got \(3.0, 2.0\)$",
        ),
        (lambda: Randomization(lidar_view=(1.0, 7.0)), "^lidar_view must be a range"),
        (lambda: Randomization(dead_sectors=-1), "^dead_sectors must be at least 0 and at most 16, got -1$"),
        (
            lambda: Randomization(dead_sector_width=(-0.1, 0.2)),
            r"^dead_sector_width must be a range .* got \(-0.1, 0.2\)$",
        ),
        (
            lambda: Randomization(lidar_min_range=(0.3, 0.2)),
            r"^lidar_min_range must be a range .* of distances, m, got \(0.3, 0.2\)$",
        ),
        (lambda: PoseConfig(source="gps"), "source must be one of .*'odometry'.*, got 'gps'"),
        (lambda: PoseConfig(drift=-1.0), "drift must be at least 0"),
        (lambda: PoseConfig(drift_time=0.0), "drift_time must be positive"),
        (lambda: PoseConfig(jump_rate=math.nan), "jump_rate must be at least 0"),
        (lambda: GuardConfig(approach=-1.0), "approach must be at least 0"),
    ],
)
def test_values_of_another_type_and_out_of_range_are_refused_at_once(make: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        make()


def test_speeds_that_are_not_stated_are_those_of_the_robots_drive() -> None:
    rover = get_robot("rover_zero")
    slow = replace(rover, name="slow", drive=replace(rover.drive, max_speed=0.4, max_yaw_rate=0.8))
    env = RoverEnv(world_n="maze", robot=slow, seed=0, backend="warp")
    assert [bound[0, 0].item() for bound in (env.action_spec.space.low, env.action_spec.space.high)] == [
        pytest.approx(-0.4),
        pytest.approx(0.4),
    ]
    td = env.reset()
    for _ in range(20):
        td = env.step(td.set("action", torch.tensor([[2.0, math.pi / 2]])))["next"]
    assert td["velocities"][0].tolist() == pytest.approx([0.4, 0.8], abs=0.02)
    stated = ActionConfig(min_speed=-1.0, max_speed=1.0)
    assert ActionConfig().for_robot("rover_zero") == stated == replace(stated.for_robot(slow), max_turn=math.pi)
    # At this heading offset, the robot turns as fast as it can.
    assert stated.for_robot(slow).max_turn == 0.4
    assert EnvConfig(robot=slow, action=ActionConfig(min_speed=0.0)).bounded_action.max_speed == 0.4
    with pytest.raises(ValueError, match="min_speed must be less than max_speed, both finite, got 0.5 and 0.4"):
        EnvConfig(robot=slow, action=ActionConfig(min_speed=0.5))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"wrld": 1}, r"^file: there is no setting wrld; use some of \['action', .*'world'\]$"),
        ({"lidar": {"points": "3"}}, r"^lidar.points in file: a value of type int is needed, got '3'$"),
        ({"lidar": {"point": 3}}, r"^lidar in file: there is no setting point; use some of"),
        ({"task": {"stuck_window": 0}}, r"^task in file: stuck_window must be positive"),
        ({"outcome_from": "luck"}, r"^outcome_from in file: one of \['truth', 'sensors'\] is needed, got 'luck'$"),
        ({"length": True}, r"^length in file: a value of type int is needed, got True$"),
        ({"backend": {"bullet": {"substeps": 3}}}, r"^backend bullet in file: substeps must be an even number"),
        ({"backend": {"gazebo": {}}}, r"^unknown backend 'gazebo'"),
        ([1], r"^file must hold settings by name, got \[1\]$"),
    ],
)
def test_a_file_that_describes_no_environment_is_refused_in_one_sentence(data: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message) as error:
        env_from_plain(data, "file")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (EnvConfig(world=get_world("maze")), "a World cannot be written to a file"),
        (EnvConfig(robot=get_robot("rover_zero")), "a Robot cannot be written to a file"),
        (EnvConfig(reward=contract_reward()), "a reward object cannot be written to a file"),
    ],
)
def test_objects_are_refused_where_only_names_can_be_written(config: EnvConfig, message: str) -> None:
    with pytest.raises(ValueError, match=rf"{message}.*register it, or name it as module:attribute"):
        plain_env(config)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lidar": LidarConfig(points=16)}, "made for lidar points 32, and the environment has 16"),
        ({"lidar": LidarConfig(max_range=6.0)}, r"made for a lidar range of \(m\) 12.0, and the environment has 6.0"),
        ({"robot": "my_package:scout"}, "made for the robot rover_zero, and the environment has my_package:scout"),
        ({"action": ActionConfig(min_speed=0.0)}, r"made for actions .*-1.0.*, and the environment has \(0.0"),
        ({"heading_gains": HeadingGains(kp=1.0)}, "made for heading gains"),
    ],
)
def test_a_policy_made_for_another_environment_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        require_match(EnvConfig(), replace(EnvConfig(), **change))


def test_other_worlds_rewards_simulators_and_equal_robots_match() -> None:
    other: dict[str, Any] = {"randomization": Randomization.typical(), "lidar": LidarConfig(beams=640), "length": 9}
    require_match(EnvConfig(), EnvConfig(world="moon", reward="task", backend="warp", **other))
    stated, robot = EnvConfig(action=ActionConfig(min_speed=-1.0, max_speed=1.0)), get_robot("rover_zero")
    require_match(stated, EnvConfig())
    require_match(EnvConfig(), stated)
    require_match(EnvConfig(), EnvConfig(robot=robot))
    require_match(EnvConfig(robot=robot), EnvConfig(robot=replace(robot)))
    with pytest.raises(ValueError, match="the environment has another robot of the name rover_zero"):
        require_match(EnvConfig(robot=robot), EnvConfig(robot=replace(robot, lidar_range=6.0)))


def test_a_policy_that_was_trained_with_views_drives_its_robot_with_any_of_them() -> None:
    made_for = EnvConfig(randomization=Randomization(lidar_view=(2.0, 4.0)))
    for view in (2.0, 3.5):
        require_match(made_for, EnvConfig(robot=f"rover_zero(lidar_view={view})"))
    for other in ("lidar_view=1.9", "lidar_view=4.1", "lidar_view=3, lidar_range=5"):
        with pytest.raises(ValueError, match=r"made for the robot rover_zero, and the environment has rover_zero\("):
            require_match(made_for, EnvConfig(robot=f"rover_zero({other})"))
    with pytest.raises(ValueError, match="made for the robot rover_zero"):
        require_match(EnvConfig(), EnvConfig(robot="rover_zero(lidar_view=3)"))


def test_options_of_the_robot_become_part_of_its_name() -> None:
    config = EnvConfig(robot="scout.urdf", robot_options=RobotOptions(drive="skid_steer", max_speed=1.5, lidar="0 0 1"))
    assert config.robot == "scout.urdf(drive=skid_steer, lidar='0 0 1', max_speed=1.5)"
    assert config.robot_options == RobotOptions()
    assert env_from_plain(yaml.safe_load(yaml.safe_dump(plain_env(config))), "text") == config
    assert replace(config, robot_options=RobotOptions(max_speed=2.0)).robot.endswith(", max_speed=2.0)")
    both = EnvConfig(robot=("a.urdf", "b.urdf"), robot_options=RobotOptions(torque=2.0))
    assert both.robot == ("a.urdf(torque=2.0)", "b.urdf(torque=2.0)")
    nested = {"robot": "scout.urdf", "robot_options": {"torque": 3.0}}
    assert env_from_plain(nested, "text").robot == "scout.urdf(torque=3.0)"
    with pytest.raises(ValueError, match="robot_options are for robots by name and URDF files"):
        EnvConfig(robot=get_robot("rover_zero"), robot_options=RobotOptions(max_speed=2.0))


def test_a_description_needs_no_pytorch() -> None:
    code = "import sys; from rover_rl.envs.config import EnvConfig; EnvConfig(); assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_scalars_and_arrays_of_other_libraries_are_taken() -> None:
    lidar, task = LidarConfig(np.int32(16), max_range=np.array(9.0)), TaskConfig(torch.tensor(0.75))
    noise = Randomization(friction=np.array([0.5, 1.5]), latency=(np.int64(0), np.int64(1)))
    counts: dict[str, Any] = {"num_envs": np.int64(4), "agents": np.array(2), "seed": np.uint8(3), "size": [64, 64]}
    others: dict[str, Any] = {"length": torch.tensor(100), "end_on_goal": np.bool_(True)}
    others |= {"control_rate": np.float32(10.0), "backend": np.str_("warp"), "randomization": noise}
    config = EnvConfig(world=np.array(["maze", "moon"]), lidar=lidar, task=task, **counts, **others)
    counts = {"num_envs": 4, "agents": 2, "seed": 3, "length": 100, "end_on_goal": True, "control_rate": 10.0}
    noise = Randomization(friction=(0.5, 1.5), latency=(0, 1))
    plain = EnvConfig(
        ("maze", "moon"), lidar=LidarConfig(16, max_range=9.0), task=TaskConfig(0.75), backend="warp", **counts
    )
    assert repr(config) == repr(replace(plain, randomization=noise))
