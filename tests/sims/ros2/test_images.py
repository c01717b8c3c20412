"""Depth images of a live rover."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rover_rl import EnvConfig, RoverEnv, Terrain, World, box
from rover_rl.envs.sensors.ray_images import DepthCamera, SegmentationCamera
from rover_rl.envs.served_rover import ServedRover
from rover_rl.sims.ros2 import RobotLostError, Ros2Settings
from rover_rl.sims.ros2.dds import DdsTransport
from rover_rl.sims.ros2.images import depth_message, read_depth, resized
from rover_rl.sims.ros2.messages import Header, Image
from rover_rl.sims.ros2.robot import RobotNode
from tests.sims.ros2.processes import until

WORLD = World("wall", Terrain.flat((16.0, 16.0)), [box((3.0, 0.5, 0.5), (0.4, 2.0, 1.0))])
CAMERA = DepthCamera(size=(12, 16))


def _image(pixels: np.ndarray, kind: str, padding: int = 0, **fields) -> Image:
    lines = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    lines = np.pad(lines, ((0, 0), (0, padding)), constant_values=7)
    rows, columns = pixels.shape
    layout = {"height": rows, "width": columns, "step": lines.shape[1], "encoding": kind, "data": lines.flatten()}
    return Image(Header(), **{**layout, **fields})


def test_depths_are_read_in_meters_whatever_their_encoding():
    meters = np.array([[0.5, 1.25, np.nan], [2.0, np.inf, -1.0]])
    expected = torch.tensor([[0.5, 1.25, 0.0], [2.0, torch.inf, 0.0]])
    assert read_depth(_image(meters.astype("<f4"), "32FC1")).equal(expected)
    assert read_depth(_image(meters.astype(">f4"), "32FC1", padding=5, is_bigendian=1)).equal(expected)
    millimeters = np.array([[500, 0], [65535, 1250]])
    for kind, order in (("<u2", 0), (">u2", 1)):
        read = read_depth(_image(millimeters.astype(kind), "16UC1", is_bigendian=order))
        torch.testing.assert_close(read, torch.tensor([[0.5, 0.0], [65.535, 1.25]]))
    assert read_depth(depth_message(expected, Header().stamp, "camera")).equal(expected)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"encoding": "rgb8"}, r"one of \['32FC1', '16UC1', 'mono16'\], got 'rgb8'"),
        ({"height": 3}, "2 x 3 pixels has 16 bytes, in rows of 8"),
        ({"step": 4}, "2 x 2 pixels has 16 bytes, in rows of 4"),
        ({"width": 0}, "0 x 2 pixels"),
    ],
)
def test_an_image_that_is_no_depth_image_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        read_depth(_image(np.ones((2, 2), dtype="<f4"), "32FC1", **changes))


def test_another_size_takes_the_nearest_pixels():
    depth = torch.arange(16.0).reshape(4, 4)
    assert resized(depth, (4, 4)).equal(depth)
    assert resized(depth, (2, 2)).equal(depth[1::2, 1::2])
    assert set(resized(depth, (7, 5)).flatten().tolist()) <= set(depth.flatten().tolist())


def _live(wire, *sensors, cameras=(CAMERA,)) -> RoverEnv:
    """Starts a robot with cameras on the wire, and the environment that drives it with sensors."""
    rover = ServedRover(EnvConfig(world=WORLD, seed=0, backend="warp", sensors=cameras))
    node = RobotNode(rover, wire, WORLD, 12.0)
    wire.rovers.append(node.step)
    backend = Ros2Settings(reset="none", settle=0.05, step_timeout=1.0)
    return RoverEnv(world_n=WORLD, backend=backend, seed=0, sensors=sensors)


def test_a_live_camera_reads_what_the_simulated_one_does(wire):
    env = _live(wire, CAMERA)
    env.reset()
    live = env.rand_step()["next", "depth"].unflatten(-1, CAMERA.size)[0]
    still = RoverEnv(world_n=WORLD, num_envs=1, seed=0, backend="warp", sensors=[CAMERA])
    simulated = still.reset(start=torch.zeros(1, 3), goal=torch.ones(1, 2))["depth"].unflatten(-1, CAMERA.size)[0]
    # The rover has moved a little.
    torch.testing.assert_close(live.median(), simulated.median(), atol=0.05, rtol=0)
    assert ((live - simulated).abs() < 0.1).float().mean() > 0.9
    env.close()


def test_several_cameras_have_topics_of_their_own(wire):
    left = DepthCamera(name="left", size=(6, 8), yaw=1.0, topic="/left/depth")
    env = _live(wire, CAMERA, left, cameras=(CAMERA, left))
    env.reset()
    step = env.rand_step()["next"]
    assert not step["left"].equal(step["depth"].unflatten(-1, CAMERA.size)[..., ::2, ::2].flatten(1))
    assert (step["left"] > 0).any()
    env.close()


def test_a_camera_that_is_silent_stops_the_rover(wire):
    env = _live(wire, CAMERA, cameras=())
    env.reset()
    with pytest.raises(RobotLostError, match=r"/camera/image_raw .*no message has arrived yet; a stop"):
        env.rand_step()
    env.close()


def test_a_sensor_that_a_live_rover_does_not_have_is_refused(wire):
    env = _live(wire, SegmentationCamera())
    with pytest.raises(ValueError, match="casts rays.*a live rover has none"):
        env.reset()
    env.close()


@pytest.mark.ros2
def test_an_image_of_a_dds_publisher_arrives(domain):
    talker, listener = DdsTransport("talker", domain), DdsTransport("listener", domain)
    received: list[Image] = []
    listener.subscribe("/depth", Image, received.append)
    publish = talker.publisher("/depth", Image, reliable=True)
    until(lambda: talker.subscribers("/depth"))
    depth = torch.rand(48, 64)
    publish(depth_message(depth, Header().stamp, "camera"))
    until(lambda: received)
    assert read_depth(received[0]).equal(depth)
    talker.close()
    listener.close()
