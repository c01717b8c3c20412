"""Tests specific to the Warp simulator; those of every simulator are in ``tests/sims``."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl import make_env
from rover_rl.native.warp import wp
from rover_rl.robots import get_robots
from rover_rl.robots.fleet import Fleet
from rover_rl.rotations import matrix_to_quaternion, quaternion_to_euler
from rover_rl.sims.free_space import rest_on_ground
from rover_rl.sims.warp import WarpSettings
from rover_rl.sims.warp.kernels import placing
from rover_rl.worlds import Terrain, World, box, get_world
from tests.sims.driven import ROVER, drive, in_world, placed, slope

HOPPER = 90
"""Compute capability 9.0 (H100, H200)."""


def test_several_threads_scan_for_a_rover():
    scans = []
    for lanes in (1, 8):
        settings = WarpSettings(threads=2, lidar_lanes=lanes)
        env = make_env(backend=settings, world_n=["inspect", "maze"], num_envs=40, seed=1)
        td = env.reset()
        for _ in range(5):
            td = env.step(td.set("action", torch.tensor([[0.8, 0.3]] * 40)))["next"]
        scans.append(env.base_env.scan)
        env.close()
    torch.testing.assert_close(*scans, rtol=5e-7, atol=0)


@pytest.mark.slow
def test_random_driving_stays_on_the_ground_and_out_of_obstacles():
    """Rovers are not launched, do not sink in or become NaN; wheels penetrate obstacles by at most 1 cm."""
    for name in ("moon", "maze"):
        world = get_world(name)
        env = make_env(backend="warp", world_n=name, num_envs=32, seed=0, lidar_beams=32, length=400)
        td = env.reset()
        generator = torch.Generator().manual_seed(0)
        space = env.action_spec.space
        for step in range(100):
            if step % 10 == 0:
                action = space.low + (space.high - space.low) * torch.rand(32, 2, generator=generator)
            _, td = env.step_and_maybe_reset(td.set("action", action))
            position = env.base_env.rover_state.position
            assert torch.isfinite(position).all()
            above = position[:, 2] - world.height_at(position[:, :2])
            assert above.max() < 2.0
            assert above.min() > -0.1
            # At 1 m/s a rover moves 20 cm in four steps, and would be found inside of an obstacle.
            if step % 4 == 0:
                hubs = in_world(env.base_env.rover_state, ROVER.wheels.hubs).reshape(-1, 3)
                for obstacle in world.obstacles:
                    planes = obstacle.planes.double()
                    outside = (hubs @ planes[:, :3].T + planes[:, 3]).amax(-1)
                    # The least distance of a hub to a wall, with the wheel parallel to it, is half of a wheel's width.
                    assert outside.min() > ROVER.wheels.width / 2 - 0.01


@pytest.mark.slow
def test_kernels_compile_for_a_gpu(tmp_path):
    """On every machine. What they do there is tested in tests/gpu."""
    wp.compile_aot_module(placing, arch=HOPPER, module_dir=str(tmp_path), use_ptx=True)
    (code,) = tmp_path.glob("*.ptx")
    text = code.read_text()
    assert f".target sm_{HOPPER}" in text
    assert ".entry place_" in text


def test_rover_tips_over_at_the_static_stability_angle():
    """Across a slope, a rover tips over the outer edges of the lower wheels once its center of mass passes them."""
    edge = ROVER.wheels.hubs[0][1] + ROVER.wheels.width / 2
    height = ROVER.center_of_mass[2] - (ROVER.wheels.hubs[0][2] - ROVER.wheels.radius)
    tipping = math.degrees(math.atan2(edge, height))
    assert 45 < tipping < 65
    for degrees, stands in ((tipping - 2.5, True), (tipping + 2.5, False)):
        # With high friction, the rover tips instead of sliding.
        settings = WarpSettings(ground_friction=4.0)
        simulator = placed(settings, slope(degrees, cell=0.1), [(0.0, 0.0, math.pi / 2)])
        rolls = [quaternion_to_euler(state.orientation)[0, 0].item() for state in drive(simulator, (0.0, 0.0), 30)]
        assert (math.degrees(max(map(abs, rolls))) < degrees + 5) == stands


def test_obstacles_have_their_own_friction():
    """The friction of a wall slows a rover that slides along it."""
    world = World("wall", Terrain.flat((60, 60)), [box((0.0, 0.5, 0.5), (30.0, 0.4, 1.0))])
    distances = []
    for friction in (0.0, 0.25):
        simulator = placed(WarpSettings(obstacle_friction=friction), world, [(-5.0, -0.05, 0.35)])
        states = drive(simulator, (0.8, 0.6), 80)
        distances.append((states[-1].position[0, 0] - states[0].position[0, 0]).item())
        # Neither rover passes through the wall.
        assert states[-1].position[0, 1] < 0.3 - 0.2
    assert distances[0] > distances[1] + 0.05


@pytest.mark.parametrize("world_name", ["maze", "moon"])
def test_rovers_are_placed_where_they_rest(world_name: str) -> None:
    world, robots = get_world(world_name), get_robots(("rover_zero", "leo", "jackal", "husky", "racer", "hunter"))
    index = torch.arange(64) % len(robots)
    generator = torch.Generator().manual_seed(0)
    low, high = (torch.tensor(corner) for corner in zip(*world.bounds, strict=True))
    places = low + (high - low) * torch.rand(64, 2, generator=generator)
    poses = torch.cat((places, (2 * torch.rand(64, 1, generator=generator) - 1) * torch.pi), -1)
    state = placed("warp", world, poses, Fleet(robots, index)).state()
    for robot in range(len(robots)):
        rows = index == robot
        position, rotation = rest_on_ground(world, robots[robot], poses[rows])
        # The kernel computes in float32.
        torch.testing.assert_close(state.position[rows].double(), position, rtol=0, atol=5e-5)
        torch.testing.assert_close(state.orientation[rows].double(), matrix_to_quaternion(rotation), rtol=0, atol=5e-5)
