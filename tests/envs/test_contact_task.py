"""A task whose collision is the contact of the rover's body, instead of a near lidar reading."""

from __future__ import annotations

import pytest
import torch

from rover_rl import TaskConfig, make_env
from rover_rl.envs.task import StepEvent
from tests.envs.contract.scripted_env import play, rewards, scripted, step_events
from tests.envs.scripted import Moment, ScriptedBackend

CONTACT = TaskConfig(collision_from="contact")
FREE, NEAR, TOUCHING = Moment(), Moment(ranges=0.1), Moment(contact=True)


def reporting(*scripts, **settings):
    return scripted(*scripts, backend=ScriptedBackend(contacts=True), **settings)


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
    ("task", "moment"),
    [(TaskConfig(collision_window=0), NEAR), (TaskConfig(0.5, 1.0, 0.3, 0, collision_from="contact"), TOUCHING)],
)
def test_with_a_window_of_0_the_first_collision_ends_the_episode(task, moment):
    results = play(reporting([FREE, FREE, moment], task=task), 2)
    assert [td["terminated"].item() for td in results] == [False, True]
    assert step_events(results) == [StepEvent.DENSE, StepEvent.JAM]
    assert rewards(results)[1] == -20.0
    assert results[1]["outcome", "jammed"].item()
    assert results[1]["outcome", "collision"].item()


def test_a_goal_does_not_count_in_the_step_in_which_a_contact_ends_the_episode():
    task = TaskConfig(collision_window=0, collision_from="contact")
    (result,) = play(reporting([Moment(x=3.0), TOUCHING], task=task), 1, goal=(0.0, 0.0))
    assert not result["outcome", "goal_reached"].item()
    assert result["reward"].item() == -20.0


def test_a_backend_without_contacts_is_refused_only_if_the_task_needs_them():
    message = (
        "a task with collision_from='contact' needs a backend that reports contacts: ScriptedSimulator does not "
        "have the feature 'contacts'"
    )
    with pytest.raises(ValueError) as error:
        scripted([FREE], task=CONTACT)
    assert str(error.value) == message
    assert not play(scripted([FREE]), 1)[0]["outcome", "collision"].any()


def test_an_unknown_source_of_collisions_is_refused():
    with pytest.raises(ValueError, match=r"collision_from must be one of \('lidar', 'contact'\), got 'bumper'"):
        TaskConfig(collision_from="bumper")


def test_any_contact_ends_the_episode_in_a_maze():
    task, rows = TaskConfig(collision_window=0, collision_from="contact"), 64
    env = make_env(world_n="maze", num_envs=rows, seed=4, backend="warp", task=task, lidar_beams=32)
    td, touched, near = env.reset(), 0, 0
    forward = torch.tensor([[1.0, 0.0]]).expand(rows, 2)
    for _ in range(60):
        step, td = env.step_and_maybe_reset(td.set("action", forward))
        outcome = step["next", "outcome"]
        assert torch.equal(outcome["collision"], outcome["jammed"])
        touched += int(outcome["collision"].sum())
        near += int(((step["next", "lidar"].amin(-1, keepdim=True) < 0.3) & ~outcome["collision"]).sum())
    assert touched > 0
    # The original's collision would have held in other steps.
    assert near > 0
