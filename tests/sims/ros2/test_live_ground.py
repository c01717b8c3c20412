"""Height scan and 3D lidar of a live rover."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch

from rover_rl import EnvConfig, RoverEnv
from rover_rl.envs.sensors.heights import HeightScan
from rover_rl.envs.sensors.ray_images import Lidar3D
from rover_rl.envs.served_rover import ServedRover
from rover_rl.rotations import quaternion_to_euler, rotate
from rover_rl.sims.elevation_map import ElevationMap
from rover_rl.sims.ros2 import RobotLostError, Ros2Settings
from rover_rl.sims.ros2.dds import DdsTransport
from rover_rl.sims.ros2.elevation_maps import elevation_map_message
from rover_rl.sims.ros2.messages import GridMap, Header, LaserScan, PointCloud2, encode
from rover_rl.sims.ros2.point_clouds import point_cloud_message
from rover_rl.sims.ros2.pose_reset import TargetPose
from rover_rl.sims.ros2.poses import IDENTITY_ORIENTATION, MeasuredPose, PoseEstimator
from rover_rl.sims.ros2.robot import RobotNode
from rover_rl.worlds import get_world
from tests.sims.ros2.processes import until
from tests.sims.ros2.wire import Rover

HEIGHTS, LIDAR = HeightScan(size=(8, 6), spacing=0.3), Lidar3D(size=(8, 48))
LIVE = Ros2Settings(reset="none", settle=0.05, step_timeout=20.0)
PLACE, YAW = (1.0, 2.0, 0.1), 0.5
"""Position and heading of the rover of these tests, which stands on a slope and is level nevertheless."""
STOP = torch.zeros(1, 2)


def test_a_live_rover_on_hills_reads_what_a_simulated_one_does(wire):
    world, start = get_world("hills:3"), (1.0, 2.0, 0.7)
    by_points = replace(HEIGHTS, name="by_points", topic="/points", mount=LIDAR.mount)
    config = EnvConfig(world=world, seed=0, backend="warp", sensors=(HEIGHTS, LIDAR))
    robot = ServedRover(config)
    wire.rovers.append(RobotNode(robot, wire, 12.0, start=start).step)
    env, still = RoverEnv(world_n=world, backend=LIVE, seed=0, sensors=[HEIGHTS, LIDAR, by_points]), RoverEnv(config)
    env.reset()
    x, y, _ = env.rover_state.position[0].tolist()
    place = torch.tensor([[x, y, quaternion_to_euler(env.rover_state.orientation)[0, 2]]])
    still.reset(start=place, goal=torch.ones(1, 2))
    # Both come to rest.
    for _ in range(20):
        live, simulated = (each.step_commands(STOP) for each in (env, still))
    assert simulated["heights"].std() > 0.05
    torch.testing.assert_close(live["heights"], simulated["heights"], atol=0.02, rtol=0)
    assert 0.3 < (simulated["lidar3d"] < LIDAR.max_range).float().mean() < 0.9
    assert ((live["lidar3d"] - simulated["lidar3d"]).abs() < 0.02).float().mean() >= 0.99
    seen = live["by_points"] != 0
    assert seen.sum() > 10
    torch.testing.assert_close(live["by_points"][seen], simulated["heights"][seen], atol=0.08, rtol=0)
    for each in (env, still, robot):
        each.close()


def _ground(x, y):
    return 0.2 * x - 0.1 * y


def _map(frame: str) -> GridMap:
    """The slope on a map of 7.4 x 7.4 m around the rover, with a hole at its place."""
    along = torch.arange(3.65, -3.7, -0.1, dtype=torch.float64)
    x, y = torch.meshgrid(along, along, indexing="ij")
    if frame == "base_link":
        heights, center = _in_world(x, y) - PLACE[2], (0.0, 0.0)
    else:
        heights, center = _ground(PLACE[0] + x, PLACE[1] + y), PLACE[:2]
    heights = heights.masked_fill(x.square() + y.square() < 0.04, math.nan)
    return elevation_map_message(ElevationMap(heights, center, 0.1), Header().stamp, frame)


def _in_world(forward, left):
    """Height of the slope at points relative to the rover."""
    cos, sin = math.cos(YAW), math.sin(YAW)
    return _ground(PLACE[0] + cos * forward - sin * left, PLACE[1] + sin * forward + cos * left)


def _cloud(frame: str) -> PointCloud2:
    """The slope at the points of the grid, but for the one at the rover, as a lidar 0.5 m above the rover sees it."""
    forward, left = _points()
    x, y = (torch.tensor(PLACE)[:2] + _turned(forward, left)).unbind(-1)
    if frame == "map":
        points = torch.stack((x, y, _ground(x, y)), -1)
    else:
        points = torch.stack((forward, left, _in_world(forward, left) - PLACE[2]), -1)
        points = points if frame == "base_link" else points - torch.tensor([0.0, 0.0, 0.5])
    hidden = forward.hypot(left) < 0.1
    return point_cloud_message(points.masked_fill(hidden[..., None], math.nan), Header().stamp, frame)


def _points() -> tuple[torch.Tensor, torch.Tensor]:
    return torch.meshgrid(torch.arange(4.0, -2.0, -1.0), torch.arange(1.0, -2.0, -1.0), indexing="ij")


def _turned(forward, left):
    cos, sin = math.cos(YAW), math.sin(YAW)
    return torch.stack((cos * forward - sin * left, sin * forward + cos * left), -1)


def _live(wire, sensor, message, pose_frame="/map", backend=LIVE):
    """A rover that publishes a message for a sensor in each of its steps, and the environment that drives it."""
    Rover(wire)

    def name_frame(poses):
        poses.header.frame_id = pose_frame
        return poses

    wire.tamper["/rover/pose_array"] = name_frame
    if message is not None:
        publish = wire.publisher(sensor.topic, type(message))
        wire.rovers.insert(0, lambda: publish(message))
    env = RoverEnv(world_n="maze", backend=backend, seed=0, sensors=[sensor])
    env.reset()
    return env


@pytest.mark.parametrize("frame", ["map", "base_link", "lidar"])
@pytest.mark.parametrize("message", [_map, _cloud])
def test_heights_are_those_of_the_ground_whatever_the_frame(wire, message, frame):
    if message is _map and frame == "lidar":
        frame = "odom"
    scan = HeightScan(size=(6, 3), spacing=1.0, ahead=1.5, topic="/ground")
    env = _live(wire, scan, message(frame), pose_frame="" if frame == "odom" else "/map")
    heights = env.step_commands(STOP)["heights"].unflatten(-1, scan.size)[0]
    forward, left = _points()
    expected = _in_world(forward, left) - PLACE[2]
    # The map ends 3.7 m ahead, and has a hole.
    unknown = (forward.abs() + left.abs()) == 0
    if message is _map:
        x, y = (forward, left) if frame == "base_link" else _turned(forward, left).unbind(-1)
        unknown |= (x.abs() > 3.7) | (y.abs() > 3.7)
    torch.testing.assert_close(heights, expected.masked_fill(unknown, 0.0).clamp(-1, 1), atol=1e-4, rtol=0)
    env.close()


@pytest.mark.parametrize(
    ("sensor", "message", "text"),
    [
        (HeightScan(topic="/ground"), None, r"/ground \(layer elevation /ground\): no message has arrived yet"),
        (HeightScan(topic="/ground"), _map("odom"), r"frame of pose or robot, \['base_link', 'map'\], got 'odom'"),
        (
            HeightScan(topic="/ground", layer="top"),
            _map("map"),
            r"must have the layer 'top', got \['elevation'\] with 1 arrays",
        ),
        (Lidar3D(topic="/ground"), None, r"/ground \(lidar3d /ground\): no message has arrived yet"),
        (Lidar3D(topic="/ground"), _cloud("map"), "must be in the frame of the lidar, got 'map'"),
    ],
)
def test_a_topic_without_usable_messages_stops_the_rover(wire, sensor, message, text):
    env = _live(wire, sensor, message, backend=replace(LIVE, step_timeout=0.5))
    with pytest.raises(RobotLostError, match=f"{text}; a stop command was sent"):
        env.step_commands(STOP)
    env.close()


def test_the_ground_is_not_read_from_other_messages(wire):
    with pytest.raises(ValueError, match=r"read from \['grid_map.*/PointCloud2'\], and /g has \['sensor"):
        _live(wire, HeightScan(topic="/g"), LaserScan())


def test_odometry_is_placed_in_the_world_with_the_pose():
    estimator = PoseEstimator("wheels")
    pose = MeasuredPose(torch.tensor([3.0, -1.0, 0.4]), torch.tensor([0.0, 0.0, math.sin(0.3), math.cos(0.3)]))
    estimator.start_episode(pose, IDENTITY_ORIENTATION, TargetPose(5.0, 6.0, 0.0, 1.7), ground=0.2)
    position, orientation = estimator.frame_in_world()
    torch.testing.assert_close(position + rotate(orientation, pose.position), torch.tensor([5.0, 6.0, 0.2]))
    ahead = rotate(orientation, torch.tensor([math.cos(0.6), math.sin(0.6), 0.0]))
    torch.testing.assert_close(ahead, torch.tensor([math.cos(1.7), math.sin(1.7), 0.0]))


@pytest.mark.ros2
def test_maps_and_clouds_of_a_dds_publisher_arrive(domain):
    talker, listener = DdsTransport("talker", domain), DdsTransport("listener", domain)
    sent = [("/ground", _map("map")), ("/points", _cloud("lidar"))]
    received: dict[str, Any] = {}
    for topic, message in sent:
        listener.subscribe(topic, type(message), partial(received.__setitem__, topic))
        publish = talker.publisher(topic, type(message), reliable=True)
        until(partial(talker.subscribers, topic))
        publish(message)
        until(lambda topic=topic: topic in received)
        until(lambda topic=topic, message=message: listener.types(topic) == {message.ros_type})
    assert listener.types("/nothing") == set()
    assert encode(received["/ground"]) == encode(sent[0][1])
    assert encode(received["/points"]) == encode(sent[1][1])
    talker.close()
    listener.close()
