from __future__ import annotations

import math

import pytest
import torch

from rover_rl.sims.ros2.guard import SECTOR, UnseenGuard

ANGLES = torch.arange(128) * (2 * math.pi / 128)
AHEAD = ANGLES.cos() > math.cos(SECTOR) - 1e-3
BEHIND = ANGLES.cos() < 1e-3 - math.cos(SECTOR)


@pytest.mark.parametrize(("speed", "sector"), [(0.3, AHEAD), (-0.3, BEHIND)], ids=["forwards", "backwards"])
def test_every_beam_around_the_direction_of_travel_must_be_seen(speed, sector):
    guard = UnseenGuard(ANGLES)
    for beam in range(128):
        seen = torch.ones(128, dtype=torch.bool)
        seen[beam] = False
        assert guard.blocks(speed, seen) == sector[beam].item()


def test_zero_forward_speed_is_never_blocked():
    assert not UnseenGuard(ANGLES).blocks(0.0, torch.zeros(128, dtype=torch.bool))


def test_a_full_field_of_view_blocks_nothing():
    guard, seen = UnseenGuard(ANGLES), torch.ones(128, dtype=torch.bool)
    assert not guard.blocks(1.0, seen)
    assert not guard.blocks(-1.0, seen)
