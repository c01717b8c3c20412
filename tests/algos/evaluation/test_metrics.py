"""Columns of episodes, metrics of them, their intervals, and contacts of the body."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl import World
from rover_rl.algos.driving import EARLY_ENDINGS, TIME_LIMIT
from rover_rl.algos.evaluation.metrics import METRICS, Estimate, compute_metrics, episode_row, proportion, ratio
from rover_rl.algos.evaluation.trajectory import Encounters, Trajectory, count_runs, find_body_contacts
from rover_rl.robots import get_robot
from rover_rl.worlds import Terrain, box
from tests.algos.evaluation.drives import line

ROVER = get_robot("rover_zero")
WALL = World("wall", Terrain.flat((12.0, 12.0)), [box((1.5, 0.0, 0.5), (1.0, 4.0, 1.0))])


def drive(
    length: float = 2.0,
    steps: int = 40,
    ending: str = "goal",
    *,
    goals: int | None = None,
    tilt: float = 0.0,
    turn: float = 0.0,
    collisions: str = "",
    dt: float = 0.05,
) -> Trajectory:
    """A straight drive of ``length`` m along x that turns by ``turn`` rad in total, with a constant ``tilt`` in rad."""
    driven, share = line(ending, end=(length, 0.0), steps=steps), torch.linspace(0, 1, steps + 1)
    yaw = torch.remainder(share * turn + math.pi, 2 * math.pi) - math.pi
    goals = int(ending == "goal") if goals is None else goals
    return replace(
        driven,
        angles=torch.stack((torch.full_like(share, tilt), torch.zeros_like(share), yaw), -1),
        collision=flags(collisions, steps),
        goal=torch.arange(steps) >= steps - goals,
        dt=dt,
    )


def flags(text: str, count: int) -> torch.Tensor:
    return torch.tensor([character == "x" for character in text.ljust(count)])


def at(x: float, yaw: float = 0.0, z: float = 0.0, pitch: float = 0.0) -> Trajectory:
    """An episode of one step in which the rover stands still."""
    position, angles = torch.tensor([[x, 0.0, z]]).repeat(2, 1), torch.tensor([[0.0, pitch, yaw]]).repeat(2, 1)
    return replace(line("time limit", steps=1), position=position, angles=angles)


def moving(speeds: list[float], yaw: float = 0.7, ending: str = "time limit") -> Trajectory:
    """A drive along a line with the given speeds, m/s."""
    along = torch.tensor([0.0, *speeds]).cumsum(0) * 0.05
    angles = torch.tensor([[0.0, 0.0, yaw]]).expand(len(along), 3)
    position = along[:, None] * torch.tensor([math.cos(yaw), math.sin(yaw), 0.0])
    goal = torch.arange(len(speeds)) == (len(speeds) - 1 if ending == "goal" else -1)
    return replace(line(ending, steps=len(speeds)), position=position, angles=angles, goal=goal)


def met(
    speeds: list[float], contact: str = "", gap: Any = 9.0, center: float = 9.0, ending: str = "goal"
) -> Trajectory:
    """A drive with what happens between rover and movers at the start and after each step."""
    states = len(speeds) + 1
    gaps = torch.tensor(gap) if isinstance(gap, list) else torch.full((states,), gap)
    encounters = Encounters(flags(contact, states), gaps, torch.full((states,), center))
    return replace(moving(speeds, 0.0, ending), encounters=encounters)


def row_of(trajectory: Trajectory, shortest: float = 2.0, walls: str = "") -> dict[str, Any]:
    return episode_row(trajectory, flags(walls, len(trajectory) + 1), shortest)


def found(*trajectories: Trajectory, shortest: float | list[float] = 2.0, endless: bool = False) -> dict[str, Estimate]:
    """Metrics of episodes in an empty world."""
    lengths = shortest if isinstance(shortest, list) else [shortest] * len(trajectories)
    return compute_metrics([row_of(*pair) for pair in zip(trajectories, lengths, strict=True)], endless)


def measured(*trajectories: Trajectory, **options) -> dict[str, float]:
    return {key: estimate.value for key, estimate in found(*trajectories, **options).items()}


def touched(trajectory: Trajectory, world: World = WALL) -> bool:
    return bool(find_body_contacts([trajectory], [world], [ROVER])[0].any())


# --- intervals


def test_wilson_interval() -> None:
    for successes, low, high in ((0, 0.0, 0.2775), (5, 0.2366, 0.7634), (10, 0.7225, 1.0)):
        estimate = proportion(successes, 10)
        assert estimate.value == successes / 10
        assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=1e-3)


@given(st.lists(st.floats(0, 100), min_size=2, max_size=40))
@settings(deadline=None, max_examples=20)
def test_a_mean_lies_in_its_interval(values: list[float]) -> None:
    estimate = ratio(values)
    assert estimate == ratio(values)
    assert estimate.value == pytest.approx(sum(values) / len(values))
    assert estimate.low - 1e-9 <= estimate.value <= estimate.high + 1e-9


def test_the_interval_of_a_mean_agrees_with_its_standard_error() -> None:
    values = torch.linspace(0, 1, 200, dtype=torch.float64)
    estimate = ratio(values.tolist())
    margin = 1.96 * values.std().item() / math.sqrt(200)
    assert (estimate.high - estimate.low) / 2 == pytest.approx(margin, rel=0.1)


@pytest.mark.parametrize(
    ("estimate", "value"),
    [
        (proportion(0, 0), math.nan),
        (ratio([1.0, 2.0], [0, 0]), math.nan),
        (ratio([math.nan, 1.0, 2.0]), math.nan),  # An undefined episode makes the ratio undefined.
        (ratio([3.0]), 3.0),
        (ratio([3.0, 0.0], [1, 0]), 3.0),
    ],
)
def test_an_undefined_value_and_one_episode_have_no_interval(estimate: Estimate, value: float) -> None:
    assert estimate.value == pytest.approx(value, nan_ok=True)
    assert math.isnan(estimate.low)
    assert math.isnan(estimate.high)


def test_resamples_without_a_denominator_are_left_out() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ratio([0.0, 0.0, 1.0, 2.0], [0, 0, 1, 1]) == Estimate(1.5, 1.0, 2.0)
    assert ratio([1.0] * 4, [1, 1, 0, 0]) == Estimate(2.0, 1.0, math.inf)
    assert ratio([0.5] * 7) == Estimate(0.5, 0.5, 0.5)


# --- metrics


def test_speed_and_duration_follow_from_the_step() -> None:
    slow, fast = drive(2.0, 40), drive(2.0, 40, dt=0.02)
    assert (slow.seconds, fast.seconds) == pytest.approx((2.0, 0.8))
    torch.testing.assert_close(fast.speed, torch.full((40,), 2.5))
    assert measured(fast, fast)["mean_time_to_traverse"] == pytest.approx(0.8)
    assert measured(fast, fast)["traverse_rate"] == pytest.approx(2.5)


def test_spl_and_times() -> None:
    drives = [drive(2.0), drive(2.0), drive(2.0, ending="stuck"), drive(2.0)]
    # A shortest path, a path of twice that length, a failure, and a path shorter than the computed shortest one.
    assert measured(*drives, shortest=[2.0, 1.0, 2.0, 3.0])["spl"] == pytest.approx((1 + 0.5 + 0 + 1) / 4)
    # Times of failures count for the traverse rate only.
    drives = [drive(steps=40), drive(steps=80), drive(steps=120, ending="time limit")]
    values = measured(*drives, shortest=1.5)
    assert values["mean_time_to_traverse"] == pytest.approx(3.0)
    assert values["traverse_rate"] == pytest.approx(3.0 / 12.0)
    assert math.isnan(measured(drives[2])["mean_time_to_traverse"])


def test_rough_ground_standstill_and_collisions() -> None:
    level, slope = drive(2.0, 40, tilt=math.radians(9)), drive(1.0, 40, tilt=math.radians(11))
    assert measured(level, slope)["velocity_over_rough_terrain"] == pytest.approx(0.5)
    assert math.isnan(measured(level)["velocity_over_rough_terrain"])
    assert measured(drive(2.0, 100), drive(0.01, 300, "stuck"))["standstill"] == pytest.approx(0.75)
    # Consecutive collision steps are one collision.
    drives = [drive(collisions="xx  x"), drive(collisions=" xxx"), drive(), drive(collisions="x x x")]
    assert measured(*drives)["collisions"] == pytest.approx((2 + 1 + 0 + 3) / 4)
    assert [count_runs(flags(text, 5)) for text in ("", "x   x", "xxxxx")] == [0, 2, 1]


def test_turns_count_both_directions_and_wrap_at_pi() -> None:
    left, right = drive(turn=3 * math.pi), drive(turn=-2 * math.pi)
    assert measured(left, right)["turns_per_goal"] == pytest.approx((1.5 + 1) / 2, rel=1e-5)
    circling = drive(turn=8 * math.pi, ending="time limit")
    assert measured(left, circling)["turns_per_goal"] == pytest.approx(5.5, rel=1e-5)
    assert math.isnan(measured(circling)["turns_per_goal"])


def test_jerk_is_the_root_mean_square_of_the_second_difference_of_the_speed() -> None:
    # Second differences of 0.2, -0.4 and 0.2 m/s.
    pulse = [0.0, 0.0, 0.2, 0.0, 0.0]
    expected = math.sqrt((0.2**2 + 0.4**2 + 0.2**2) / 3) / 0.05**2
    assert measured(moving(pulse))["jerk"] == pytest.approx(expected, rel=1e-3)
    assert measured(moving([0.1, 0.2, 0.3, 0.4]))["jerk"] == pytest.approx(0, abs=0.02)
    # All steps of all episodes count equally.
    both = found(moving(pulse), moving([1.0] * 5))["jerk"]
    assert both.value == pytest.approx(expected / math.sqrt(2), rel=1e-3)
    assert both.low <= both.value <= both.high
    # So is a reversal at the same pace. Second differences of -0.4 and 0.4 m/s.
    assert measured(moving([0.2, 0.2, -0.2, -0.2]))["jerk"] == pytest.approx(0.4 / 0.05**2, rel=1e-3)
    assert math.isnan(measured(moving([1.0] * 2))["jerk"])


def test_endless_metrics() -> None:
    long, early = drive(steps=2000, goals=20, ending="time limit"), drive(steps=400, goals=4, ending="jammed")
    values = measured(long, early, endless=True)
    assert "success_rate" not in values
    assert (values["goals_per_episode"], values["ended_early"]) == (12, 0.5)
    assert values["seconds_per_goal"] == pytest.approx(5)
    assert values["episode_seconds"] == pytest.approx(60)


def test_every_episode_has_exactly_one_ending() -> None:
    values = measured(*(drive(steps=2, ending=ending) for ending in ("goal", "goal", TIME_LIMIT, *EARLY_ENDINGS)))
    shares = [value for key, value in values.items() if key.startswith("ending_")]
    assert sum(shares) + values["success_rate"] == pytest.approx(1)
    assert set(values) <= set(METRICS)


# --- contacts of the body


@pytest.mark.parametrize(
    ("yaw", "reach"),
    [(0.0, 0.2635), (math.pi, 0.267), (math.pi / 2, 0.225), (-math.pi / 2, 0.225), (math.pi / 4, 0.3454)],
    ids=["front", "rear", "right", "left", "corner"],
)
def test_a_contact_is_where_the_outline_meets_a_wall(yaw: float, reach: float) -> None:
    assert touched(at(1 - reach - 0.005, yaw=yaw))
    assert not touched(at(1 - reach - 0.02, yaw=yaw))


def test_only_obstacles_at_the_height_of_the_wheel_hubs_are_touched() -> None:
    for bottom, top, expected in ((1.0, 3.0, True), (2.5, 3.0, False), (1.0, 2.1, False)):
        obstacle = box((0.0, 0.0, (bottom + top) / 2), (1.0, 1.0, top - bottom))
        assert touched(at(0.6, z=2.0), World("w", Terrain.flat((12.0, 12.0), 2.0), [obstacle])) == expected
    curb = World("curb", Terrain.flat((12.0, 12.0)), [box((1.0, 0.0, 0.0), (1.0, 4.0, 0.2))])
    assert not touched(at(0.25), curb)
    assert touched(at(0.25, pitch=0.2), curb)


def test_body_contacts_are_counted_per_run_and_per_episode() -> None:
    there_and_back = torch.cat([at(x).position for x in (0.0, 0.74, 0.0, 0.74, 0.0)])
    twice = replace(line("goal", steps=len(there_and_back) - 1), position=there_and_back)
    drives = [twice, replace(at(0.0), ending="goal")]
    walls = find_body_contacts(drives, [WALL] * 2, [ROVER] * 2)
    values = compute_metrics([episode_row(*pair, 1.0) for pair in zip(drives, walls, strict=True)])
    assert values["body_contacts"].value == 1
    assert values["body_contact_share"].value == values["contact_free_success_rate"].value == 0.5


# --- movers


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
        ([0.0, 0.0, 0.0, 1.0, 1.0], " x x x", 3, 2),
        ([1.0], "", 0, 0),
    ],
)
def test_a_rover_that_stands_still_is_run_into(speeds: list[float], contact: str, contacts: int, run_into: int) -> None:
    row = row_of(met(speeds, contact))
    assert (row["mover_contacts"], row["run_into"], row["at_fault"]) == (contacts, run_into, contacts - run_into)


def test_contacts_with_movers_count_as_contacts_and_are_told_apart_from_walls() -> None:
    values = measured(met([1.0] * 3, " x x"), met([1.0] * 3), met([1.0] * 3, "xx  ", ending="stuck"))
    assert values["contact_free_success_rate"] == pytest.approx(1 / 3)
    assert values["body_contact_share"] == values["mover_contact_share"] == pytest.approx(2 / 3)
    assert values["body_contacts"] == values["mover_contacts"] == pytest.approx(1)
    assert values["wall_contact_share"] == 0
    rows = [row_of(met([1.0] * 4, " xx  "), walls="  xx "), row_of(met([1.0] * 4), walls="x    ")]
    told = compute_metrics(rows)
    assert told["wall_contact_share"].value == 1
    assert told["mover_contact_share"].value == 0.5
    # A contact with a wall that follows one with a mover at once is part of it.
    assert told["body_contacts"].value == 1


def test_distances_and_times_near_movers() -> None:
    near = met([1.0, 0.0, 0.0, 1.0], gap=[0.3, 1.1, 1.3, 2.1, 0.4], center=0.45)
    row = row_of(near)
    assert row["least_mover_distance"] == pytest.approx(0.3)
    # Times are those of steps: what is near at their ends. The rover stands still at 1.3 and 2.1 m.
    assert row["risk_seconds"] == pytest.approx(4 * 0.05)
    assert row["intrusion_seconds"] == pytest.approx(2 * 0.05)
    assert row["frozen_seconds"] == pytest.approx(0.05)
    values = measured(near, met([1.0] * 4, gap=0.7, ending="stuck"))
    assert values["least_mover_distance"] == pytest.approx(0.5)
    assert values["risk_per_goal"] == pytest.approx(0.2)
    assert values["intrusion"] == pytest.approx(6 / 8)
    assert values["frozen"] == pytest.approx(1 / 8)
    assert math.isnan(measured(met([1.0], ending="stuck"))["risk_per_goal"])
