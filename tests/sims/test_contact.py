"""Contacts of the rover with obstacles, reported by every simulator by the same definition."""

from __future__ import annotations

import math

import torch

from rover_rl.algos.evaluation.trajectory import Trajectory, find_body_contacts
from rover_rl.rotations import quaternion_to_euler
from rover_rl.worlds import Terrain, World, box, cylinder
from tests.sims.driven import ROVER, drive, placed

SIDE = 0.18 + 0.045
"""Distance from the middle of the rover to the outside of its wheels, m."""
WALL_X = 2.5
"""Near side of the wall, m."""
WALLED = World(
    "walled", Terrain.flat((24, 24)), [box((WALL_X + 0.5, 0, 1), (1, 16, 2)), cylinder((-3, 0, 0.5), 0.2, 1.0)]
)
"""Level ground with a wall and a post."""


def contacts(backend: str, poses, speeds: list[float], steps: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Reported and geometric contacts of straight drives at ``speeds`` (m/s), bool ``[N, steps + 1]`` each."""
    simulator = placed(backend, WALLED, poses)
    commands = torch.stack((torch.tensor(speeds), torch.zeros(len(speeds))), -1)
    states = [simulator.state(), *drive(simulator, commands, steps)]
    simulator.close()
    position = torch.stack([state.position for state in states], 1)
    angles = torch.stack([quaternion_to_euler(state.orientation) for state in states], 1)
    nothing = torch.zeros(steps, dtype=torch.bool)
    drives = [Trajectory(p, a, nothing, nothing, "time limit") for p, a in zip(position, angles, strict=True)]
    reported = torch.cat([state.contact for state in states], 1)
    return reported, torch.stack(find_body_contacts(drives, [WALLED] * len(drives), [ROVER] * len(drives)))


def first(flags: torch.Tensor) -> torch.Tensor:
    """Index of the first true value of each row of ``flags [N, T]``."""
    assert flags.any(1).all()
    return flags.int().argmax(1)


def test_a_contact_begins_where_the_outline_meets_a_wall_or_a_post(backend):
    headings = [0.0, 0.35, -0.8, 1.2, 1.9, -2.4, 2.8, math.pi]
    poses = [(1.85, 1.5 * row - 6, heading) for row, heading in enumerate(headings)]
    # With its front or its rear toward the wall. The post meets a front wheel, or the side: the outline has no gap.
    poses += [(-4.0, 0.18, 0.0), (-4.0, -0.2 - SIDE + 0.05, 0.0)]
    reported, geometric = contacts(backend, poses, [math.copysign(1, math.cos(h)) for h in headings] + [1.0, 1.0], 30)
    assert not reported[:, 0].any()
    assert ((first(reported) - first(geometric)).abs() <= 1).all()
    # A rover that bounces off the wall may touch it between two poses that do not.
    near = geometric[:, :-1] | geometric[:, 1:]
    assert not (reported[:, 1:] & ~near).any()


def test_passing_at_3_cm_is_no_contact(backend):
    gap = WALL_X - SIDE - 0.03
    poses = [(gap, -5.0, math.pi / 2), (gap, 5.0, -math.pi / 2), (-4.0, -0.2 - SIDE - 0.03, 0.0)]
    reported, geometric = contacts(backend, poses, [1.0, 1.0, 1.0], 40)
    assert not reported.any()
    assert not geometric.any()


def test_the_ground_is_no_obstacle_even_where_the_chassis_scrapes_it(backend):
    # A ridge of 8 cm between the wheels, higher than the bottom of the chassis.
    heights = torch.zeros(81, 81)
    heights[40] = 0.08
    ridge = World("ridge", Terrain(heights, 0.1), [box((0, 3, 0.5), (1, 1, 1))])
    simulator = placed(backend, ridge, [(-2.0, 0.0, 0.0)])
    states = drive(simulator, (0.5, 0.0), 30)
    # The chassis carries a part of the weight: the rover stands higher than its wheels would hold it.
    assert states[-1].position[0, 2] > 0.005
    assert not any(state.contact.any() for state in states)


def test_contacts_end_with_a_reset_and_stay_in_held_rows(backend):
    poses = [(1.8, -2.0, 0.0), (1.8, 2.0, 0.0), (-6.0, 0.0, 0.0)]
    simulator = placed(backend, WALLED, poses)
    touched = drive(simulator, (1.0, 0.0), 16)[-1].contact
    assert touched.flatten().tolist() == [True, True, False]
    mask = torch.tensor([True, False, False])
    assert simulator.reset(mask, torch.tensor(poses)).contact.flatten().tolist() == [False, True, False]
    held = simulator.step(torch.tensor([[0.0, 0.0], [-1.0, 0.0], [0.0, 0.0]]), torch.tensor([True, False, True]))
    assert held.contact.flatten().tolist() == [False, True, False]
    free = drive(simulator, [[0.0, 0.0], [-1.0, 0.0], [0.0, 0.0]], 6)[-1]
    assert not free.contact.any()
    assert touched.any(), "returned states do not change"
