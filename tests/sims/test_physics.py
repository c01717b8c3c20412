"""Physics of every simulator, compared with analytic expectations for the rover."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl.sims import Backend, make_simulator
from rover_rl.sims.robots import get_robot
from rover_rl.sims.rotations import quaternion_to_euler
from rover_rl.sims.worlds import Terrain, World, box

ROVER = get_robot("rover_zero")
DT = 0.05


def slope(degrees: float, size: float = 40.0, cell: float = 0.25) -> World:
    """A plane that rises along x."""
    count = int(size / cell) + 1
    x = torch.arange(count) * cell - size / 2
    return World(f"slope {degrees}", Terrain((math.tan(math.radians(degrees)) * x).expand(count, -1), cell))


def simulate(backend: str | Backend, world: World, poses: list[tuple[float, float, float]]):
    simulator = make_simulator(backend, worlds=[world] * len(poses), robot=ROVER)
    simulator.reset(torch.ones(len(poses), dtype=torch.bool), torch.tensor(poses))
    return simulator


def drive(simulator, commands: list[tuple[float, float]], steps: int):
    """Returns the states of ``steps`` steps with constant commands, one per rover."""
    return [simulator.step(torch.tensor(commands)) for _ in range(steps)]


def yaw_rate(states) -> torch.Tensor:
    """Mean yaw rate of the bodies over the states, rad/s."""
    yaws = torch.stack([quaternion_to_euler(s.orientation)[:, 2] for s in states])
    steps = torch.remainder(yaws[1:] - yaws[:-1] + math.pi, 2 * math.pi) - math.pi
    return steps.mean(0) / DT


@pytest.fixture(scope="module")
def flat():
    return World("flat", Terrain.flat((40, 40)))


def test_commanded_speed_is_reached_on_flat_ground(backend, flat):
    simulator = simulate(backend, flat, [(0.0, 0.0, 0.0), (0.0, 0.0, 2.0), (0.0, 3.0, -1.0)])
    states = drive(simulator, [(1.0, 0.0), (1.0, 0.0), (0.5, 0.0)], 60)
    body = (states[-1].position - states[-21].position).norm(dim=-1) / (20 * DT)
    torch.testing.assert_close(body, torch.tensor([1.0, 1.0, 0.5]), atol=0.0, rtol=0.05)
    torch.testing.assert_close(states[-1].linear_velocity.squeeze(-1), torch.tensor([1.0, 1.0, 0.5]), atol=0.01, rtol=0)


def test_stops_within_its_acceleration_limit(backend, flat):
    simulator = simulate(backend, flat, [(0.0, 0.0, 0.0)])
    moving = drive(simulator, [(1.0, 0.0)], 40)[-1]
    states = [moving, *drive(simulator, [(0.0, 0.0)], 20)]
    speeds = torch.stack([s.linear_velocity[0, 0] for s in states])
    # Braking from 1 m/s at 5 m/s^2 takes 0.2 s and 0.1 m.
    assert (speeds[1:] - speeds[:-1]).abs().max() <= ROVER.drive.max_linear_acceleration * DT * 1.05
    assert speeds[5:].abs().max() < 0.02
    braking = (states[-1].position - moving.position).norm().item()
    # Friction of 0.5 brakes at 4.9 m/s^2. The wheels hold the mean speed of a step: 0.1 m/s more, for 0.2 s.
    assert 0.085 <= braking <= 0.125


def test_turns_within_its_angular_acceleration_limit(backend, flat):
    simulator = simulate(backend, flat, [(0.0, 0.0, 0.0)])
    rates = torch.stack([s.angular_velocity[0, 0] for s in drive(simulator, [(0.0, 2.0)], 20)])
    assert (rates[1:] - rates[:-1]).abs().max() <= ROVER.drive.max_angular_acceleration * DT * 1.1
    assert rates[-1] == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("heading", [0.0, math.pi / 4, math.pi])
def test_climbs_and_descends_15_degrees(backend, heading):
    simulator = simulate(backend, slope(15), [(0.0, 0.0, heading)])
    states = drive(simulator, [(1.0, 0.0)], 80)
    gained = states[-1].position[0, 2] - states[39].position[0, 2]
    along = (states[-1].position - states[39].position).norm()
    assert along.item() == pytest.approx(40 * DT, rel=0.05)
    assert gained.item() == pytest.approx(40 * DT * math.sin(math.radians(15)) * math.cos(heading), abs=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("degrees", [0.001, 15.0])
def test_stands_still_for_600_steps(backend, degrees):
    # Ahead, diagonally, across and backwards.
    headings = [0.0, 0.25 * math.pi, 0.5 * math.pi, math.pi]
    simulator = simulate(backend, slope(degrees), [(1.5 * k, 0.0, yaw) for k, yaw in enumerate(headings)])
    first = drive(simulator, [(0.0, 0.0)] * 4, 1)[0]
    last = drive(simulator, [(0.0, 0.0)] * 4, 599)[-1]
    moved = (last.position[:, :2] - first.position[:, :2]).norm(dim=-1)
    assert moved.max() < 0.0009


def test_stands_still_on_a_plane(backend):
    simulator = simulate(backend, World("plane", Terrain.flat((20, 20))), [(0.0, 0.0, 0.3)])
    first = drive(simulator, [(0.0, 0.0)], 1)[0]
    last = drive(simulator, [(0.0, 0.0)], 599)[-1]
    assert (last.position - first.position).norm() < 0.0009


def test_odometry_reports_the_wheels_not_the_body(backend, flat):
    simulator = simulate(backend, flat, [(0.0, 0.0, 0.0)])
    states = drive(simulator, [(0.0, 2.0)], 40)
    assert states[-1].angular_velocity.item() == pytest.approx(2.0, abs=0.05)
    assert yaw_rate(states[20:]).item() < 1.1


def test_flipped_rover_reports_its_orientation(backend):
    # Driving off an edge of 1.2 m, the rover pitches nose down and rolls over.
    heights = torch.zeros(41, 41)
    heights[:, :20] = 1.2
    simulator = simulate(backend, World("cliff", Terrain(heights, 0.25)), [(-0.8, 0.0, 0.0)])
    tilt = torch.stack([quaternion_to_euler(s.orientation)[0, :2] for s in drive(simulator, [(1.0, 0.0)], 80)])
    assert (tilt.abs() > 1.48).any()


def test_rovers_pass_through_one_another(backend, flat):
    together = simulate(backend, flat, [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (1.0, 0.0, math.pi)])
    alone = simulate(backend, flat, [(0.0, 0.0, 0.0)])
    for _ in range(40):
        a = together.step(torch.tensor([(1.0, 0.0), (1.0, 0.5), (1.0, 0.0)]))
        b = alone.step(torch.tensor([(1.0, 0.0)]))
    assert torch.equal(a.position[0], b.position[0])


def test_walls_stop_the_rover(backend):
    world = World("wall", Terrain.flat((20, 20)), [box((2.0, 0.0, 0.5), (0.5, 6.0, 1.0))])
    simulator = simulate(backend, world, [(0.0, 0.0, 0.0)])
    last = drive(simulator, [(1.0, 0.0)], 80)[-1]
    # The front of the wheels is 0.2635 m ahead of the base frame.
    assert last.position[0, 0].item() == pytest.approx(2.0 - 0.25 - 0.2635, abs=0.05)


def test_resting_pose_needs_no_settling(backend):
    world = slope(15)
    simulator = simulate(backend, world, [(0.0, 0.0, 0.7)])
    before = simulator.state()
    after = drive(simulator, [(0.0, 0.0)], 20)[-1]
    assert (after.position - before.position).norm() < 0.005
    assert (quaternion_to_euler(after.orientation) - quaternion_to_euler(before.orientation)).abs().max() < 0.01


def test_base_frame_is_level_on_level_ground(backend, flat):
    # The chassis' principal axes of inertia are rotated by a degree against the base frame; the pose is not.
    state = drive(simulate(backend, flat, [(1.0, 2.0, 0.5)]), [(0.0, 0.0)], 20)[-1]
    euler = quaternion_to_euler(state.orientation)
    torch.testing.assert_close(euler, torch.tensor([[0.0, 0.0, 0.5]]), atol=1e-3, rtol=0)
    torch.testing.assert_close(state.position[0, :2], torch.tensor([1.0, 2.0]), atol=1e-3, rtol=0)
