"""Pictures of a rover in its world."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rover_rl.robots import get_robot
from rover_rl.rotations import quaternion_product, rotate
from rover_rl.sims.rendering import scenes
from rover_rl.sims.rendering.cache import RendererCache
from rover_rl.sims.rendering.renderer import Camera, Sight
from rover_rl.sims.rendering.scenery import SUN
from rover_rl.worlds import Terrain, World, box

ROVER = get_robot("rover_zero")
FLAT = World("flat", Terrain.flat((20, 20)))


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0):
    """Position and quaternion of successive rotations about the fixed axes x, y and z, ``[7]``."""
    turn = torch.tensor((0.0, 0.0, 0.0, 1.0), dtype=torch.float64)
    for axis, angle in enumerate((roll, pitch, yaw)):
        one = torch.zeros(4, dtype=torch.float64)
        one[axis], one[3] = math.sin(angle / 2), math.cos(angle / 2)
        turn = quaternion_product(one, turn)
    return torch.cat((torch.tensor((x, y, z), dtype=torch.float64), turn))


def render(world: World = FLAT, at: Tensor | None = None, view="chase", size=(160, 120), goal=None):
    """Renders one picture, int ``[height, width, 3]``."""
    goal = None if goal is None else torch.tensor(goal)
    return RendererCache(ROVER).render(world, pose() if at is None else at, view, *size, goal).int()


def is_orange(image: Tensor) -> Tensor:
    """Pixels of the chassis."""
    red, green, blue = image.unbind(-1)
    return (red > 1.4 * green) & (green > 1.4 * blue)


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
        monkeypatch.setattr(scenes, "MAX_THREADS", threads)
        monkeypatch.setattr(scenes.os, "cpu_count", lambda: 8)
        images.append(RendererCache(ROVER).render(FLAT, at, "chase", 97, 71, goal))
    assert (images[0].shape, images[0].dtype) == ((71, 97, 3), torch.uint8)
    assert torch.equal(*images)


def test_a_pose_that_is_not_a_number_gives_a_picture():
    assert render(at=torch.full((7,), math.nan, dtype=torch.float64)).shape == (120, 160, 3)
