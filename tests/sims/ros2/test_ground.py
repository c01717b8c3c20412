"""Elevation maps, point clouds, and the ground and 3D lidar of a live rover that are read from them.

Messages of maps are built here as grid_map's documentation says.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from rover_rl import EnvConfig, RoverEnv
from rover_rl.envs.sensors.cameras import Lidar3D
from rover_rl.envs.sensors.heights import HeightScan
from rover_rl.envs.served_rover import ServedRover
from rover_rl.rotations import quaternion_product, quaternion_to_euler
from rover_rl.sims.ros2 import RobotLostError, Ros2Settings
from rover_rl.sims.ros2 import ground as live_ground
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.ground import elevation_map_message, point_cloud_message, read_elevation_map, read_points
from rover_rl.sims.ros2.robot import RobotNode
from rover_rl.sims.sensor_report import ElevationMap
from rover_rl.worlds import get_world
from tests.sims.ros2.wire import Rover

CENTER, CELL, SIZE = (3.0, -2.0), 0.5, (6, 4)  # middle, side of a cell, rows and columns of the map that is read here
POINTS = np.array(
    [[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0], [-4.5, 5.25, 1e3], [0.0, np.inf, 0.0], [7.0, 8.0, 9.0], [0, 0, 0]]
)
KEPT = torch.from_numpy(POINTS[[0, 2, 4, 5]].astype(np.float32))
LIVE = Ros2Settings(reset="none", settle=0.05)
PLACE, YAW = (1.0, 2.0, 0.1), 0.5
"""Position and heading of the rover of the live tests, which stands on a slope and is level nevertheless."""
STOP = torch.zeros(1, 2)


def position(row: int, column: int) -> tuple[float, float]:
    """Middle of a cell of a map whose buffer starts at 0, 0: GridMapMath.cpp, getPositionFromIndex."""
    x, y = (c + n * CELL / 2 - CELL / 2 - CELL * i for c, n, i in zip(CENTER, SIZE, (row, column), strict=True))
    return x, y


def plane(x: Any, y: Any) -> Any:
    return 0.1 * x - 0.3 * y


def grid_map(start: tuple[int, int] = (0, 0)) -> Any:
    """A map of a plane, with a hole in the cell 1, 2, and a layer of zeros before it."""
    (rows, columns), buffer = SIZE, np.empty(SIZE, np.float32)
    for row, column in np.ndindex(SIZE):
        height = np.nan if (row, column) == (1, 2) else plane(*position(row, column))
        buffer[(row + start[0]) % rows, (column + start[1]) % columns] = height
    dimensions = [("column_index", columns, rows * columns), ("row_index", rows, rows)]
    layout = ros.MultiArrayLayout([ros.MultiArrayDimension(*each) for each in dimensions])
    layers = [ros.Float32MultiArray(layout, array.flatten(order="F")) for array in (np.zeros_like(buffer), buffer)]
    info = ros.GridMapInfo(CELL, rows * CELL, columns * CELL, ros.Pose(ros.Point(*CENTER, 7.0)))
    return ros.GridMap(ros.Header(), info, ["variance", "elevation"], [], layers, *start)


@pytest.mark.parametrize("start", [(0, 0), (5, 2)])
def test_a_map_is_read_whatever_its_circular_buffer_starts_with(start):
    ground = read_elevation_map(ros.decode(ros.GridMap, ros.encode(grid_map(start))))
    places = torch.tensor([[position(row, column) for column in range(4)] for row in range(6)])
    heights = ground.height_at(places)
    assert heights.isnan().nonzero().tolist() == [[1, 2]]
    expected = plane(*places.unbind(-1)).masked_fill(heights.isnan(), torch.nan)
    torch.testing.assert_close(heights, expected, equal_nan=True)
    # Between the middles of cells the plane is met exactly, and beyond the edge nothing is known.
    between = places[4, 1] + 0.2
    torch.testing.assert_close(ground.height_at(between), plane(*between.unbind(-1)))
    assert ground.height_at(torch.tensor([[CENTER[0] + 1.6, CENTER[1]], [CENTER[0], CENTER[1] - 1.1]])).isnan().all()
    back = read_elevation_map(elevation_map_message(ground, ros.Time(), "map"))
    torch.testing.assert_close(back.heights, ground.heights, equal_nan=True)
    assert back[1:] == (CENTER, CELL, "elevation")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda msg: setattr(msg, "layers", ["a", "b"]), r"the layer 'elevation', got \['a', 'b'\] with 2 arrays"),
        (lambda msg: setattr(msg.info, "resolution", 0.0), "resolution .* positive and finite, got 0.0"),
        (lambda msg: setattr(msg.info, "length_x", 9.0), r"9.0 x 2.0 m with cells of 0.5 m has \(6, 4\) cells"),
        (lambda msg: setattr(msg.info.pose.position, "x", math.nan), "center of an elevation map must be finite"),
        (lambda msg: setattr(msg.info.pose, "orientation", ros.Quaternion(z=0.5, w=0.8)), "must not be turned"),
        (lambda msg: setattr(msg.data[1], "data", np.zeros(23, np.float32)), r"of \[4, 6\] with 23 values"),
    ],
)
def test_a_malformed_map_is_refused_in_a_sentence(change, message):
    msg = grid_map()
    change(msg)
    with pytest.raises(ValueError, match=message):
        read_elevation_map(msg)


def test_a_tilted_map_is_read_along_the_vertical():
    """The map is in the frame of a robot that looks up a slope of 20 degrees, which is flat for the robot."""
    tilt, yaw = math.radians(-20), 0.6
    flat = ElevationMap(torch.full((80, 80), 0.05), (0.0, 0.0), 0.1)
    pitch = torch.tensor([0.0, math.sin(tilt / 2), 0.0, math.cos(tilt / 2)])
    turn = torch.tensor([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)])
    place, ahead = torch.tensor([5.0, -1.0, 2.0]), torch.tensor([0.0, 1.0, 2.0, 9.0])
    grid = place[:2] + ahead[:, None] * torch.tensor([math.cos(yaw), math.sin(yaw)])
    heights = live_ground.sample(flat, place, quaternion_product(turn, pitch), grid[None])[0]
    expected = 2.0 + ahead * math.tan(-tilt) + 0.05 / math.cos(tilt)
    torch.testing.assert_close(heights[:3], expected[:3], atol=1e-4, rtol=0)
    assert heights[3].isnan()


def cloud(order: str = "<", shape: tuple[int, int] = (1, 6), kind: str = "f4", padding: int = 0, **changes) -> Any:
    """A cloud whose points have z first, an intensity, and bytes between; and whose rows end with a padding."""
    size = int(kind[1])
    formats, offsets = [order + kind, order + "u2", order + kind, order + kind], [0, size, size + 3, 2 * size + 5]
    names = ["z", "intensity", "x", "y"]
    layout = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": 3 * size + 9})
    records = np.zeros(shape, layout)
    for number, name in enumerate("xyz"):
        records[name] = POINTS[:, number].reshape(shape)
    lines = np.pad(records.view(np.uint8).reshape(shape[0], -1), ((0, 0), (0, padding)), constant_values=7)
    datatype = {"f4": 7, "f8": 8, "i4": 5}[kind]
    fields = [ros.PointField("intensity", size, 4, 1)]
    fields += [ros.PointField(name, layout.fields[name][1], datatype, 1) for name in "zyx"]
    parts = {"height": shape[0], "width": shape[1], "fields": fields, "is_bigendian": order == ">"}
    parts |= {"point_step": layout.itemsize, "row_step": lines.shape[1], "data": lines.flatten()}
    return ros.PointCloud2(ros.Header(), **{**parts, **changes})


@pytest.mark.parametrize(
    ("order", "shape", "kind", "padding"), [("<", (1, 6), "f4", 0), (">", (2, 3), "f4", 5), ("<", (3, 2), "f8", 0)]
)
def test_finite_points_are_read_whatever_the_layout(order, shape, kind, padding):
    assert read_points(ros.decode(ros.PointCloud2, ros.encode(cloud(order, shape, kind, padding)))).equal(KEPT)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: cloud(fields=cloud().fields[:3]), r"x, y and z as float32 or float64, got the fields \['intensity', "),
        (lambda: cloud(kind="i4", shape=(1, 6)), "x, y and z as float32 or float64"),
        (lambda: cloud(point_step=10), "6 x 1 points of 10 bytes, whose coordinates end at 17, has 126 bytes"),
        (lambda: cloud(shape=(2, 3), row_step=8), "in rows of 8"),
    ],
)
def test_a_malformed_cloud_is_refused_in_a_sentence(make, message):
    with np.errstate(invalid="ignore"):
        msg = make()
    with pytest.raises(ValueError, match=message):
        read_points(msg)


def test_the_ground_of_a_cell_is_the_lower_quarter_of_its_points():
    """The grid looks along y. Each point of the grid has a cell of 0.4 m around it."""
    yaw = torch.tensor(math.pi / 2)
    ahead, left = torch.meshgrid(torch.tensor([1.4, 1.0, 0.6]), torch.tensor([0.4, 0.0]), indexing="ij")
    grid = torch.stack((5.0 - left, ahead), -1)
    offsets = 0.38 * torch.rand(40, 2) - 0.19
    ground = torch.cat((grid[1, 0] + offsets, torch.full((40, 1), 0.3)), -1)
    above, below = ground[:24] + torch.tensor([0.0, 0.0, 1.5]), ground[:3] - torch.tensor([0.0, 0.0, 4.0])
    elsewhere = torch.tensor([[5.0, 0.6, 0.7], [5.0, 3.0, 9.0], [5.3, 1.0, 9.0]])
    heights = live_ground.lowest_quarter(torch.cat((above, ground, below, elsewhere)), grid, yaw, 0.4)
    assert (heights[1, 0], heights[2, 1]) == (pytest.approx(0.3), pytest.approx(0.7))
    assert heights.isnan().sum() == 4
    assert live_ground.lowest_quarter(torch.zeros(0, 3), grid, yaw, 0.4).isnan().all()


def test_points_fall_in_the_pixel_of_their_direction():
    lidar = Lidar3D(size=(5, 12), field_of_view=1.5, elevation=(-0.4, 0.2), min_range=0.5)
    rays = torch.tensor(lidar.rays()[0])
    near, far = 1.0 + torch.rand(60), torch.full((60,), 7.0)
    image = lidar.range_image(torch.cat((rays * far[:, None], rays * near[:, None])))
    torch.testing.assert_close(image.flatten(), near)
    # Too far, too close, at the origin, above the image, and behind it.
    few = torch.cat((rays[[0]] * 50, rays[[1]] * 0.4, torch.zeros(1, 3), torch.tensor([[1.0, 0, 3], [-1, 0.1, 0]])))
    image = lidar.range_image(few).flatten()
    assert image[1] == 0
    assert (image[[0, *range(2, 60)]] == lidar.max_range).all()


def test_a_live_rover_on_hills_reads_what_a_simulated_one_does(wire):
    heights, lidar = HeightScan(size=(8, 6), spacing=0.3), Lidar3D(size=(8, 48))
    by_points = replace(heights, name="by_points", topic="/points", mount=lidar.mount)
    world = get_world("hills:3")
    config = EnvConfig(world=world, seed=0, backend="warp", sensors=(heights, lidar))
    robot = ServedRover(config)
    wire.rovers.append(RobotNode(robot, wire, start=(1.0, 2.0, 0.7)).step)
    env, still = RoverEnv(world_n=world, backend=LIVE, seed=0, sensors=[heights, lidar, by_points]), RoverEnv(config)
    env.reset()
    x, y, _ = env.rover_state.position[0].tolist()
    place = torch.tensor([[x, y, quaternion_to_euler(env.rover_state.orientation)[0, 2]]])
    still.reset(start=place, goal=torch.ones(1, 2))
    # Both come to rest.
    for _ in range(20):
        live, simulated = (each.step_commands(STOP) for each in (env, still))
    assert simulated["heights"].std() > 0.05
    torch.testing.assert_close(live["heights"], simulated["heights"], atol=0.02, rtol=0)
    assert ((live["lidar3d"] - simulated["lidar3d"]).abs() < 0.02).float().mean() >= 0.99
    seen = live["by_points"] != 0
    assert seen.sum() > 10
    torch.testing.assert_close(live["by_points"][seen], simulated["heights"][seen], atol=0.08, rtol=0)
    for each in (env, still, robot):
        each.close()


def slope(x, y):
    return 0.2 * x - 0.1 * y


def around(forward, left):
    """Height of the slope at points relative to the rover."""
    x, y = turned(forward, left).unbind(-1)
    return slope(PLACE[0] + x, PLACE[1] + y)


def turned(forward, left):
    cos, sin = math.cos(YAW), math.sin(YAW)
    return torch.stack((cos * forward - sin * left, sin * forward + cos * left), -1)


def points_of_grid() -> tuple[torch.Tensor, torch.Tensor]:
    return torch.meshgrid(torch.arange(4.0, -2.0, -1.0), torch.arange(1.0, -2.0, -1.0), indexing="ij")


def map_of_slope(frame: str) -> Any:
    """The slope on a map of 7.4 x 7.4 m around the rover, with a hole at its place."""
    along = torch.arange(3.65, -3.7, -0.1, dtype=torch.float64)
    x, y = torch.meshgrid(along, along, indexing="ij")
    if frame == "base_link":
        heights, center = around(x, y) - PLACE[2], (0.0, 0.0)
    else:
        heights, center = slope(PLACE[0] + x, PLACE[1] + y), PLACE[:2]
    heights = heights.masked_fill(x.square() + y.square() < 0.04, math.nan)
    return elevation_map_message(ElevationMap(heights, center, 0.1), ros.Time(), frame)


def cloud_of_slope(frame: str) -> Any:
    """The slope at the points of the grid, but for the one at the rover, as a lidar 0.5 m above the rover sees it."""
    forward, left = points_of_grid()
    x, y = (torch.tensor(PLACE)[:2] + turned(forward, left)).unbind(-1)
    if frame == "map":
        points = torch.stack((x, y, slope(x, y)), -1)
    else:
        points = torch.stack((forward, left, around(forward, left) - PLACE[2]), -1)
        points = points if frame == "base_link" else points - torch.tensor([0.0, 0.0, 0.5])
    hidden = forward.hypot(left) < 0.1
    return point_cloud_message(points.masked_fill(hidden[..., None], math.nan), ros.Time(), frame)


def live_env(wire, sensor, message, pose_frame="/map", backend=LIVE):
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


@pytest.mark.parametrize(
    ("message", "frame"),
    [
        *((map_of_slope, frame) for frame in ("map", "base_link", "odom")),
        *((cloud_of_slope, frame) for frame in ("map", "base_link", "lidar")),
    ],
)
def test_heights_are_those_of_the_ground_whatever_the_frame(wire, message, frame):
    scan = HeightScan(size=(6, 3), spacing=1.0, ahead=1.5, topic="/ground")
    env = live_env(wire, scan, message(frame), pose_frame="" if frame == "odom" else "/map")
    heights = env.step_commands(STOP)["heights"].unflatten(-1, scan.size)[0]
    forward, left = points_of_grid()
    # The map ends 3.7 m ahead, and has a hole.
    unknown = (forward.abs() + left.abs()) == 0
    if message is map_of_slope:
        x, y = (forward, left) if frame == "base_link" else turned(forward, left).unbind(-1)
        unknown |= (x.abs() > 3.7) | (y.abs() > 3.7)
    expected = (around(forward, left) - PLACE[2]).masked_fill(unknown, 0.0).clamp(-1, 1)
    torch.testing.assert_close(heights, expected, atol=1e-4, rtol=0)
    env.close()


@pytest.mark.parametrize(
    ("sensor", "message", "text"),
    [
        (HeightScan(topic="/ground"), None, r"/ground \(layer elevation /ground\): no message has arrived yet"),
        (HeightScan(topic="/ground"), map_of_slope("odom"), r"pose or robot, \['base_link', 'map'\], got 'odom'"),
        (HeightScan(topic="/ground", layer="top"), map_of_slope("map"), r"must have the layer 'top', got"),
        (Lidar3D(topic="/ground"), cloud_of_slope("map"), "must be in the frame of the lidar, got 'map'"),
    ],
)
def test_a_topic_without_usable_messages_stops_the_rover(wire, sensor, message, text):
    env = live_env(wire, sensor, message, backend=replace(LIVE, step_timeout=0.5))
    with pytest.raises(RobotLostError, match=f"{text}.*; a stop command was sent"):
        env.step_commands(STOP)
    env.close()
