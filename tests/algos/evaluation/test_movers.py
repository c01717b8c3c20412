"""Evaluations in worlds in which something moves."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl import World
from rover_rl.algos.evaluation.episodes import EpisodeSet, draw_episodes
from rover_rl.algos.evaluation.evaluate import Evaluation, evaluate
from rover_rl.robots import get_robot
from rover_rl.worlds import Terrain
from rover_rl.worlds.movers import Box, Cylinder, Mover, Wander, Waypoints
from rover_rl.worlds.pool import WorldPool
from tests.algos.drivers import standing
from tests.algos.evaluation.drives import FIELD, WARP, assert_same

ROVER = get_robot("rover_zero")
FRONT = 0.2635  # from the rover's origin to its front, m
# A cylinder comes along the x axis from 3 m away at 1 m/s and stops behind the origin; a box stands far away.
APPROACH = Waypoints([(0.0, 3.0, 0.0, math.pi), (5.0, -2.0, 0.0, math.pi)], repeat="once")
BOX = Mover(Waypoints([(0.0, 4.0, 4.0, math.pi / 2)]), Box(length=2.0, width=1.0, height=0.8))
STREET = World("street", Terrain.flat((12.0, 12.0)), movers=[Mover(APPROACH, Cylinder(radius=0.3, height=1.0)), BOX])


@pytest.fixture(scope="module")
def run_into() -> Evaluation:
    """A rover that stands still at the origin is run into in the street, and by nobody in the field."""
    start, goal = torch.zeros(2, 3), torch.tensor([[-4.0, -4.0]]).repeat(2, 1)
    pool, index = WorldPool(STREET, FIELD), torch.arange(2)
    episodes = EpisodeSet("street", pool, 0, start, goal, torch.full((2,), 7.0), world_index=index)
    return evaluate(standing, episodes, env=WARP, seconds=2.8, track_movers=True)


def test_encounters_are_those_with_the_nearest_mover(run_into: Evaluation) -> None:
    met = run_into.trajectories[0].encounters
    assert met is not None
    assert [len(values) for values in met] == [57] * 3
    assert not met.contact[0]
    first = int(met.contact.to(torch.uint8).argmax())
    assert first * 0.05 == pytest.approx(3.0 - 0.3 - FRONT, abs=0.1)
    seconds = torch.arange(first) * 0.05
    torch.testing.assert_close(met.center_distance[:first], 3.0 - seconds, atol=0.02, rtol=0)
    gap = (3.0 - seconds - 0.3 - ROVER.radius).clamp(min=0)
    torch.testing.assert_close(met.gap[:first], gap, atol=0.02, rtol=0)
    alone = run_into.trajectories[1]
    assert (alone.encounters, alone.movers) == (None, None)


def test_movers_are_those_of_the_episode_whatever_rover_drives_it() -> None:
    wanderers = World("crowd", Terrain.flat((12.0, 12.0)), movers=[Mover(Wander(), Cylinder())] * 4)
    crowd, options = draw_episodes(WorldPool(wanderers, STREET), 3, seed=1), {"env": WARP, "seconds": 0.5}
    together, in_turn = (evaluate(standing, crowd, rows=n, track_movers=True, **options).trajectories for n in (6, 2))
    alone = evaluate(standing, crowd.part(1, 2), track_movers=True, **options).trajectories[0]
    assert_same([*in_turn, alone], [*together, together[1]])
    tracks = [one.movers.position for one in together]
    assert all(
        map(torch.equal, [*(one.movers.position for one in in_turn), alone.movers.position], [*tracks, tracks[1]])
    )
    assert not torch.equal(tracks[0][0], tracks[1][0])


def test_a_trajectory_until_a_step(run_into: Evaluation) -> None:
    whole = run_into.trajectories[0]
    part = whole.until(30, "contact")
    assert (len(part), part.ending) == (30, "contact")
    assert torch.equal(part.position, whole.position[:31])
    assert [len(values) for values in part.encounters or ()] == [31] * 3
    assert part.movers is not None
    assert len(part.movers.position) == len(part.movers.orientation) == 31
    assert len(part.movers.kind) == 2


def test_results_of_a_drive(run_into: Evaluation) -> None:
    assert [bool(touched.any()) for touched in run_into.contacts] == [True, False]
    assert not any(touched.any() for touched in run_into.wall_contacts)
    found = {name: estimate.value for name, estimate in run_into.metrics.items()}
    assert found["run_into"] == found["mover_contact_share"] == 1
    assert found["body_contact_share"] == 0.5
    assert found["least_mover_distance"] == 0
    # From a distance of 2 m on, until the cylinder pushes it.
    since, until = 3.0 - 0.3 - ROVER.radius - 2.0, 3.0 - 0.3 - FRONT
    assert found["frozen"] == pytest.approx((until - since) / 2.8, abs=0.05)
    moving, alone = run_into.by_world
    assert moving["mover_contact_share"] == 1
    assert "mover_contact_share" not in alone
