"""Physics of Warp and of MuJoCo compared with analytic solutions."""

from __future__ import annotations

import itertools
import math

import pytest
import torch

from benchmarks.coulomb import steady_motion
from rover_rl.sims import Backend, make_simulator
from rover_rl.sims.mujoco import MujocoSettings
from rover_rl.sims.robots import get_robot
from rover_rl.sims.robots.inertial_model import read_inertial_model
from rover_rl.sims.rotations import quaternion_to_euler
from rover_rl.sims.warp import WarpSettings
from rover_rl.sims.worlds import Terrain, World, box
from tests.extras import needs_mujoco

ROVER = get_robot("rover_zero")
MODEL = read_inertial_model(ROVER)
CENTER = MODEL.total(torch.tensor([MODEL.chassis_mass], dtype=torch.float64))[1][0].numpy()
FLAT = World("flat", Terrain.flat((60, 60)))
DT, GRAVITY = 0.05, 9.81
BOTH = pytest.mark.parametrize(
    "settings", [WarpSettings, pytest.param(MujocoSettings, marks=needs_mujoco)], ids=["warp", "mujoco"]
)


def simulate(world: World, poses: list[tuple[float, float, float]], settings: Backend | None = None):
    simulator = make_simulator(settings or WarpSettings(), worlds=[world] * len(poses), robot=ROVER, lidar_beams=1)
    simulator.reset(torch.ones(len(poses), dtype=torch.bool), torch.tensor(poses))
    return simulator


def drive(simulator, command: tuple[float, float], steps: int):
    return [simulator.step(torch.tensor([command] * simulator.num_envs)) for _ in range(steps)]


@pytest.mark.parametrize("command", [(0.0, 2.0), (0.0, 1.0), (0.5, 1.0), (0.3, 0.5)])
@BOTH
def test_skid_steering_matches_coulomb_friction(settings, command):
    expected = steady_motion(ROVER, CENTER[0], *command)
    simulator = simulate(FLAT, [(0.0, 0.0, 2 * math.pi * k / 8) for k in range(8)], settings())
    drive(simulator, command, 30)
    states = drive(simulator, command, 21)
    yaws = torch.stack([quaternion_to_euler(state.orientation)[:, 2] for state in states])
    turned = (torch.remainder(yaws[1:] - yaws[:-1] + math.pi, 2 * math.pi) - math.pi).sum(0)
    # Friction is isotropic: the yaw rate does not depend on the heading.
    torch.testing.assert_close(turned, turned.mean().expand(8), rtol=0.005, atol=0)
    assert turned.mean().item() == pytest.approx(expected.yaw, rel=0.02 if settings is MujocoSettings else 0.05)
    displacement = torch.stack([b.position - a.position for a, b in itertools.pairwise(states)])
    assert displacement.norm(dim=-1).sum(0).mean().item() == pytest.approx(expected.forward, rel=0.03, abs=0.02)
    if settings is MujocoSettings:
        # The wheels do not hop.
        heights = torch.stack([state.position[:, 2] for state in states])
        assert (heights.max() - heights.min()).item() < 1e-4


@BOTH
def test_locked_wheels_brake_by_friction_times_weight(settings):
    # The acceleration limit of the drive exceeds what friction can provide, so that the wheels slip.
    friction = 0.3
    simulator = simulate(FLAT, [(0.0, 0.0, 0.4)], settings(ground_friction=friction))
    drive(simulator, (1.0, 0.0), 60)
    states = drive(simulator, (0.0, 0.0), 20)
    speed = torch.stack([(b.position - a.position).norm() / DT for a, b in itertools.pairwise(states)])
    # Measured while all wheels slip.
    deceleration = (speed[1] - speed[4]) / (3 * DT)
    assert deceleration.item() == pytest.approx(friction * GRAVITY, rel=0.02)


def test_rover_tips_over_at_the_static_stability_angle():
    """Across a slope, a rover tips over the outer edges of the lower wheels once its center of mass passes them."""
    edge = ROVER.wheels.hubs[0][1] + ROVER.wheels.width / 2
    height = CENTER[2] - (ROVER.wheels.hubs[0][2] - ROVER.wheels.radius)
    tipping = math.degrees(math.atan2(edge, height))
    assert 45 < tipping < 65
    for degrees, stands in ((tipping - 2.5, True), (tipping + 2.5, False)):
        count = 401
        rise = math.tan(math.radians(degrees)) * (torch.arange(count) * 0.1 - 20)
        world = World("slope", Terrain(rise[:, None].expand(-1, count), 0.1))
        # With high friction, the rover tips instead of sliding.
        simulator = simulate(world, [(0.0, 0.0, 0.0)], WarpSettings(ground_friction=4.0))
        rolls = [quaternion_to_euler(state.orientation)[0, 0].item() for state in drive(simulator, (0.0, 0.0), 30)]
        assert (math.degrees(max(map(abs, rolls))) < degrees + 5) == stands


def test_free_fall():
    # Driving off a cliff of 3 m at 1 m/s: only gravity acts until the rover lands.
    heights = torch.zeros(81, 81)
    heights[:, :40] = 3.0
    simulator = simulate(World("cliff", Terrain(heights, 0.25)), [(-1.0, 0.0, 0.0)])
    states = drive(simulator, (1.0, 0.0), 60)
    centers = torch.stack([_center(state) for state in states])
    speed = (centers[1:] - centers[:-1]) / DT
    falling = (speed[1:, 2] - speed[:-1, 2]) / DT
    free = falling < -9.0
    assert free.sum() >= 5
    assert falling[free].median().item() == pytest.approx(-GRAVITY, rel=0.01)


def _center(state) -> torch.Tensor:
    x, y, z, w = state.orientation[0].double()
    vector, center = torch.stack((x, y, z)), torch.from_numpy(CENTER)
    turned = center + 2 * torch.linalg.cross(vector, torch.linalg.cross(vector, center) + w * center)
    return state.position[0].double() + turned


def test_obstacles_have_their_own_friction():
    """The friction of a wall slows a rover that slides along it."""
    wall = box((0.0, 0.5, 0.5), (30.0, 0.4, 1.0))
    world = World("wall", Terrain.flat((60, 60)), [wall])
    distances = []
    for friction in (0.0, 0.25):
        simulator = simulate(world, [(-5.0, -0.05, 0.35)], WarpSettings(obstacle_friction=friction))
        states = drive(simulator, (0.8, 0.6), 80)
        distances.append((states[-1].position[0, 0] - states[0].position[0, 0]).item())
        # Neither rover passes through the wall.
        assert states[-1].position[0, 1] < 0.3 - 0.2
    assert distances[0] > distances[1] + 0.05
