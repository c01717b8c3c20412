"""Reactive motions: what their papers show."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rover_rl.worlds import Terrain, World
from rover_rl.worlds.movers import Cylinder, Mover, Orca, Rovers, SocialForce, Walk
from tests.worlds.movers.crowds import DT, ROVER_RADIUS, begun, rovers_at, walk, yard

RADIUS = 0.3
AWAY = torch.tensor([[0.0, 9.0]])


def pairwise_gap(points: Tensor) -> float:
    """Returns the least distance between the surfaces of movers at ``points [steps, M, 2]``, m."""
    return (torch.cdist(points, points) + 10 * torch.eye(points.shape[1])).min().item() - 2 * RADIUS


@pytest.mark.parametrize(("motion", "least"), [(Orca, 0.0), (SocialForce, -0.02)])
def test_two_that_meet_head_on_pass(motion: type[Walk], least: float) -> None:
    ends = [(-4.0, 0.0), (4.0, 0.0)]
    movers = [Mover(motion(start=a, goal=b), Cylinder(RADIUS)) for a, b in (ends, ends[::-1])]
    field = begun([yard(movers)], rovers=AWAY)
    points = walk(field, 200, lambda _: rovers_at(AWAY))[:, 0]
    assert pairwise_gap(points) > least
    assert (points - torch.tensor(ends[::-1])).norm(dim=-1).min(0).values.max() < 0.21


def test_eight_on_a_circle_reach_the_other_side_without_contact() -> None:
    angles = [2 * math.pi * k / 8 for k in range(8)]
    starts = [(5 * math.cos(angle), 5 * math.sin(angle)) for angle in angles]
    movers = [Mover(Orca(start=(x, y), goal=(-x, -y)), Cylinder(RADIUS)) for x, y in starts]
    points = walk(begun([yard(movers)], 1, AWAY), 300, lambda _: rovers_at(AWAY))[:, 0]
    assert pairwise_gap(points) > 0.0
    assert (points + torch.tensor(starts)).norm(dim=-1).min(0).values.max() < 0.21


def oncoming(step: int) -> Rovers:
    """Returns a rover that drives from x = 5 toward -x at 1 m/s."""
    return rovers_at(torch.tensor([[5.0 - step * DT, 0.05]]), torch.tensor([[-1.0, 0.0]]))


def rover_gap(motion: Walk) -> float:
    """Returns the least distance between the surfaces of a mover that walks toward +x and the oncoming rover, m."""
    field = begun([yard([Mover(motion, Cylinder(RADIUS))])], rovers=AWAY)
    points = walk(field, 160, oncoming)[:, 0, 0]
    rovers = torch.cat([oncoming(step + 1).position[0] for step in range(160)])
    return (points - rovers).norm(dim=-1).min().item() - RADIUS - ROVER_RADIUS


@pytest.mark.parametrize("motion", [Orca, SocialForce])
def test_movers_evade_the_rover_that_they_see(motion: type[Walk]) -> None:
    assert rover_gap(motion(start=(-4.0, 0.0), goal=(4.0, 0.0))) > -1e-3
    assert rover_gap(motion(start=(-4.0, 0.0), goal=(4.0, 0.0), sees_rover=False)) < -0.3  # type: ignore[call-arg]


def lane_order(points: Tensor, directions: Tensor, length: float) -> float:
    """Returns the mean of ``((same - others) / (same + others))^2`` over walkers, 1 in perfect lanes.

    ``same`` and ``others`` count those in the same and in the opposite direction within 0.8 m to the sides and 6 m
    ahead and behind (as M. Rex and H. Loewen, "Lane formation in oppositely charged colloids driven by an electric
    field", Physical Review E 75 (2007) 051402).
    """
    offset = points[..., :, None, :] - points[..., None, :, :]
    x = torch.remainder(offset[..., 0] + length / 2, length) - length / 2
    near = (offset[..., 1].abs() < 0.8) & (x.abs() < 6.0) & ~torch.eye(len(directions), dtype=torch.bool)
    same = (near & (directions[:, None] == directions)).sum(-1)
    others = near.sum(-1) - same
    return ((same - others) / (same + others).clamp(min=1)).square().mean().item()


def test_lanes_form_in_a_corridor_with_two_directions() -> None:
    """As in figure 2 of Helbing and Molnar (1995): 0.3 persons per m^2 in a periodic corridor."""
    length, width, count = 40.0, 5.0, 60
    start = ((-length / 2, length / 2), (-width / 2 + 0.4, width / 2 - 0.4))
    motions = [
        SocialForce(speed=1.34, start=start, goal=((300 * s, 300 * s + 1), (-width / 2, width / 2)), patience=1e5)
        for s in (1.0, -1.0)
    ]
    movers = [Mover(motion, Cylinder(0.23)) for motion in motions for _ in range(count // 2)]
    corridor = World("corridor", Terrain.flat((length + 20, width)), movers=movers, spawn_range=start)
    away = torch.full((2, 2), 1000.0)
    field = begun([corridor] * 2, rovers=away)
    directions = torch.tensor([1.0, -1.0]).repeat_interleave(count // 2)
    before = lane_order(field.state.position, directions, length)
    slow = float(0)
    for step in range(800):
        field.advance(None, rovers_at(away))
        if step == 100:
            slow = (field.state.velocity[..., 0] * directions).mean().item()
        x, y = field.state.position.unbind(-1)
        x = torch.remainder(x + length / 2, length) - length / 2
        field.state = replace(field.state, position=torch.stack((x, y), -1))
    assert before < 0.3
    assert lane_order(field.state.position, directions, length) > 0.6
    # In lanes, they walk faster than while the directions are mixed.
    assert (field.state.velocity[..., 0] * directions).mean().item() > max(slow, 1.2)
