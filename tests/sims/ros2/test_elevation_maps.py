"""Elevation maps of ROS 2: messages are built here as grid_map's documentation says."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl.rotations import quaternion_product
from rover_rl.sims.elevation_map import ElevationMap
from rover_rl.sims.ros2.elevation_maps import elevation_map_message, read_elevation_map
from rover_rl.sims.ros2.ground import sample
from rover_rl.sims.ros2.messages import (
    Float32MultiArray,
    GridMap,
    GridMapInfo,
    Header,
    MultiArrayDimension,
    MultiArrayLayout,
    Point,
    Pose,
    Quaternion,
    decode,
    encode,
)

CENTER, CELL = (3.0, -2.0), 0.5


def _height(x: Any, y: Any) -> Any:
    return 0.1 * x - 0.3 * y


def _position(row: int, column: int, size: tuple[int, int]) -> tuple[float, float]:
    """Middle of a cell of a map whose buffer starts at 0, 0: GridMapMath.cpp, getPositionFromIndex."""
    x, y = (c + n * CELL / 2 - CELL / 2 - CELL * i for c, n, i in zip(CENTER, size, (row, column), strict=True))
    return x, y


def _message(size: tuple[int, int] = (6, 4), start: tuple[int, int] = (0, 0)) -> GridMap:
    """A map of a plane, with a hole in the cell 1, 2, and a layer of zeros before it."""
    rows, columns = size
    buffer = np.empty(size, np.float32)
    for row in range(rows):
        for column in range(columns):
            height = np.nan if (row, column) == (1, 2) else _height(*_position(row, column, size))
            buffer[(row + start[0]) % rows, (column + start[1]) % columns] = height
    layout = MultiArrayLayout(
        [MultiArrayDimension("column_index", columns, rows * columns), MultiArrayDimension("row_index", rows, rows)]
    )
    layers = [Float32MultiArray(layout, array.flatten(order="F")) for array in (np.zeros_like(buffer), buffer)]
    info = GridMapInfo(CELL, rows * CELL, columns * CELL, Pose(Point(*CENTER, 7.0)))
    return GridMap(Header(), info, ["variance", "elevation"], [], layers, *start)


@pytest.mark.parametrize("start", [(0, 0), (4, 0), (0, 3), (5, 2)])
def test_a_map_is_read_whatever_its_circular_buffer_starts_with(start):
    ground = read_elevation_map(decode(GridMap, encode(_message(start=start))))
    places = torch.tensor([[_position(row, column, (6, 4)) for column in range(4)] for row in range(6)])
    heights = ground.height_at(places)
    assert heights.isnan().nonzero().tolist() == [[1, 2]]
    torch.testing.assert_close(
        heights, _height(*places.unbind(-1)).masked_fill(heights.isnan(), torch.nan), equal_nan=True
    )
    # Between the middles of cells the plane is met exactly, and beyond the edge nothing is known.
    between = places[4, 1] + 0.2
    torch.testing.assert_close(ground.height_at(between), _height(*between.unbind(-1)))
    # Beside the hole, the neighbors that are known count.
    torch.testing.assert_close(
        ground.height_at(places[1, 1] - torch.tensor([0.0, 0.2])), _height(*places[1, 1].unbind(-1))
    )
    assert ground.height_at(torch.tensor([[CENTER[0] + 1.6, CENTER[1]], [CENTER[0], CENTER[1] - 1.1]])).isnan().all()


def test_rows_may_be_stored_one_after_another():
    msg = _message()
    by_row = MultiArrayLayout([*reversed(msg.data[1].layout.dim)])
    data = msg.data[1].data.reshape(4, 6).T.flatten()
    turned = replace(msg, layers=["elevation"], data=[Float32MultiArray(by_row, data)])
    torch.testing.assert_close(read_elevation_map(turned).heights, read_elevation_map(msg).heights, equal_nan=True)


@settings(deadline=None, max_examples=30)
@given(rows=st.integers(1, 5), columns=st.integers(1, 5), start=st.tuples(st.integers(0, 4), st.integers(0, 4)))
def test_a_map_is_sent_and_read_unchanged(rows, columns, start):
    heights = (
        torch.arange(float(rows * columns))
        .reshape(rows, columns)
        .masked_fill(torch.rand(rows, columns) < 0.2, math.nan)
    )
    sent = elevation_map_message(ElevationMap(heights, (1.0, 2.0), 0.25, "top"), Header().stamp, "map")
    # As a map that has moved: its buffer starts elsewhere.
    shift = start[0] % rows, start[1] % columns
    buffer = np.roll(sent.data[0].data.reshape(columns, rows).T, shift, (0, 1)).flatten(order="F")
    moved = replace(
        sent, data=[replace(sent.data[0], data=buffer)], outer_start_index=shift[0], inner_start_index=shift[1]
    )
    back = read_elevation_map(decode(GridMap, encode(moved)), "top")
    torch.testing.assert_close(back.heights, heights, equal_nan=True)
    assert back[1:] == ((1.0, 2.0), 0.25, "top")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda msg: setattr(msg, "layers", ["a", "b"]), r"the layer 'elevation', got \['a', 'b'\] with 2 arrays"),
        (lambda msg: msg.data.pop(), r"'elevation'\] with 1 arrays"),
        (lambda msg: setattr(msg.info, "resolution", 0.0), "resolution .* positive and finite, got 0.0"),
        (lambda msg: setattr(msg.info, "length_x", 9.0), r"9.0 x 2.0 m with cells of 0.5 m has \(6, 4\) cells"),
        (lambda msg: setattr(msg.info.pose.position, "x", math.nan), "center of an elevation map must be finite"),
        (
            lambda msg: setattr(msg.info.pose, "orientation", Quaternion(z=0.5, w=0.8)),
            "must not be turned in its frame",
        ),
        (lambda msg: setattr(msg.data[1], "data", np.zeros(23, np.float32)), r"of \[4, 6\] with 23 values"),
        (lambda msg: setattr(msg.data[1].layout.dim[0], "label", "x"), r"got \['x', 'row_index'\]"),
    ],
)
def test_a_malformed_map_is_refused_in_a_sentence(change, message):
    msg = _message()
    change(msg)
    with pytest.raises(ValueError, match=message):
        read_elevation_map(msg)


def test_a_tilted_map_is_read_along_the_vertical():
    """The map is in the frame of a robot that looks up a slope of 20 degrees, which is flat for the robot."""
    tilt, yaw = math.radians(-20), 0.6
    flat = ElevationMap(torch.full((80, 80), 0.05), (0.0, 0.0), 0.1)
    pitch = torch.tensor([0.0, math.sin(tilt / 2), 0.0, math.cos(tilt / 2)])
    turn = torch.tensor([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)])
    position = torch.tensor([5.0, -1.0, 2.0])
    ahead = torch.tensor([0.0, 1.0, 2.0, 9.0])
    grid = position[:2] + ahead[:, None] * torch.tensor([math.cos(yaw), math.sin(yaw)])
    heights = sample(flat, position, quaternion_product(turn, pitch), grid[None])[0]
    expected = 2.0 + ahead * math.tan(-tilt) + 0.05 / math.cos(tilt)
    torch.testing.assert_close(heights[:3], expected[:3], atol=1e-4, rtol=0)
    assert heights[3].isnan()
