"""The pose of a live rover by tf."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rover_rl.algos.deploy.goals import GoalTopic
from rover_rl.sims.ros2 import RobotLostError
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.robot import RobotFrames
from rover_rl.sims.ros2.tf import FrameTree, RobotPose, Transform
from rover_rl.worlds import get_world
from tests.sims.ros2.wire import ALL, SimulatedRobot, Wire, drive, simulator, yaw_of


def moved(parent: str, child: str, x: float, y: float, yaw: float = 0.0, stamp: float = 1.0) -> ros.TFMessage:
    transform = Transform(parent, child, np.array([x, y, 0.0]), Rotation.from_euler("z", yaw))
    return ros.TFMessage([transform.message(ros.Time.from_seconds(stamp))])


def place(pose) -> list[float]:
    assert (pose.header.frame_id, pose.pose.orientation.x) == ("map", 0.0)
    return [
        pose.pose.position.x,
        pose.pose.position.y,
        2 * math.atan2(pose.pose.orientation.z, pose.pose.orientation.w),
    ]


def test_transforms_are_chained_and_a_pose_has_the_time_of_the_robot_in_odom() -> None:
    robot = RobotPose("map", "base_link")
    assert robot.after(moved("map", "odom", 1.0, 0.0, math.pi / 2, stamp=0.2)) is None
    pose = robot.after(moved("odom", "base_link", 2.0, 0.5, 0.3))
    assert place(pose) == pytest.approx([0.5, 2.0, math.pi / 2 + 0.3])
    assert ros.seconds_of(pose.header.stamp) == 1.0
    # A localizer jumps, which counts from the next transform of the robot on.
    assert robot.after(moved("map", "odom", 1.1, 0.0, math.pi / 2, stamp=0.9)) is None
    assert robot.after(moved("odom", "base_link", 2.0, 0.5, 0.3)) is None  # repeated
    assert place(robot.after(moved("odom", "base_link", 2.0, 0.5, 0.3, stamp=1.05)))[0] == pytest.approx(0.6)
    # The clock has gone back: the simulation began again.
    assert place(robot.after(moved("odom", "base_link", 0.0, 0.0, stamp=0.1)))[:2] == pytest.approx([1.1, 0.0])


@pytest.mark.parametrize(
    ("messages", "sentence"),
    [
        ([moved("odom", "base_link", 0, 0)], "no transform leads from 'map' to 'odom' in 'base_link'"),
        (
            [moved("base_link", "odom", 0, 0), moved("odom", "base_link", 0, 0)],
            "the transforms of 'base_link' in 'odom' in 'base_link' form a loop",
        ),
        ([moved("map", "base_link", math.nan, 0)], "the transform from 'map' to 'base_link' must be finite"),
    ],
)
def test_transforms_that_tell_no_pose_are_told_in_words(messages: list, sentence: str) -> None:
    robot = RobotPose("map", "base_link")
    *before, last = messages
    for message in before:
        assert robot.after(message) is None
    with pytest.raises(ValueError, match=sentence):
        robot.after(last)


@pytest.fixture
def tree() -> FrameTree:
    """A robot that drives along x of ``odom``, 1 m/s from time 1 to 3, and a camera on it."""
    tree = FrameTree()
    for second in (1.0, 2.0, 3.0):
        tree.read(moved("odom", "base_link", second, 0.0, 0.2 * second, stamp=second))
    tree.read(moved("map", "odom", 10.0, 0.0, math.pi / 2, stamp=2.0))
    tree.read(moved("base_link", "camera", 0.5, 0.0), fixed=True)
    return tree


@pytest.mark.parametrize(
    ("root", "frame", "stamp", "expected"),
    [
        ("odom", "base_link", None, (3.0, 0.0, 0.6)),
        ("odom", "base_link", 1.5, (1.0, 0.0, 0.2)),
        ("odom", "base_link", 9.0, (3.0, 0.0, 0.6)),  # the last one holds
        ("map", "odom", 1.0, (10.0, 0.0, math.pi / 2)),
        ("map", "base_link", 2.0, (10.0, 2.0, math.pi / 2 + 0.4)),
        ("world", "odom", None, (10.0, 0.0, math.pi / 2)),  # the same as map
        ("odom", "map", None, (0.0, 10.0, -math.pi / 2)),
        ("camera", "base_link", 1.5, (-0.5, 0.0, 0.0)),
    ],
)
def test_frames_are_transformed_up_and_down_the_tree_at_a_stamp(tree, root, frame, stamp, expected) -> None:
    found = tree.between(root, frame, stamp)
    assert [*found.position[:2], found.rotation.as_euler("xyz")[2]] == pytest.approx([*expected])


def test_what_tf_does_not_tell_is_told_in_words(tree) -> None:
    with pytest.raises(ValueError, match="no transform leads from 'map' to 'gps'"):
        tree.between("map", "gps")
    with pytest.raises(ValueError, match="from 'lab' to 'map' in 'odom' in 'base_link' in 'camera'"):
        tree.between("lab", "camera")
    with pytest.raises(ValueError, match="where 'base_link' was at 0.4 s is not known, but from 1.0 s on"):
        tree.between("map", "base_link", 0.4)
    tree.read(moved("odom", "base_link", 0.0, 0.0, stamp=0.1))  # the simulation began again
    assert tree.between("odom", "base_link", 2.0).position[0] == 0.0


def test_goals_in_other_frames_are_transformed_at_their_stamp(wire: Wire, tree: FrameTree) -> None:
    topic = GoalTopic(wire, "/goal", lambda goal: None, lambda: "map", tree)
    waiting = topic.goals(lambda: None)

    def received(x: float, y: float, frame: str, stamp: float = 0.0) -> list[float]:
        header = ros.Header(ros.Time.from_seconds(stamp), frame)
        wire.say("/goal", ros.PoseStamped(header, ros.Pose(ros.Point(x, y))), "rviz")
        return [*next(waiting)]

    assert received(1.0, 2.0, "odom") == pytest.approx([8.0, 1.0])
    assert received(1.0, 2.0, "world") == pytest.approx([1.0, 2.0])
    ahead = math.pi / 2 + 0.2
    assert received(1.0, 0.0, "base_link", 1.0) == pytest.approx([10.0 + math.cos(ahead), 1.0 + math.sin(ahead)])
    wire.say("/goal", ros.PoseStamped(ros.Header(frame_id="gps")), "rviz")
    assert wire.sent["/goal/status"][-1].data == "refused 0.00 0.00: no transform leads from 'map' to 'gps'"


def test_the_pose_of_a_rover_is_that_of_tf(wire: Wire) -> None:
    robot = SimulatedRobot(wire, get_world("maze"), (-3.0, 0.0, 0.7))
    sim = simulator(pose="tf", reset="none")
    sim.reset(ALL, torch.zeros(1, 3))
    for _ in range(10):
        drive(sim)
        state = sim.state()
        position, yaw = robot.poses[round(state.stamp.item(), 3)]
        torch.testing.assert_close(state.position[0], position, atol=1e-3, rtol=0)
        assert yaw_of(state) == pytest.approx(yaw, abs=2e-3)
    assert sim.pose_frame == "map"
    robot.rover.close()


def test_a_robot_without_a_localizer_is_lost_in_words(wire: Wire) -> None:
    robot = SimulatedRobot(wire, get_world("maze"), (-3.0, 0.0, 0.7))
    robot._node._frames = RobotFrames(robot.rover.robot, is_localized=False)
    sim = simulator(pose="tf", reset="none")
    with pytest.raises(RobotLostError, match="/tf .* no transform leads from 'map' to 'odom' in 'base_link'"):
        sim.reset(ALL, torch.zeros(1, 3))
    robot.rover.close()
