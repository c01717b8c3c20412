"""Remaps, namespaces and names of nodes on the command line."""

from __future__ import annotations

from pathlib import Path

import pytest

from rover_rl.cli import ros_arguments
from rover_rl.cli.ros_arguments import split_ros_arguments
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.settings import Connection


def renamed(*args: str, **topics: str) -> dict[str, str]:
    """Topics and the node of a driver with arguments, some of whose topics are given."""
    own, rules = split_ros_arguments(["--seed", "1", "--ros-args", *args])
    assert own == ["--seed", "1"]
    connection, settings = ros_arguments.renamed(rules, Connection(**topics), Ros2Settings())
    return vars(connection) | vars(settings)


def test_a_rule_renames_a_topic() -> None:
    names = renamed("-r", "/scan:=/front/scan", "--remap", "cmd_vel:=base/cmd_vel", "-r", "__node:=driver")
    assert (names["scan_topic"], names["cmd_vel_topic"]) == ("/front/scan", "/base/cmd_vel")
    assert (names["imu_topic"], names["node"]) == ("/imu/data", "driver")


def test_a_namespace_stands_before_all_topics_but_those_of_all_robots_and_given_ones() -> None:
    names = renamed("-r", "__ns:=/lab/robot1", imu_topic="/imu", points_topic="cloud")
    assert (names["scan_topic"], names["plan_topic"]) == ("/lab/robot1/scan", "/lab/robot1/plan")
    assert (names["imu_topic"], names["points_topic"]) == ("/imu", "/lab/robot1/cloud")
    everyones = [names[f"{name}_topic"] for name in ("tf", "tf_static", "clock", "diagnostics")]
    assert everyones == ["/tf", "/tf_static", "/clock", "/diagnostics"]
    assert names["node"] == "/lab/robot1/rover_rl"


@pytest.mark.parametrize("rule", ["/scan:=/front/scan", "scan:=/front/scan", "/robot1/scan:=/front/scan"])
def test_rules_name_topics_with_their_namespace_or_without(rule: str) -> None:
    names = renamed("-r", rule, "-r", "/tf:=tf", "-r", "scan:=never", "-r", "__ns:=/robot1")
    assert (names["scan_topic"], names["tf_topic"]) == ("/front/scan", "/robot1/tf")


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["-r", "/scna:=/x"], r"-r /scna:=/x: no topic is called /scna, perhaps '/scan'; use one of \['/scan', "),
        (["-r", "/scan=/x"], "--ros-args takes -r /scan:=/front/scan, .* got '-r /scan=/x'"),
        (["-r", "/scan:=/1x"], "got '-r /scan:=/1x'"),
        (["-r", "__ns:=/1"], "got '-r __ns:=/1'"),
        (["-r"], "got '-r '"),
        (["-p", "use_sim_time=true"], "and ends with -- or the line, got '-p use_sim_time=true'"),
        (["-p", "goal:=[1, 2"], r"a parameter is a value of YAML, .* got '-p goal:=\[1, 2'"),
        (["--params-file", "none.yaml"], "no settings at none.yaml"),
    ],
)
def test_what_is_malformed_or_unknown_is_told_in_words(args: list[str], message: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        renamed(*args)


def test_parameters_are_options(tmp_path: Path) -> None:
    file = tmp_path / "driver.yaml"
    file.write_text(
        "/**:\n  ros__parameters: {use_sim_time: true, pose: tf, guard: {deceleration: 2}}\n"
        "/robot1/driver:\n  ros__parameters: {give_way: true, dry_run: false, pose_topic: /amcl_pose}\n"
        "/robot1/other:\n  ros__parameters: {pose: wheels}\n"
    )
    given = ["-r", "__node:=driver", "-p", "goal:=[1.5, -2]", "--params-file", str(file), "-p", "pose:=odometry"]
    own, rules = split_ros_arguments(["robust", "--ros-args", *given, "-p", "guard.margin:=0.3"])
    options = "--pose odometry --guard.deceleration 2 --give-way --no-dry-run --pose-topic /amcl_pose --goal 1.5 -2"
    assert (own, rules) == (["robust", *options.split(), "--guard.margin", "0.3"], {"__node": "driver"})


def test_arguments_go_on_after_two_dashes() -> None:
    own, rules = split_ros_arguments(["--ros-args", "-r", "__ns:=/", "--", "--world", "maze"])
    assert (own, rules) == (["--world", "maze"], {"__ns": "/"})
    assert ros_arguments.node_name(rules, "rover") == "/rover"
