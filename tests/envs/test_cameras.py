"""Depth, color and segmentation cameras, 3D lidar and height scan, and networks with convolutions over them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from tensordict import TensorDict
from torch import Tensor

from rover_rl import LidarConfig, RoverEnv, Terrain, World, box
from rover_rl.algos.config import training_config
from rover_rl.algos.policy.networks import (
    UNITS,
    ImageFeatures,
    actor_of,
    encoder_of,
    make_action_critic,
    make_actor,
    make_critic,
    mirrored,
    mirrors_of,
)
from rover_rl.envs.encoding import ObservationEncoder
from rover_rl.envs.sensors.cameras import ColorCamera, DepthCamera, Lidar3D, Seen, SegmentationCamera
from rover_rl.envs.sensors.heights import HeightScan
from rover_rl.robots import get_robot
from rover_rl.rotations import rotate
from rover_rl.sims.rendering.renderer import FIELD_OF_VIEW, Camera, Renderer, Sight
from rover_rl.worlds.movers import Cylinder, Mover, Person, Waypoints
from tests.extras import BACKENDS
from tests.sims.movers.test_seen import cast

WALL = box((3.0, 0.0, 1.0), (0.2, 8.0, 2.0))
EMPTY = World("empty", Terrain.flat((20.0, 20.0)))
FLAT = replace(EMPTY, name="flat", obstacles=[WALL])
LEVEL = DepthCamera(size=(8, 12), pitch=0.0, mount=(0.3, 0.0, 0.5), field_of_view=math.radians(60))
VIEW = {"size": (32, 40), "pitch": 0.1, "mount": (0.3, 0.1, 0.5)}
ACROSS = torch.arange(41) * 0.5
ROUGH = World(
    "rough",
    Terrain(0.2 * ACROSS[:, None].sin() * (1.3 * ACROSS).cos(), cell=0.5),
    [box((3.0, -0.8, 0.5), (0.7, 0.9, 1.6)), box((4.5, 1.5, 0.3), (0.5, 0.5, 1.5))],
    movers=[Mover(Waypoints([(0.0, 2.2, 0.7, 0.0)]), Cylinder(0.2, 1.5))],
)


def _opened(world, *sensors, rows=1, backend="warp", start=(0.0, 0.0, 0.0), goal=(3.0, -1.0), **settings):
    """An environment with rovers at ``start``, and its first observation."""
    env = RoverEnv(world_n=world, num_envs=rows, seed=0, backend=backend, sensors=sensors, **settings)
    places = torch.tensor(start).reshape(-1, 3).expand(rows, 3)
    return env, env.reset(start=places, goal=torch.tensor([goal] * rows))


def _read(sensor, world=FLAT, yaw=0.0, rows=1):
    """Reads a sensor of a robot in the middle of a world."""
    env, td = _opened(world, sensor, rows=rows, start=(0.0, 0.0, yaw), goal=(0.0, -5.0))
    return td[sensor.name].unflatten(-1, sensor.size), env.rover_state.position[0]


def test_depth_is_the_distance_along_the_optical_axis():
    depth, position = _read(LEVEL)
    # The wall is flat: the rays to its ends are longer, but its depth is the same. The upper rays reach it.
    x, z = position[0].item(), position[2].item()
    assert depth[0, :4] == pytest.approx(torch.full((4, 12), 2.9 - 0.3 - x), abs=0.02)
    # Below, each row of pixels meets the ground where its slope says, or the wall before.
    focal = 6 / math.tan(LEVEL.field_of_view / 2)
    for row in range(4, 8):
        ground = (0.5 + z) * focal / (row - 3.5)
        assert depth[0, row].numpy() == pytest.approx(min(ground, 2.6 - x), abs=0.03)


def test_a_camera_looks_where_it_is_mounted_and_sees_what_moves():
    ahead = _read(LEVEL)[0]
    left = _read(replace(LEVEL, yaw=math.pi / 2, mount=(0.0, 0.3, 0.5)), yaw=-math.pi / 2)[0]
    torch.testing.assert_close(left, ahead, atol=0.05, rtol=0)
    down = _read(replace(LEVEL, pitch=math.pi / 2 - 1e-6))[0]
    assert down.numpy() == pytest.approx(0.5, abs=0.03)
    # Nothing is behind, above the ground.
    assert (_read(LEVEL, yaw=math.pi)[0][0, :4] == LEVEL.max_range).all()
    moving = _read(LEVEL, replace(FLAT, movers=[Mover(Waypoints([(0.0, 2.0, 0.0, 0.0)]), Cylinder(0.2, 2.0))]))[0]
    assert (moving[0, :4, 5:7] < ahead[0, :4, 5:7] - 0.5).all()
    assert moving[0, :, 0].equal(ahead[0, :, 0])


@pytest.mark.parametrize("backend", BACKENDS)
def test_depths_and_kinds_are_those_of_rays_in_meshes(backend):
    camera = {"size": (18, 24), "pitch": 0.2, "mount": (0.3, 0.1, 0.4)}
    depth, kinds = DepthCamera(**camera), SegmentationCamera(**camera)
    env, td = _opened(ROUGH, depth, kinds, backend=backend, start=(0.0, 0.0, 0.1), goal=(2.5, 0.1))
    state, part = env.rover_state, env.movers.parts
    turn = Rotation.from_quat(state.orientation[0].double().numpy())
    origin = state.position[0].double().numpy() + turn.apply(depth.mount)
    directions, lengths = depth.rays()
    directions = turn.apply(np.array(directions) / np.array(lengths)[:, None])
    post = trimesh.creation.cylinder(0.08, 1.2, sections=96)
    blocks = [trimesh.Trimesh(one.vertices.numpy(), one.faces.numpy()) for one in ROUGH.obstacles]
    mover = trimesh.creation.cylinder(0.2, 1.5, sections=96).apply_translation(part.position[0, 0].numpy())
    solids = {
        Seen.GROUND: trimesh.Trimesh(*(part.numpy() for part in ROUGH.terrain.mesh())),
        Seen.OBSTACLE: trimesh.util.concatenate(blocks),
        Seen.MOVER: mover,
        Seen.GOAL: post.apply_translation((2.5, 0.1, 0.6 + ROUGH.height_at(env.goal.double()).item())),
    }
    ranges = np.array([cast(solid, origin, directions) for solid in solids.values()])
    nearest = np.where(ranges.min(0) < kinds.max_range, np.array(list(solids))[ranges.argmin(0)], Seen.NOTHING)
    assert {*nearest.tolist()} == {*Seen}
    assert (td["segmentation"][0].numpy() == nearest).mean() >= 0.99
    # The post is no solid.
    expected = np.minimum(ranges[:3].min(0) / np.array(lengths), depth.max_range)
    assert (np.abs(td["depth"][0].numpy() - expected) < 0.02).mean() >= 0.99


def test_networks_read_an_image_for_each_kind():
    sensor = SegmentationCamera(size=(2, 3))
    value = torch.tensor([[0.0, 1, 2, 3, 4, 1]])
    planes = sensor.encode(value).unflatten(-1, (len(Seen), 2, 3))
    assert planes.sum(1).eq(1).all()
    assert planes.argmax(1).flatten(1).equal(value.long())
    assert sensor.mirror(value).tolist() == [[2, 1, 0, 1, 4, 3]]
    features = ImageFeatures(ObservationEncoder(("target", "segmentation"), sensors=[sensor]))
    assert features(torch.zeros(1, 5 + 30)).shape == (1, 5 + UNITS)


@pytest.mark.parametrize("size", [(8, 12), (6, 9), (1, 16)])
def test_patches_read_every_pixel_of_images_of_any_size(size):
    encoder = ObservationEncoder(("target", "depth"), sensors=[replace(LEVEL, size=size)], image_network="patches")
    torch.manual_seed(0)
    network = ImageFeatures(encoder)
    image = torch.rand(2, 3, size[0] * size[1], requires_grad=True)
    read = network(torch.cat((torch.zeros(2, 3, 5), image), -1))
    assert read.shape == (2, 3, 5 + UNITS)
    read.sum().backward()
    assert (image.grad != 0).all()
    torch.testing.assert_close(read[1, 2], network(torch.cat((torch.zeros(5), image[1, 2]), -1)))


def test_a_policy_without_convolutions_says_so_in_its_settings():
    settings = training_config("ppo", sensors=["depth"], observation=("target", "depth"), image_network="patches")
    actor = actor_of(settings)
    assert not any(isinstance(layer, torch.nn.Conv2d) for layer in actor.modules())
    seen = {"target": torch.zeros(1, 2), "depth": torch.ones(1, encoder_of(settings).sensors["depth"].features)}
    assert actor(TensorDict(seen, [1]))["action"].shape == (1, 2)


def test_pixels_kinds_and_heights_are_lost_too_close_and_noisy():
    kinds, seen = (_read(SegmentationCamera(size=(16, 16), dropout=dropout))[0] for dropout in (0.5, 0.0))
    assert set(seen.unique().tolist()) >= {Seen.GROUND, Seen.OBSTACLE}
    assert (kinds == seen).logical_or(kinds == Seen.NOTHING).all()
    assert (kinds == Seen.NOTHING)[seen > 0].float().mean() == pytest.approx(0.5, abs=0.1)
    large = replace(LEVEL, size=(32, 32))
    depth, exact = (
        _read(sensor, rows=4)[0] for sensor in (replace(large, min_range=1.0, noise=0.01, dropout=0.2), large)
    )
    assert (depth[exact < 0.95] == 0).all()
    far = exact > 1.1
    assert (depth[far] == 0).float().mean() == pytest.approx(0.2, abs=0.03)
    error = ((depth - exact) / exact.square())[far & (depth > 0)]
    assert error.std() == pytest.approx(0.01, rel=0.1)
    assert error.mean().abs() < 0.001
    assert not depth[0].equal(depth[1])
    heights = _read(HeightScan(size=(40, 40), noise=0.02, holes=0.1), EMPTY, rows=2)[0]
    assert (heights == 0).float().mean() == pytest.approx(0.1, abs=0.02)
    assert heights[heights != 0].std() == pytest.approx(0.02, rel=0.1)


def test_a_lidar_with_planes_meets_wall_and_ground_at_the_angles_of_its_beams():
    sensor = Lidar3D(size=(3, 4), mount=(0.0, 0.0, 0.3), elevation=(-0.5, 0.5), field_of_view=0.4)
    ranges, position = _read(sensor)
    x, z = position[0].item(), position[2].item()
    left = torch.tensor([0.15, 0.05, -0.05, -0.15])
    assert ranges[0, 1] == pytest.approx((2.9 - x) / left.cos(), abs=0.02)
    assert ranges[0, 2].numpy() == pytest.approx((0.3 + z) / math.sin(0.5), abs=0.03)
    assert ranges[0, 0] == pytest.approx((2.9 - x) / left.cos() / math.cos(0.5), abs=0.03)
    turn = _read(Lidar3D(size=(1, 8), elevation=(0.0, 0.0)))[0]
    # The wall is ahead, and nothing behind.
    assert (turn[0, 0, [3, 4]] < 4).all()
    assert (turn[0, 0, [0, 1, 6, 7]] == 12.0).all()


def test_heights_are_those_of_the_ground_relative_to_the_robot():
    slope = World("slope", Terrain(torch.linspace(0, 1, 41).expand(41, 41), cell=0.5))
    scan = HeightScan(size=(5, 3), spacing=0.4, ahead=0.4)
    uphill, position = _read(scan, slope)
    x = 0.4 + 0.4 * torch.tensor([2.0, 1.0, 0.0, -1.0, -2.0])
    expected = slope.height_at(torch.stack((position[0] + x, torch.zeros(5)), -1).double()).float() - position[2]
    assert uphill[0] == pytest.approx(expected[:, None].expand(5, 3), abs=0.01)
    across, _ = _read(scan, slope, yaw=math.pi / 2)
    # The rover looks along the contour, and the ground falls to its left.
    assert (across[0].diff(dim=-1) > 0.005).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: DepthCamera(size=(0, 8)), "rows must be"),
        (lambda: DepthCamera(field_of_view=4.0), "field_of_view must be between 0 and pi"),
        (lambda: SegmentationCamera(noise=0.1), "a segmentation has no noise, but lost pixels"),
        (lambda: DepthCamera(min_range=9.0), "min_range must be from 0 to below max_range=8.0, got 9.0"),
        (lambda: DepthCamera(dropout=1.5), "dropout must be at least 0 and at most 1, got 1.5"),
        (lambda: ColorCamera(noise=-0.1), "noise must be at least 0"),
        (lambda: ColorCamera(yaw=0.5).mirror(torch.zeros(1, 3 * 64 * 64)), "no mirror"),
        (lambda: Lidar3D(field_of_view=7.0), "field_of_view must be positive and at most 2 pi"),
        (lambda: Lidar3D(elevation=(0.3, 0.1)), "elevation must be two ascending angles"),
        (lambda: HeightScan(size=(8, 0)), "columns must be"),
        (lambda: HeightScan(spacing=0.0), "spacing must be positive"),
        (lambda: HeightScan(holes=-0.1), "holes must be at least 0"),
        (lambda: RoverEnv(num_envs=1, sensors=[DepthCamera(), DepthCamera()]), "cannot add 'depth'"),
    ],
)
def test_settings_out_of_range_raise(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_names_have_settings():
    sensors = ["depth(size=(4, 6), name='small', noise=0.01)", "depth"]
    env = RoverEnv(num_envs=1, seed=0, backend="warp", sensors=sensors)
    assert env.sensors["small"] == DepthCamera(size=(4, 6), name="small", noise=0.01)
    assert env.reset()["small"].shape == (1, 24)
    for name, message in {
        "depth(sizes=(4, 6))": "is called with the settings \\['sizes'\\]: got an unexpected keyword argument 'sizes'",
        "depth(size=4)": "does not take the settings {'size': 4}",
        "depth(size=__import__('os'))": "with numbers, texts and tuples",
        "depth(4)": "settings are NAME",
        "deep(size=(4, 6))": "unknown sensor 'deep', perhaps",
    }.items():
        with pytest.raises(ValueError, match=message):
            RoverEnv(num_envs=1, seed=0, backend="warp", sensors=[name])


def test_images_are_mirrored_with_the_world():
    world, image = (replace(EMPTY, name=f"{y}", obstacles=[box((2.0, y, 0.5), (0.5, 1.0, 1.0))]) for y in (1.5, -1.5))
    torch.testing.assert_close(LEVEL.mirror(_read(LEVEL, world)[0].flatten(1)), _read(LEVEL, image)[0].flatten(1))
    with pytest.raises(ValueError, match="sensor 'depth' has no mirror image"):
        replace(LEVEL, yaw=0.5).mirror(torch.zeros(1, 96))


def test_networks_read_images_with_convolutions():
    keys, sensors = ("lidar", "target", "heights", "depth"), [LEVEL]
    encoder = ObservationEncoder(keys, sensors=sensors)
    env = RoverEnv(num_envs=3, seed=0, backend="warp", sensors=["heights", LEVEL], lidar=LidarConfig(points=32))
    td = env.rollout(2)
    actor, critic = make_actor(encoder, (16,)), make_critic(encoder, (16,))
    assert actor(td)["action"].shape == (3, 2, 2)
    assert critic(td)["state_value"].shape == (3, 2, 1)
    # The first layer reads each image as so many numbers.
    first = next(part for part in actor.modules() if isinstance(part, torch.nn.Linear) and part.out_features == 16)
    assert first.in_features == 32 + 5 + 2 * UNITS
    seen = td.clone()
    seen["depth"] = seen["depth"] * 0.5
    assert not actor(seen)["loc"].equal(actor(td)["loc"])
    td["features"] = encoder(*(td[key] for key in keys))
    assert make_action_critic(encoder, (16,))(td)["state_action_value"].shape == (3, 2, 1)
    every = torch.ones(3, 2, dtype=torch.bool)
    mirrors = mirrors_of(encoder.sensors)
    back = mirrored(mirrored(td, every, mirrors), every, mirrors)
    assert back["heights"].equal(td["heights"])
    assert back["depth"].equal(td["depth"])


# Colors


def _look(backend: str) -> tuple[Tensor, Tensor, Tensor]:
    """Colors ``[3, K]`` and kinds ``[K]`` of the pixels, and how far their rays rise ``[K]``."""
    camera, kinds = ColorCamera(**VIEW), SegmentationCamera(**VIEW, max_range=100.0)
    env, td = _opened(ROUGH, camera, kinds, backend=backend, start=(0.0, 0.0, 0.1), goal=(2.5, 0.1))
    rise = rotate(env.rover_state.orientation, torch.tensor(camera.rays()[0]))[:, 2]
    return td["colors"][0].unflatten(-1, (3, -1)), td["segmentation"][0], rise


def test_every_kind_has_its_color_in_every_simulator():
    (red, green, blue), kinds, rise = _look("warp")
    told = {
        Seen.GROUND: (red > green) & (green > blue) & (red < 1.4 * green),
        Seen.OBSTACLE: (blue > green) & (green > red),
        Seen.MOVER: (red > 1.6 * green) & (red > 1.6 * blue),
        Seen.GOAL: (green > 1.6 * red) & (green > 1.6 * blue),
    }
    for kind, is_told in told.items():
        assert (kinds == kind).sum() > 10
        assert is_told[kinds == kind].float().mean() > 0.97
    # Sky is bright, and the higher the bluer.
    low, high = ((kinds == Seen.NOTHING) & part for part in ((rise > 0.01) & (rise < 0.1), rise > 0.3))
    assert blue[low | high].min() > 0.8
    assert (red / blue)[low].min() > (red / blue)[high].max()
    same = (_look("bullet")[0] - torch.stack((red, green, blue))).abs().amax(0) < 0.05
    assert same.float().mean() > 0.97


def test_colors_are_those_of_films():
    size, middle = 48, torch.tensor((5.0, 0.0, 0.3))
    camera = ColorCamera(size=(size, size), mount=(0.6, 0.0, 0.8), pitch=0.2, field_of_view=math.radians(FIELD_OF_VIEW))
    world = World("boxes", Terrain.flat((20.0, 20.0)), [box(middle, (1.0, 1.0, 0.6)), box((4.0, 2.0, 0.5), (1, 1, 1))])
    env, td = _opened(world, camera)
    colors, state = td["colors"].unflatten(-1, (3, size, size)), env.rover_state[0].double()
    eye = state.position + rotate(state.orientation, torch.tensor(camera.mount).double())
    ahead, up = rotate(state.orientation, torch.tensor([[math.cos(0.2), 0, -math.sin(0.2)], [0, 0, 1.0]]).double())
    view, renderer = Camera(eye, eye + ahead, up, Sight(world)), Renderer(world, get_robot("rover_zero"))
    film = renderer.render_from(view, state.position, state.orientation, size, size, env.goal[0])
    apart = (colors[0] - film.permute(2, 0, 1) / 255).abs().amax(0)
    # Films have smooth edges, the rover's shadow and shades of corners.
    assert (apart < 0.02).float().mean() > 0.85
    assert apart.median() < 0.005


def test_people_have_clothes_legs_and_skin_and_other_rovers_are_red():
    person = Mover(Waypoints([(0.0, 2.5, -0.6, 0.0)]), Person())
    world = World("people", Terrain.flat((20.0, 20.0)), movers=[person])
    camera = ColorCamera(size=(96, 96), pitch=0.0, mount=(0.3, 0.0, 0.7))
    start = [[0.0, 0.0, 0.0], [2.0, 0.8, 0.0]]
    env, td = _opened(world, camera, rows=2, agents=2, start=start, goal=(-5.0, 0.0))
    colors, state = td["colors"].unflatten(-1, (3, -1))[0], env.rover_state
    eye = state.position[0] + rotate(state.orientation[0], torch.tensor(camera.mount))
    rays = torch.nn.functional.normalize(rotate(state.orientation[0], torch.tensor(camera.rays()[0])), dim=-1)

    def at(*point: float) -> Tensor:
        way = torch.tensor(point) - eye
        return colors[:, (rays @ (way / way.norm())).argmax()]

    red, green, blue = at(2.3, -0.6, 1.2)
    assert blue > 1.2 * red > 1.3 * green
    assert at(2.5, -0.48, 0.4).max() < 0.4
    red, green, blue = at(2.45, -0.6, 1.65)
    assert red > 1.15 * green > 1.2 * blue
    red, green, blue = at(2.0, 0.8, state.position[1, 2].item() + 0.05)
    assert red > 1.6 * max(green, blue)


def test_channels_are_noisy_by_the_seed_of_the_row_alone_and_lost_pixels_are_black():
    plain, noisy = ColorCamera(size=(32, 32)), ColorCamera(name="noisy", size=(32, 32), noise=0.05, dropout=0.2)
    env = RoverEnv(world_n=["maze"] * 3 + ["plaza:4"], num_envs=4, seed=0, backend="warp", sensors=[plain, noisy])
    td = env.reset()
    exact, read = (td[key].unflatten(-1, (3, -1)) for key in ("colors", "noisy"))
    lost = (read == 0).all(1)
    assert lost.float().mean() == pytest.approx(0.2, abs=0.03)
    # Where noise does not leave the bounds.
    kept = (~lost)[:, None] & (exact > 0.2) & (exact < 0.8)
    assert (read - exact)[kept].std() == pytest.approx(0.05, rel=0.1)
    assert 0 <= read.min() <= read.max() <= 1
    alone = RoverEnv(world_n="plaza:4", num_envs=1, seed=3, backend="warp", sensors=[noisy]).reset()
    assert alone["noisy"].equal(td["noisy"][3:])


def test_networks_read_three_channels_and_the_mirror_image_swaps_left_and_right():
    sensor = ColorCamera(size=(2, 3))
    value = torch.arange(18.0)[None] / 18
    assert sensor.mirror(value).unflatten(-1, (3, 2, 3)).equal(value.unflatten(-1, (3, 2, 3)).flip(-1))
    assert sensor.encode(value).equal(2 * value - 1)
    features = ImageFeatures(ObservationEncoder(("target", "colors"), sensors=[sensor]))
    first = next(part for part in features.modules() if isinstance(part, torch.nn.Conv2d))
    assert first.in_channels == 3
    assert features(torch.zeros(1, 5 + 18)).shape == (1, 5 + UNITS)
