"""The node of ``rover-rl robot``: what it obeys, and what it refuses."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch

from rover_rl import EnvConfig, LidarConfig, Randomization, Terrain, World, box, cylinder
from rover_rl.envs.config import PoseConfig
from rover_rl.envs.imperfections import imperfect
from rover_rl.envs.served_rover import ServedRover
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.messages import Odometry, PoseStamped, Quaternion, Twist, Vector3
from rover_rl.sims.ros2.robot import RobotNode
from rover_rl.worlds.movers import Cylinder, Mover, Waypoints
from tests.sims.ros2.wire import Wire

# A wall, a thin pole, a bar at a height of 0.8 m, and a man who walks from (-6, 4) to (-6, -4) within a minute.
SOLIDS = [box((3.0, 0.0, 0.5), (1.0, 4.0, 1.0)), cylinder((-3.0, 0.0, 0.5), 0.005, 1.0), box((0, -4, 0.9), (3, 3, 0.2))]
WALKS = Mover(Waypoints([(0.0, -6.0, 4.0, 0.0), (60.0, -6.0, -4.0, 0.0)], repeat="once"), Cylinder(0.3, 1.7))
YARD = World("small_yard", Terrain.flat((20.0, 12.0)), SOLIDS, movers=[WALKS])


class Robot:
    """The node of a simulated robot on the wire. The robot starts at the origin."""

    def __init__(self, wire, rover: ServedRover, settings: Ros2Settings = Ros2Settings()) -> None:  # noqa: B008
        self.rover, self._wire = rover, wire
        self._node = RobotNode(rover, wire, settings)
        self._sent = wire.publisher("/cmd_vel", Twist), wire.publisher("/rover/set_pose", PoseStamped)

    @property
    def place(self) -> list[float]:
        return self.rover.env.rover_state.position[0].tolist()

    def run(self, steps: int, twist: Twist | None = None) -> list[Odometry]:
        """Steps with a command, and returns the odometry of each step."""
        already = len(self._wire.sent.get("/odometry/wheels", []))
        for _ in range(steps):
            if twist is not None:
                self._sent[0](twist)
            self._node.step()
        return self._wire.sent["/odometry/wheels"][already:]

    def put(self, x, y, yaw=0.0, frame="world", z=0.0, orientation: Quaternion | None = None) -> None:
        heading = orientation or Quaternion(z=math.sin(yaw / 2), w=math.cos(yaw / 2))
        self._sent[1](PoseStamped(ros.Header(frame_id=frame), ros.Pose(ros.Point(x, y, z), heading)))
        self.run(1)


def served(**config) -> ServedRover:
    described = EnvConfig(world=YARD, backend="warp", seed=0, lidar=LidarConfig(beams=64))
    return ServedRover(replace(described, **config))


@pytest.fixture(scope="module")
def rover():
    rover = served()
    yield rover
    rover.close()


@pytest.fixture
def robot(wire, rover) -> Robot:
    return Robot(wire, rover)


@pytest.mark.parametrize("kind", ["husky", "hunter"])
def test_no_command_drives_a_robot_beyond_its_limits(kind):
    rover = served(robot=kind)
    drive = rover.env.robot.drive
    for x, z in ((-1e30, 0.0), (50.0, -50.0)):
        before = 0.0
        for odometry in Robot(Wire(), rover).run(30, Twist(Vector3(x=x), Vector3(z=z))):
            speed = odometry.twist.twist.linear.x
            assert abs(speed) <= 1.05 * drive.max_speed
            assert abs(odometry.twist.twist.angular.z) <= 1.05 * drive.max_yaw_rate
            assert abs(speed - before) <= 1.5 * drive.max_linear_acceleration * 0.05
            before = speed
        assert abs(before) == pytest.approx(min(abs(x), drive.max_speed), abs=0.05) or z
    rover.close()


def test_a_command_within_the_limits_is_obeyed_also_by_a_harsh_robot(robot):
    assert robot.run(20, Twist(Vector3(x=-0.7)))[-1].twist.twist.linear.x == pytest.approx(-0.7, abs=0.02)
    config = imperfect(EnvConfig(world=YARD, backend="warp", seed=0), "harsh")
    harsh = served(randomization=replace(config.randomization, limits=(0.2, 0.2)))
    speeds = [each.twist.twist.linear.x for each in Robot(Wire(), harsh).run(40, Twist(Vector3(x=-0.7)))]
    assert min(speeds) < -0.5
    harsh.close()


def test_speeds_that_the_robot_cannot_drive_are_named_and_the_rest_is_obeyed_for_half_a_second(robot, wire, caplog):
    odometry = robot.run(10, Twist(Vector3(x=-0.5, y=0.4)))
    assert odometry[-1].twist.twist.linear.x == pytest.approx(-0.5, abs=0.02)
    assert abs(robot.place[1]) < 0.01
    assert caplog.text.count("/cmd_vel: only linear.x and angular.z move the robot") == 1
    assert robot.run(20)[-1].twist.twist.linear.x == pytest.approx(0.0, abs=0.02)
    times = [round(ros.seconds_of(message.clock) / 0.05) for message in wire.sent["/clock"]]
    assert times == [*range(times[0], times[0] + 30)]


def test_a_command_that_is_not_finite_is_refused(robot):
    robot.run(5, Twist(Vector3(x=-0.5)))
    for number, part, axis in product((math.nan, math.inf, 1e39), ("linear", "angular"), "xyz"):
        with pytest.raises(ValueError, match="a command must be finite"):
            robot.run(1, Twist(**{part: Vector3(**{axis: number})}))
    assert robot.run(1)[0].twist.twist.linear.x < -0.4


REFUSED = {
    "a wall": ((3.0, 0.0), {}, "the rover is in an obstacle"),
    "a thin pole between the wheels": ((-3.0, 0.02), {}, "the rover is in an obstacle"),
    "half off the terrain": ((9.9, 0.0), {}, "the rover is not on the terrain"),
    "not a number": ((math.nan, 0.0), {}, "a position must be finite"),
    "no orientation": ((1.0, 0.0), {"orientation": Quaternion(w=0.0)}, "a finite quaternion other than zero"),
    "another frame": ((1.0, 0.0), {"frame": "map"}, "its frame_id must be 'world', the frame of the world, or empty"),
    "where a mover begins": ((-6.0, 3.9), {}, "the rover is in something that moves"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_pose_where_the_rover_cannot_stand_is_refused_with_a_warning_and_the_rover_stays(robot, caplog, case):
    before = robot.place
    place, options, reason = REFUSED[case]
    robot.put(*place, **options)
    assert "/rover/set_pose: ignored a pose, and the rover stays where it is: " in caplog.text
    assert reason in caplog.text
    robot.run(5)
    assert math.dist(robot.place, before) < 0.01


ACCEPTED = {
    "no frame": ((1.0, 0.5), {"frame": ""}),
    "beside a wall": ((2.2, 1.0), {}),
    "under a bar": ((0.0, -4.0), {}),
    "upside down in the air": ((1.0, 0.5), {"z": 500.0, "orientation": Quaternion(x=1.0, w=0.0)}),
    "where a mover will be": ((-6.0, 0.0), {}),
}


@pytest.mark.parametrize("case", ACCEPTED)
def test_a_rover_is_put_upright_on_the_ground_where_it_can_stand(robot, caplog, case):
    (x, y), options = ACCEPTED[case]
    robot.put(x, y, **options)
    robot.run(10)
    assert robot.place == pytest.approx([x, y, 0.0], abs=0.01)
    assert robot.rover.env.rover_state.orientation[0, :2].abs().max() < 0.01
    assert not caplog.text


def covariances(message) -> tuple[np.ndarray, np.ndarray]:
    return message.pose.covariance.reshape(6, 6), message.twist.covariance.reshape(6, 6)


def test_covariances_of_an_exact_robot_are_small_and_of_what_it_does_not_measure_large(robot, wire):
    pose, twist = covariances(robot.run(5, Twist(Vector3(x=-0.5)))[-1])
    for spread in (pose, twist):
        np.testing.assert_array_equal(spread, np.diag([1e-6, 1e-6, 1e6, 1e6, 1e6, 1e-6]))
    imu = wire.sent["/imu/data"][-1]
    np.testing.assert_array_equal(imu.orientation_covariance.reshape(3, 3), 1e-6 * np.eye(3))
    np.testing.assert_array_equal(imu.angular_velocity_covariance.reshape(3, 3), np.diag([1e6, 1e6, 1e-6]))
    assert imu.linear_acceleration_covariance[0] == -1


def test_covariances_are_those_of_the_noise(wire):
    """Errors are as large as the covariances say: their mean square, in standard deviations, is about 1."""
    noise = Randomization(odometry_noise=0.2, imu_noise=0.02)
    rover = served(randomization=noise, pose=PoseConfig("localized", drift_heading=0.1, drift_time=0.2))
    robot, headings = Robot(wire, rover), []
    for _ in range(400):
        robot.run(1, Twist(Vector3(x=0.3), Vector3(z=1.0)))
        headings.append(quaternion_to_euler(rover.env.rover_state.orientation)[0].tolist())
    imus, odometry = wire.sent["/imu/data"], wire.sent["/odometry/wheels"]
    told = [
        quaternion_to_euler(torch.tensor([vars(imu.orientation)[axis] for axis in "xyzw"])).tolist() for imu in imus
    ]
    errors = np.remainder(np.array(told) - np.array(headings) + math.pi, 2 * math.pi) - math.pi
    spread = np.diag(imus[-1].orientation_covariance.reshape(3, 3))
    np.testing.assert_allclose(np.square(errors).mean(0) / spread, 1.0, atol=0.4)
    rates = (
        np.array([imu.angular_velocity.z for imu in imus[1:]])
        - np.diff(np.unwrap([yaw for *_, yaw in headings])) / 0.05
    )
    assert np.square(rates).mean() == pytest.approx(imus[-1].angular_velocity_covariance[8], rel=0.3)
    speeds = np.array([each.twist.twist.linear.x for each in odometry[20:]])
    assert speeds.var() == pytest.approx(np.mean([covariances(each)[1][0, 0] for each in odometry[20:]]), rel=0.3)
    rover.close()


def test_the_covariance_of_dead_reckoning_is_that_of_many_drives():
    ends, spreads = [], []
    rover = served(randomization=Randomization(odometry_noise=0.3, odometry_scale=(0.8, 1.2)))
    for _ in range(40):  # a new node begins with a reset, which draws the scale
        end = Robot(Wire(), rover).run(30, Twist(Vector3(x=-0.5), Vector3(z=0.8)))[-1]
        place, turn = end.pose.pose.position, end.pose.pose.orientation
        ends.append([place.x, place.y, 2 * math.atan2(turn.z, turn.w)])
        spreads.append(np.diag(covariances(end)[0])[[0, 1, 5]])
    rover.close()
    np.testing.assert_allclose(np.var(ends, axis=0) / np.mean(spreads, axis=0), 1.0, atol=0.5)


def test_a_robot_receives_stamped_commands_if_asked_and_names_others(wire, rover, monkeypatch, caplog):
    monkeypatch.setattr("rover_rl.sims.ros2.robot.TYPES_PERIOD", 0.0)
    robot = Robot(wire, rover)
    robot.run(1)
    assert not caplog.text
    stamped = wire.publisher("/cmd_vel", ros.TwistStamped)
    robot.run(1)
    assert "/cmd_vel: ignored geometry_msgs/TwistStamped: the robot receives geometry_msgs/Twist; with" in caplog.text
    wire.receivers["/cmd_vel"].clear()
    other = Robot(wire, rover, Ros2Settings(command="twist_stamped"))
    stamped(ros.TwistStamped(twist=Twist(Vector3(x=-0.5))))
    assert other.run(8)[-1].twist.twist.linear.x == pytest.approx(-0.5, abs=0.02)
