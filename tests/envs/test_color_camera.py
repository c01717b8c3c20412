"""Color camera."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rover_rl import RoverEnv, Terrain, World, box
from rover_rl.algos.policy.networks import UNITS, ImageFeatures
from rover_rl.envs.encoding import ObservationEncoder
from rover_rl.envs.sensors.cameras import ColorCamera, Seen, SegmentationCamera
from rover_rl.robots import get_robot
from rover_rl.rotations import rotate
from rover_rl.sims.rendering.renderer import FIELD_OF_VIEW, Camera, Renderer, Sight
from rover_rl.worlds.movers import Cylinder, Mover, Person, Waypoints

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


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"noise": -0.1}, "noise must be at least 0"), ({"size": (8, 0)}, "columns must be"), ({"yaw": 0.5}, "no mirror")],
)
def test_settings_out_of_range_raise(settings, message):
    with pytest.raises(ValueError, match=message):
        ColorCamera(**settings).mirror(torch.zeros(1, 3 * 64 * 64))
