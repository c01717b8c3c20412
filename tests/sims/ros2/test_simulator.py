from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

from rover_rl import RoverEnv, TaskConfig
from rover_rl.envs.gym import RoverEnv as GymRoverEnv
from rover_rl.sims import make_simulator
from rover_rl.sims.connection import Connection
from rover_rl.sims.robots import get_robot
from rover_rl.sims.ros2 import PoseResetError, RobotLostError, Ros2Settings
from rover_rl.sims.ros2.messages import (
    Header,
    Imu,
    LaserScan,
    Odometry,
    Point,
    Pose,
    PoseArray,
    PoseStamped,
    PoseWithCovariance,
    Quaternion,
    Time,
    Twist,
    TwistWithCovariance,
    Vector3,
)
from rover_rl.sims.ros2.simulator import Ros2Simulator
from rover_rl.sims.rotations import quaternion_to_euler
from rover_rl.sims.worlds import get_world
from tests.sims.ros2.processes import until
from tests.sims.ros2.wire import Wire

BEAMS = 8
ALL = torch.ones(1, dtype=torch.bool)


class Rover:
    """A rover that follows commands immediately, without moving, and publishes its state at 100 Hz."""

    def __init__(self, wire: Wire, stamp_step: float = 0.05) -> None:
        self.wire, self.stamp_step = wire, stamp_step
        self.x, self.y, self.yaw, self.speed, self.turn = 1.0, 2.0, 0.5, 0.0, 0.0
        self.z = 0.1
        self.imu_offset = self.climb = 0.0
        self.ranges = np.full(BEAMS, 5.0, np.float32)
        self.layout: tuple[float, float] | None = None  # angle of the first beam, and angle increment
        self.silent: set[str] = set()
        self.stamp = 0.0
        self._publish = {
            "scan": wire.publisher("/scan", LaserScan),
            "imu": wire.publisher("/imu/data", Imu),
            "odometry": wire.publisher("/odometry/wheels", Odometry),
            "pose": wire.publisher("/rover/pose_array", PoseArray),
            "localizer": wire.publisher("/pose", PoseStamped),
        }
        wire.subscribe("/cmd_vel", Twist, self.obey)
        wire.subscribe("/rover/set_pose", PoseStamped, self.move_to)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def obey(self, twist: Twist) -> None:
        self.speed, self.turn = twist.linear.x, twist.angular.z

    def move_to(self, msg: PoseStamped) -> None:
        self.x, self.y = msg.pose.position.x, msg.pose.position.y
        self.yaw = 2 * math.atan2(msg.pose.orientation.z, msg.pose.orientation.w)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(0.01):
            self.publish()

    def publish(self) -> None:
        self.stamp += self.stamp_step
        header = Header(Time.from_seconds(self.stamp))
        heading = Quaternion(z=math.sin(self.yaw / 2), w=math.cos(self.yaw / 2))
        imu_yaw = self.yaw + self.imu_offset
        self.z += self.climb
        pose = Pose(Point(self.x, self.y, self.z), heading)
        messages = {
            "imu": Imu(header, Quaternion(z=math.sin(imu_yaw / 2), w=math.cos(imu_yaw / 2))),
            "odometry": Odometry(
                header,
                pose=PoseWithCovariance(pose),
                twist=TwistWithCovariance(Twist(Vector3(x=self.speed), Vector3(z=self.turn))),
            ),
            "pose": PoseArray(header, [pose]),
            "localizer": PoseStamped(header, pose),
            "scan": self.scan(header, self.ranges.copy()),
        }
        for kind, message in messages.items():
            if kind not in self.silent:
                self._publish[kind](message)

    def scan(self, header: Header, ranges: np.ndarray) -> LaserScan:
        first, increment = self.layout or (-math.pi, 2 * math.pi / len(ranges))
        last = first + increment * (len(ranges) - 1)
        return LaserScan(header, angle_min=first, angle_max=last, angle_increment=increment, ranges=ranges)


@pytest.fixture
def rover(wire: Wire) -> Iterator[Rover]:
    rover = Rover(wire)
    yield rover
    rover.stop()


def simulator(timeout: float = 2.0, beams: int = BEAMS, **settings: Any) -> Ros2Simulator:
    quick = {"max_acceleration": 100.0, "max_yaw_acceleration": 100.0}  # sends commands unchanged
    settings = {"reset": "topic", "step_timeout": 0.3, "reset_timeout": 1.0, "settle": 0.05, **quick, **settings}
    made = make_simulator(
        Ros2Settings(**settings),
        worlds=[get_world("maze")],
        robot=get_robot("rover_zero"),
        connection=Connection(timeout=timeout),
    )
    assert isinstance(made, Ros2Simulator)
    made.scanner(beams)
    return made


def drive(sim: Ros2Simulator, steps: int) -> None:
    for _ in range(steps):
        sim.step(torch.tensor([[0.5, 0.0]]))


def yaw_of(state) -> float:
    return quaternion_to_euler(state.orientation)[0, 2].item()


def test_step_sends_the_command_and_returns_the_next_state(wire, rover):
    rover.start()
    sim = simulator()
    sim.reset(ALL, torch.tensor([[1.0, 2.0, 0.5]]))
    rover.ranges[0] = 1.5  # the lidar's first beam, which points forward
    state = sim.step(torch.tensor([[0.5, -0.25]]))
    command = wire.sent["/cmd_vel"][-1]
    assert (command.linear.x, command.angular.z) == (0.5, -0.25)
    assert state.position[0].tolist() == pytest.approx([1.0, 2.0, 0.1])
    assert yaw_of(state) == pytest.approx(0.5, abs=1e-5)
    assert sim.ranges().shape == (1, BEAMS)
    assert sim.ranges()[0, 0] == 1.5
    assert sim.last_command == (0.5, -0.25)
    assert 0 < sim.latency < 0.3
    state = sim.step(torch.tensor([[0.5, -0.25]]))
    assert (state.linear_velocity.item(), state.angular_velocity.item()) == (0.5, -0.25)  # by the wheels


def test_dt_is_the_difference_of_scan_stamps(rover):
    rover.stamp_step = 0.02
    rover.start()
    sim = simulator()
    sim.reset(ALL, torch.zeros(1, 3))
    first, second = (sim.step(torch.zeros(1, 2)) for _ in range(2))
    assert second.dt.item() == pytest.approx(second.stamp.item() - first.stamp.item(), abs=1e-6)
    rover.stamp = -1000.0  # the clock has jumped
    assert sim.step(torch.zeros(1, 2)).dt.item() == pytest.approx(0.05)


def test_reset_stops_the_rover_and_moves_it_to_the_pose(wire, rover):
    rover.start()
    sim = simulator()
    sim.step(torch.tensor([[1.0, 1.0]]))
    state = sim.reset(ALL, torch.tensor([[-3.0, 4.0, 2.0]]))
    assert state.position[0, :2].tolist() == pytest.approx([-3.0, 4.0])
    assert yaw_of(state) == pytest.approx(2.0, abs=1e-5)
    assert (rover.speed, rover.turn) == (0.0, 0.0)
    placed = wire.sent["/rover/set_pose"][-1].pose.position
    assert placed.z == pytest.approx(get_world("maze").drop_height(torch.tensor([-3.0, 4.0])).item())


def test_reset_fails_if_the_rover_does_not_reach_the_pose(wire, rover):
    wire.receivers["/rover/set_pose"][:] = [lambda msg: None]
    rover.start()
    sim = simulator(reset_timeout=0.3)
    with pytest.raises(PoseResetError, match=r"rest at x -3.00 m, y 4.00 m; after 0.3 s it is at x 1.00 m, y 2.00 m"):
        sim.reset(ALL, torch.tensor([[-3.0, 4.0, 2.0]]))


def test_manual_reset_prompts_without_a_time_limit(rover, monkeypatch):
    asked: list[str] = []

    def put(text: str) -> str:
        asked.append(text)
        time.sleep(0.3)
        rover.x, rover.y, rover.yaw = -3.0, 4.0, 0.0
        return ""

    monkeypatch.setattr("builtins.input", put)
    rover.start()
    sim = simulator(reset="manual", reset_timeout=0.25)
    state = sim.reset(ALL, torch.tensor([[-3.0, 4.0, 0.0]]))
    assert state.position[0, :2].tolist() == pytest.approx([-3.0, 4.0])
    assert asked == ["Put the rover at x -3.00 m, y 4.00 m, heading 0 degrees, and press Enter: "]


def test_manual_reset_fails_without_standard_input(rover, monkeypatch):
    def nobody(text: str) -> str:
        raise EOFError

    monkeypatch.setattr("builtins.input", nobody)
    rover.start()
    with pytest.raises(PoseResetError, match="nobody answers the prompt"):
        simulator(reset="manual").reset(ALL, torch.zeros(1, 3))


def test_reset_fails_if_the_heading_is_wrong(wire, rover, monkeypatch):
    rover.start()
    monkeypatch.setattr(rover, "move_to", lambda msg: None)
    wire.receivers["/rover/set_pose"][:] = [lambda msg: vars(rover).update(x=-3.0, y=4.0)]
    with pytest.raises(PoseResetError, match=r"it is at x -3.00 m, y 4.00 m"):
        simulator(reset_timeout=0.3).reset(ALL, torch.tensor([[-3.0, 4.0, -2.0]]))


def test_a_falling_rover_is_not_at_rest(rover):
    rover.start()
    rover.climb = -1.0
    with pytest.raises(PoseResetError, match=r"z -\d+\.90 m, and its wheels are at rest"):
        simulator(reset_timeout=0.5, settle=0.2).reset(ALL, torch.tensor([[-3.0, 4.0, 0.0]]))


def test_reset_fails_if_the_rover_is_lost(rover):
    rover.start()
    sim = simulator(reset_timeout=5.0)
    rover.speed = 1.0
    sim.step(torch.tensor([[1.0, 0.0]]))
    rover.silent |= {"odometry", "imu", "pose", "scan"}
    with pytest.raises(RobotLostError, match=r"the last message is 0.\d s old"):
        sim.reset(ALL, torch.tensor([[-3.0, 4.0, 0.0]]))


def test_wheel_odometry_is_aligned_with_the_start_pose(rover, monkeypatch):
    rover.start()
    rover.imu_offset = 1.1
    monkeypatch.setattr("builtins.input", lambda text: "")
    sim = simulator(pose="wheels", reset="manual")
    state = sim.reset(ALL, torch.tensor([[-3.0, 4.0, 2.0]]))
    assert state.position[0, :2].tolist() == pytest.approx([-3.0, 4.0], abs=1e-5)
    assert yaw_of(state) == pytest.approx(2.0, abs=1e-5)
    # One meter ahead in the odometry's frame (yaw 0.5 rad) is one meter ahead in the world (yaw 2.0 rad).
    rover.x, rover.y = rover.x + math.cos(0.5), rover.y + math.sin(0.5)
    rover.yaw += 0.25
    for _ in range(3):
        state = sim.step(torch.zeros(1, 2))
    assert state.position[0, :2].tolist() == pytest.approx([-3.0 + math.cos(2.0), 4.0 + math.sin(2.0)], abs=1e-5)
    assert yaw_of(state) == pytest.approx(2.25, abs=1e-5)


def test_wheel_odometry_without_reset_keeps_its_own_frame(rover):
    rover.start()
    rover.imu_offset = 1.1
    state = simulator(pose="wheels", reset="none").reset(ALL, torch.tensor([[-3.0, 4.0, 2.0]]))
    assert state.position[0, :2].tolist() == pytest.approx([1.0, 2.0], abs=1e-5)
    assert yaw_of(state) == pytest.approx(0.5, abs=1e-5)  # the heading of the odometry, not of the IMU


def test_a_localizer_provides_pose_and_heading(rover):
    rover.imu_offset = -0.7
    rover.start()
    sim = simulator(pose="pose_stamped", pose_topic="/pose", reset="none")
    state = sim.reset(ALL, torch.zeros(1, 3))
    assert state.position[0, :2].tolist() == pytest.approx([1.0, 2.0])
    assert yaw_of(state) == pytest.approx(0.5, abs=1e-5)


def test_the_imu_updates_the_heading_between_poses_of_a_localizer(rover):
    rover.imu_offset = -0.7
    rover.start()
    sim = simulator(pose="pose_stamped", pose_topic="/pose", reset="none")
    sim.reset(ALL, torch.zeros(1, 3))
    rover.silent.add("localizer")
    drive(sim, steps=2)
    rover.yaw += 0.4
    drive(sim, steps=2)
    assert yaw_of(sim.state()) == pytest.approx(0.9, abs=1e-5)


def test_a_pose_array_without_orientation_is_accepted(rover):
    rover.start()
    sim = simulator(reset="none")
    rover.stop()
    position = Point(7.0, 8.0, 0.5)
    sim.receive("pose", PoseArray(poses=[Pose(position, Quaternion(w=0.0))]))
    assert sim.state().position[0].tolist() == [7.0, 8.0, 0.5]


def test_scans_of_a_fast_lidar_are_skipped(rover):
    rover.stamp_step = 0.01
    rover.start()
    sim = simulator(reset="none")
    sim.reset(ALL, torch.zeros(1, 3))
    for _ in range(5):
        assert sim.step(torch.zeros(1, 2)).dt.item() >= 0.0375 - 1e-6


def test_stamped_commands(wire, rover):
    wire.receivers["/cmd_vel"].clear()
    rover.start()
    sim = simulator(command="twist_stamped", reset="none")
    sim.reset(ALL, torch.zeros(1, 3))
    sim.step(torch.tensor([[0.5, -0.25]]))
    sent = wire.sent["/cmd_vel"][-1]
    assert sent.header.frame_id == "base_link"
    assert sent.header.stamp.sec == pytest.approx(time.time(), abs=60)
    assert (sent.twist.linear.x, sent.twist.angular.z) == (0.5, -0.25)


def test_without_a_robot_observations_are_empty_with_a_warning(wire, caplog):
    sim = simulator(timeout=0.05)
    assert "no usable scan on /scan within 0.05 s" in caplog.text
    assert not sim.robot_connected
    state = sim.reset(ALL, torch.zeros(1, 3))
    assert "no robot has appeared" in caplog.text
    assert torch.isposinf(sim.ranges()).all()
    assert (state.position == 0).all()
    assert state.orientation.tolist() == [[0, 0, 0, 1]]
    with pytest.raises(RobotLostError, match=r"/scan \(scan\): no message has arrived yet"):
        sim.step(torch.tensor([[1.0, 0.0]]))
    assert set(map(repr, wire.sent["/cmd_vel"])) == {repr(Twist())}  # no motion without a scan


def test_a_robot_may_appear_after_the_simulator(wire, rover):
    sim = simulator(timeout=0.05)
    rover.start()
    assert sim.wait_for_robot(2.0)
    assert sim.robot_connected
    assert sim.reset(ALL, torch.tensor([[0.0, 1.0, 0.0]])).position[0, :2].tolist() == pytest.approx([0.0, 1.0])
    rover.stop()
    time.sleep(0.4)
    assert not sim.wait_for_robot(0.0)


@pytest.mark.parametrize("kind", ["imu", "odometry", "pose"])
def test_a_topic_may_start_after_the_scan(rover, kind):
    rover.silent.add(kind)
    rover.start()
    sim = simulator(step_timeout=5.0)
    threading.Timer(0.1, rover.silent.clear).start()
    assert sim.reset(ALL, torch.tensor([[0.0, 1.0, 0.0]])).position[0, :2].tolist() == pytest.approx([0.0, 1.0])


def test_a_topic_that_never_starts_is_reported(rover):
    rover.silent.add("imu")
    rover.start()
    with pytest.raises(RobotLostError, match=r"/imu/data \(imu\): no message has arrived yet"):
        simulator().reset(ALL, torch.zeros(1, 3))


@pytest.mark.parametrize(
    ("kind", "topic"),
    [("scan", "/scan"), ("imu", "/imu/data"), ("odometry", "/odometry/wheels"), ("pose", "/rover/pose_array")],
)
def test_a_silent_topic_stops_the_rover(wire, rover, kind, topic):
    rover.start()
    sim = simulator()
    sim.reset(ALL, torch.tensor([[0.0, 1.0, 0.0]]))
    sim.step(torch.tensor([[0.5, 0.0]]))
    rover.silent.add(kind)
    with pytest.raises(RobotLostError, match=rf"lost the robot: {topic} \({kind}\): the last message is \d.\d s old"):
        drive(sim, steps=100)
    assert wire.sent["/cmd_vel"][-2:] == [Twist(), Twist()]


def test_malformed_messages_are_ignored_and_the_last_valid_value_remains(rover, caplog):
    rover.start()
    sim = simulator()
    sim.reset(ALL, torch.tensor([[0.0, 1.0, 0.5]]))
    rover.stop()
    before = sim.state()
    bad = {
        "scan": LaserScan(angle_increment=0.1),
        "imu": Imu(orientation=Quaternion(w=0.0)),
        "odometry": Odometry(twist=TwistWithCovariance(Twist(Vector3(x=math.nan)))),
        "pose": PoseArray(),
    }
    for kind, message in bad.items():
        caplog.clear()
        sim.receive(kind, message)
        sim.receive(kind, message)
        assert caplog.text.count("ignored a message") == 1
    after = sim.state()
    assert all(torch.equal(before.get(key), after.get(key)) for key in before.keys())  # noqa: SIM118


def test_gymnasium_callbacks_process_messages(wire):
    env = GymRoverEnv(world_n="maze", backend=Ros2Settings(reset="none"), connection_check_timeout=0)
    assert not env._robot_connected
    assert not env._check_robot_connection(timeout=0.0)
    env.lidar_callback(LaserScan(angle_min=-math.pi, angle_increment=math.pi / 4, ranges=np.full(8, 3.0, np.float32)))
    env.imu_callback(Imu(orientation=Quaternion(z=2.0, w=2.0)))
    env.odom_callback(Odometry(twist=TwistWithCovariance(Twist(Vector3(x=0.5), Vector3(z=-0.25)))))
    env.pose_array_callback(PoseArray(poses=[Pose(Point(1.0, 2.0, 3.0))]))
    assert env._check_robot_connection(timeout=0.0)
    state = env.base_env.simulator.state()
    assert yaw_of(state) == pytest.approx(math.pi / 2, abs=1e-5)
    assert (state.linear_velocity.item(), state.angular_velocity.item()) == (0.5, -0.25)
    assert state.position[0].tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(ValueError, match="kind must be one of"):
        env.base_env.simulator.receive("camera", None)
    env.close()


@pytest.mark.parametrize(
    ("ranges", "seen"),
    [
        ([-1.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0], 0.0),
        ([math.nan] + [2.0] * 15, 2.0),  # two readings per beam: the other one is valid
        ([math.nan] * 3 + [2.0] * 13, 1.0),  # no valid reading
        ([math.inf, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0], 12.0),
        ([-math.inf, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0], 0.0),
        ([1.0, 2.0], 1.0),
    ],
)
def test_every_lidar_reading_becomes_a_valid_observation(rover, ranges, seen):
    rover.ranges = np.array(ranges, np.float32)
    rover.start()
    backend = Ros2Settings(reset="none", lidar_yaw=math.pi, max_invalid=0.2, settle=0.05)
    env = RoverEnv(world_n="maze", backend=backend, lidar_beams=BEAMS, lidar_points=BEAMS)
    lidar = env.reset()["lidar"][0]
    assert lidar[0] == seen
    assert ((lidar >= 0) & (lidar <= 12.0)).all()
    env.close()


def test_a_live_rover_drives_a_policy_of_a_task_with_contact_and_senses_none(rover):
    rover.ranges[0] = 0.1
    rover.start()
    task = TaskConfig(collision_from="contact", collision_window=0)
    backend = Ros2Settings(reset="none", settle=0.05)
    env = RoverEnv(world_n="maze", backend=backend, lidar_beams=BEAMS, lidar_points=BEAMS, task=task)
    td = env.step(env.reset().set("action", torch.tensor([[0.5, 0.0]])))["next"]
    assert td["lidar"].min() < 0.3
    assert not td["outcome", "collision"].item()
    assert not td["terminated"].item()
    assert env.rover_state.contact.tolist() == [[False]]
    env.close()


def sent_speed(sim: Ros2Simulator, wire: Wire, speed: float = 0.5) -> float:
    """Returns the forward speed that is sent for a desired ``speed``."""
    for _ in range(2):
        sim.step(torch.tensor([[speed, 0.2]]))
    assert wire.sent["/cmd_vel"][-1].angular.z == pytest.approx(0.2)  # turning is always allowed
    return wire.sent["/cmd_vel"][-1].linear.x


def ranges_with(front: float, behind: float) -> np.ndarray:
    """Ranges of 64 beams from straight behind, with the given readings ahead and behind."""
    ranges = np.full(64, 5.0, np.float32)
    ranges[[31, 32, 33]] = front
    ranges[[63, 0, 1]] = behind
    return ranges


@pytest.mark.parametrize(
    ("front", "behind", "speed", "sent"),
    [(5.0, 5.0, 0.5, 0.5), (math.nan, 5.0, 0.5, 0.0), (math.nan, 5.0, -0.5, -0.5), (5.0, math.nan, -0.5, 0.0)],
)
def test_a_rover_does_not_move_towards_unseen_directions(wire, rover, caplog, front, behind, speed, sent):
    rover.ranges = ranges_with(front, behind)
    rover.start()
    sim = simulator(reset="none", lidar_yaw=0.0, beams=64)
    sim.reset(ALL, torch.zeros(1, 3))
    assert sent_speed(sim, wire, speed) == sent
    assert sim.held == (sent == 0.0)
    assert ("no beam covers all of that direction" in caplog.text) == sim.held


def test_directions_without_beams_are_unknown_not_free(wire, rover):
    """With a lidar of 180 degrees, directions behind read 1 m, and the rover does not back up."""
    rover.ranges, rover.layout = np.full(64, 5.0, np.float32), (-math.pi / 2, math.pi / 64)
    rover.start()
    sim = simulator(reset="none", lidar_yaw=0.0, beams=64)
    sim.reset(ALL, torch.zeros(1, 3))
    scanner = sim.scanner(64)
    assert sim.field_of_view == pytest.approx(math.pi)
    ahead = scanner.angles.cos() > 0.1
    behind = scanner.angles.cos() < -0.1
    assert (scanner.scan()[0, ahead] == 5.0).all()
    assert (scanner.scan()[0, behind] == 1.0).all()
    assert sent_speed(sim, wire, 0.5) == 0.5
    assert sent_speed(sim, wire, -0.5) == 0.0


def test_unusable_scans_stop_the_rover_before_it_is_lost(wire, rover):
    rover.start()
    sim = simulator(reset="none", step_timeout=5.0)
    sim.reset(ALL, torch.zeros(1, 3))
    assert sent_speed(sim, wire) == 0.5
    rover.ranges = np.full(BEAMS, math.nan, np.float32)
    go = threading.Thread(target=drive, args=(sim, 3), daemon=True)
    go.start()
    until(lambda: wire.sent["/cmd_vel"][-1] == Twist(), seconds=2.0)  # well before step_timeout
    rover.ranges = np.full(BEAMS, 5.0, np.float32)
    go.join(5.0)
    assert sent_speed(sim, wire) == 0.5  # drives on with usable scans


def test_unusable_scans_end_the_wait_for_a_robot_and_are_reported(wire, rover, caplog):
    rover.ranges = np.full(BEAMS, math.nan, np.float32)
    rover.start()
    sim = simulator(timeout=60.0)
    assert not sim.robot_connected
    with pytest.raises(RobotLostError, match=r"messages cannot be used: 8 of 8 readings of the scan are missing, NaN"):
        sim.require_robot()


@pytest.mark.parametrize(("step", "warned"), [(0.05, False), (0.1, True), (0.01, True)])
def test_an_unsupported_scan_rate_logs_a_warning(rover, caplog, step, warned):
    rover.stamp_step = step
    sim = simulator(reset="none", timeout=0.01)
    for _ in range(25):
        rover.publish()
    assert ("scans per second; policies require 15 to 30" in caplog.text) == warned
    sim.close()


def test_two_robots_on_one_topic_are_detected(wire, rover):
    rover.start()
    sim = simulator(reset="none")
    sim.reset(ALL, torch.zeros(1, 3))
    sent_speed(sim, wire)
    wire.robots = 2
    with pytest.raises(RobotLostError, match=r"2 publishers send on /\S+: there may be several robots"):
        drive(sim, steps=200)
    assert wire.sent["/cmd_vel"][-1] == Twist()
    with pytest.raises(RobotLostError, match=r"2 publishers send on /"):
        sim.reset(ALL, torch.zeros(1, 3))


def test_sent_commands_are_within_the_limits(wire, rover):
    rover.start()
    limits = {"max_speed": 0.4, "max_yaw_rate": 0.6, "max_acceleration": 1.0, "max_yaw_acceleration": 2.0}
    sim = simulator(reset="none", **limits)
    sim.reset(ALL, torch.zeros(1, 3))
    for _ in range(10):
        sim.step(torch.tensor([[1.0, -7.0]]))
    speeds, turns = zip(*((twist.linear.x, twist.angular.z) for twist in wire.sent["/cmd_vel"]), strict=True)
    assert max(speeds) == 0.4
    assert min(turns) == -0.6
    assert max(np.diff(speeds)) <= 1.0 * 0.05 + 1e-6
    assert max(np.abs(np.diff(turns))) <= 2.0 * 0.05 + 1e-6


def test_automatic_reset_selects_an_available_placer(wire, rover, monkeypatch, caplog):
    monkeypatch.setattr("shutil.which", lambda command: None)
    rover.start()
    sim = simulator(reset="auto")
    state = sim.reset(ALL, torch.tensor([[-3.0, 4.0, 2.0]]))
    assert state.position[0, :2].tolist() == pytest.approx([-3.0, 4.0])  # the rover subscribes to the reset topic
    wire.receivers["/rover/set_pose"].clear()
    monkeypatch.setattr("rover_rl.sims.ros2.pose_reset._DISCOVERY_TIMEOUT", 0.01)
    state = simulator(reset="auto").reset(ALL, torch.tensor([[1.0, 1.0, 0.0]]))
    assert state.position[0, :2].tolist() == pytest.approx([-3.0, 4.0])
    assert "no node subscribes to /rover/set_pose, and neither ign nor gz is installed" in caplog.text


def test_several_rovers_are_rejected(wire):
    with pytest.raises(ValueError, match="drives one live rover, got num_envs=2"):
        make_simulator("ros2", worlds=[get_world("maze")] * 2, robot=get_robot("rover_zero"))


def test_close_stops_the_rover_and_closes_the_connection(wire, rover):
    rover.start()
    sim = simulator()
    drive(sim, steps=2)  # no motion in the first step, before the first scan
    assert wire.sent["/cmd_vel"][-1] == Twist(Vector3(x=0.5))
    sim.close()
    sim.close()
    assert wire.closed
    assert wire.sent["/cmd_vel"][-1] == Twist()


def test_a_deleted_simulator_stops_the_rover_and_closes_the_connection(wire, rover):
    rover.start()
    sim = simulator()
    drive(sim, steps=2)
    assert wire.sent["/cmd_vel"][-1] == Twist(Vector3(x=0.5))
    del sim
    until(lambda: wire.closed)
    assert wire.sent["/cmd_vel"][-1] == Twist()


def test_close_sends_no_stop_without_earlier_commands(wire):
    simulator(timeout=0.01).close()
    assert not wire.sent.get("/cmd_vel")


def test_invalid_settings_are_rejected():
    with pytest.raises(ValueError, match="reset must be one of"):
        Ros2Settings(reset="later")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="step_timeout must be positive and finite"):
        Ros2Settings(step_timeout=0.0)
    with pytest.raises(ValueError, match="lidar_yaw must be a finite angle"):
        Ros2Settings(lidar_yaw=math.nan)
    with pytest.raises(ValueError, match="max_invalid must be at least 0 and less than 1"):
        Ros2Settings(max_invalid=1.0)
    with pytest.raises(ValueError, match="transport must be one of"):
        Ros2Settings(transport="zenoh")  # type: ignore[arg-type]
