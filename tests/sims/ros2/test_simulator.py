from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from rover_rl import Randomization, RoverEnv, TaskConfig
from rover_rl import make_env as make_env_of_contract
from rover_rl.envs.gym import RoverEnv as GymRoverEnv
from rover_rl.envs.sensors.standard import taken_at
from rover_rl.sims.ros2 import RobotLostError, Ros2Settings
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.messages import Imu, LaserScan, Odometry, PoseArray, Quaternion, Twist, Vector3
from rover_rl.sims.ros2.simulator import FROZEN_SCANS, Ros2Simulator
from rover_rl.worlds import get_world
from tests.envs import transcription as contract
from tests.envs.contract.witness import check_witnessed, witness
from tests.sims.ros2.wire import ALL, BEAMS, STEP, SimulatedRobot, Wire, drive, simulator, yaw_of

POSE = torch.tensor([[1.0, 2.0, 0.5]])  # pose of the rover before a reset


@pytest.fixture
def sim(rover) -> Ros2Simulator:
    sim = simulator(reset="none")
    sim.reset(ALL, POSE)
    return sim


def test_step_sends_the_command_and_returns_the_next_state(wire, rover, sim):
    rover.ranges[0] = 1.5  # the lidar's first beam, which points forward
    wire.now += 0.01
    state = sim.step(torch.tensor([[0.5, -0.25]]))
    command = wire.sent["/cmd_vel"][-1]
    assert (command.linear.x, command.angular.z) == sim.last_command == (0.5, -0.25)
    assert state.position[0].tolist() == pytest.approx([1.0, 2.0, 0.1])
    assert yaw_of(state) == pytest.approx(0.5, abs=1e-5)
    assert sim.scan().shape == (1, BEAMS)
    assert sim.scan()[0, 0] == 1.5
    assert sim.latency == pytest.approx(0.01)
    assert (state.linear_velocity.item(), state.angular_velocity.item()) == (0.5, -0.25)  # by the wheels


def test_dt_is_the_difference_of_scan_stamps(rover, sim):
    rover.stamp_step = 0.08
    drive(sim)
    assert sim.state().dt.item() == pytest.approx(0.08, abs=1e-6)
    rover.stamp_step = 0.01  # scans of a fast lidar are skipped
    drive(sim)
    assert sim.state().dt.item() == pytest.approx(0.04, abs=1e-6)
    rover.stamp, rover.stamp_step = -1000.0, 0.08  # the clock has jumped
    drive(sim)
    assert sim.state().dt.item() == pytest.approx(0.05)


def test_messages_that_arrive_after_their_scan_belong_to_it_and_commands_may_be_stamped(wire, rover):
    wire.receivers["/cmd_vel"].clear()
    wire.received["/cmd_vel"] = {"geometry_msgs/msg/TwistStamped"}
    rover.silent.add("odometry")  # which starts after the scan
    wire.rovers.append(lambda: rover.stamp > 0.5 and rover.silent.clear())
    rover.scan_first, sim = True, simulator(command="twist_stamped", reset="none")
    sim.reset(ALL, POSE)
    for _ in range(3):
        rover.yaw += 0.1
        drive(sim)
        assert yaw_of(sim.state()) == pytest.approx(rover.yaw, abs=1e-5)
        assert sim.state().stamp.item() == pytest.approx(rover.stamp)
    sent = wire.sent["/cmd_vel"][-1]
    assert (sent.header.frame_id, sent.header.stamp.sec) == ("base_link", int(wire.now))
    assert (sent.twist.linear.x, sent.twist.angular.z) == (0.5, pytest.approx(0.2))


def test_without_a_robot_observations_are_empty_with_a_warning(wire, caplog):
    sim = simulator(timeout=0.05)
    assert "no usable scan on /scan within 0.05 s" in caplog.text
    assert not sim.robot_connected
    state = sim.reset(ALL, POSE)
    assert "no robot has appeared" in caplog.text
    assert torch.isposinf(sim.scan()).all()
    assert (state.position == 0).all()
    assert state.orientation.tolist() == [[0, 0, 0, 1]]
    with pytest.raises(RobotLostError, match=r"/scan \(scan\): no message has arrived yet"):
        drive(sim)
    assert all(twist == Twist() for twist in wire.sent["/cmd_vel"])  # no motion without a scan


@pytest.mark.parametrize(("kind", "topic"), [("scan", "/scan"), ("imu", "/imu/data"), ("pose", "/rover/pose_array")])
def test_a_silent_topic_stops_the_rover(wire, rover, kind, topic):
    sim = simulator(reset="none", step_timeout=0.5)
    sim.reset(ALL, POSE)
    drive(sim)
    rover.silent.add(kind)
    with pytest.raises(RobotLostError, match=rf"lost the robot: {topic} \({kind}\): the last message is \d+.\d s old"):
        drive(sim, steps=10**6)
    assert wire.sent["/cmd_vel"][-2:] == [Twist(), Twist()]
    wire.sleep(1.0)
    assert not sim.robot_connected
    rover.silent.clear()
    rover.publish()  # the robot resumes
    drive(sim)
    assert wire.sent["/cmd_vel"][-1].linear.x == 0.5


def test_malformed_messages_are_ignored_and_the_last_valid_value_remains(sim, caplog):
    before = sim.state()
    bad = {
        "scan": LaserScan(angle_increment=0.1),
        "imu": Imu(orientation=Quaternion(w=0.0)),
        "odometry": Odometry(twist=ros.TwistWithCovariance(Twist(Vector3(x=math.nan)))),
        "pose": PoseArray(),
    }
    for kind, message in bad.items():
        caplog.clear()
        assert not sim.receive(kind, message)
        assert not sim.receive(kind, message)
        assert caplog.text.count("ignored a message") == 1
    after = sim.state()
    assert all(torch.equal(before.get(key), after.get(key)) for key in before.keys())  # noqa: SIM118


def test_gymnasium_callbacks_process_messages(wire):
    env = GymRoverEnv(world_n="maze", backend=Ros2Settings(reset="none"), connection_check_timeout=0)
    assert not env._robot_connected
    assert not env._check_robot_connection(timeout=0.0)
    env.lidar_callback(LaserScan(angle_min=-math.pi, angle_increment=math.pi / 4, ranges=np.full(8, 3.0, np.float32)))
    env.imu_callback(Imu(orientation=Quaternion(z=2.0, w=2.0)))
    env.odom_callback(Odometry(twist=ros.TwistWithCovariance(Twist(Vector3(x=0.5), Vector3(z=-0.25)))))
    env.pose_array_callback(PoseArray(poses=[ros.Pose(ros.Point(1.0, 2.0, 3.0))]))
    assert env._check_robot_connection(timeout=0.0)
    state = env.base_env.simulator.state()
    assert yaw_of(state) == pytest.approx(math.pi / 2, abs=1e-5)
    assert (state.linear_velocity.item(), state.angular_velocity.item()) == (0.5, -0.25)
    assert state.position[0].tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(ValueError, match="kind must be one of"):
        env.base_env.simulator.receive("camera", None)
    env.close()


def test_the_environment_of_a_live_rover_matches_its_specs_and_fulfills_the_contract(wire):
    robot = SimulatedRobot(wire, get_world("maze"), (0.0, 0.0, 0.0))
    settings = {"world_n": "maze", "backend": Ros2Settings(reset="topic"), "seed": 0, "length": 20}
    check_env_specs(make_env_of_contract(**settings), break_when_any_done="both")
    env = make_env_of_contract(**settings)
    rng = np.random.default_rng(0)

    def wander(td, bare, k):
        return torch.from_numpy(rng.uniform(-1, 1, (1, 2))).float() * torch.tensor([1.0, math.pi])

    table = contract.WORLDS["maze"]
    seen = witness(env, (table.too_far_away_x, table.too_far_away_y), 50, wander, length=20)
    check_witnessed(seen)
    assert sum(verdict.truncated for verdict in seen.verdicts) == 2
    env.close()
    robot.rover.close()


def make_env(task: TaskConfig | None = None) -> RoverEnv:
    backend = Ros2Settings(reset="none", max_invalid=0.2, settle=0.05)
    return RoverEnv(world_n="maze", backend=backend, lidar_beams=BEAMS, lidar_points=BEAMS, task=task)


@pytest.mark.parametrize(
    ("ranges", "seen"),
    [
        ([math.nan] + [2.0] * 15, 2.0),  # two readings per beam: the other one is valid
        ([math.nan] * 3 + [2.0] * 13, 1.0),  # no valid reading
        ([math.inf] + [2.0] * 7, 12.0),
        ([-math.inf] + [2.0] * 7, 0.0),
        ([1.0, 2.0], 1.0),
    ],
)
def test_every_lidar_reading_becomes_a_valid_observation(rover, ranges, seen):
    rover.ranges = np.array(ranges, np.float32)
    env = make_env()
    lidar = env.reset()["lidar"][0]
    assert lidar[0] == seen
    assert ((lidar >= 0) & (lidar <= 12.0)).all()
    env.close()


def test_a_live_rover_drives_a_policy_of_a_task_with_contact_and_senses_none(rover):
    rover.ranges[0] = 0.1
    env = make_env(TaskConfig(collision_from="contact", collision_window=0))
    td = env.step(env.reset().set("action", torch.tensor([[0.5, 0.0]])))["next"]
    assert td["lidar"].min() < 0.3
    assert not td["outcome", "collision"].item()
    assert not td["terminated"].item()
    assert env.rover_state.contact.tolist() == [[False]]
    env.close()


def sent_speed(sim: Ros2Simulator, wire: Wire, speed: float = 0.5) -> float:
    """Returns the forward speed that is sent for a desired ``speed``."""
    drive(sim, steps=2, speed=speed)
    assert wire.sent["/cmd_vel"][-1].angular.z == pytest.approx(0.2)  # turning is always allowed
    return wire.sent["/cmd_vel"][-1].linear.x


@pytest.mark.parametrize(
    ("front", "behind", "speed", "sent"),
    [(5.0, 5.0, 0.5, 0.5), (math.nan, 5.0, 0.5, 0.0), (math.nan, 5.0, -0.5, -0.5), (5.0, math.nan, -0.5, 0.0)],
)
def test_a_rover_does_not_move_towards_unseen_directions(wire, rover, caplog, front, behind, speed, sent):
    rover.ranges = np.full(64, 5.0, np.float32)  # from straight behind
    rover.ranges[[31, 32, 33]], rover.ranges[[63, 0, 1]] = front, behind
    sim = simulator(reset="none", lidar_yaw=0.0, beams=64)
    sim.reset(ALL, POSE)
    assert sent_speed(sim, wire, speed) == sent
    assert sim.held == (sent == 0.0)
    assert ("no beam covers all of that direction" in caplog.text) == sim.held


def test_unusable_scans_stop_the_rover_before_it_is_lost(wire, rover, sim):
    assert sent_speed(sim, wire) == 0.5
    rover.ranges[:] = math.nan
    stopped_at: list[float] = []

    def recover() -> None:
        if wire.sent["/cmd_vel"][-1] == Twist():
            stopped_at.append(rover.stamp)
            rover.ranges[:] = 5.0

    wire.rovers.append(recover)
    before = rover.stamp
    drive(sim)
    assert stopped_at[0] - before == pytest.approx(0.25 + STEP)
    assert sent_speed(sim, wire) == 0.5  # drives on with usable scans


@pytest.mark.parametrize(("step", "warned"), [(0.05, False), (0.1, True), (0.01, True)])
def test_an_unsupported_scan_rate_logs_a_warning(rover, sim, caplog, step, warned):
    rover.stamp_step = step
    for _ in range(25):
        rover.publish()
    assert ("scans per second; policies require 15 to 30" in caplog.text) == warned


def test_two_robots_on_one_topic_are_detected(wire, rover, sim, monkeypatch):
    monkeypatch.setattr("rover_rl.sims.ros2.simulator.PUBLISHER_CHECK_INTERVAL", -1.0)
    drive(sim)
    assert wire.sent["/cmd_vel"][-1] != Twist()
    wire.robots = 2
    for use in (drive, lambda sim: sim.reset(ALL, POSE), Ros2Simulator.require_robot):
        with pytest.raises(RobotLostError, match=r"2 publishers send on /\S+: there may be several robots"):
            use(sim)
        assert wire.sent["/cmd_vel"][-1] == Twist()


@pytest.mark.parametrize("close", [True, False], ids=["closed", "deleted"])
def test_the_end_of_a_simulator_stops_the_rover_and_closes_the_connection(wire, rover, close):
    sim = simulator()
    drive(sim, steps=2)  # no motion in the first step, before the first scan
    assert wire.sent["/cmd_vel"][-1].linear.x == 0.5
    if close:
        sim.close()
        sim.close()
    del sim
    assert wire.closed
    assert wire.sent["/cmd_vel"][-1] == Twist()


def test_a_late_scan_is_paired_with_the_pose_of_its_time_and_a_late_pose_is_carried_on_to_now(wire):
    late = Randomization(scan_latency=(4, 4), state_latency=(2, 2), lost_scans=0.1)
    robot = SimulatedRobot(wire, get_world("maze"), (-2.0, 0.0, 0.5), randomization=late)
    settings = {"world_n": "maze", "backend": Ros2Settings(reset="none"), "seed": 0}
    env = RoverEnv(**settings, sensors=["scan_pose"], compensate_delay=True)
    td = env.reset()
    errors = []
    for _ in range(20):
        td = env.step(td.set("action", torch.tensor([[0.8, 1.0]])))["next"]
        truth, yaw = [*robot.poses.values()][-1]
        place = torch.stack((td["pose"][0], env.state.pose.position[0]))
        heading = torch.stack((td["imu"][0, 2], env.state.sensed.yaw[0, 0]))
        errors.append(torch.cat(((place - truth).norm(dim=-1), (heading - yaw).abs())))
    predicted, told, turned, seen = torch.stack(errors)[5:].median(0).values
    assert predicted < 0.4 * told
    assert turned < 0.4 * seen
    position, attitude = taken_at(td)
    place, yaw = robot.poses[round(env.rover_state.stamp.item(), 3)]
    assert torch.allclose(position[0], place, atol=1e-3)
    assert attitude[0, 2].item() == pytest.approx(yaw, abs=1e-3)
    assert td["scan_pose"][0, :2].norm() > 0.02
    env.close()
    with pytest.raises(ValueError, match=r"compensate_delay needs sensors=\('scan_pose',\) with a live rover"):
        RoverEnv(**settings, compensate_delay=True)
    robot.rover.close()


def test_a_frozen_scan_stops_the_rover_that_drives(wire, rover, sim):
    rover.frozen = True
    drive(sim, steps=FROZEN_SCANS)  # some drivers send each scan several times
    with pytest.raises(RobotLostError, match=r"scans on /scan stay the same to the last bit while the wheels turn"):
        drive(sim, steps=10)
    assert wire.sent["/cmd_vel"][-1] == Twist()


@pytest.mark.parametrize("case", ["stands", "sees nothing", "slow"])
def test_the_same_scan_may_come_again(rover, sim, case):
    rover.frozen = True
    rover.ranges[:] = math.inf if case == "sees nothing" else 5.0
    for _ in range(30):
        sim.step(torch.tensor([[{"stands": 0.0, "slow": 0.1}.get(case, 0.5), 0.0]]))


def test_another_driver_stops_the_rover_and_is_named(wire, rover, sim):
    drive(sim)
    wire.say("/cmd_vel", Twist(Vector3(x=0.1)), "/joystick")
    for use in (drive, lambda sim: sim.reset(ALL, POSE), Ros2Simulator.require_robot):
        with pytest.raises(
            RobotLostError, match="/joystick also sends commands on /cmd_vel, so that the rover is stop"
        ):
            use(sim)
        assert wire.sent["/cmd_vel"][-1] == Twist()


def test_another_driver_of_long_ago_is_forgotten_and_one_with_priority_wins(wire, rover, monkeypatch):
    sim = simulator(reset="none", give_way=True)
    sim.reset(ALL, POSE)
    wire.say("/cmd_vel", Twist(Vector3(x=-0.1)), "/joystick")
    count = len(wire.sent["/cmd_vel"])
    drive(sim, steps=3)
    assert len(wire.sent["/cmd_vel"]) == count
    assert sim.last_command == (-0.1, 0.0)
    monkeypatch.setattr("rover_rl.sims.ros2.commands.OTHER_TIME", 0.0)
    drive(sim)
    assert wire.sent["/cmd_vel"][-1].linear.x == 0.5


def test_topics_of_other_types_are_named(wire, rover):
    wire.kinds["/pose"] = {"geometry_msgs/msg/PoseWithCovarianceStamped"}
    rover.silent.add("localizer")
    sim = simulator(reset="none", pose="pose_stamped", pose_topic="/pose", step_timeout=0.3)
    with pytest.raises(
        RobotLostError, match="PoseWithCovarianceStamped, and geometry_msgs/PoseStamped is read: choose p"
    ):
        sim.reset(ALL, POSE)
    wire.received["/cmd_vel"] = {"geometry_msgs/msg/TwistStamped"}
    wire.receivers["/cmd_vel"].clear()
    with pytest.raises(
        ValueError, match="/cmd_vel expects geometry_msgs/TwistStamped, and geometry_msgs/Twist would be"
    ):
        simulator(reset="none").require_robot()
    simulator(reset="none", command="twist_stamped").require_robot()
