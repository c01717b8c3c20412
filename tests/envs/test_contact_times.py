"""The sensor ``contact_times``: walls, what moves, mirror images, and other robots."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.envs.config import EnvConfig, Randomization
from rover_rl.envs.sensors.contact_times import LONGEST, SPEEDS, TURNS, ContactTimes
from rover_rl.worlds import Terrain, World, box
from rover_rl.worlds.movers import Cylinder, Mover, Waypoints

STRAIGHT, BACKWARD, STILL, AHEAD = TURNS // 2, 0, SPEEDS // 2, SPEEDS - 1


def at_rest(world: World, sensors: tuple[str, ...], robot: str = "rover_zero", rows: int = 1, steps: int = 0) -> Tensor:
    """Times ``[N, SPEEDS, TURNS]`` of rovers that stand at the origin and look along x."""
    config = EnvConfig(world=world, robot=robot, num_envs=rows, backend="warp", sensors=sensors, seed=3)
    env = RoverEnv(config)
    tensordict = env.reset(start=torch.zeros(rows, 3), goal=torch.tensor([[-3.0, 0.0]] * rows))
    for _ in range(steps):
        tensordict = env.step(tensordict.set("action", torch.zeros(rows, 2)))["next"]
    return tensordict["contact_times"].unflatten(-1, (SPEEDS, TURNS))


def walled(x: float, y: float) -> World:
    return World("walled", Terrain.flat((20.0, 20.0)), [box((x, y, 0.5), (0.2, 2.0, 1.0))])


def test_times_are_those_until_the_body_touches_a_wall() -> None:
    times = at_rest(walled(1.1, 0.0), ("contact_times",))[0]
    # The body reaches 0.41 m ahead of the origin, and the wall begins at 1 m: 0.59 m at 1 m/s, or at half of it.
    assert times[AHEAD, STRAIGHT].item() == pytest.approx(0.6)
    assert times[SPEEDS - 2, STRAIGHT].item() == pytest.approx(1.2)
    assert (times[: STILL + 1] == LONGEST).all()
    assert (at_rest(walled(6.0, 0.0), ("contact_times",)) == LONGEST).all()
    behind = at_rest(walled(-1.0, 0.0), ("contact_times",))[0]
    assert behind[BACKWARD, STRAIGHT].item() == pytest.approx(0.6)
    assert (behind[STILL:] == LONGEST).all()


def test_the_mirror_image_is_that_of_the_mirrored_world() -> None:
    left, right = (at_rest(walled(1.3, side), ("contact_times",)) for side in (0.9, -0.9))
    assert not torch.equal(left, right)
    image = ContactTimes().mirror(left.flatten(1)).unflatten(-1, (SPEEDS, TURNS))
    # Readings lie between beams, and are not quite symmetric.
    assert (image - right).abs().mean() < 0.05 < (left - right).abs().mean()


def test_what_moves_is_where_it_will_be_if_the_movers_are_observed() -> None:
    # It comes from the left at 1 m/s, and is 2 m away after 2 s: it touches the standing rover after 1.2 s or so.
    comes = Mover(Waypoints([(0.0, 0.0, 4.0, -1.57), (8.0, 0.0, -4.0, -1.57)]), Cylinder(0.4, 1.0))
    world = World("coming", Terrain.flat((20.0, 20.0)), movers=[comes])
    (times,), (without,) = (
        at_rest(world, names, steps=40) for names in (("movers", "contact_times"), ("contact_times",))
    )
    assert 1.0 < times[STILL, STRAIGHT] < 1.9
    assert times[AHEAD, STRAIGHT] == times[BACKWARD, STRAIGHT] == LONGEST
    assert without[STILL, STRAIGHT] == LONGEST


def test_late_scans_are_where_they_were_taken() -> None:
    times = []
    for late in (0, 4):
        noise = Randomization(scan_latency=(late, late))
        config = EnvConfig(world=walled(3.0, 0.0), backend="warp", sensors=("contact_times",), randomization=noise)
        env = RoverEnv(config)
        tensordict = env.reset(start=torch.zeros(1, 3), goal=torch.tensor([[8.0, 0.0]]))
        for _ in range(24):
            tensordict = env.step(tensordict.set("action", torch.tensor([[1.0, 0.0]])))["next"]
        times.append(tensordict["contact_times"])
    exact, late_times = times
    # After 1.1 m at 1 m/s, a scan of 0.2 s ago is 0.2 m behind.
    assert (exact - late_times).abs().max() < 0.01
    assert exact.unflatten(-1, (SPEEDS, TURNS))[0, AHEAD, STRAIGHT] < LONGEST


def test_a_row_does_not_depend_on_the_others_and_robots_differ() -> None:
    many, one = (at_rest(walled(1.1, 0.3), ("contact_times",), rows=rows) for rows in (3, 1))
    assert torch.equal(many[2:], one)
    # A car does not turn in place: without speed, it stays where it is.
    car = at_rest(walled(1.1, 0.3), ("contact_times",), robot="hunter")[0]
    assert (car[STILL] == LONGEST).all()
    assert not torch.equal(car[AHEAD], one[0, AHEAD])
