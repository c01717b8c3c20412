"""Physics of Warp compared with analytic solutions."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl.sims import Backend, make_simulator
from rover_rl.sims.robots import get_robot
from rover_rl.sims.robots.inertial_model import read_inertial_model
from rover_rl.sims.rotations import quaternion_to_euler
from rover_rl.sims.warp import WarpSettings
from rover_rl.sims.worlds import Terrain, World, box

ROVER = get_robot("rover_zero")
MODEL = read_inertial_model(ROVER)
CENTER = MODEL.total(torch.tensor([MODEL.chassis_mass], dtype=torch.float64))[1][0].numpy()
FLAT = World("flat", Terrain.flat((60, 60)))
DT, GRAVITY = 0.05, 9.81


def simulate(world: World, poses: list[tuple[float, float, float]], settings: Backend | None = None):
    simulator = make_simulator(settings or WarpSettings(), worlds=[world] * len(poses), robot=ROVER)
    simulator.reset(torch.ones(len(poses), dtype=torch.bool), torch.tensor(poses))
    return simulator


def drive(simulator, command: tuple[float, float], steps: int):
    return [simulator.step(torch.tensor([command] * simulator.num_envs)) for _ in range(steps)]


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
