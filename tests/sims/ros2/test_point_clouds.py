"""Point clouds of ROS 2, and what sensors read of them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from rover_rl.envs.sensors.ray_images import Lidar3D
from rover_rl.sims.ros2.ground import lowest_quarter
from rover_rl.sims.ros2.messages import Header, PointCloud2, PointField, decode, encode
from rover_rl.sims.ros2.point_clouds import point_cloud_message, read_points

POINTS = np.array(
    [[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0], [-4.5, 5.25, 1e3], [0.0, np.inf, 0.0], [7.0, 8.0, 9.0], [0, 0, 0]]
)
KEPT = torch.from_numpy(POINTS[[0, 2, 4, 5]].astype(np.float32))


def _cloud(
    order: str = "<", shape: tuple[int, int] = (1, 6), kind: str = "f4", padding: int = 0, **changes
) -> PointCloud2:
    """A cloud whose points have z first, an intensity, and bytes between; and whose rows end with a padding."""
    size = int(kind[1])
    layout = np.dtype(
        {
            "names": ["z", "intensity", "x", "y"],
            "formats": [order + kind, order + "u2", order + kind, order + kind],
            "offsets": [0, size, size + 3, 2 * size + 5],
            "itemsize": 3 * size + 9,
        }
    )
    records = np.zeros(shape, layout)
    for number, name in enumerate("xyz"):
        records[name] = POINTS[:, number].reshape(shape)
    lines = np.pad(records.view(np.uint8).reshape(shape[0], -1), ((0, 0), (0, padding)), constant_values=7)
    datatype = {"f4": 7, "f8": 8, "i4": 5}[kind]
    fields = [PointField("intensity", size, 4, 1)]
    fields += [PointField(name, layout.fields[name][1], datatype, 1) for name in "zyx"]
    parts = {
        "height": shape[0],
        "width": shape[1],
        "fields": fields,
        "is_bigendian": order == ">",
        "point_step": layout.itemsize,
        "row_step": lines.shape[1],
        "data": lines.flatten(),
    }
    return PointCloud2(Header(), **{**parts, **changes})


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize(("shape", "kind", "padding"), [((1, 6), "f4", 0), ((2, 3), "f4", 5), ((3, 2), "f8", 0)])
def test_finite_points_are_read_whatever_the_layout(order, shape, kind, padding):
    assert read_points(decode(PointCloud2, encode(_cloud(order, shape, kind, padding)))).equal(KEPT)


def test_an_empty_cloud_has_no_points_and_an_organized_one_is_sent_unchanged():
    assert read_points(PointCloud2(fields=_cloud().fields, point_step=30)).shape == (0, 3)
    assert read_points(_cloud(row_step=0)).equal(KEPT)
    sent = point_cloud_message(torch.from_numpy(POINTS).reshape(2, 3, 3), Header().stamp, "lidar")
    assert read_points(decode(PointCloud2, encode(sent))).equal(KEPT)


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (
            lambda: _cloud(fields=_cloud().fields[:3]),
            r"x, y and z as float32 or float64, got the fields \['intensity', ",
        ),
        (lambda: _cloud(kind="i4", shape=(1, 6)), "x, y and z as float32 or float64"),
        (lambda: _cloud(point_step=10), "6 x 1 points of 10 bytes, whose coordinates end at 17, has 126 bytes"),
        (
            lambda: _cloud(width=7),
            "7 x 1 points of 21 bytes, whose coordinates end at 17, has 126 bytes, in rows of 147",
        ),
        (lambda: _cloud(shape=(2, 3), row_step=8), "in rows of 8"),
    ],
)
def test_a_malformed_cloud_is_refused_in_a_sentence(cloud, message):
    with np.errstate(invalid="ignore"):
        msg = cloud()
    with pytest.raises(ValueError, match=message):
        read_points(msg)


@pytest.mark.parametrize("field_of_view", [2 * math.pi, 1.5])
def test_points_fall_in_the_pixel_of_their_direction(field_of_view):
    lidar = Lidar3D(size=(5, 12), field_of_view=field_of_view, elevation=(-0.4, 0.2), min_range=0.5)
    rays = torch.tensor(lidar.rays()[0])
    near, far = 1.0 + torch.rand(60), torch.full((60,), 7.0)
    up = torch.asin(rays[:, 2])
    # A bit beside the middle of the pixel.
    beside = torch.stack((rays[:, 0], rays[:, 1], (up + 0.07).tan() * rays[:, :2].norm(dim=-1)), -1)
    image = lidar.range_image(torch.cat((rays * far[:, None], rays * near[:, None])))
    torch.testing.assert_close(image.flatten(), near)
    torch.testing.assert_close(lidar.range_image(beside), beside.norm(dim=-1).reshape(5, 12))
    # No return, too far, too close, at the origin, and beyond the image.
    few = torch.cat((rays[[0]] * 50, rays[[1]] * 0.4, torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 3.0]])))
    if field_of_view < 3:
        few = torch.cat((few, torch.tensor([[-1.0, 0.1, 0.0], [1.0, 1.0, 0.0]])))
    image = lidar.range_image(few).flatten()
    assert image[1] == 0
    assert (image[[0, *range(2, 60)]] == lidar.max_range).all()


def test_one_plane_has_its_elevation_and_that_of_a_square_pixel():
    flat = Lidar3D(size=(1, 8), elevation=(0.0, 0.0))
    points = torch.tensor([[2.0, -0.1, 0.5], [-2.0, -0.1, 2.0]])
    assert flat.range_image(points)[0].lt(flat.max_range).nonzero().tolist() == [[4]]


def test_the_ground_of_a_cell_is_the_lower_quarter_of_its_points():
    """The grid looks along y. Each point of the grid has a cell of 0.4 m around it."""
    yaw = torch.tensor(math.pi / 2)
    ahead, left = torch.meshgrid(torch.tensor([1.4, 1.0, 0.6]), torch.tensor([0.4, 0.0]), indexing="ij")
    grid = torch.stack((5.0 - left, ahead), -1)
    middle = grid[1, 0]
    offsets = 0.38 * torch.rand(40, 2) - 0.19
    ground = torch.cat((middle + offsets, torch.full((40, 1), 0.3)), -1)
    above, below = ground[:24] + torch.tensor([0.0, 0.0, 1.5]), ground[:3] - torch.tensor([0.0, 0.0, 4.0])
    elsewhere = torch.tensor([[5.0, 0.6, 0.7], [5.0, 3.0, 9.0], [5.3, 1.0, 9.0]])
    heights = lowest_quarter(torch.cat((above, ground, below, elsewhere)), grid, yaw, 0.4)
    assert heights[1, 0] == pytest.approx(0.3)
    assert heights[2, 1] == pytest.approx(0.7)
    assert heights.isnan().sum() == 4
    assert lowest_quarter(torch.zeros(0, 3), grid, yaw, 0.4).isnan().all()
