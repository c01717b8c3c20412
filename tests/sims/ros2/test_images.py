"""Depth and color images of a live rover."""

from __future__ import annotations

import struct
from io import BytesIO

import numpy as np
import pytest
import torch
from PIL import Image as Picture

from rover_rl import EnvConfig, RoverEnv, Terrain, World, box
from rover_rl.cli import main
from rover_rl.envs.sensors.color_camera import ColorCamera
from rover_rl.envs.sensors.ray_images import DepthCamera, SegmentationCamera
from rover_rl.envs.served_rover import ServedRover
from rover_rl.sims.ros2 import RobotLostError, Ros2Settings
from rover_rl.sims.ros2.dds import DdsTransport
from rover_rl.sims.ros2.image_formats import image_format
from rover_rl.sims.ros2.images import depth_message, read_colors, read_depth, resized
from rover_rl.sims.ros2.messages import CompressedImage, Header, Image
from rover_rl.sims.ros2.robot import RobotNode
from tests.sims.ros2.processes import until

WORLD = World("wall", Terrain.flat((16.0, 16.0)), [box((3.0, 0.5, 0.5), (0.4, 2.0, 1.0))])
CAMERA = DepthCamera(size=(12, 16))
PIXELS = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
COLORS = torch.from_numpy(PIXELS).permute(2, 0, 1) / 255
SMOOTH = torch.stack([torch.linspace(low, 1 - low, 32)[:, None].expand(32, 48) for low in (0.0, 0.3, 1.0)])
"""Colors that a JPEG hardly changes."""


def _image(pixels: np.ndarray, kind: str, padding: int = 0, **fields) -> Image:
    lines = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    lines = np.pad(lines, ((0, 0), (0, padding)), constant_values=7)
    rows, columns = pixels.shape[:2]
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


def test_colors_are_read_whatever_their_encoding():
    alpha, gray = np.full((5, 7, 1), 9, np.uint8), PIXELS[..., 0]
    for kind, pixels in {
        "rgb8": PIXELS,
        "bgr8": PIXELS[..., ::-1],
        "rgba8": np.concatenate((PIXELS, alpha), -1),
        "bgra8": np.concatenate((PIXELS[..., ::-1], alpha), -1),
    }.items():
        assert read_colors(_image(pixels, kind, padding=3)).equal(COLORS)
    assert read_colors(_image(gray, "mono8")).equal(COLORS[:1].expand(3, -1, -1))
    form = image_format("colors", "/camera/color/image_raw")
    assert form.read(form.write(COLORS, Header().stamp, "camera")).equal(COLORS)


def _file(pixels: np.ndarray, kind: str = "PNG") -> bytes:
    file = BytesIO()
    Picture.fromarray(pixels).save(file, kind)
    return file.getvalue()


def _compressed(kind: str, data: bytes) -> CompressedImage:
    return CompressedImage(Header(), format=kind, data=np.frombuffer(data, dtype=np.uint8))


def test_compressed_colors_are_read():
    read = image_format("colors", "/color/compressed").read
    for kind in ("png", "rgb8; png compressed bgr8", "bgr8; png compressed bgr8"):
        assert read(_compressed(kind, _file(PIXELS))).equal(COLORS)
    assert read(_compressed("rgb8; png compressed rgb8", _file(PIXELS))).equal(COLORS.flip(0))
    assert read(_compressed("mono8; png compressed ", _file(PIXELS[..., 0]))).equal(COLORS[:1].expand(3, -1, -1))
    smooth = (255 * SMOOTH).byte().permute(1, 2, 0).numpy()
    for kind in ("jpeg", "bgr8; jpeg compressed bgr8"):
        torch.testing.assert_close(read(_compressed(kind, _file(smooth, "JPEG"))), SMOOTH, atol=0.04, rtol=0)


def test_compressed_depths_are_read():
    read = image_format("depth", "/depth/compressedDepth").read
    millimeters = np.array([[500, 0], [65535, 1250]], dtype=np.uint16)
    expected = torch.tensor([[0.5, 0.0], [65.535, 1.25]])
    header = struct.pack("<iff", 0, 0.0, 0.0)
    for kind, data in {
        "16UC1; compressedDepth": header + _file(millimeters),
        "16UC1; compressedDepth png": header + _file(millimeters),
        "16UC1; png compressed ": _file(millimeters),
    }.items():
        torch.testing.assert_close(read(_compressed(kind, data)), expected)
    # As the plugin quantizes, by default: a = q (q + 1) and b = 1 - a / farthest.
    a = 100.0 * 101.0
    b = 1 - a / 10.0
    depth = np.array([[0.5, 1.0, 4.0], [9.9, 0.7, 0.0]])
    quantized = np.where(depth > 0, a / np.maximum(depth, 0.1) + b, 0).astype(np.uint16)
    read_back = read(_compressed("32FC1; compressedDepth png", struct.pack("<iff", 0, a, b) + _file(quantized)))
    torch.testing.assert_close(read_back, torch.from_numpy(depth).float(), atol=0.01, rtol=0)


GRAY = np.ones((4, 4), dtype=np.uint8)


@pytest.mark.parametrize(
    ("kind", "topic", "encoding", "data", "message"),
    [
        ("colors", "/compressed", "jpeg", b"", "a whole JPEG or PNG, got 0 bytes"),
        ("colors", "/compressed", "jpeg", _file(PIXELS, "JPEG")[:-40], "a whole JPEG or PNG"),
        ("colors", "/compressed", "jpeg", _file(PIXELS, "GIF"), "a whole JPEG or PNG"),
        ("colors", "/compressed", "png", _file(GRAY.astype(np.uint16)), "must have 8 bits a channel, got 'png'"),
        ("depth", "/compressed", "jpeg", _file(GRAY, "JPEG"), "must be a PNG of 16UC1 or 32FC1, got 'jpeg'"),
        ("depth", "/compressed", "16UC1; png", _file(GRAY), "must have 16 bits a pixel"),
        ("depth", "/compressedDepth", "16UC1; compressedDepth rvl", bytes(40), "must be a PNG of 16UC1 or 32FC1"),
        ("depth", "/compressedDepth", "32FC1; png", _file(GRAY.astype(np.uint16)), "must have the header"),
        ("depth", "/compressedDepth", "16UC1; png", bytes(12) + _file(GRAY.astype(np.uint16))[:50], "a whole JPEG"),
    ],
)
def test_a_compressed_image_that_cannot_be_read_is_refused(kind, topic, encoding, data, message):
    with pytest.raises(ValueError, match=message):
        image_format(kind, topic).read(_compressed(encoding, data))


def test_colors_that_cannot_be_read_are_refused():
    with pytest.raises(ValueError, match=r"one of \['rgb8', .* 'mono8'\], got '32FC1'"):
        read_colors(_image(PIXELS, "32FC1"))
    with pytest.raises(ValueError, match="a color image of 7 x 5 pixels has 100 bytes"):
        read_colors(_image(PIXELS, "rgb8", data=np.zeros(100, np.uint8)))
    with pytest.raises(ValueError, match="colors end in /compressed if they are compressed, got '/a/compressedDepth'"):
        image_format("colors", "/a/compressedDepth")


def test_another_size_takes_the_nearest_pixels():
    depth = torch.arange(16.0).reshape(4, 4)
    assert resized(depth, (4, 4)).equal(depth)
    assert resized(depth, (2, 2)).equal(depth[1::2, 1::2])
    assert resized(torch.stack((depth, -depth)), (2, 2))[1].equal(-depth[1::2, 1::2])
    assert set(resized(depth, (7, 5)).flatten().tolist()) <= set(depth.flatten().tolist())


def _live(wire, *sensors, cameras=(CAMERA,)) -> RoverEnv:
    """Starts a robot with cameras on the wire, and the environment that drives it with sensors."""
    rover = ServedRover(EnvConfig(world=WORLD, seed=0, backend="warp", sensors=cameras))
    node = RobotNode(rover, wire, 12.0)
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


def test_live_color_cameras_read_what_the_simulated_one_does(wire):
    colors = ColorCamera(size=(12, 16))
    jpeg = ColorCamera(name="jpeg", size=(12, 16), topic="/color/compressed")
    png = DepthCamera(name="png", size=(12, 16), topic="/depth/compressedDepth")
    env = _live(wire, colors, jpeg, CAMERA, png, cameras=(colors, jpeg, CAMERA, png))
    env.reset()
    step = env.rand_step()["next"]
    torch.testing.assert_close(step["png"], step["depth"], atol=0.0006, rtol=0)
    assert (step["jpeg"] - step["colors"]).abs().mean() < 0.03
    still = RoverEnv(world_n=WORLD, num_envs=1, seed=0, backend="warp", sensors=[colors])
    simulated = still.reset(start=torch.zeros(1, 3), goal=env.goal)["colors"]
    # The rover has moved a little, and its own goal is elsewhere.
    assert ((step["colors"] - simulated).abs() < 0.1).float().mean() > 0.8
    env.close()


def test_a_camera_whose_images_are_broken_stops_the_rover(wire):
    camera = ColorCamera(size=(12, 16), topic="/color/compressed")
    wire.tamper[camera.topic] = lambda message: _compressed(message.format, bytes(message.data)[:100])
    env = _live(wire, camera, cameras=(camera,))
    env.reset()
    with pytest.raises(RobotLostError, match="/color/compressed .*cannot be used: a compressed image must be a whole"):
        env.rand_step()
    env.close()


@pytest.mark.parametrize(
    ("options", "kinds"),
    [
        (["--camera"], {"/camera/image_raw": Image}),
        (
            ["--camera", "colors", "depth", "--camera-topic", "/d/compressedDepth", "--color-topic", "/c/compressed"],
            {"/d/compressedDepth": CompressedImage, "/c/compressed": CompressedImage},
        ),
    ],
)
def test_the_robot_publishes_the_cameras_that_are_asked_for(wire, monkeypatch, options, kinds):
    monkeypatch.setattr("rover_rl.sims.ros2.transport.make_transport", lambda *_: wire)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    monkeypatch.setattr(RobotNode, "run", lambda node, *_: node.step())
    main(["robot", "--backend", "warp", "--lidar-beams", "16", *options])
    images = {topic: type(sent[0]) for topic, sent in wire.sent.items() if type(sent[0]) in (Image, CompressedImage)}
    assert images == kinds


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
def test_images_of_a_dds_publisher_arrive(domain):
    talker, listener = DdsTransport("talker", domain), DdsTransport("listener", domain)
    depth, received = 0.001 * torch.randint(0, 60000, (48, 64)), {}
    sent = {("depth", "/depth"): depth, ("depth", "/depth/compressedDepth"): depth, ("colors", "/c/compressed"): SMOOTH}
    for (kind, topic), image in sent.items():
        form = image_format(kind, topic)
        listener.subscribe(topic, form.message, lambda message, topic=topic: received.update({topic: message}))
        publish = talker.publisher(topic, form.message, reliable=True)
        until(lambda topic=topic: talker.subscribers(topic))
        publish(form.write(image, Header().stamp, "camera"))
        until(lambda topic=topic: topic in received)
        torch.testing.assert_close(form.read(received[topic]), image, atol=0.03 if kind == "colors" else 1e-5, rtol=0)
    talker.close()
    listener.close()
