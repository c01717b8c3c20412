from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rover_rl.envs.sensors.standard import LidarPooling
from rover_rl.sims.ros2.messages import Header, LaserScan, Quaternion, Time
from rover_rl.sims.ros2.poses import read_orientation
from rover_rl.sims.ros2.scans import SECTOR, aligned, cut, is_blocked, read_scan


def scan(ranges, first=0.0, increment=None) -> LaserScan:
    increment = 2 * math.pi / max(1, len(ranges)) if increment is None else increment
    return LaserScan(
        Header(Time(3, 500_000_000)), angle_min=first, angle_increment=increment, ranges=np.array(ranges, np.float32)
    )


def test_ranges_are_unchanged_copies():
    message = scan([1.0, math.inf, math.nan, -math.inf])
    read = read_scan(message, max_invalid=0.25)
    np.testing.assert_array_equal(read.ranges, message.ranges)
    assert read.valid.tolist() == [True, True, False, True]
    assert read.stamp == 3.5
    read.ranges[0] = 7
    assert message.ranges[0] == 1
    assert aligned(read_scan(scan([-math.inf, 1.0])), 2)[0].tolist() == [-math.inf, 1.0]


@pytest.mark.parametrize(
    ("ranges", "announced", "message_start"),
    [
        ([math.nan] * 640, 640, "640 of 640 readings"),
        ([1.0] * 7, 640, "633 of 640 readings"),
        ([12.5] * 33 + [0.1] * 32 + [1.0] * 575, 640, "65 of 640 readings"),  # beyond the limits
    ],
)
def test_a_scan_with_too_many_invalid_readings_is_rejected(ranges, announced, message_start):
    message = scan(ranges, increment=2 * math.pi / announced)
    message.angle_max = (announced - 1) * message.angle_increment
    message.range_min, message.range_max = 0.15, 12.0
    with pytest.raises(ValueError, match=f"{message_start} of the scan are missing, NaN or outside of its limits"):
        read_scan(message)
    assert read_scan(message, max_invalid=1.0).ranges.shape == (len(ranges),)
    # A tenth is accepted.
    assert (~read_scan(scan([math.nan] * 64 + [1.0] * 576)).valid).sum() == 64


def test_a_clockwise_scan_is_reversed():
    message = scan([1.0, 2.0, 3.0], first=0.5, increment=-0.1)
    message.angle_max = 0.3
    turned = read_scan(message)
    assert turned.ranges.tolist() == [3, 2, 1]
    assert turned.angle_min == pytest.approx(0.3)
    assert turned.angle_increment == pytest.approx(0.1)


def reference_alignment(message: LaserScan, beams: int, yaw: float) -> list[float | None]:
    """Reference implementation: nearest valid reading in each beam's sector, else the adjacent one, else ``None``."""
    angles = [message.angle_min + yaw + k * message.angle_increment for k in range(len(message.ranges))]
    ranges = message.ranges.tolist()
    expected: list[float | None] = []
    for beam in range(beams):
        middle = 2 * math.pi * beam / beams
        distances = [abs(math.remainder(angle - middle, 2 * math.pi)) for angle in angles]
        inside = [r for r, a in zip(ranges, distances, strict=True) if a < math.pi / beams and not math.isnan(r)]
        adjacent = min(range(len(ranges)), key=distances.__getitem__)
        is_adjacent = distances[adjacent] <= message.angle_increment / 2 and not math.isnan(ranges[adjacent])
        expected.append(min(inside) if inside else ranges[adjacent] if is_adjacent else None)
    return expected


@settings(deadline=None)
@given(
    readings=st.lists(st.floats(0.1, 12.0) | st.just(math.inf) | st.just(math.nan), min_size=1, max_size=40),
    beams=st.sampled_from([1, 7, 8, 32]),
    yaw=st.sampled_from([0.0, math.pi, 0.3]),
    share=st.floats(0.2, 1.0),
)
def test_alignment_matches_a_reference_implementation(readings, beams, yaw, share):
    # Offset, so that no reading lies on the border between two sectors.
    message = scan(readings, first=-math.pi + 0.00371, increment=share * 2 * math.pi / len(readings))
    ranges, seen = aligned(read_scan(message, max_invalid=1.0).mounted(yaw), beams)
    expected = reference_alignment(message, beams, yaw)
    assert seen.tolist() == [reading is not None for reading in expected]
    assert ranges.tolist() == pytest.approx([math.inf if reading is None else reading for reading in expected])


@pytest.mark.parametrize("count", [640, 1081, 37])
@pytest.mark.parametrize(("yaw", "first"), [(math.pi, -math.pi), (3.14, -math.pi), (2.0, 0.5)])
def test_segments_are_the_contracts_cut_of_the_raw_scan(count, yaw, first):
    ranges = np.random.default_rng(count).uniform(0.2, 11.0, count).astype(np.float32)
    increment = np.float32(2 * math.pi / count).item()
    turned = math.remainder(yaw + first, 2 * math.pi)
    ahead = np.roll(ranges, math.floor(turned / increment + 0.25))  # the first reading from straight ahead on is first
    expected = [part.min() for part in np.array_split(ahead, 32)]
    read = read_scan(scan(ranges, np.float32(first).item(), increment))
    assert cut(read.mounted(yaw), 32).tolist() == pytest.approx(expected)
    assert (cut(read.mounted(yaw), 32) == LidarPooling(count, 32, 12.0)(torch.from_numpy(ahead)[None])[0]).all()


@pytest.mark.parametrize("yaw", [math.pi, 0.3])
@pytest.mark.parametrize("clockwise", [False, True])
def test_a_lidar_that_hangs_upside_down_is_rolled_before_it_is_turned(yaw, clockwise):
    angles = -math.pi + np.arange(360) * 2 * math.pi / 360
    at = math.radians(-60.0)  # in the lidar's frame
    ranges = np.where(np.abs(angles - at) < 0.01, 1.0, 8.0)
    message = scan(ranges[::-1], angles[-1], -2 * math.pi / 360) if clockwise else scan(ranges, -math.pi)
    # Rotation by a roll of pi, then by the yaw.
    direction = Rotation.from_euler("xz", [math.pi, yaw]).apply([math.cos(at), math.sin(at), 0.0])
    beam = round(math.atan2(direction[1], direction[0]) / (2 * math.pi / 360)) % 360
    read = read_scan(message)
    assert aligned(read.mounted(yaw, inverted=True), 360)[0].argmin() == beam
    assert cut(read.mounted(yaw, inverted=True), 360)[[beam - 1, beam, (beam + 1) % 360]].min() == 1.0


def test_an_orientation_is_normalized_from_any_object_with_the_attributes_and_must_be_valid():
    orientation = read_orientation(SimpleNamespace(x=0.0, y=0.0, z=3.0, w=4.0))
    np.testing.assert_allclose(orientation, [0, 0, 0.6, 0.8], atol=1e-6)
    for quaternion in ((0, 0, 0, 0), (math.nan, 0, 0, 1), (math.inf, 0, 0, 1)):
        with pytest.raises(ValueError, match="finite quaternion other than zero"):
            read_orientation(Quaternion(*quaternion))


@pytest.mark.parametrize(("speed", "direction"), [(0.3, 1.0), (-0.3, -1.0), (0.0, 0.0)])
def test_every_beam_around_the_direction_of_travel_must_be_seen(speed, direction):
    angles = torch.arange(128) * (2 * math.pi / 128)
    sector = direction * angles.cos() > math.cos(SECTOR) - 1e-3
    for beam in range(128):
        seen = torch.ones(128, dtype=torch.bool)
        assert not is_blocked(speed, seen)
        seen[beam] = False
        assert is_blocked(speed, seen) == sector[beam].item()
