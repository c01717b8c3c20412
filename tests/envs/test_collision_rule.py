"""When a lidar reading is a collision: below the contract's threshold for Rover Zero, at the outline for others."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from rover_rl import TaskConfig
from rover_rl.robots import get_robot
from rover_rl.robots.footprint import COLLISION_MARGIN, collision_ranges
from tests.envs.contract.scripted_env import bare, play, scripted
from tests.envs.scripted import Moment
from tests.fleet import husky

BEAMS = 32
LEFT, BACK = 8, 16
FREE = 5.0


def reading(beam: int, distance: float) -> Moment:
    return Moment(ranges=tuple(distance if k == beam else FREE for k in range(BEAMS)))


def collides(moment: Moment, **settings) -> bool:
    (result,) = play(scripted([Moment(), moment], **settings), 1)
    return result["outcome", "collision"].item()


def test_the_ranges_of_the_beams_reach_to_the_outline_and_a_margin():
    robot, outline = husky(), husky().footprint
    x, y, _ = robot.lidar_position
    ranges = collision_ranges(robot, 360, margin=0.0)
    angles = np.radians(np.arange(360))
    ends = np.stack((x + ranges * np.cos(angles), y + ranges * np.sin(angles)), -1)
    on_side = [np.isclose(ends[:, 0], end) for end in (outline.front, outline.back)]
    on_side += [np.isclose(ends[:, 1], end) for end in (outline.left, outline.right)]
    assert np.logical_or.reduce(on_side).all()
    assert np.allclose(collision_ranges(robot, 360), ranges + COLLISION_MARGIN)


def test_rover_zero_has_the_contracts_threshold_in_every_direction():
    assert set(collision_ranges(get_robot("rover_zero"), BEAMS)) == {0.3}
    assert bare(scripted([Moment()])).config.task.collision_threshold == 0.3
    assert [collides(reading(BACK, d)) for d in (0.31, 0.29)] == [False, True]


@pytest.mark.parametrize(("beam", "limit"), [(0, 0.275), (LEFT, 0.3355), (BACK, 0.715)])
def test_a_larger_robot_collides_where_its_outline_is(beam, limit):
    limit += COLLISION_MARGIN
    assert math.isclose(collision_ranges(husky(), BEAMS)[beam], limit, abs_tol=1e-3)
    answers = [collides(reading(beam, limit + by), robot=husky()) for by in (0.01, -0.01)]
    assert answers == [False, True]


def test_a_range_that_the_robot_or_the_task_states_holds_in_every_direction():
    stated = replace(husky(), collision_range=0.5)
    assert [collides(reading(BACK, d), robot=stated) for d in (0.51, 0.49)] == [False, True]
    task = TaskConfig(collision_threshold=0.2)
    assert [collides(reading(BACK, d), robot=husky(), task=task) for d in (0.21, 0.19)] == [False, True]


def test_a_lidar_beside_the_footprint_has_the_margin_where_its_beams_miss_it():
    with pytest.warns(UserWarning, match="outside of its body"):
        robot = replace(husky(), lidar_position=(0.55, 0.0, 0.4))
    ranges = collision_ranges(robot, 4)
    assert np.allclose(ranges, [COLLISION_MARGIN, COLLISION_MARGIN, 0.55 + 0.495 + COLLISION_MARGIN, COLLISION_MARGIN])
