"""The backend of ``docs/backends.md`` moves as the page says. ``tests/sims/test_simulator.py`` tests its interface."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl import RoverEnv, make_env
from rover_rl.envs.config import Randomization
from rover_rl.sims import make_scanner
from tests.sims.driven import FLAT, ROVER, WALLED, drive, placed

MOUNT = ROVER.lidar_position[0]


def test_a_turn_is_a_circle(guide):
    sim = placed(guide, FLAT, torch.zeros(1, 3))
    steps = round(2 * math.pi / sim.control_dt)
    start, *_, end = drive(sim, (0.5, 1.0), 20 + steps)[19:]
    assert end.angular_velocity.item() == pytest.approx(1.0, abs=1e-4)
    # A full turn ends within a step of its start, and half a turn later the rover is a diameter away.
    assert (end.position - start.position).norm() < 0.5 * sim.control_dt
    half = drive(sim, (0.5, 1.0), steps // 2)[-1]
    assert (half.position - end.position).norm().item() == pytest.approx(2 * 0.5 / 1.0, rel=0.01)


def test_the_lidar_measures_the_distance_to_a_wall(guide):
    sim = placed(guide, WALLED, [[0.0, 0.0, 0.0], [0.5, 0.0, math.pi / 4], [3.0, 0.0, 0.0]])
    ranges = make_scanner(sim, [WALLED] * 3, ROVER, beams=8).scan()
    # The wall's face is at x = 2.5; beams are 45 degrees apart.
    ahead = 2.5 - MOUNT
    diagonal = math.sqrt(2) * ahead
    inf = math.inf
    expected = torch.tensor([ahead, diagonal, inf, inf, inf, inf, inf, diagonal])
    torch.testing.assert_close(ranges[0], expected, atol=1e-5, rtol=0)
    x = 0.5 + MOUNT * math.sqrt(0.5)
    assert ranges[1, 7].item() == pytest.approx(2.5 - x, abs=1e-5)
    assert ranges[1, 0].item() == pytest.approx(math.sqrt(2) * (2.5 - x), abs=1e-5)
    assert (ranges[2] == 0).all()


def test_a_wall_stops_the_body_and_not_the_wheels(guide):
    sim = placed(guide, WALLED, torch.zeros(1, 3))
    stopped = drive(sim, (1.0, 0.0), 80)[-1]
    # It stops within a step of the pose in which the beam ahead is as long as the rover's radius.
    assert 0 <= stopped.position[0, 0] - (2.5 - MOUNT - ROVER.radius) < 1.0 * sim.control_dt
    assert torch.equal(drive(sim, (1.0, 0.0), 1)[-1].position, stopped.position)
    assert stopped.linear_velocity.item() == pytest.approx(1.0, abs=1e-4)
    assert drive(sim, (-1.0, 0.0), 20)[-1].position[0, 0] < stopped.position[0, 0] - 0.5


def test_environments_render_it_and_say_what_it_does_not_do(guide):
    env = make_env(backend=guide, world_n=["inspect", "maze"], num_envs=4, lidar_beams=32, seed=0)
    env.reset()
    image = env.base_env.render(3, width=32, height=24)
    assert image.shape == (24, 32, 3)
    assert image.float().std() > 1
    env.close()
    env.reset()
    with pytest.raises(ValueError, match="friction, mass and motors need a backend .*'dynamics'$"):
        RoverEnv(world_n="maze", backend=guide, randomization=Randomization(friction=(0.5, 1.0)))
