"""A row's movers are the same to the last bit in any batch."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rover_rl.worlds import box
from rover_rl.worlds.movers import Cross, Cylinder, Motion, Mover, Orca, SocialForce, Wander, Waypoints
from tests.worlds.movers.crowds import begun, rovers_at, walk, yard

MOTIONS = [
    Wander(turn_time=1.0),
    Cross(patience=1.0, pause=0.3),
    SocialForce(patience=1.0, pause=0.3),
    Orca(patience=1.0, pause=0.3),
    Waypoints.there_and_back((0.0, 0.0), (4.0, 3.0), random_start=True),
]
PILLARS = [box((x, y, 0.5), (2.0, 1.0, 1.0)) for x in (-3.0, 3.0) for y in (-2.5, 2.5)]


def circling(rows: int, seed: int, step: int) -> Tensor:
    """Points of rovers that depend on the seed of the row and on the step, ``[rows, 2]``."""
    turn = torch.arange(seed, seed + rows) + 0.02 * step
    # Powers of the angle: sines may differ in the last bit.
    return torch.stack((torch.remainder(turn, 6) - 3, torch.remainder(0.5 * turn, 4) - 2), -1)


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
def test_a_row_alone_is_as_it_is_in_a_batch(motion: Motion) -> None:
    # Some rows fill the processor's vectors, and the last one is left over.
    rows = 33
    world = yard([Mover(motion, Cylinder(0.3))] * 5, 12.0, PILLARS)
    # Other rows have more movers, of other motions, too.
    crowded = yard([Mover(Waypoints([(0.0, 1.0, 1.0, 0.0)])), *[Mover(motion, Cylinder(0.2))] * 7], 14.0)
    row = rows - 3
    alone = begun([world], seed=row, rovers=circling(1, row, 0))
    batch = begun([crowded if k != row and k % 3 else world for k in range(rows)], rovers=circling(rows, 0, 0))
    again = (torch.arange(rows) % 2 == 0)[:, None]
    again[row] = False
    for step in range(80):
        if step == 40:
            batch.reset(again, torch.arange(rows)[:, None], circling(rows, 0, step))
        alone.advance(None, rovers_at(circling(1, row, step)))
        batch.advance(None, rovers_at(circling(rows, 0, step)))
    for name in ("position", "yaw", "velocity", "goal", "clock", "draws"):
        assert torch.equal(getattr(alone.state, name)[0], getattr(batch.state, name)[row, :5]), name
    assert torch.equal(alone.parts.position[0], batch.parts.position[row, :5])


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
def test_rows_in_which_no_time_passes_stay_and_all_movers_are_elsewhere(motion: Motion) -> None:
    field = begun([yard([Mover(motion)] * 3)] * 2)
    before = field.state.position
    for _ in range(30):
        field.advance(torch.tensor([[True], [False]]), rovers_at(torch.zeros(2, 2)))
    assert torch.equal(field.state.position[1], before[1])
    assert not torch.equal(field.state.position[0], before[0])
    points = walk(field, 20)[-1].reshape(-1, 2)
    assert len(points.unique(dim=0)) == 6
