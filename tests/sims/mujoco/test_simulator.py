"""Tests specific to the MuJoCo simulator; those of every simulator are in ``tests/sims``."""

from __future__ import annotations

import sys

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from rover_rl import RoverEnv, make_env
from rover_rl.sims import make_simulator
from rover_rl.sims.base import Dynamics
from rover_rl.sims.mujoco import MujocoSettings
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import Terrain, World, box, get_world

ROVER = get_robot("rover_zero")
FLAT = World("flat", Terrain.flat((40, 40)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"substeps": 0}, "substeps must be at least 1, got 0"),
        ({"solver_iterations": 0}, "solver_iterations must be at least 1, got 0"),
        ({"threads": 0}, "threads must be at least 1, got 0"),
        ({"control_dt": 0.0}, "control_dt must be positive, got 0.0"),
        ({"stiffness": float("nan")}, "stiffness must be positive, got nan"),
        ({"solver_tolerance": -1.0}, "solver_tolerance must not be negative, got -1.0"),
        ({"ground_friction": -0.1}, "ground_friction must not be negative, got -0.1"),
    ],
)
def test_settings_out_of_range_raise(settings, message):
    with pytest.raises(ValueError, match=message):
        MujocoSettings(**settings)


def test_presets_of_bullet_are_unknown():
    with pytest.raises(ValueError, match=r"unknown physics 'fast'; use one of \['default'\]"):
        RoverEnv(backend="mujoco", physics="fast")


def test_missing_mujoco_raises_with_install_command(monkeypatch):
    for name in [name for name in sys.modules if name.startswith(("rover_rl.sims.mujoco.", "rover_rl.sims.native."))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"backend='mujoco' needs MuJoCo: pip install 'rover_rl\[mujoco\]'"):
        RoverEnv(backend="mujoco")


pytestmark = pytest.mark.usefixtures("mujoco")


@pytest.fixture
def mujoco():
    return pytest.importorskip("mujoco", reason="needs rover_rl[mujoco]")


def simulator(worlds, **settings):
    return make_simulator(MujocoSettings(**settings), worlds=worlds, robot=ROVER)


def all_rows(count):
    return torch.ones(count, dtype=torch.bool)


def drive(sim, commands, steps):
    for _ in range(steps):
        state = sim.step(torch.tensor(commands))
    return state


def test_environment_specs():
    check_env_specs(make_env(backend="mujoco", world_n=["inspect", "maze"], num_envs=4, seed=0))


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_results_do_not_depend_on_the_batch_or_the_number_of_threads(threads):
    worlds = [get_world("moon")] * 9 + [get_world("maze")] * 7
    poses = torch.tensor([[0.5 * (row % 4) - 5, 0.4 * row - 3, 0.7 * row] for row in range(16)])
    commands = torch.tensor([[0.9 - 0.1 * row, 0.2 * row - 1] for row in range(16)])
    batch = simulator(worlds, threads=threads)
    batch.reset(all_rows(16), poses)
    together = drive(batch, commands.tolist(), 30)
    scans = batch.scanner(8).scan()
    for row in (0, 8, 15):
        alone = simulator(worlds[row : row + 1], threads=1)
        alone.reset(all_rows(1), poses[row : row + 1])
        # Earlier episodes leave no trace.
        drive(alone, [(1.0, 0.5)], 7)
        alone.reset(all_rows(1), poses[row : row + 1])
        state = drive(alone, commands[row : row + 1].tolist(), 30)
        assert (state.position[0] - poses[row, 0]).norm() > 0.1
        for name in ("position", "orientation", "linear_velocity", "angular_velocity"):
            assert torch.equal(getattr(state, name)[0], getattr(together, name)[row])
        assert torch.equal(alone.scanner(8).scan()[0], scans[row])
    batch.close()
    batch.close()


def test_results_do_not_depend_on_held_steps():
    held, free = simulator([FLAT] * 2), simulator([FLAT])
    for _ in range(10):
        held.step(torch.tensor([[0.5, 0.5]] * 2))
        held.step(torch.tensor([[1.0, 0.0]] * 2), torch.tensor([True, False]))
        state = free.step(torch.tensor([[0.5, 0.5]]))
    assert torch.equal(held.state().position[1], state.position[0])


def dynamics(friction=(1.0, 1.0), chassis_mass=(1.0, 1.0), motor_torque=(1.0, 1.0)):
    return Dynamics(*map(torch.tensor, (friction, chassis_mass, motor_torque)))


def slope(gradient: float) -> World:
    x = torch.arange(161) * 0.25 - 20
    return World("slope", Terrain((gradient * x).expand(161, -1), 0.25))


def randomized(world, change):
    """Returns two rovers, of which the second has other dynamics."""
    sim = simulator([world] * 2)
    sim.set_dynamics(torch.tensor([False, True]), change)
    sim.reset(all_rows(2), torch.tensor([[0.0, 0.0, 0.3]] * 2))
    return sim


def rest(world, change, steps):
    """Returns the state of two rovers with locked wheels. The first moves as one whose dynamics nobody has set."""
    state = drive(randomized(world, change), [(0.0, 0.0)] * 2, steps)
    alone = simulator([world])
    alone.reset(all_rows(1), torch.tensor([[0.0, 0.0, 0.3]]))
    assert torch.equal(state.position[0], drive(alone, [(0.0, 0.0)], steps).position[0])
    return state


def test_chassis_mass_acts_on_its_row_alone():
    # Twice the weight of the chassis sinks in deeper by that weight over the stiffness of four wheels.
    state = rest(FLAT, dynamics(chassis_mass=(3.0, 2.0)), 40)
    expected = 7.486 * 9.81 / (4 * MujocoSettings().stiffness)
    assert (state.position[0, 2] - state.position[1, 2]).item() == pytest.approx(expected, rel=0.05)


def test_motor_torque_acts_on_its_row_alone():
    # A gradient of 0.3 takes 1.1 N m of each motor; the second rover's have 0.5 N m and cannot hold it.
    state = rest(slope(0.3), dynamics(motor_torque=(9.0, 0.1)), 20)
    assert state.linear_velocity[1].abs() > 0.3
    assert state.linear_velocity[0].abs() < 0.01


def test_friction_acts_on_its_row_alone():
    # The coefficient is 0.5 in the first row and 0.2 in the second, and the gradient 0.3.
    moved = rest(slope(0.3), dynamics(friction=(7.0, 0.4)), 20).position[:, :2].norm(dim=-1)
    assert moved[0] < 0.005
    assert moved[1] > 0.1


def test_dynamics_return_to_those_of_the_robot():
    sim = randomized(slope(0.3), dynamics(friction=(1.0, 0.4), chassis_mass=(1.0, 1.3)))
    sim.set_dynamics(all_rows(2), dynamics())
    sim.reset(all_rows(2), torch.tensor([[0.0, 0.0, 0.3]] * 2))
    state = drive(sim, [(0.7, 0.4)] * 2, 20)
    assert torch.equal(state.position[0], state.position[1])


@pytest.mark.parametrize(
    "world", [World("edge", Terrain.flat((8, 8))), World("edge", Terrain(torch.tensor([[0.0, 0.0, 0.01]] * 3), 4.0))]
)
def test_the_height_of_the_edge_continues_outside_the_terrain(world):
    sim = simulator([world])
    sim.reset(all_rows(1), torch.tensor([[3.0, 0.0, 0.0]]))
    state = drive(sim, [(1.0, 0.0)], 60)
    assert state.position[0, 0] > 5.5
    assert state.position[0, 2].abs() < 0.02


def test_a_wall_stops_the_rover_at_contact():
    world = World("wall", Terrain.flat((20, 20)), [box((2.0, 0.0, 0.5), (0.5, 6.0, 1.0))])
    state = drive(simulator([world]), [(1.0, 0.0)], 80)
    # The front of the wheels is 0.2635 m ahead of the base frame.
    assert state.position[0, 0].item() == pytest.approx(2.0 - 0.25 - 0.2635, abs=0.01)
