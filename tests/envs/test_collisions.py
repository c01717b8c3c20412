"""What is a collision: a reading below the contract's threshold, or at the outline of another robot, or a contact."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from rover_rl import TaskConfig
from rover_rl.envs.task import StepEvent
from rover_rl.robots import get_robot
from rover_rl.robots.footprint import COLLISION_MARGIN, collision_ranges
from tests.envs.scripted import Moment, ScriptedBackend, bare, play, rewards, scripted, step_events

BEAMS = 32
LEFT, BACK = 8, 16
HUSKY = replace(get_robot("husky"), lidar_view=math.tau)
"""A larger robot, whose lidar sees all around."""
CONTACT = TaskConfig(collision_from="contact")
FREE, NEAR, TOUCHING = Moment(), Moment(ranges=0.1), Moment(contact=True)


def reading(beam: int, distance: float) -> Moment:
    return Moment(ranges=tuple(distance if k == beam else 5.0 for k in range(BEAMS)))


def collides(moment: Moment, **settings) -> bool:
    (result,) = play(scripted([Moment(), moment], **settings), 1)
    return result["outcome", "collision"].item()


def reporting(*scripts, **settings):
    return scripted(*scripts, backend=ScriptedBackend(contacts=True), **settings)


def test_the_ranges_of_the_beams_reach_to_the_outline_and_a_margin():
    robot, outline = HUSKY, HUSKY.footprint
    x, y, _ = robot.lidar_position
    ranges = collision_ranges(robot, 360, margin=0.0)
    angles = np.radians(np.arange(360))
    ends = np.stack((x + ranges * np.cos(angles), y + ranges * np.sin(angles)), -1)
    on_side = [np.isclose(ends[:, 0], end) for end in (outline.front, outline.back)]
    on_side += [np.isclose(ends[:, 1], end) for end in (outline.left, outline.right)]
    assert np.logical_or.reduce(on_side).all()
    assert np.allclose(collision_ranges(robot, 360), ranges + COLLISION_MARGIN)
    with pytest.warns(UserWarning, match="outside of its body"):
        robot = replace(HUSKY, lidar_position=(0.55, 0.0, 0.44))
    # A lidar beside the footprint has the margin where its beams miss it.
    aside = [COLLISION_MARGIN, COLLISION_MARGIN, 0.55 + 0.4937 + COLLISION_MARGIN, COLLISION_MARGIN]
    assert np.allclose(collision_ranges(robot, 4), aside)


def test_rover_zero_has_the_contracts_threshold_in_every_direction():
    assert set(collision_ranges(get_robot("rover_zero"), BEAMS)) == {0.3}
    assert bare(scripted([Moment()])).config.task.collision_threshold == 0.3
    assert [collides(reading(BACK, d)) for d in (0.31, 0.29)] == [False, True]


@pytest.mark.parametrize(("beam", "limit"), [(0, 0.1567), (LEFT, 0.34255), (BACK, 0.8307)])
def test_a_larger_robot_collides_where_its_outline_is(beam, limit):
    limit += COLLISION_MARGIN
    assert math.isclose(collision_ranges(HUSKY, BEAMS)[beam], limit, abs_tol=1e-3)
    assert [collides(reading(beam, limit + by), robot=HUSKY) for by in (0.01, -0.01)] == [False, True]


def test_a_range_that_the_robot_or_the_task_states_holds_in_every_direction():
    stated = replace(HUSKY, collision_range=0.5)
    assert [collides(reading(BACK, d), robot=stated) for d in (0.51, 0.49)] == [False, True]
    task = TaskConfig(collision_threshold=0.2)
    assert [collides(reading(BACK, d), robot=HUSKY, task=task) for d in (0.21, 0.19)] == [False, True]


def test_a_contact_is_a_collision_and_a_near_reading_is_none_or_by_default_the_other_way_round():
    script = [FREE, NEAR, TOUCHING, FREE, *[TOUCHING] * 16]
    results = play(reporting(script, task=CONTACT), 19)
    assert [td["outcome", "collision"].item() for td in results[:3]] == [False, True, False]
    later = [StepEvent.COLLISION] * 15 + [StepEvent.JAM]
    assert step_events(results) == [StepEvent.DENSE, StepEvent.COLLISION, StepEvent.DENSE, *later]
    assert rewards(results)[1] == -0.5
    results = play(reporting(script), 3)
    assert [td["outcome", "collision"].item() for td in results] == [True, False, False]


@pytest.mark.parametrize(
    ("task", "moment"), [(TaskConfig(collision_window=0), NEAR), (replace(CONTACT, collision_window=0), TOUCHING)]
)
def test_with_a_window_of_0_the_first_collision_ends_the_episode_also_at_a_goal(task, moment):
    results = play(reporting([FREE, FREE, moment], task=task), 2)
    assert [td["terminated"].item() for td in results] == [False, True]
    assert step_events(results) == [StepEvent.DENSE, StepEvent.JAM]
    assert rewards(results)[1] == -20.0
    assert results[1]["outcome", "jammed"].item()
    assert results[1]["outcome", "collision"].item()
    (result,) = play(reporting([Moment(x=3.0), moment], task=task), 1, goal=(0.0, 0.0))
    assert not result["outcome", "goal_reached"].item()
    assert result["reward"].item() == -20.0


def test_a_backend_without_contacts_is_refused_only_if_the_task_needs_them():
    message = "a task with collision_from='contact' needs a backend that reports contacts: .* the feature 'contacts'"
    with pytest.raises(ValueError, match=message):
        scripted([FREE], task=CONTACT)
    with pytest.raises(ValueError, match=r"collision_from must be one of \('lidar', 'contact'\), got 'bumper'"):
        TaskConfig(collision_from="bumper")
