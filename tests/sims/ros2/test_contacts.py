"""Contact forces on a live rover."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from rover_rl import EnvConfig, RoverEnv, Terrain, World, box
from rover_rl.envs.served_rover import ServedRover
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.ros2.contacts import contact_force, read_contacts
from rover_rl.sims.ros2.messages import Contact, Contacts, Entity, JointWrench, Vector3, Wrench, decode, encode
from rover_rl.sims.ros2.robot import RobotNode
from rover_rl.sims.settings import Connection
from rover_rl.worlds.movers import Box
from tests.sims.movers.scenes import going

LIVE = Ros2Settings(reset="none", settle=0.05, step_timeout=20.0)
MOVERS = LIVE.mover_names
CONNECTION = Connection(contact_topic="/contacts")


def _contact(other: str, point, normal, force, first: bool = True):
    """A contact of the rover. Gazebo's forces are for either order of the two, whatever the order of the names."""
    wrench = JointWrench(body_1_wrench=Wrench(Vector3(*force)), body_2_wrench=Wrench(Vector3(*(-x for x in force))))
    names = [f"{LIVE.model}::base_link::box", other]
    shapes = [Entity(name=name) for name in (names if first else names[::-1])]
    return Contact(*shapes, [Vector3(*point)], [Vector3(*normal)], np.zeros(1), [wrench])


def _felt(*contacts, position=(0.0, 0.0, 0.0), yaw: float = 0.0) -> list[float]:
    received = decode(Contacts, encode(Contacts(contacts=list(contacts))))
    orientation = torch.tensor([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)])
    force = contact_force(read_contacts(received, LIVE.model, MOVERS), torch.tensor(position), orientation)
    return pytest.approx(force.tolist(), abs=1e-4)


def test_a_live_rover_feels_the_contacts_of_a_simulated_one(wire):
    wall, mover = box((3.0, 0.0, 1.0), (1.0, 10.0, 2.0)), going(Box(0.4, 1.2, 0.6), (2.1, 0.3), (2.1, -1.0), 2.0)
    world, start = World("pushed", Terrain.flat((24.0, 24.0)), [wall], movers=[mover]), (2.15, -1.0, 0.2)
    robot = ServedRover(EnvConfig(world=world, seed=0, backend="warp", sensors=("contact",)))
    wire.rovers.append(RobotNode(robot, wire, 12.0, start=start).step)
    env = RoverEnv(world_n=world, backend=LIVE, seed=0, sensors=["contact"], connection=CONNECTION)
    env.reset()
    most = torch.zeros(8)
    for step in range(50):
        speed = 0.5 if step < 35 else -0.5
        felt = env.step_commands(torch.tensor([[speed, 0.0]]))["contact"][0]
        torch.testing.assert_close(felt, robot.env.rover_state.contact_force[0], rtol=1e-3, atol=0.05)
        most = most.maximum(felt)
    assert most[0] > 10
    assert most[4:].max() > 10
    assert not felt[0]
    env.close(), robot.close()


@pytest.mark.parametrize(
    ("contact", "expected"),
    [
        # A wall ahead, with friction, whatever the order of the two in the physics engine.
        (("wall::link::shape", (1.3, 0.0, 0.1), (-1.0, 0.0, 0.0), (-50.0, 8.0, 3.0)), {0: 50.0}),
        (("wall::link::shape", (1.3, 0.0, 0.1), (1.0, 0.0, 0.0), (50.0, 8.0, 3.0), False), {0: 50.0}),
        # A person behind and to the right.
        (("Person_2::legs::shape", (0.8, -0.2, 0.1), (0.6, 0.8, 0.0), (30.0, 40.0, 0.0)), {6: 30.0, 7: 40.0}),
        (("wall::link::shape", (1.0, 0.2, 0.1), (0.0, 1.0, 0.0), (0.0, 20.0, 0.0)), {1: 20.0}),
        # The ground, and parts of the rover itself.
        (("plane::link::shape", (1.2, 0.1, 0.0), (0.3, 0.0, 0.95), (10.0, 0.0, 60.0)), {}),
        ((f"{LIVE.model}::wheel::shape", (1.3, 0.0, 0.1), (1.0, 0.0, 0.0), (50.0, 0.0, 0.0)), {}),
    ],
)
def test_forces_are_normal_horizontal_and_by_side(contact, expected):
    place = (1.0, 0.0, 0.1)
    assert [expected.get(column, 0.0) for column in range(8)] == _felt(_contact(*contact), position=place)
    twice = [_contact(*contact)] * 2
    # A rover that faces the other way feels it on the other side.
    turned = {(column + 2) % 4 + column // 4 * 4: 2 * force for column, force in expected.items()}
    assert [turned.get(column, 0.0) for column in range(8)] == _felt(*twice, position=place, yaw=math.pi)


def test_silence_is_no_contact(wire, rover):
    send = wire.publisher("/contacts", Contacts)
    env = RoverEnv(world_n="maze", backend=LIVE, seed=0, sensors=["contact"], connection=CONNECTION)
    assert not env.reset()["contact"].any()
    ahead = _contact("wall", (rover.x + 0.3, rover.y, 0.1), (1.0, 0.0, 0.0), (20.0, 0.0, 0.0))
    wire.rovers.insert(0, lambda: send(Contacts(contacts=[ahead])))
    step = torch.zeros(1, 2)
    assert env.step_commands(step)["contact"][0, 0] == pytest.approx(20.0 * math.cos(rover.yaw), rel=1e-3)
    del wire.rovers[0]
    assert not env.step_commands(step)["contact"].any()
    env.close()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"collision1": Entity(name="crate::box")},
            "^a contact must be of the rover, model 'rover_zero4wd', got 'crate",
        ),
        ({"wrenches": []}, "^a contact must .*, got 1 positions, 1 normals and 0 wrenches$"),
        ({"positions": [Vector3(math.nan)]}, "^a contact must be finite"),
        ({"normals": [Vector3()]}, "^the normal of a contact must not be zero$"),
    ],
)
def test_unusable_contacts_are_refused(changes, message):
    contact = replace(_contact("wall", (1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)), **changes)
    with pytest.raises(ValueError, match=message):
        read_contacts(Contacts(contacts=[contact]), LIVE.model, MOVERS)


def test_without_a_topic_the_sensor_is_refused(wire, rover):
    with pytest.raises(ValueError, match=r"^contact forces of a live rover need their topic: .* --contact-topic$"):
        RoverEnv(world_n="maze", backend=LIVE, seed=0, sensors=["contact"])
    assert wire.closed
