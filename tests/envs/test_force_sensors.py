"""Contact forces and motor torques, held against mechanics by hand in every simulator."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rover_rl import RoverEnv, Terrain, World, box
from rover_rl.envs.sensors.forces import ContactSensor, WheelEffort
from rover_rl.robots import get_robot
from rover_rl.worlds.movers import Box
from tests.envs.scripted import ScriptedBackend
from tests.envs.test_sensors import LiveBackend
from tests.extras import BACKENDS
from tests.sims.driven import slope
from tests.sims.movers.scenes import act, flat, going, opened

ROVER = get_robot("rover_zero")
WEIGHT, GROUND_FRICTION, OBSTACLE_FRICTION = 9.81 * ROVER.mass, 0.5, 0.25
WALLED = World("walled", Terrain.flat((24.0, 24.0)), [box((3.0, 0.0, 1.0), (1.0, 10.0, 2.0))])
STRUCK = flat([going(Box(0.4, 1.2, 0.6), (0.0, 1.5), (0.0, -0.7), 2.0)], name="struck")
FRONT, LEFT, BACK = range(3)
SENSORS = ["contact", "effort"]


def _means(env: RoverEnv, action: Tensor, steps: int) -> tuple[Tensor, Tensor]:
    """Means of the contact forces (N) and of the sum of the torques (N m) over steps, ``[N, 8]`` and ``[N]``."""
    seen = [act(env, action) for _ in range(steps)]
    contact, effort = (torch.stack([td[key] for td in seen]) for key in SENSORS)
    return contact.mean(0), effort.sum(-1).mean(0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_forces_and_torques_are_those_of_mechanics(backend: str) -> None:
    # Against a wall with the front and with the back; at rest; up a slope; struck from the left.
    worlds = [WALLED, WALLED, WALLED, slope(10.0, 16.0), STRUCK]
    starts = [(2.15, -1.0, 0.0), (2.15, 1.0, math.pi), (-4.0, 0.0, 0.3), (-3.0, 0.0, 0.0), (0.0, 0.0, 0.0)]
    action = torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 0.0], [0.5, 0.0], [0.0, 0.0]])
    with opened(worlds, starts, backend=backend, sensors=SENSORS) as env:
        _means(env, action, 20)
        contact, torque = _means(env, action, 15)
        # Spinning wheels climb the wall: its friction takes a part of the weight off the ground.
        pushed = GROUND_FRICTION * WEIGHT / (1 + GROUND_FRICTION * OBSTACLE_FRICTION)
        expected = torch.zeros(5, 8)
        expected[0, FRONT] = expected[1, BACK] = pushed
        expected[4, 4 + LEFT] = GROUND_FRICTION * WEIGHT
        torch.testing.assert_close(contact, expected, rtol=0.1, atol=0.5)
        force = torque / ROVER.wheels.radius
        assert force[2].abs() < 0.5
        assert force[3] == pytest.approx(WEIGHT * math.sin(math.radians(10.0)), rel=0.1)
        # Rows that are held keep their forces, and those that are reset feel nothing.
        before = act(env, action)
        held = act(env, -action, torch.tensor([False, True, True, True, True]))
        assert all(held[key][0].equal(before[key][0]) for key in SENSORS)
        env.reset(held.set("_reset", torch.tensor([[True]] + [[False]] * 4)))
        assert not env.rover_state.contact_force[0].any()
        assert not env.rover_state.wheel_torque[0].any()
        assert env.rover_state.contact_force[1].equal(held["contact"][1])


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_drive_does_not_depend_on_what_is_measured(backend: str) -> None:
    def drive(sensors: list[str]) -> Tensor:
        with opened([WALLED, STRUCK], [(2.0, 0.0, 0.4), (0.0, 0.0, 0.0)], backend=backend, sensors=sensors) as env:
            for _ in range(20):
                act(env, torch.tensor([[1.0, 0.5], [0.3, -0.2]]))
            return env.rover_state.position

    # In MuJoCo, the order of the contacts is another one.
    torch.testing.assert_close(drive(SENSORS), drive([]), atol=1e-4 if backend == "mujoco" else 0, rtol=0)


def test_wheels_are_in_pairs_from_front_to_back_whatever_the_robot() -> None:
    settings = {"robot": ["rover_zero", "racer"], "sensors": ["effort(wheels=6, max_torque=0.5)"]}
    env = RoverEnv(world_n="maze", num_envs=8, seed=0, backend="warp", **settings)
    env.reset()
    racer = [env.fleet[row].name for row in range(8)].index("racer")
    effort = torch.stack([act(env, torch.tensor([[1.0, 0.0]] * 8))["effort"] for _ in range(3)]).mean(0)
    assert effort.shape == (8, 6)
    assert not effort[:, 4:].any()
    assert effort.max() == 0.5
    # The racer's motors are on the rear wheels.
    assert not effort[racer, :2].any()
    assert (effort[racer, 2:4] > 0).all()


def test_a_rover_of_the_group_is_felt_as_a_mover() -> None:
    starts = [(-0.6, 0.0, 0.0), (0.0, 0.0, 0.0)]
    with opened(flat(), starts, backend="warp", agents=2, sensors=SENSORS) as env:
        _means(env, torch.tensor([[1.0, 0.0], [0.0, 0.0]]), 6)
        contact, _ = _means(env, torch.tensor([[1.0, 0.0], [0.0, 0.0]]), 6)
    assert contact.argmax(-1).tolist() == [4 + FRONT, 4 + BACK]
    assert (contact.amax(-1) > 5).all()


def test_networks_read_small_numbers_and_mirror_images() -> None:
    contact, effort = ContactSensor(), WheelEffort(wheels=6)
    assert contact.encode(torch.tensor([0.0, contact.max_force])).tolist() == pytest.approx([0.0, 2.53], abs=0.01)
    assert effort.encode(torch.tensor([-5.0, 0.0, 5.0])).tolist() == pytest.approx([-0.9, 0.0, 0.9], abs=0.01)
    assert contact.mirror(torch.arange(8.0)).tolist() == [0, 3, 2, 1, 4, 7, 6, 5]
    assert effort.mirror(torch.arange(6.0)).tolist() == [1, 0, 3, 2, 5, 4]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ContactSensor(max_force=0.0), "max_force must be positive"),
        (lambda: WheelEffort(wheels=0), "wheels must be"),
        (lambda: WheelEffort(max_torque=-1.0), "max_torque must be positive"),
        (lambda: WheelEffort(wheels=3).mirror(torch.zeros(3)), "no mirror image with wheels=3"),
        (lambda: RoverEnv(backend="warp", sensors=[WheelEffort(wheels=2)]), "wheels=2, a robot has 4: set wheels=4"),
        (lambda: RoverEnv(backend=ScriptedBackend(), sensors=["contact"]), "not have the feature 'contact_force'"),
        (lambda: RoverEnv(backend=LiveBackend(), sensors=["effort"]), "^sensor 'effort' needs .*: Live.*_torque'$"),
    ],
)
def test_what_cannot_be_measured_is_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
