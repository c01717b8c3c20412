"""Tests specific to the Warp simulator; those of every simulator are in ``tests/sims``."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from rover_rl import RoverEnv, make_env
from rover_rl.sims import make_simulator
from rover_rl.sims.robots import get_robot
from rover_rl.sims.warp import WarpSettings
from rover_rl.sims.worlds import Terrain, World, boulder, box, get_world

ROVER = get_robot("rover_zero")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"substeps": 0}, "substeps must be at least 1, got 0"),
        ({"solver_iterations": 0}, "solver_iterations must be at least 1, got 0"),
        ({"threads": 0}, "threads must be at least 1, got 0"),
        ({"lidar_lanes": 3}, "lidar_lanes must be 1, 2, 4, 8, 16 or 32, got 3"),
        ({"block_size": 48}, "block_size must be a multiple of 32 from 32 to 1024, got 48"),
        ({"control_dt": 0.0}, "control_dt must be positive, got 0.0"),
        ({"stiffness": 0.0}, "stiffness must be positive, got 0.0"),
        ({"ground_friction": -0.1}, "ground_friction must not be negative, got -0.1"),
    ],
)
def test_settings_out_of_range_are_rejected(settings, message):
    with pytest.raises(ValueError, match=message):
        WarpSettings(**settings)


def test_presets_of_bullet_are_unknown():
    with pytest.raises(ValueError, match="unknown physics 'fast'; backend 'warp' has one preset, 'default'"):
        RoverEnv(backend="warp", physics="fast")
    assert RoverEnv(backend="warp", physics="default").simulator.settings == WarpSettings()


def test_environment_specs():
    check_env_specs(make_env(backend="warp", world_n=["inspect", "maze"], num_envs=4, seed=0))


def test_results_do_not_depend_on_the_number_of_threads():
    rollouts = []
    for threads in (1, 2, 3):
        env = make_env(
            backend=WarpSettings(threads=threads), world_n=["inspect", "maze", "moon"], num_envs=100, seed=1, length=30
        )
        torch.manual_seed(0)
        rollouts.append(env.rollout(80, break_when_any_done=False))
        env.close()
    assert rollouts[0]["next", "done"].any()
    for other in rollouts[1:]:
        assert (rollouts[0] == other).all()


def test_several_threads_scan_for_a_rover():
    scans = []
    for lanes in (1, 8):
        env = make_env(
            backend=WarpSettings(threads=2, lidar_lanes=lanes), world_n=["inspect", "maze"], num_envs=40, seed=1
        )
        td = env.reset()
        for _ in range(5):
            td = env.step(td.set("action", torch.tensor([[0.8, 0.3]] * 40)))["next"]
        scans.append(env.base_env.scan)
        env.close()
    torch.testing.assert_close(*scans, rtol=5e-7, atol=0)


@pytest.mark.slow
def test_random_driving_stays_on_the_ground_and_out_of_obstacles():
    """Rovers are not launched, do not sink in or become NaN; wheels penetrate obstacles by at most 1 cm."""
    for name in ("inspect", "moon", "maze"):
        world = get_world(name)
        env = make_env(backend="warp", world_n=name, num_envs=256, seed=0, lidar_beams=32, length=400)
        td = env.reset()
        generator = torch.Generator().manual_seed(0)
        space = env.action_spec.space
        for step in range(300):
            if step % 10 == 0:
                action = space.low + (space.high - space.low) * torch.rand(256, 2, generator=generator)
            _, td = env.step_and_maybe_reset(td.set("action", action))
            position = env.base_env.rover_state.position
            assert torch.isfinite(position).all()
            above = position[:, 2] - world.height_at(position[:, :2])
            assert above.max() < 2.0
            assert above.min() > -0.1
            # At 1 m/s a rover moves 20 cm in four steps, and would be found inside of an obstacle.
            if step % 4 == 0:
                hubs = _hubs(env.base_env.rover_state)
                for obstacle in world.obstacles:
                    planes = obstacle.planes.float()
                    outside = (hubs @ planes[:, :3].T + planes[:, 3]).amax(-1)
                    # The least distance of a hub to a wall, with the wheel parallel to it, is half of a wheel's width.
                    assert outside.min() > ROVER.wheels.width / 2 - 0.01


def _hubs(state) -> torch.Tensor:
    """Centers of all wheels in the world frame, ``[N * W, 3]``."""
    x, y, z, w = (part[:, None] for part in state.orientation.split(1, -1))
    vector, hubs = torch.cat((x, y, z), -1), torch.tensor(ROVER.wheels.hubs)[None]
    vector = vector.expand(-1, hubs.shape[1], 3)
    hubs = hubs.expand(len(vector), -1, 3)
    turned = hubs + 2 * torch.linalg.cross(vector, torch.linalg.cross(vector, hubs) + w * hubs)
    return (state.position[:, None] + turned).reshape(-1, 3)


@pytest.mark.parametrize("yaw", [0.0, 0.5, 1.2])
def test_boulder_stops_the_rover(yaw):
    rock = boulder((2.0, 0.0, 0.2), 0.8, np.random.default_rng(0))
    world = World("rock", Terrain.flat((20, 20)), [rock])
    simulator = make_simulator("warp", worlds=[world], robot=ROVER)
    simulator.reset(torch.ones(1, dtype=torch.bool), torch.tensor([[0.0, 0.0, 0.1 * yaw]]))
    for _ in range(100):
        state = simulator.step(torch.tensor([[1.0, 0.0]]))
    # The front of the rover does not pass the middle of the rock.
    assert state.position[0, 0] < 2.0 - 0.26
    assert torch.isfinite(state.position).all()


def test_ridge_between_the_wheels_carries_the_rover():
    """High-centering: a ridge that is higher than the ground clearance lifts the chassis."""
    heights = torch.zeros(161, 161)
    heights[81, :] = 0.30
    world = World("ridge", Terrain(heights, 0.25))
    x = 0.0
    ridge = world.terrain.origin[1] + 81 * 0.25
    simulator = make_simulator("warp", worlds=[world], robot=ROVER)
    simulator.reset(torch.ones(1, dtype=torch.bool), torch.tensor([[x, ridge, 0.0]]))
    for _ in range(60):
        state = simulator.step(torch.tensor([[0.0, 0.0]]))
    # The belly is 65 mm above the base frame's origin.
    assert state.position[0, 2] + 0.065 > 0.30 - 0.02
    assert torch.isfinite(state.orientation).all()


def test_worlds_without_obstacles_and_with_one_outside_the_terrain():
    worlds = [
        World("plain", Terrain.flat((8, 8))),
        World("edge", Terrain.flat((8, 8)), [box((30.0, 30.0, 0.5), (1.0, 1.0, 1.0))]),
    ]
    simulator = make_simulator("warp", worlds=worlds, robot=ROVER)
    simulator.reset(torch.ones(2, dtype=torch.bool), torch.tensor([[0.0, 0.0, 0.0], [3.0, 3.0, 1.0]]))
    assert torch.isinf(simulator.scanner(16).scan()).all()
    for _ in range(100):
        # The rovers leave the terrain, where the height of the nearest edge continues.
        state = simulator.step(torch.tensor([[1.0, 0.0]] * 2))
    assert (state.position[:, 2].abs() < 0.02).all()


def test_scan_depends_on_the_pose_alone():
    world = get_world("maze")
    simulator = make_simulator("warp", worlds=[world] * 3, robot=ROVER)
    poses = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.0, 1.0], [0.0, 0.5, 2.0]])
    everyone, first = torch.ones(3, dtype=torch.bool), torch.tensor([True, False, False])
    scanner = simulator.scanner(32)
    simulator.reset(everyone, poses)
    before = scanner.scan()
    simulator.reset(first, poses + torch.tensor((0.3, 0.2, 0.0)))
    elsewhere = scanner.scan()
    assert not torch.equal(elsewhere[0], before[0])
    assert torch.equal(elsewhere[1:], before[1:])
    simulator.reset(first, poses)
    assert torch.equal(scanner.scan(), before)


def test_close_is_idempotent():
    simulator = make_simulator(WarpSettings(threads=2), worlds=[get_world("maze")] * 64, robot=ROVER)
    simulator.close()
    simulator.close()
