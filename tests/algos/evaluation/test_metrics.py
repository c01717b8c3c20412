"""Columns of episodes, metrics of them, their intervals, and contacts of the body."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl import World
from rover_rl.algos.driving import EARLY_ENDINGS, TIME_LIMIT
from rover_rl.algos.evaluation.metrics import METRICS, Estimate, compute_metrics, episode_row, proportion, ratio
from rover_rl.algos.evaluation.trajectory import Trajectory, count_runs, find_body_contacts
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
        collision=torch.tensor([c == "x" for c in collisions.ljust(steps)]),
        goal=torch.arange(steps) >= steps - goals,
        dt=dt,
    )


def at(x: float, yaw: float = 0.0, z: float = 0.0, pitch: float = 0.0) -> Trajectory:
    """An episode of one step in which the rover stands still."""
    position, angles = torch.tensor([[x, 0.0, z]]).repeat(2, 1), torch.tensor([[0.0, pitch, yaw]]).repeat(2, 1)
    return replace(line("time limit", steps=1), position=position, angles=angles)


def moving(speeds: list[float]) -> Trajectory:
    """A drive along a line with the given speeds, m/s, at a yaw of 0.7."""
    along = torch.tensor([0.0, *speeds]).cumsum(0) * 0.05
    angles = torch.tensor([[0.0, 0.0, 0.7]]).expand(len(along), 3)
    position = along[:, None] * torch.tensor([math.cos(0.7), math.sin(0.7), 0.0])
    return replace(line("time limit", steps=len(speeds)), position=position, angles=angles)


def found(*trajectories: Trajectory, shortest: float | list[float] = 2.0, endless: bool = False) -> dict[str, Estimate]:
    """Metrics of episodes in an empty world."""
    lengths = shortest if isinstance(shortest, list) else [shortest] * len(trajectories)
    pairs = zip(trajectories, lengths, strict=True)
    return compute_metrics([episode_row(t, torch.zeros(len(t) + 1, dtype=torch.bool), s) for t, s in pairs], endless)


def measured(*trajectories: Trajectory, **options) -> dict[str, float]:
    return {key: estimate.value for key, estimate in found(*trajectories, **options).items()}


def touched(trajectory: Trajectory, world: World = WALL, robot=ROVER) -> bool:
    return bool(find_body_contacts([trajectory], [world], [robot])[0].any())


def test_wilson_interval() -> None:
    for successes, low, high in ((0, 0.0, 0.2775), (5, 0.2366, 0.7634), (10, 0.7225, 1.0)):
        estimate = proportion(successes, 10)
        assert estimate.value == successes / 10
        assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=1e-3)


@given(st.lists(st.floats(0, 100), min_size=2, max_size=40))
@settings(deadline=None, max_examples=30)
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


def test_speed_and_duration_follow_from_the_step() -> None:
    slow, fast = drive(2.0, 40), drive(2.0, 40, dt=0.02)
    assert (slow.seconds, fast.seconds) == pytest.approx((2.0, 0.8))
    torch.testing.assert_close(fast.speed, torch.full((40,), 2.5))
    assert measured(fast, fast)["mean_time_to_traverse"] == pytest.approx(0.8)
    assert measured(fast, fast)["traverse_rate"] == pytest.approx(2.5)


def test_spl() -> None:
    drives = [drive(2.0), drive(2.0), drive(2.0, ending="stuck"), drive(2.0)]
    # A shortest path, a path of twice that length, a failure, and a path shorter than the computed shortest one.
    assert measured(*drives, shortest=[2.0, 1.0, 2.0, 3.0])["spl"] == pytest.approx((1 + 0.5 + 0 + 1) / 4)


def test_times_of_failures_count_for_the_traverse_rate_only() -> None:
    drives = [drive(steps=40), drive(steps=80), drive(steps=120, ending="time limit")]
    values = measured(*drives, shortest=1.5)
    assert values["mean_time_to_traverse"] == pytest.approx(3.0)
    assert values["traverse_rate"] == pytest.approx(3.0 / 12.0)
    assert math.isnan(measured(drives[2])["mean_time_to_traverse"])


def test_velocity_over_rough_terrain() -> None:
    level, slope = drive(2.0, 40, tilt=math.radians(9)), drive(1.0, 40, tilt=math.radians(11))
    assert measured(level, slope)["velocity_over_rough_terrain"] == pytest.approx(0.5)
    assert math.isnan(measured(level)["velocity_over_rough_terrain"])


def test_consecutive_collision_steps_are_one_collision() -> None:
    drives = [drive(collisions="xx  x"), drive(collisions=" xxx"), drive(), drive(collisions="x x x")]
    assert measured(*drives)["collisions"] == pytest.approx((2 + 1 + 0 + 3) / 4)


@given(st.lists(st.booleans(), max_size=30))
def test_count_runs(flags: list[bool]) -> None:
    text = "".join("x" if flag else " " for flag in flags)
    assert count_runs(torch.tensor(flags, dtype=torch.bool)) == len(text.split())


def test_turns_count_both_directions_and_wrap_at_pi() -> None:
    left, right = drive(turn=3 * math.pi), drive(turn=-2 * math.pi)
    assert measured(left, right)["turns_per_goal"] == pytest.approx((1.5 + 1) / 2, rel=1e-5)
    circling = drive(turn=8 * math.pi, ending="time limit")
    assert measured(left, circling)["turns_per_goal"] == pytest.approx(5.5, rel=1e-5)
    assert math.isnan(measured(circling)["turns_per_goal"])


def test_standstill_is_a_proportion_of_the_time() -> None:
    assert measured(drive(2.0, 100), drive(0.01, 300, "stuck"))["standstill"] == pytest.approx(0.75)


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
    for steps in (1, 2):
        assert math.isnan(measured(moving([1.0] * steps))["jerk"])


def test_endless_metrics() -> None:
    long, early = drive(steps=2000, goals=20, ending="time limit"), drive(steps=400, goals=4, ending="jammed")
    values = measured(long, early, endless=True)
    assert "success_rate" not in values
    assert (values["goals_per_episode"], values["ended_early"]) == (12, 0.5)
    assert values["seconds_per_goal"] == pytest.approx(5)
    assert values["episode_seconds"] == pytest.approx(60)


@given(st.lists(st.sampled_from(["goal", TIME_LIMIT, *EARLY_ENDINGS]), min_size=1, max_size=12))
@settings(deadline=None, max_examples=20)
def test_every_episode_has_exactly_one_ending(endings: list[str]) -> None:
    values = measured(*(drive(steps=2, ending=ending) for ending in endings))
    shares = [value for key, value in values.items() if key.startswith("ending_")]
    assert sum(shares) + values["success_rate"] == pytest.approx(1)
    assert set(values) <= set(METRICS)


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
