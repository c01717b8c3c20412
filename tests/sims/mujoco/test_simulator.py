"""Tests specific to the MuJoCo simulator; those of every simulator are in ``tests/sims``."""

from __future__ import annotations

import math
import sys

import pytest
import torch

from rover_rl import RoverEnv
from rover_rl.sims.mujoco import MujocoSettings
from rover_rl.sims.rover_state import Dynamics
from tests.sims.driven import FLAT, all_rows, drive, placed, slope

HILL = slope(math.degrees(math.atan(0.3)))
"""A gradient of 0.3."""
START = [(0.0, 0.0, 0.3)]


def test_missing_mujoco_raises_with_install_command(monkeypatch):
    for name in [name for name in sys.modules if name.startswith(("rover_rl.sims.mujoco.", "rover_rl.native."))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"backend='mujoco' needs MuJoCo: pip install 'rover_rl\[mujoco\]'"):
        RoverEnv(backend="mujoco")


pytestmark = pytest.mark.usefixtures("mujoco")


@pytest.fixture
def mujoco():
    return pytest.importorskip("mujoco", reason="needs rover_rl[mujoco]")


def dynamics(friction=(1.0, 1.0), chassis_mass=(1.0, 1.0), motor_torque=(1.0, 1.0)):
    return Dynamics(*map(torch.tensor, (friction, chassis_mass, motor_torque)))


def randomized(world, change):
    """Returns two rovers, of which the second has other dynamics."""
    sim = placed(MujocoSettings(), world, START * 2)
    sim.set_dynamics(torch.tensor([False, True]), change)
    sim.reset(all_rows(2), torch.tensor(START * 2))
    return sim


def rest(world, change, steps):
    """Returns the state of two rovers with locked wheels. The first moves as one whose dynamics nobody has set."""
    state = drive(randomized(world, change), (0.0, 0.0), steps)[-1]
    alone = drive(placed(MujocoSettings(), world, START), (0.0, 0.0), steps)[-1]
    assert torch.equal(state.position[0], alone.position[0])
    return state


def test_dynamics_act_on_their_row_alone():
    # Twice the weight of the chassis sinks in deeper by that weight over the stiffness of four wheels.
    state = rest(FLAT, dynamics(chassis_mass=(3.0, 2.0)), 40)
    expected = 7.486 * 9.81 / (4 * MujocoSettings().stiffness)
    assert (state.position[0, 2] - state.position[1, 2]).item() == pytest.approx(expected, rel=0.05)
    # A gradient of 0.3 takes 1.1 N m of each motor; the second rover's have 0.5 N m and cannot hold it.
    state = rest(HILL, dynamics(motor_torque=(9.0, 0.1)), 20)
    assert state.linear_velocity[1].abs() > 0.3
    assert state.linear_velocity[0].abs() < 0.01
    # The coefficient is 0.5 in the first row and 0.2 in the second, and the gradient 0.3.
    moved = rest(HILL, dynamics(friction=(7.0, 0.4)), 20).position[:, :2].norm(dim=-1)
    assert moved[0] < 0.005
    assert moved[1] > 0.1


def test_dynamics_return_to_those_of_the_robot():
    sim = randomized(HILL, dynamics(friction=(1.0, 0.4), chassis_mass=(1.0, 1.3)))
    sim.set_dynamics(all_rows(2), dynamics())
    sim.reset(all_rows(2), torch.tensor(START * 2))
    state = drive(sim, (0.7, 0.4), 20)[-1]
    assert torch.equal(state.position[0], state.position[1])
