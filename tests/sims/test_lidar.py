"""Lidar of every simulator, compared with analytic distances."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from rover_rl import RoverEnv
from rover_rl.robots import get_robot
from rover_rl.sims import make_scanner
from rover_rl.sims.bullet.simulator import RAYS_PER_CALL
from rover_rl.sims.rays import seen
from rover_rl.sims.warp.plane_scanner import PlaneScanner
from rover_rl.worlds import Terrain, World, box, get_world
from rover_rl.worlds.table import WorldTable
from tests.sims.driven import ROVER, all_rows, placed, slope

MOUNT = ROVER.lidar_position[0]


def room(width: float, depth: float, height: float = 6.0) -> list:
    """Four walls around the origin; inner size ``width`` (x) by ``depth`` (y)."""
    return [box((side * (width / 2 + 0.5), 0, height / 2 - 2), (1, depth + 2, height)) for side in (-1, 1)] + [
        box((0, side * (depth / 2 + 0.5), height / 2 - 2), (width + 2, 1, height)) for side in (-1, 1)
    ]


def scans(backend: str, world: World, poses: torch.Tensor, beams: int) -> torch.Tensor:
    simulator = placed(backend, world, poses)
    return make_scanner(simulator, [world] * len(poses), ROVER, beams).scan()


def scan(backend: str, world: World, pose: tuple[float, float, float], beams: int = 64) -> torch.Tensor:
    return scans(backend, world, torch.tensor([pose]), beams)[0]


def to_walls(x: float, y: float, angles: np.ndarray, width: float, depth: float) -> np.ndarray:
    """Distances from a point to the walls of a rectangular room, along ``angles``."""
    with np.errstate(divide="ignore"):
        along_x = np.where(np.cos(angles) > 0, width / 2 - x, -width / 2 - x) / np.cos(angles)
        along_y = np.where(np.sin(angles) > 0, depth / 2 - y, -depth / 2 - y) / np.sin(angles)
    return np.minimum(np.abs(along_x), np.abs(along_y))


@pytest.mark.parametrize(("yaw", "beams"), [(0.7, 7), (-2.5, 640)])
def test_ranges_in_a_room_match_analytic_distances(backend, yaw, beams):
    world = World("room", Terrain.flat((30, 30)), room(8, 6))
    x, y = 0.9 + MOUNT * math.cos(yaw), -0.4 + MOUNT * math.sin(yaw)
    angles = yaw + 2 * math.pi * np.arange(beams) / beams
    expected = to_walls(x, y, angles, 8, 6)
    np.testing.assert_allclose(scan(backend, world, (0.9, -0.4, yaw), beams).numpy(), expected, atol=0.01)


@pytest.mark.parametrize(("tilt", "yaw"), [(12.0, 0.0), (5.0, math.pi)])
def test_tilted_scan_measures_slanted_distances(backend, tilt, yaw):
    """On a slope along x, beams ahead and behind hit vertical walls at d / cos(tilt), beams to the sides at d."""
    world = World("ramp", slope(tilt, size=30).terrain, room(8, 6, height=12))
    ranges = scan(backend, world, (0.0, 0.0, yaw), 4)
    cos, sin = math.cos(math.radians(tilt)), math.sin(math.radians(tilt))
    # The lidar is MOUNT ahead along the slope; its height above the slope is corrected for the wheels' clearance.
    up = ROVER.lidar_position[2] - 0.003 + 0.0005
    x = math.cos(yaw) * MOUNT * cos - up * sin
    ahead, behind = ((4 + sign * x) / cos for sign in ((1, -1) if yaw else (-1, 1)))
    expected = [ahead, 3.0, behind, 3.0]
    torch.testing.assert_close(ranges, torch.tensor(expected), atol=0.01, rtol=0)


def test_wall_beyond_the_range_is_not_seen(backend):
    world = World("far", Terrain.flat((60, 60)), [box((ROVER.lidar_range + MOUNT + 0.55, 0, 1), (1, 4, 2))])
    assert torch.isinf(scan(backend, world, (0.0, 0.0, 0.0))).all()
    assert scan(backend, world, (0.1, 0.0, 0.0))[0] == pytest.approx(11.95, abs=0.01)


def test_scan_from_inside_an_obstacle_is_zero(backend):
    world = World("block", Terrain.flat((30, 30)), [box((0, 0, 1), (2, 2, 2))])
    assert (scan(backend, world, (0.0, 0.0, 0.0)) == 0).all()
    assert (scan(backend, world, (-1.3, 0.0, 0.0))[1:] > 0).any()


def test_large_batches_match_single_scans(backend):
    world, rovers = World("room", Terrain.flat((30, 30)), room(8, 6)), RAYS_PER_CALL // 128 + 8
    poses = torch.stack([torch.linspace(-2, 2, rovers), torch.zeros(rovers), torch.linspace(-3, 3, rovers)], 1)
    ranges = scans(backend, world, poses, 128)
    for row in (0, -1):
        assert torch.equal(ranges[row], scan(backend, world, tuple(poses[row].tolist()), 128))


def test_ground_outside_of_the_bounds_is_seen_as_far_as_the_range(backend):
    heights = torch.full((321, 321), 3.0)
    heights[96:225, 96:225] = 0.0  # a step up between 16 and 16.25 m from the middle, on all sides
    middle = ((-2.0, 2.0), (-2.0, 2.0))
    world = World("hollow", Terrain(heights, 0.25), spawn_range=middle, bounds=middle)
    turns = torch.arange(4) * math.pi / 2
    poses = torch.stack((4.6 * turns.cos(), 4.6 * turns.sin(), turns), -1)
    ahead = scans(backend, world, poses, 4)[:, 0] + 4.6 + MOUNT
    assert ((ahead > 16) & (ahead < 16.1)).all()


def test_the_planar_lidar_sees_what_the_lidars_of_the_simulators_see(backend):
    world = get_world("moon")
    poses = torch.tensor([[0.0, 0.0, 0.3], [2.0, -1.0, 2.0], [-3.0, 2.0, -1.0]])
    simulator = placed(backend, world, poses)
    table = WorldTable.of([world] * 3, "cpu")
    cast = PlaneScanner(simulator, table, ROVER, 256)
    own = make_scanner(simulator, table, ROVER, 256)
    assert torch.equal(cast.angles, own.angles)
    near = torch.isclose(cast.scan(), own.scan(), atol=0.01, rtol=0)
    # A beam along an edge may hit or miss it.
    assert near.float().mean() > 0.99
    before = cast.scan()
    simulator.reset(all_rows(3), poses.flip(0))
    assert torch.equal(cast.scan(torch.tensor([True, False, True]))[1], before[1])


def test_a_view_is_centered_on_straight_ahead() -> None:
    angles = torch.arange(8) * math.pi / 4
    assert seen(angles, math.radians(270)).tolist() == [True, True, True, True, False, True, True, True]
    assert seen(angles, math.radians(80)).tolist() == [True, *[False] * 7]
    assert seen(angles, 2 * math.pi).all()


def test_readings_outside_of_the_view_have_no_return(backend: str) -> None:
    front = replace(ROVER, name="front", lidar_view=math.radians(270))
    full, partial = (RoverEnv(world_n="maze", robot=robot, backend=backend, seed=0) for robot in (ROVER, front))
    expected, readings = (env.reset()["lidar"][0] for env in (full, partial))
    # 32 readings of 11.25 degrees, from straight ahead on; those behind are 12 to 19.
    assert torch.equal(readings[:12], expected[:12])
    assert torch.equal(readings[20:], expected[20:])
    assert (readings[12:20] >= expected[12:20]).all()
    assert readings[13:19].tolist() == [12.0] * 6
    assert partial.scan.isinf().sum() > full.scan.isinf().sum()


def test_robots_state_the_views_of_their_lidars() -> None:
    views = {name: math.degrees(get_robot(name).lidar_view) for name in ("rover_zero", "jackal")}
    assert views == pytest.approx({"rover_zero": 360.0, "jackal": 270.0}, abs=0.1)
    with pytest.raises(ValueError, match="lidar_view of robot .* must be positive and at most 2 pi rad, got 7"):
        replace(ROVER, lidar_view=7.0)
