"""Evaluations in worlds in which something moves."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl import World
from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.evaluate import Evaluation, evaluate
from rover_rl.envs import EnvConfig
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import Terrain
from rover_rl.sims.worlds.movers import Box, Cylinder, Mover, Waypoints
from rover_rl.sims.worlds.pool import WorldPool
from tests.algos.drivers import standing
from tests.algos.evaluation.drives import FIELD

ROVER = get_robot("rover_zero")
# A cylinder comes along the x axis from 3 m away at 1 m/s and stops behind the origin; a box stands far away.
CYLINDER = Mover(
    Waypoints([(0.0, 3.0, 0.0, math.pi), (5.0, -2.0, 0.0, math.pi)], repeat="once"), Cylinder(radius=0.3, height=1.0)
)
BOX = Mover(Waypoints([(0.0, 4.0, 4.0, math.pi / 2)]), Box(length=2.0, width=1.0, height=0.8))
STREET = World("street", Terrain.flat((12.0, 12.0)), movers=[CYLINDER, BOX])


def episodes(*worlds: World, y: float = 0.0) -> EpisodeSet:
    """An episode in each world, from the origin or beside it, facing the cylinder."""
    count = len(worlds)
    start, goal = torch.tensor([[0.0, y, 0.0]]), torch.tensor([[-5.0, -5.0]])
    places = (start.repeat(count, 1), goal.repeat(count, 1), torch.full((count,), 7.0))
    return EpisodeSet("street", WorldPool(*worlds), 0, *places, world_index=torch.arange(count))


@pytest.fixture(scope="module")
def run_into() -> Evaluation:
    """A rover that stands still is run into in the street, and by nobody in the field."""
    options = {"env": EnvConfig(backend="warp"), "seconds": 2.8, "track_movers": True}
    return evaluate(standing, episodes(STREET, FIELD), **options)


# --- what is recorded


def test_encounters_are_those_with_the_nearest_mover(run_into: Evaluation) -> None:
    met = run_into.trajectories[0].encounters
    assert met is not None
    assert [len(values) for values in met] == [57] * 3
    assert not met.contact[0]
    # The front of the rover is 0.2635 m from its origin.
    first = int(met.contact.to(torch.uint8).argmax())
    assert first * 0.05 == pytest.approx(3.0 - 0.3 - 0.2635, abs=0.1)
    seconds = torch.arange(first) * 0.05
    torch.testing.assert_close(met.center_distance[:first], 3.0 - seconds, atol=0.02, rtol=0)
    gap = (3.0 - seconds - 0.3 - ROVER.radius).clamp(min=0)
    torch.testing.assert_close(met.gap[:first], gap, atol=0.02, rtol=0)


def test_an_episode_without_movers_has_no_encounters(run_into: Evaluation) -> None:
    assert run_into.trajectories[1].encounters is None
    assert run_into.trajectories[1].movers is None


def test_a_trajectory_keeps_where_movers_are_if_asked_for(run_into: Evaluation) -> None:
    track = run_into.trajectories[0].movers
    assert track is not None
    assert track.mover.tolist() == [0, 1]
    assert track.kind.tolist() == [0, 1]
    torch.testing.assert_close(track.half, torch.tensor([[0.3, 0.3, 0.5], [1.0, 0.5, 0.4]]))
    x = 3.0 - torch.arange(57) * 0.05
    torch.testing.assert_close(track.position[:, 0], torch.stack((x, x * 0, x * 0 + 0.5), -1), atol=1e-3, rtol=0)
    torch.testing.assert_close(track.position[:, 1], torch.tensor([[4.0, 4.0, 0.4]]).expand(57, 3))
    upright = torch.tensor([[0.0, 0.0, 0.5**0.5, 0.5**0.5]]).expand(57, 4)
    torch.testing.assert_close(track.orientation[:, 1], upright)
    without = evaluate(standing, episodes(STREET), env=EnvConfig(backend="warp"), seconds=0.1)
    assert without.trajectories[0].movers is None


def test_a_trajectory_until_a_step(run_into: Evaluation) -> None:
    whole = run_into.trajectories[0]
    part = whole.until(30, "contact")
    assert (len(part), part.ending) == (30, "contact")
    assert torch.equal(part.position, whole.position[:31])
    assert [len(values) for values in part.encounters or ()] == [31] * 3
    assert part.movers is not None
    assert len(part.movers.position) == len(part.movers.orientation) == 31
    assert len(part.movers.kind) == 2
