"""Evaluations in worlds in which something moves."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from rover_rl import World
from rover_rl.algos.evaluation.episodes import EpisodeSet, draw_episodes
from rover_rl.algos.evaluation.evaluate import Evaluation, evaluate
from rover_rl.algos.evaluation.metrics import compute_metrics, episode_row
from rover_rl.algos.evaluation.trajectory import Encounters, Trajectory
from rover_rl.envs.config import EnvConfig
from rover_rl.robots import get_robot
from rover_rl.worlds import Terrain
from rover_rl.worlds.movers import Box, Cylinder, Mover, Wander, Waypoints
from rover_rl.worlds.pool import WorldPool
from tests.algos.drivers import standing
from tests.algos.evaluation.drives import FIELD, assert_same, line

ROVER = get_robot("rover_zero")
FRONT = 0.2635  # from the rover's origin to its front, m
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
    first = int(met.contact.to(torch.uint8).argmax())
    assert first * 0.05 == pytest.approx(3.0 - 0.3 - FRONT, abs=0.1)
    seconds = torch.arange(first) * 0.05
    torch.testing.assert_close(met.center_distance[:first], 3.0 - seconds, atol=0.02, rtol=0)
    gap = (3.0 - seconds - 0.3 - ROVER.radius).clamp(min=0)
    torch.testing.assert_close(met.gap[:first], gap, atol=0.02, rtol=0)


def test_an_episode_without_movers_has_no_encounters(run_into: Evaluation) -> None:
    assert run_into.trajectories[1].encounters is None
    assert run_into.trajectories[1].movers is None


def test_movers_are_those_of_the_episode_whatever_rover_drives_it() -> None:
    wanderers = World("crowd", Terrain.flat((12.0, 12.0)), movers=[Mover(Wander(), Cylinder())] * 4)
    crowd = draw_episodes(WorldPool(wanderers, STREET), 4, seed=1)
    options = {"env": EnvConfig(backend="warp"), "seconds": 1.5, "track_movers": True}
    together = evaluate(standing, crowd, rows=8, **options).trajectories
    in_turn = evaluate(standing, crowd, rows=3, **options).trajectories
    alone = [evaluate(standing, crowd.part(n, n + 1), **options).trajectories[0] for n in range(3)]
    assert_same(in_turn, together)
    assert_same(alone, together[:3])
    for one, other in ((one, other) for same in (in_turn, alone) for one, other in zip(same, together, strict=False)):
        assert one.movers is not None
        assert other.movers is not None
        assert torch.equal(one.movers.position, other.movers.position)
    assert not torch.equal(together[0].movers.position[0], together[1].movers.position[0])  # type: ignore[union-attr]


def test_a_trajectory_until_a_step(run_into: Evaluation) -> None:
    whole = run_into.trajectories[0]
    part = whole.until(30, "contact")
    assert (len(part), part.ending) == (30, "contact")
    assert torch.equal(part.position, whole.position[:31])
    assert [len(values) for values in part.encounters or ()] == [31] * 3
    assert part.movers is not None
    assert len(part.movers.position) == len(part.movers.orientation) == 31
    assert len(part.movers.kind) == 2


# --- metrics


def met(
    speeds: list[float], *, contact: str = "", gap: float | list[float] = 9.0, center: float = 9.0, ending: str = "goal"
) -> Trajectory:
    """A drive along x with the given speed in each step, and with what happens at the start and after each step."""
    steps = len(speeds)
    x = torch.tensor([0.0, *speeds]).cumsum(0) * 0.05
    gaps = torch.tensor(gap) if isinstance(gap, list) else torch.full((steps + 1,), gap)
    flags = torch.tensor([character == "x" for character in contact.ljust(steps + 1)])
    encounters = Encounters(flags, gaps, torch.full((steps + 1,), center))
    goal = torch.arange(steps) == (steps - 1 if ending == "goal" else steps)
    position = torch.stack((x, x * 0, x * 0), -1)
    return replace(line(ending, steps=steps), position=position, goal=goal, encounters=encounters)


def row_of(trajectory: Trajectory) -> dict[str, Any]:
    """Columns of an episode without contacts with obstacles at rest."""
    return episode_row(trajectory, torch.zeros(len(trajectory) + 1, dtype=torch.bool), 1.0)


def values(*trajectories: Trajectory) -> dict[str, float]:
    return {name: estimate.value for name, estimate in compute_metrics([*map(row_of, trajectories)]).items()}


@pytest.mark.parametrize(
    ("speeds", "contact", "contacts", "run_into"),
    [
        ([1.0, 1.0, 1.0, 1.0], "  xx ", 1, 0),
        # The mover pushes the rover in the step of the contact.
        ([0.0, 0.04, 0.9, 0.9], "   xx", 1, 1),
        # The rover drives against a mover that stops it at once.
        ([1.0, 1.0, 0.0, 0.0], "   xx", 1, 0),
        # Contacts from the start and in the first step: rovers start at rest.
        ([1.0, 1.0, 1.0, 1.0], "xx  x", 2, 1),
        ([1.0, 1.0, 1.0, 1.0], " x   ", 1, 1),
        ([0.0, 0.0, 0.0, 1.0, 1.0], " x x x", 3, 2),
        ([1.0], "", 0, 0),
    ],
)
def test_a_rover_that_stands_still_is_run_into(speeds: list[float], contact: str, contacts: int, run_into: int) -> None:
    row = row_of(met(speeds, contact=contact))
    assert (row["mover_contacts"], row["run_into"], row["at_fault"]) == (contacts, run_into, contacts - run_into)


def test_contacts_with_movers_count_as_contacts() -> None:
    touched, free, late = met([1.0] * 3, contact=" x x"), met([1.0] * 3), met([1.0] * 3, contact="xx  ", ending="stuck")
    found = values(touched, free, late)
    assert found["contact_free_success_rate"] == pytest.approx(1 / 3)
    assert found["body_contact_share"] == found["mover_contact_share"] == pytest.approx(2 / 3)
    assert found["body_contacts"] == found["mover_contacts"] == pytest.approx(1)
    assert found["wall_contact_share"] == 0


def test_contacts_with_walls_and_with_movers_are_told_apart() -> None:
    drives = [met([1.0] * 4, contact=" xx  "), met([1.0] * 4)]
    walls = [torch.tensor([character == "x" for character in text]) for text in ("  xx ", "x    ")]
    found = compute_metrics([episode_row(*pair, 1.0) for pair in zip(drives, walls, strict=True)])
    assert found["wall_contact_share"].value == 1
    assert found["mover_contact_share"].value == 0.5
    # A contact with a wall that follows one with a mover at once is part of it.
    assert found["body_contacts"].value == 1


def test_distances_and_times_near_movers() -> None:
    near = met([1.0, 0.0, 0.0, 1.0], gap=[0.3, 1.1, 1.3, 2.1, 0.4], center=0.45)
    row = row_of(near)
    assert row["least_mover_distance"] == pytest.approx(0.3)
    # Times are those of steps: what is near at their ends. The rover stands still at 1.3 and 2.1 m.
    assert row["risk_seconds"] == pytest.approx(4 * 0.05)
    assert row["intrusion_seconds"] == pytest.approx(2 * 0.05)
    assert row["frozen_seconds"] == pytest.approx(0.05)

    found = values(near, met([1.0] * 4, gap=0.7, ending="stuck"))
    assert found["least_mover_distance"] == pytest.approx(0.5)
    assert found["risk_per_goal"] == pytest.approx(0.2)
    assert found["intrusion"] == pytest.approx(6 / 8)
    assert found["frozen"] == pytest.approx(1 / 8)
    assert math.isnan(values(met([1.0], ending="stuck"))["risk_per_goal"])


# --- results, tables and files


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
