"""Rovers feel movers, in every simulator."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl.robots import Robot, get_robot
from rover_rl.worlds.movers import Box, Cylinder, Mover, Waypoints
from tests.robots.drives.vehicles import make_car, make_omni
from tests.sims.movers.scenes import act, flat, going, opened

ROVER = get_robot("rover_zero")
HUB_X, HUB_Y = max(x for x, _, _ in ROVER.wheels.hubs), max(y for _, y, _ in ROVER.wheels.hubs)
SIDE = HUB_Y + ROVER.wheels.width / 2
"""Distance from the middle of the rover to the outside of its wheels, m."""
REST = torch.zeros(1, 2)
DT, GRAVITY, GROUND_FRICTION = 0.05, 9.81, 0.5


def still(shape, x: float, y: float) -> Mover:
    return Mover(Waypoints([(0, x, y, 0.0)], repeat="once"), shape)


def test_a_contact_begins_when_the_cylinder_meets_the_wheel(backend):
    radius, start = 0.2, -1.513
    # From the right at 1 m/s, toward the hub of a front wheel.
    world = flat([going(Cylinder(radius, 1.0), (HUB_X, start), (HUB_X, 0.0), -start)])
    touch = -SIDE - radius - start
    with opened(world, [(0.0, 0.0, 0.0)], backend=backend) as env:
        told = []
        for _ in range(30):
            outcome = act(env, REST)["outcome"]
            assert torch.equal(outcome["mover_contact"], env.rover_state.contact)
            told.append(bool(outcome["mover_contact"]))
    assert abs(DT * (told.index(True) + 1) - touch) <= DT


@pytest.mark.parametrize("shape", [Cylinder(0.3, 1.0), Box(0.4, 0.9, 0.6)], ids=["cylinder", "box"])
def test_a_pushed_rover_slides_on_as_coulombs_law_has_it(backend, shape):
    # Pushed sideways at 1 m/s for a meter, until the mover stops.
    world = flat([going(shape, (0.0, -2.0), (0.0, 1.0), 3.0)])
    with opened(world, [(0.0, 0.0, 0.0)], backend=backend) as env:
        places, touched = [0.0], []
        for _ in range(80):
            act(env, REST)
            places.append(env.rover_state.position[0, 1].item())
            touched.append(bool(env.rover_state.mover_contact))
    speed = (places[60] - places[42]) / (18 * DT)
    assert speed == pytest.approx(1.0, rel=0.01)
    # Where the rover is when the mover stops, in a mean over the last half of a second.
    stop = sum(places[k] + DT * (60 - k) for k in range(50, 61)) / 11
    assert places[-1] - stop == pytest.approx(1 / (2 * GROUND_FRICTION * GRAVITY), rel=0.1)
    assert all(touched[45:60])
    assert not any(touched[70:])


def test_a_rover_stops_at_a_mover_at_rest(backend):
    front = max(HUB_X + ROVER.wheels.radius, 0.0)
    with opened(flat([still(Box(0.4, 2.0, 1.0), 1.5, 0.0)]), [(0.0, 0.0, 0.0)], backend=backend) as env:
        for _ in range(60):
            act(env, torch.tensor([[1.0, 0.0]]))
        assert env.rover_state.mover_contact.all()
        before = env.rover_state.position[0, 0].item()
        act(env, torch.tensor([[1.0, 0.0]]))
        assert abs(env.rover_state.position[0, 0].item() - before) < 0.002
        assert 1.3 - front - 0.1 < before < 1.3 - front + 0.02


def test_a_mover_that_passes_at_3_cm_is_no_contact(backend):
    beside = SIDE + 0.3 + 0.03
    world = flat([going(Cylinder(0.3, 1.0), (-1.5, beside), (1.5, beside), 2.0)])
    with opened(world, [(0.0, 0.0, 0.0)], backend=backend) as env:
        for _ in range(45):
            act(env, REST)
            assert not env.rover_state.contact.any()
            assert not env.rover_state.mover_contact.any()
        assert env.rover_state.position[:, :2].abs().max() < 1e-3


def test_a_rover_feels_the_movers_of_its_own_row_alone(backend):
    pushed, empty = flat([going(Cylinder(0.3, 1.0), (-1.0, 0.0), (1.0, 0.0), 2.0)]), flat(name="empty")
    starts, rest = [(0.0, 0.0, 1.0)] * 2, torch.zeros(2, 2)
    with opened([pushed, empty], starts, backend=backend) as env, opened(empty, starts[:1], backend=backend) as alone:
        for _ in range(45):
            act(env, rest)
            act(alone, REST)
            assert not env.rover_state.contact[1]
            assert torch.equal(env.rover_state.position[1], alone.rover_state.position[0])
            assert torch.equal(env.scan[1], alone.scan[0])
        assert env.rover_state.position[0, 0] > 0.8
        assert alone.rover_state.mover_contact is None


@pytest.mark.parametrize("make", [make_car, make_omni])
def test_other_robots_are_pushed(backend, make, tmp_path):
    robot: Robot = make(tmp_path)
    world = flat([going(Box(0.4, 1.2, 0.6), (0.0, -1.5), (0.0, 0.5), 2.0)])
    with opened(world, [(0.0, 0.0, 0.0)], backend=backend, robot=robot) as env:
        for _ in range(40):
            act(env, REST)
        assert env.rover_state.mover_contact.all()
        # The face of the box is at 0.7 m. The outside of the wheels is 0.225 m from the middle, or 0.3 m where they are
        # spheres.
        assert 0.9 < env.rover_state.position[0, 1].item() < 1.01


def test_a_turning_box_sweeps_a_rover_away(backend):
    # A bar of 2 m that turns by 90 degrees in a second, about a point beside the rover.
    bar = Mover(Waypoints([(0, 0.0, -1.0, 0.0), (1.0, 0.0, -1.0, math.pi / 2)], repeat="once"), Box(2.0, 0.1, 0.5))
    with opened(flat([bar]), [(0.6, -0.6, 0.0)], backend=backend) as env:
        touched = False
        for _ in range(20):
            act(env, REST)
            touched |= bool(env.rover_state.mover_contact)
        assert touched
        assert env.rover_state.position[0, 1] > -0.4
