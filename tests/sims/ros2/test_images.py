"""Depth and color images of a live rover."""

from __future__ import annotations

import struct
from io import BytesIO
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image as Picture

from rover_rl import EnvConfig, RoverEnv, Terrain, World, box
from rover_rl.envs.sensors.cameras import ColorCamera, DepthCamera, SegmentationCamera
from rover_rl.envs.served_rover import ServedRover
from rover_rl.sims.ros2 import RobotLostError, Ros2Settings
from rover_rl.sims.ros2.images import image_format
from rover_rl.sims.ros2.messages import CompressedImage, Header, Image
from rover_rl.sims.ros2.robot import RobotNode

WORLD = World("wall", Terrain.flat((16.0, 16.0)), [box((3.0, 0.5, 0.5), (0.4, 2.0, 1.0))])
CAMERA = DepthCamera(size=(12, 16))
PIXELS = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
COLORS = torch.from_numpy(PIXELS).permute(2, 0, 1) / 255
GRAY = np.ones((4, 4), dtype=np.uint8)
SMOOTH = torch.stack([torch.linspace(low, 1 - low, 32)[:, None].expand(32, 48) for low in (0.0, 0.3, 1.0)])
"""Colors that a JPEG hardly changes."""
DEPTH, COLOR = image_format("depth", "/camera/image_raw"), image_format("colors", "/camera/color/image_raw")


def raw(pixels: np.ndarray, kind: str, padding: int = 0, **fields) -> Any:
    lines = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    lines = np.pad(lines, ((0, 0), (0, padding)), constant_values=7)
    rows, columns = pixels.shape[:2]
    layout = {"height": rows, "width": columns, "step": lines.shape[1], "encoding": kind, "data": lines.flatten()}
    return Image(Header(), **{**layout, **fields})


def test_depths_are_read_in_meters_whatever_their_encoding():
    meters = np.array([[0.5, 1.25, np.nan], [2.0, np.inf, -1.0]])
    expected = torch.tensor([[0.5, 1.25, 0.0], [2.0, torch.inf, 0.0]])
    assert DEPTH.read(raw(meters.astype("<f4"), "32FC1")).equal(expected)
    assert DEPTH.read(raw(meters.astype(">f4"), "32FC1", padding=5, is_bigendian=1)).equal(expected)
    millimeters = np.array([[500, 0], [65535, 1250]])
    for kind, order in (("<u2", 0), (">u2", 1)):
        read = DEPTH.read(raw(millimeters.astype(kind), "16UC1", is_bigendian=order))
        torch.testing.assert_close(read, torch.tensor([[0.5, 0.0], [65.535, 1.25]]))
    assert DEPTH.read(DEPTH.write(expected, Header().stamp, "camera")).equal(expected)


def test_colors_are_read_whatever_their_encoding():
    alpha, gray = np.full((5, 7, 1), 9, np.uint8), PIXELS[..., 0]
    for kind, pixels in {
        "rgb8": PIXELS,
        "bgr8": PIXELS[..., ::-1],
        "rgba8": np.concatenate((PIXELS, alpha), -1),
        "bgra8": np.concatenate((PIXELS[..., ::-1], alpha), -1),
    }.items():
        assert COLOR.read(raw(pixels, kind, padding=3)).equal(COLORS)
    assert COLOR.read(raw(gray, "mono8")).equal(COLORS[:1].expand(3, -1, -1))
    assert COLOR.read(COLOR.write(COLORS, Header().stamp, "camera")).equal(COLORS)


def file(pixels: np.ndarray, kind: str = "PNG") -> bytes:
    made = BytesIO()
    Picture.fromarray(pixels).save(made, kind)
    return made.getvalue()


def compressed(kind: str, data: bytes) -> Any:
    return CompressedImage(Header(), format=kind, data=np.frombuffer(data, dtype=np.uint8))


def test_compressed_colors_are_read():
    read = image_format("colors", "/color/compressed").read
    for kind in ("png", "rgb8; png compressed bgr8", "bgr8; png compressed bgr8"):
        assert read(compressed(kind, file(PIXELS))).equal(COLORS)
    assert read(compressed("rgb8; png compressed rgb8", file(PIXELS))).equal(COLORS.flip(0))
    assert read(compressed("mono8; png compressed ", file(PIXELS[..., 0]))).equal(COLORS[:1].expand(3, -1, -1))
    smooth = (255 * SMOOTH).byte().permute(1, 2, 0).numpy()
    jpeg = compressed("bgr8; jpeg compressed bgr8", file(smooth, "JPEG"))
    torch.testing.assert_close(read(jpeg), SMOOTH, atol=0.04, rtol=0)


def test_compressed_depths_are_read():
    read = image_format("depth", "/depth/compressedDepth").read
    millimeters = np.array([[500, 0], [65535, 1250]], dtype=np.uint16)
    header = struct.pack("<iff", 0, 0.0, 0.0)
    for kind, data in {
        "16UC1; compressedDepth": header + file(millimeters),
        "16UC1; png compressed ": file(millimeters),
    }.items():
        torch.testing.assert_close(read(compressed(kind, data)), torch.tensor([[0.5, 0.0], [65.535, 1.25]]))
    # As the plugin quantizes, by default: a = q (q + 1) and b = 1 - a / farthest.
    a = 100.0 * 101.0
    b = 1 - a / 10.0
    depth = np.array([[0.5, 1.0, 4.0], [9.9, 0.7, 0.0]])
    quantized = np.where(depth > 0, a / np.maximum(depth, 0.1) + b, 0).astype(np.uint16)
    read_back = read(compressed("32FC1; compressedDepth png", struct.pack("<iff", 0, a, b) + file(quantized)))
    torch.testing.assert_close(read_back, torch.from_numpy(depth).float(), atol=0.01, rtol=0)


FLAT = np.ones((2, 2), "<f4")


@pytest.mark.parametrize(
    ("kind", "topic", "image", "message"),
    [
        ("depth", "/image", raw(FLAT, "rgb8"), r"one of \['32FC1', '16UC1', 'mono16'\], got 'rgb8'"),
        ("depth", "/image", raw(FLAT, "32FC1", height=3), "2 x 3 pixels has 16 bytes, in rows of 8"),
        ("colors", "/image", raw(PIXELS, "32FC1"), r"one of \['rgb8', .* 'mono8'\], got '32FC1'"),
        ("colors", "/image", raw(PIXELS, "rgb8", data=np.zeros(100, np.uint8)), "of 7 x 5 pixels has 100 bytes"),
        ("colors", "/compressed", compressed("jpeg", file(PIXELS, "JPEG")[:-40]), "a whole JPEG or PNG"),
        ("colors", "/compressed", compressed("png", file(GRAY.astype(np.uint16))), "must have 8 bits a channel, got"),
        ("depth", "/compressed", compressed("jpeg", file(GRAY, "JPEG")), "must be a PNG of 16UC1 or 32FC1, got 'jpeg'"),
        ("depth", "/compressed", compressed("16UC1; png", file(GRAY)), "must have 16 bits a pixel"),
        ("depth", "/compressedDepth", compressed("32FC1; png", file(GRAY.astype(np.uint16))), "must have the header"),
    ],
)
def test_an_image_that_cannot_be_read_is_refused(kind, topic, image, message):
    with pytest.raises(ValueError, match=message):
        image_format(kind, topic).read(image)


def live_env(wire, *sensors, cameras=(CAMERA,)) -> RoverEnv:
    """Starts a robot with cameras on the wire, and the environment that drives it with sensors."""
    rover = ServedRover(EnvConfig(world=WORLD, seed=0, backend="warp", sensors=cameras))
    wire.rovers.append(RobotNode(rover, wire).step)
    backend = Ros2Settings(reset="none", settle=0.05, step_timeout=1.0)
    return RoverEnv(world_n=WORLD, backend=backend, seed=0, sensors=sensors)


def test_live_cameras_read_what_the_simulated_ones_do_on_topics_of_their_own(wire):
    colors, left = ColorCamera(size=(12, 16)), DepthCamera(name="left", size=(6, 8), yaw=1.0, topic="/left/depth")
    jpeg = ColorCamera(name="jpeg", size=(12, 16), topic="/color/compressed")
    png = DepthCamera(name="png", size=(12, 16), topic="/depth/compressedDepth")
    cameras = (colors, jpeg, CAMERA, png, left)
    env = live_env(wire, *cameras, cameras=cameras)
    env.reset()
    step = env.rand_step()["next"]
    torch.testing.assert_close(step["png"], step["depth"], atol=0.0006, rtol=0)
    assert (step["jpeg"] - step["colors"]).abs().mean() < 0.03
    assert not step["left"].equal(step["depth"].unflatten(-1, CAMERA.size)[..., ::2, ::2].flatten(1))
    still = RoverEnv(world_n=WORLD, num_envs=1, seed=0, backend="warp", sensors=[colors, CAMERA])
    simulated = still.reset(start=torch.zeros(1, 3), goal=env.goal)
    # The rover has moved a little, and its own goal is elsewhere.
    assert ((step["colors"] - simulated["colors"]).abs() < 0.1).float().mean() > 0.8
    assert ((step["depth"] - simulated["depth"]).abs() < 0.1).float().mean() > 0.9
    env.close()


def test_a_camera_that_is_silent_or_broken_stops_the_rover_and_one_without_topic_is_refused(wire):
    camera = ColorCamera(size=(12, 16), topic="/color/compressed")
    wire.tamper[camera.topic] = lambda message: compressed(message.format, bytes(message.data)[:100])
    for sensor, cameras, error, message in (
        (camera, (camera,), RobotLostError, "/color/compressed .*cannot be used: a compressed image must be a whole"),
        (CAMERA, (), RobotLostError, r"/camera/image_raw .*no message has arrived yet; a stop"),
        (SegmentationCamera(), (), ValueError, "casts rays.*a live rover has none"),
    ):
        wire.rovers.clear()
        env = live_env(wire, sensor, cameras=cameras)
        with pytest.raises(error, match=message):
            env.rollout(1)
        env.close()
    with pytest.raises(ValueError, match="colors end in /compressed if they are compressed, got '/a/compressedDepth'"):
        image_format("colors", "/a/compressedDepth")
