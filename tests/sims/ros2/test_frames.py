"""What RViz and other tools know of a simulated robot: tf, its shape, its cameras and the map."""

from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rover_rl import Terrain, World, box
from rover_rl.envs.config import EnvConfig, LidarConfig
from rover_rl.envs.imperfections import imperfect
from rover_rl.envs.sensors.cameras import ColorCamera, DepthCamera, Lidar3D
from rover_rl.envs.served_rover import ServedRover
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.ros2.messages import Twist, Vector3, seconds_of
from rover_rl.sims.ros2.robot import RobotFrames, RobotNode, info_topic, world_map
from tests.sims.ros2.wire import Wire

# A wall whose near side is at x = 2.
WALLED = World("walled", Terrain.flat((12, 10)), [box((2.5, 1.0, 0.5), (1.0, 8.0, 1.0))])
SENSORS = (
    DepthCamera(size=(12, 16), mount=(0.2, 0.1, 0.3), yaw=0.3),
    ColorCamera(size=(6, 8), topic="/rear/image/compressed", yaw=3.0),
    Lidar3D(size=(4, 30)),
)


def driven(wire: Wire, steps: int = 40, lidar_yaw: float = 0.5, is_localized: bool = True, harsh: bool = False) -> None:
    """Drives a robot on the wire in a curve."""
    config = EnvConfig(world=WALLED, backend="warp", seed=0, lidar=LidarConfig(beams=64), sensors=SENSORS)
    rover = ServedRover(imperfect(config, "harsh") if harsh else config)
    settings = Ros2Settings(lidar_yaw=lidar_yaw)
    node = RobotNode(rover, wire, settings, start=(0.0, -1.0, 0.4), is_localized=is_localized)
    publish = wire.publisher("/cmd_vel", Twist)
    for _ in range(steps):
        publish(Twist(Vector3(x=0.4), Vector3(z=-0.8)))
        node.step()


class Tree:
    """Transforms that were published, at the time of a stamp."""

    def __init__(self, wire: Wire, stamp: float | None = None) -> None:
        known = [*wire.sent["/tf_static"], *wire.sent["/tf"]]
        found = [each for message in known for each in message.transforms]
        self.parents = {each.child_frame_id: each.header.frame_id for each in found}
        self._known = {
            each.child_frame_id: each.transform
            for each in found
            if stamp is None or seconds_of(each.header.stamp) in (0.0, stamp)
        }

    def to_map(self, frame: str, points: np.ndarray) -> np.ndarray:
        while frame != "map":
            turn, move = self._known[frame].rotation, self._known[frame].translation
            turned = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).apply(points)
            points = turned + np.array([move.x, move.y, move.z])
            frame = self.parents[frame]
        return points


@pytest.fixture(scope="module")
def wire() -> Wire:
    wire = Wire()
    driven(wire)
    return wire


def test_every_frame_of_a_message_connects_to_the_map(wire) -> None:
    tree = Tree(wire)
    messages = [sent[-1] for sent in wire.sent.values() if hasattr(sent[-1], "header")]
    frames = {message.header.frame_id for message in messages} | {wire.sent["/odometry/wheels"][-1].child_frame_id}
    assert {"depth_optical_frame", "colors_optical_frame", "lidar3d_link", "odom", "lidar_link"} < frames
    for frame in frames:
        tree.to_map(frame, np.zeros((1, 3)))


@pytest.mark.parametrize("harsh", [False, True])
def test_tf_tells_the_pose_of_its_stamp_in_ascending_order(harsh: bool) -> None:
    wire = Wire()
    driven(wire, harsh=harsh)
    stamps = [seconds_of(message.transforms[0].header.stamp) for message in wire.sent["/tf"]]
    assert len(stamps) > 20
    assert (np.diff(stamps) > 0).all()
    for message in wire.sent["/rover/pose_array"][-5:]:
        (pose,), tree = message.poses, Tree(wire, seconds_of(message.header.stamp))
        turn = pose.orientation
        corners = np.vstack((np.zeros(3), np.eye(3)))
        place = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).apply(corners)
        place += [pose.position.x, pose.position.y, pose.position.z]
        np.testing.assert_allclose(tree.to_map("base_link", corners), place, atol=1e-5)


def test_what_sensors_see_lies_where_it_is(wire) -> None:
    scan, tree = wire.sent["/scan"][-1], Tree(wire)
    (returned,) = np.nonzero(np.isfinite(scan.ranges))
    angles = scan.angle_min + scan.angle_increment * returned
    ends = np.stack((np.cos(angles), np.sin(angles), np.zeros(len(angles))), -1) * scan.ranges[returned, None]
    seen = tree.to_map(scan.header.frame_id, ends)
    assert len(seen) > 10
    np.testing.assert_allclose(seen[:, 0], 2.0, atol=0.03)

    (image,), (about,) = wire.sent["/camera/image_raw"][-1:], wire.sent["/camera/camera_info"][-1:]
    assert (about.height, about.width, about.header) == (image.height, image.width, image.header)
    depth = np.frombuffer(image.data.tobytes(), "<f4").reshape(image.height, image.width)
    rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
    pixels = np.stack((columns, rows, np.ones(len(rows))), -1)
    points = np.linalg.solve(about.k.reshape(3, 3), pixels.T).T * depth[rows, columns, None]
    seen = tree.to_map(image.header.frame_id, points)
    on_wall, on_ground = abs(seen[:, 0] - 2) < 0.05, abs(seen[:, 2]) < 0.05
    assert (on_wall | on_ground).all()
    assert on_wall.any()
    assert on_ground.any()
    assert wire.sent["/rear/camera_info"][-1].width == 8


def test_another_node_may_tell_where_odom_is(wire) -> None:
    alone = Wire()
    driven(alone, steps=3, is_localized=False)
    assert Tree(alone).parents == {
        child: parent for child, parent in Tree(wire).parents.items() if child not in ("odom", "world")
    }


def test_the_shape_is_that_of_the_robot() -> None:
    rover = ServedRover(EnvConfig(world=WALLED, backend="warp", robot="jackal"))
    root = ElementTree.fromstring(RobotFrames(rover.robot).description().data)
    (link,) = root
    assert (root.get("name"), link.get("name")) == ("jackal", "base_link")
    assert len(link) == len(rover.robot.visuals)
    places = [[float(number) for number in origin.get("xyz", "").split()] for origin in link.iter("origin")]
    np.testing.assert_allclose(places, [shape.frame.position for shape in rover.robot.visuals], atol=1e-4)


def test_the_map_has_the_obstacles() -> None:
    grid = world_map(WALLED)
    cells = grid.data.reshape(grid.info.height, grid.info.width)
    assert (grid.info.width, grid.info.height, grid.header.frame_id) == (240, 200, "map")

    def at(x: float, y: float) -> int:
        corner = grid.info.origin.position
        return cells[int((y - corner.y) / grid.info.resolution), int((x - corner.x) / grid.info.resolution)]

    assert [at(2.5, 4.9), at(2.1, -2.9), at(2.9, 0.0)] == [100] * 3
    assert [at(2.5, -3.2), at(1.9, 0.0), at(3.1, 0.0), at(-2.5, 4.9)] == [0] * 4


def test_the_topic_of_a_camera_is_beside_that_of_its_images() -> None:
    images = ("/camera/depth/image_raw", "/front/image/compressedDepth", "/image")
    assert [*map(info_topic, images)] == ["/camera/depth/camera_info", "/front/camera_info", "/camera_info"]
