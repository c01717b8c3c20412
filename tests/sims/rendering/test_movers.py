"""Pictures of movers."""

from __future__ import annotations

import math
from contextlib import closing

import torch
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.sims.rendering.renderer import Camera, Sight
from rover_rl.worlds import Terrain, World
from rover_rl.worlds.movers import Box, Capsule, Mover, Person, Shape, Waypoints

SIZE = (320, 240)


def world(shape: Shape | None, x: float = 2.0, y: float = 1.0, yaw: float = 0.0) -> World:
    """Level ground, on which a mover stands."""
    movers = [] if shape is None else [Mover(Waypoints([(0.0, x, y, yaw)]), shape)]
    return World("flat", Terrain.flat((20.0, 20.0)), movers=movers)


def picture(scene: World, view="top", backend: str = "warp") -> tuple[Tensor, Camera]:
    """A picture of a rover at the origin, int ``[height, width, 3]``, and its camera."""
    with closing(RoverEnv(world_n=scene, seed=0, backend=backend)) as env:
        env.reset(start=torch.zeros(1, 3), goal=torch.tensor([[-8.0, -8.0]]))
        rover = env.rover_state[0]
        image = env.render(view=view, width=SIZE[0], height=SIZE[1]).int()
    return image, Camera.on(rover.position, rover.orientation, Sight(scene), view)


def colors_at(scene: World, points: list[tuple[float, float, float]], view="top") -> Tensor:
    """Colors of the pixels at which points are seen, ``[P, 3]``."""
    image, camera = picture(scene, view)
    columns, rows = camera.see(torch.tensor(points), *SIZE)[0].floor().long().unbind(-1)
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
    left, right = camera.see(torch.tensor([[3.0, 0.3, 0.6], [3.0, -0.3, 0.6]]), *SIZE)[0]
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
