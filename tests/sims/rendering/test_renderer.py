"""Pictures of a rover in its world, and of what moves there."""

from __future__ import annotations

import math
from contextlib import closing

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.robots import get_robot
from rover_rl.rotations import rotate
from rover_rl.sims.rendering import renderer
from rover_rl.sims.rendering.cache import RendererCache
from rover_rl.sims.rendering.renderer import Camera, Sight
from rover_rl.sims.rendering.scenery import SUN
from rover_rl.worlds import Terrain, World, box
from rover_rl.worlds.movers import Box, Capsule, Mover, Person, Shape, Waypoints

ROVER = get_robot("rover_zero")
FLAT = World("flat", Terrain.flat((20, 20)))


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0):
    """Position and quaternion of successive rotations about the fixed axes x, y and z, ``[7]``."""
    turn = Rotation.from_euler("xyz", (roll, pitch, yaw)).as_quat()
    return torch.tensor((x, y, z, *turn), dtype=torch.float64)


def render(world: World = FLAT, at: Tensor | None = None, view="chase", size=(160, 120), goal=None):
    """Renders one picture, int ``[height, width, 3]``."""
    goal = None if goal is None else torch.tensor(goal)
    return RendererCache(ROVER).render(world, pose() if at is None else at, view, *size, goal).int()


def is_green(image: Tensor, channel: int = 1) -> Tensor:
    """Pixels of the post of the goal; with 2 for blue, of the lidar."""
    return (image[..., channel, None] > 1.5 * image[..., [0, 3 - channel]]).all(-1)


def pixels_of(points: Tensor, at: Tensor, view, size, world: World = FLAT) -> Tensor:
    """Columns and rows of the pixels that the camera assigns to points, int64 ``[..., 2]``."""
    position, orientation = at.split((3, 4))
    pixels, seen = Camera.on(position, orientation, Sight(world), view).see(points, *size)
    assert seen.all()
    return pixels.floor().long()


def test_an_obstacle_hides_the_goal():
    wall = World("wall", Terrain.flat((20, 20)), [box((3.0, 0.0, 1.5), (0.5, 6.0, 3.0))])
    assert is_green(render()).sum() == 0
    assert is_green(render(goal=(5.0, 0.0))).sum() > 10
    assert is_green(render(wall, goal=(5.0, 0.0))).sum() == 0


@pytest.mark.parametrize(("view", "size"), [("chase", (320, 240)), ("top", (300, 600))])
def test_points_of_the_post_are_where_the_camera_projects_them(view, size):
    at, goal = pose(1.0, 2.0, yaw=0.7), (3.2, 3.4)
    image = render(at=at, view=view, goal=goal, size=size)
    # The axis of the post and points 3 cm inside of its surface, from left to right in the chase view.
    heights = torch.linspace(0.1, 1.15, 8).repeat_interleave(3)
    sides = torch.tensor((-0.05, 0.0, 0.05)).repeat(8)
    points = torch.stack((goal[0] - sides * math.sin(0.7), goal[1] + sides * math.cos(0.7), heights), -1)
    columns, rows = pixels_of(points, at, view, size).unbind(-1)
    assert is_green(image[rows, columns]).all()
    if view == "chase":
        center = is_green(image).nonzero()[:, 1].float().mean()
        assert center == pytest.approx(columns.float().mean(), abs=1)


@pytest.mark.parametrize(("view", "roll", "pitch", "yaw"), [("chase", 0, 0, 2.0), ("top", 0.3, -0.3, -1.0)])
def test_the_rover_turns_with_its_pose(view, roll, pitch, yaw):
    size = (640, 480)
    at = pose(1.0, -1.0, 0.2, roll, pitch, yaw)
    # The middle of the lidar's top.
    point = at[:3] + rotate(at[3:], torch.tensor((0.174, 0.0, 0.345), dtype=torch.float64))
    column, row = pixels_of(point, at, view, size)
    assert is_green(render(at=at, view=view, size=size)[row, column], 2)


BLOCK = World("block", Terrain.flat((20, 20)), [box((0.0, 0.0, 0.5), (0.6, 0.6, 1.0))])


# The shadow of a block of 1 m ends at 1.13 m from its edges.
@pytest.mark.parametrize(("world", "at", "near"), [(BLOCK, pose(-4.0, -4.0), 0.9), (FLAT, pose(yaw=0.3), 0.45)])
def test_shadows_of_obstacles_and_the_rover_fall_away_from_the_sun(world, at, near):
    away = -torch.tensor((*SUN[:2], 0.0)) / math.hypot(*SUN[:2])
    points = torch.stack((near * away, -near * away, 2.1 * away))
    columns, rows = pixels_of(points, at, "top", (320, 240), world).unbind(-1)
    shadow, opposite, beyond = render(world, at, "top", (320, 240))[rows, columns].float().mean(-1).tolist()
    assert shadow < 0.75 * opposite
    assert shadow < 0.75 * beyond
    assert opposite == pytest.approx(beyond, rel=0.1)


def test_the_sky_is_above_the_horizon_and_hills_are_shaded():
    x = torch.linspace(-10, 10, 81)
    hills = World("hills", Terrain(0.3 * torch.sin(2 * x).expand(81, 81), 0.25))
    image = render(hills, pose(z=0.3))
    red, _, blue = image.float().unbind(-1)
    assert (blue[:5] > red[:5]).all()
    assert (blue[60:] < red[60:]).float().mean() > 0.8
    # Slopes toward the sun are brighter than the others.
    assert red[60:, :40].std() > 2 * render().float()[60:, :40, 0].std()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"size": (0, 10)}, "width .* got 0"),
        ({"size": (10, 9000)}, "height .* got 9000"),
        ({"view": "side"}, "unknown view 'side'; use 'chase' or 'top'"),
    ],
)
def test_sizes_out_of_range_and_unknown_views_are_rejected(options, message):
    with pytest.raises(ValueError, match=message):
        render(**options)


def test_the_same_pose_gives_the_same_bytes_with_any_number_of_threads(monkeypatch):
    at, goal = pose(0.5, 0.5, 0.01, 0.05, 0.1, 0.8), torch.tensor((2.0, 2.0))
    images = []
    for threads in (1, 5):
        monkeypatch.setattr(renderer, "MAX_THREADS", threads)
        monkeypatch.setattr(renderer.os, "cpu_count", lambda: 8)
        images.append(RendererCache(ROVER).render(FLAT, at, "chase", 97, 71, goal))
    assert (images[0].shape, images[0].dtype) == ((71, 97, 3), torch.uint8)
    assert torch.equal(*images)


def test_a_pose_that_is_not_a_number_gives_a_picture():
    assert render(at=torch.full((7,), math.nan, dtype=torch.float64)).shape == (120, 160, 3)


# Movers


def world(shape: Shape | None, x: float = 2.0, y: float = 1.0, yaw: float = 0.0) -> World:
    """Level ground, on which a mover stands."""
    movers = [] if shape is None else [Mover(Waypoints([(0.0, x, y, yaw)]), shape)]
    return World("flat", Terrain.flat((20.0, 20.0)), movers=movers)


def picture(scene: World, view="top", backend: str = "warp") -> tuple[Tensor, Camera]:
    """A picture of a rover at the origin, int ``[height, width, 3]``, and its camera."""
    with closing(RoverEnv(world_n=scene, seed=0, backend=backend)) as env:
        env.reset(start=torch.zeros(1, 3), goal=torch.tensor([[-8.0, -8.0]]))
        rover = env.rover_state[0]
        image = env.render(view=view, width=320, height=240).int()
    return image, Camera.on(rover.position, rover.orientation, Sight(scene), view)


def colors_at(scene: World, points: list[tuple[float, float, float]], view="top") -> Tensor:
    """Colors of the pixels at which points are seen, ``[P, 3]``."""
    image, camera = picture(scene, view)
    columns, rows = camera.see(torch.tensor(points), 320, 240)[0].floor().long().unbind(-1)
    return image[rows, columns]


def is_red(colors: Tensor) -> Tensor:
    """Colors of movers. The rover is orange, with less blue than green."""
    red, green, blue = colors.unbind(-1)
    return (red > 1.6 * green) & (red > 1.6 * blue) & (blue > 0.7 * green)


def is_violet(colors: Tensor) -> Tensor:
    red, green, blue = colors.unbind(-1)
    return (blue > 1.2 * red) & (red > 1.2 * green)


def test_a_mover_is_seen_in_every_simulator(backend: str) -> None:
    bare, met = (picture(world(shape), "chase", backend)[0] for shape in (None, Box(0.5, 0.5, 1.0)))
    assert is_red(bare).sum() == 0
    assert is_red(met).sum() > 100


def test_a_box_is_where_it_should_be_from_above() -> None:
    yaw = 0.6

    def on_top(x: float, y: float) -> tuple[float, float, float]:
        return 2 + x * math.cos(yaw) - y * math.sin(yaw), 1 + x * math.sin(yaw) + y * math.cos(yaw), 0.4

    box = world(Box(1.2, 0.6, 0.4), yaw=yaw)
    sides = [(sx * x, sy * y) for sx in (-1, 1) for sy in (-1, 1) for x, y in ((0.54, 0.0), (0.0, 0.24), (0.54, 0.24))]
    assert is_red(colors_at(box, [on_top(*side) for side in sides])).all()
    # The camera, 12 m above the rover, sees a side of the box, too, 4 cm wide.
    around = [on_top(0.72, 0.0), on_top(-0.72, 0.0), on_top(0.0, 0.42), on_top(0.0, -0.42)]
    assert not is_red(colors_at(box, around)).any()


def test_round_shapes_are_as_wide_as_they_are() -> None:
    image, camera = picture(world(Capsule(0.3, 1.2), 3.0, 0.0), "chase")
    left, right = camera.see(torch.tensor([[3.0, 0.3, 0.6], [3.0, -0.3, 0.6]]), 320, 240)[0]
    row = int(left[1])
    columns = is_red(image[row]).nonzero().squeeze(-1)
    assert (columns.min() - left[0]).abs() < 2
    assert (columns.max() - right[0]).abs() < 2


def test_a_person_has_a_violet_trunk_above_dark_legs() -> None:
    points = [(3.0, 0.0, height) for height in (1.0, 1.2)] + [(3.0, y, 0.4) for y in (-0.12, 0.12)]
    colors = colors_at(world(Person(), 3.0, 0.0), points, "chase")
    assert is_violet(colors).tolist() == [True, True, False, False]
    assert colors[2:].max() < 90


def test_a_mover_that_would_fill_the_picture_is_left_out() -> None:
    # The camera is 2.2 m behind the rover, at the height of a person's trunk.
    bare, near = (picture(world(shape, -2.1, 0.0), "chase")[0] for shape in (None, Person()))
    assert is_violet(near).sum() == 0
    assert torch.equal(bare, near)
