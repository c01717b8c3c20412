"""What is Warp's own; what every simulator does is in ``tests/sims``."""

from __future__ import annotations

import sys

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from rover_rl import RoverEnv, make_env
from rover_rl.sims import make_simulator
from rover_rl.sims.robots import get_robot
from rover_rl.sims.warp import WarpSettings
from rover_rl.sims.worlds import Terrain, World, boulder, box, get_world

ROVER = get_robot("rover_zero")


def test_without_warp_the_error_says_how_to_install_it(monkeypatch):
    for name in [name for name in sys.modules if name.startswith("rover_rl.sims.warp.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(ImportError, match=r"backend='warp' needs NVIDIA Warp: pip install 'rover_rl\[warp\]'"):
        RoverEnv(backend="warp")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"substeps": 0}, "substeps must be at least 1, got 0"),
        ({"solver_iterations": 0}, "solver_iterations must be at least 1, got 0"),
        ({"threads": 0}, "threads must be at least 1, got 0"),
        ({"control_dt": 0.0}, "control_dt must be positive, got 0.0"),
        ({"stiffness": 0.0}, "stiffness must be positive, got 0.0"),
        ({"ground_friction": -0.1}, "ground_friction must not be negative, got -0.1"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        WarpSettings(**settings)


def test_bullets_presets_are_not_its_own():
    with pytest.raises(ValueError, match="unknown physics 'fast'; backend 'warp' has one preset, 'default'"):
        RoverEnv(backend="warp", physics="fast")
    assert RoverEnv(backend="warp", physics="default").simulator.settings == WarpSettings()


pytestmark = pytest.mark.usefixtures("warp")


@pytest.fixture
def warp():
    return pytest.importorskip("warp", reason="needs rover_rl[warp]")


def test_it_is_an_environment_as_any_other():
    check_env_specs(make_env(backend="warp", world_n=["inspect", "maze"], num_envs=4, seed=0))


def test_the_number_of_threads_changes_no_number():
    rolled = []
    for threads in (1, 2, 3):
        env = make_env(
            backend=WarpSettings(threads=threads), world_n=["inspect", "maze", "moon"], num_envs=100, seed=1, length=30
        )
        torch.manual_seed(0)
        rolled.append(env.rollout(80, break_when_any_done=False))
        env.close()
    assert rolled[0]["next", "done"].any()
    for other in rolled[1:]:
        assert (rolled[0] == other).all()


def test_random_driving_stays_on_the_ground_and_out_of_obstacles():
    """Nothing is thrown up, sinks in or becomes NaN; wheels and chassis get into obstacles by a centimetre at most."""
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
            hubs = _hubs(env.base_env.rover_state)
            for obstacle in world.obstacles:
                planes = obstacle.planes.float()
                outside = (hubs @ planes[:, :3].T + planes[:, 3]).amax(-1)
                # The hub keeps the least distance at which a wheel may be beside a wall: half of its width.
                assert outside.min() > ROVER.wheel_width / 2 - 0.01


def _hubs(state) -> torch.Tensor:
    """Centres of all wheels in the world, ``[N * W, 3]``."""
    x, y, z, w = (part[:, None] for part in state.orientation.split(1, -1))
    vector, hubs = torch.cat((x, y, z), -1), torch.tensor(ROVER.wheel_positions)[None]
    vector = vector.expand(-1, hubs.shape[1], 3)
    hubs = hubs.expand(len(vector), -1, 3)
    turned = hubs + 2 * torch.linalg.cross(vector, torch.linalg.cross(vector, hubs) + w * hubs)
    return (state.position[:, None] + turned).reshape(-1, 3)


@pytest.mark.parametrize("yaw", [0.0, 0.5, 1.2])
def test_a_boulder_stops_the_rover(yaw):
    import numpy as np

    rock = boulder((2.0, 0.0, 0.2), 0.8, np.random.default_rng(0))
    world = World("rock", Terrain.flat((20, 20)), [rock])
    simulator = make_simulator("warp", worlds=[world], robot=ROVER, lidar_beams=8)
    simulator.reset(torch.ones(1, dtype=torch.bool), torch.tensor([[0.0, 0.0, 0.1 * yaw]]))
    for _ in range(100):
        state = simulator.step(torch.tensor([[1.0, 0.0]]))
    # Its front stays before the rock's middle.
    assert state.position[0, 0] < 2.0 - 0.26
    assert torch.isfinite(state.position).all()


def test_a_ridge_between_the_wheels_carries_the_rover():
    """High-centring: a ridge that is higher than the belly lifts the chassis, and the wheels lose their grip."""
    heights = torch.zeros(161, 161)
    heights[81, :] = 0.30
    world = World("ridge", Terrain(heights, 0.25))
    x = 0.0
    ridge = world.terrain.origin[1] + 81 * 0.25
    simulator = make_simulator("warp", worlds=[world], robot=ROVER, lidar_beams=8)
    simulator.reset(torch.ones(1, dtype=torch.bool), torch.tensor([[x, ridge, 0.0]]))
    for _ in range(60):
        state = simulator.step(torch.tensor([[0.0, 0.0]]))
    # The belly is 65 mm above the base frame's origin.
    assert state.position[0, 2] + 0.065 > 0.30 - 0.02
    assert torch.isfinite(state.orientation).all()


def test_worlds_without_obstacles_and_with_one_behind_the_edge():
    worlds = [
        World("plain", Terrain.flat((8, 8))),
        World("edge", Terrain.flat((8, 8)), [box((30.0, 30.0, 0.5), (1.0, 1.0, 1.0))]),
    ]
    simulator = make_simulator("warp", worlds=worlds, robot=ROVER, lidar_beams=16)
    state = simulator.reset(torch.ones(2, dtype=torch.bool), torch.tensor([[0.0, 0.0, 0.0], [3.0, 3.0, 1.0]]))
    assert torch.isinf(state.ranges).all()
    for _ in range(100):
        # Out of the terrain, where the nearest edge goes on.
        state = simulator.step(torch.tensor([[1.0, 0.0]] * 2))
    assert (state.position[:, 2].abs() < 0.02).all()


def test_scans_from_other_poses_move_nothing():
    world = get_world("maze")
    simulator = make_simulator("warp", worlds=[world] * 3, robot=ROVER, lidar_beams=32)
    before = simulator.state().clone()
    elsewhere = simulator.scan_from(before.position + torch.tensor((0.3, 0.2, 0.0)), before.orientation)
    assert not torch.equal(elsewhere, before.ranges)
    assert (simulator.state() == before).all()
    assert torch.equal(simulator.scan_from(before.position, before.orientation), before.ranges)


def test_it_can_be_closed_twice():
    simulator = make_simulator(WarpSettings(threads=2), worlds=[get_world("maze")] * 64, robot=ROVER, lidar_beams=8)
    simulator.close()
    simulator.close()
