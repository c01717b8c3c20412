"""Lidars that see less than a full turn."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from rover_rl import RoverEnv
from rover_rl.robots import get_robot
from rover_rl.sims.rays import seen
from tests.sims.driven import ROVER

FRONT = replace(ROVER, name="front", lidar_view=math.radians(270))


def test_a_view_is_centered_on_straight_ahead() -> None:
    angles = torch.arange(8) * math.pi / 4
    assert seen(angles, math.radians(270)).tolist() == [True, True, True, True, False, True, True, True]
    assert seen(angles, math.radians(80)).tolist() == [True, *[False] * 7]
    assert seen(angles, 2 * math.pi).all()


def test_readings_outside_of_the_view_have_no_return(backend: str) -> None:
    full, partial = (RoverEnv(world_n="maze", robot=robot, backend=backend, seed=0) for robot in (ROVER, FRONT))
    expected, readings = (env.reset()["lidar"][0] for env in (full, partial))
    # 32 readings of 11.25 degrees, from straight ahead on; those behind are 12 to 19.
    assert torch.equal(readings[:12], expected[:12])
    assert torch.equal(readings[20:], expected[20:])
    assert (readings[12:20] >= expected[12:20]).all()
    assert readings[13:19].tolist() == [12.0] * 6
    assert partial.scan.isinf().sum() > full.scan.isinf().sum()


def test_robots_state_the_views_of_their_lidars() -> None:
    views = {name: math.degrees(get_robot(name).lidar_view) for name in ("rover_zero", "jackal", "racer")}
    assert views == pytest.approx({"rover_zero": 360.0, "jackal": 270.0, "racer": 269.3}, abs=0.1)
    with pytest.raises(ValueError, match="lidar_view of robot .* must be positive and at most 2 pi rad, got 7"):
        replace(ROVER, lidar_view=7.0)
