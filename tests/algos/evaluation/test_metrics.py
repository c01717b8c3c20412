from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_rl import World
from rover_rl.algos.evaluation import metrics
from rover_rl.algos.evaluation.metrics import METRICS, Estimate, proportion, ratio
from rover_rl.algos.evaluation.trajectory import Trajectory, count_runs, find_body_contacts
from rover_rl.robots import get_robot
from rover_rl.worlds import Terrain, box
from tests.algos.evaluation.drives import FIELD, line

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


def measured(*trajectories: Trajectory) -> dict[str, float]:
    """Metrics of endless episodes in an empty world."""
    found = metrics.endless_metrics(trajectories, find_body_contacts(trajectories, FIELD, ROVER))
    return {key: estimate.value for key, estimate in found.items()}


# --- intervals


def test_wilson_interval() -> None:
    for successes, low, high in ((0, 0.0, 0.2775), (5, 0.2366, 0.7634), (10, 0.7225, 1.0)):
        estimate = proportion(successes, 10)
        assert estimate.value == successes / 10
        assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=1e-3)


@given(st.integers(1, 500).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_a_proportion_lies_in_its_interval(case: tuple[int, int]) -> None:
    estimate = proportion(*case)
    assert 0 <= estimate.low <= estimate.value + 1e-12
    assert estimate.value - 1e-12 <= estimate.high <= 1


@given(st.lists(st.floats(0, 100), min_size=2, max_size=40))
@settings(deadline=None, max_examples=50)
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


def test_equal_episodes_have_an_interval_without_width() -> None:
    assert ratio([0.5] * 7) == Estimate(0.5, 0.5, 0.5)


def test_resamples_without_a_denominator_are_left_out() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ratio([0.0, 0.0, 1.0, 2.0], [0, 0, 1, 1]) == Estimate(1.5, 1.0, 2.0)


def test_an_interval_may_be_unbounded() -> None:
    assert ratio([1.0] * 4, [1, 1, 0, 0]) == Estimate(2.0, 1.0, math.inf)


# --- trajectories


def test_speed_and_duration_follow_from_the_step() -> None:
    slow, fast = drive(2.0, 40), drive(2.0, 40, dt=0.02)
    assert (slow.seconds, fast.seconds) == pytest.approx((2.0, 0.8))
    torch.testing.assert_close(slow.speed, torch.full((40,), 1.0))
    torch.testing.assert_close(fast.speed, torch.full((40,), 2.5))
    assert metrics.mean_time_to_traverse([fast, fast]).value == pytest.approx(0.8)
    assert metrics.traverse_rate([fast, fast], torch.tensor([2.0, 2.0])).value == pytest.approx(2.5)


# --- one goal


def test_success_rate_and_ending_share() -> None:
    trajectories = [drive(), drive(ending="time limit"), drive(ending="jammed"), drive()]
    assert metrics.ending_share(trajectories, "goal").value == 0.5
    assert metrics.ending_share(trajectories, "jammed", "flipped").value == 0.25


def test_spl() -> None:
    shortest = torch.tensor([2.0, 1.0, 2.0, 3.0])
    trajectories = [drive(2.0), drive(2.0), drive(2.0, ending="stuck"), drive(2.0)]
    # A shortest path, a path of twice that length, a failure, and a path shorter than the computed shortest one.
    assert metrics.spl(trajectories, shortest).value == pytest.approx((1 + 0.5 + 0 + 1) / 4)


def test_mean_time_to_traverse_covers_successes_only() -> None:
    trajectories = [drive(steps=40), drive(steps=80), drive(steps=1200, ending="time limit")]
    assert metrics.mean_time_to_traverse(trajectories).value == pytest.approx(3.0)
    assert math.isnan(metrics.mean_time_to_traverse(trajectories[2:]).value)


def test_traverse_rate_counts_the_time_but_not_the_length_of_failures() -> None:
    trajectories = [drive(steps=40), drive(steps=160, ending="time limit")]
    assert metrics.traverse_rate(trajectories, torch.tensor([1.5, 5.0])).value == pytest.approx(1.5 / 10)


def test_velocity_over_rough_terrain() -> None:
    level, slope = drive(2.0, 40, tilt=math.radians(9)), drive(1.0, 40, tilt=math.radians(11))
    assert metrics.velocity_over_rough_terrain([level, slope]).value == pytest.approx(0.5)
    assert math.isnan(metrics.velocity_over_rough_terrain([level]).value)


def test_consecutive_collision_steps_are_one_collision() -> None:
    trajectories = [drive(collisions="xx  x"), drive(collisions=" xxx"), drive(), drive(collisions="x x x")]
    assert measured(*trajectories)["collisions"] == pytest.approx((2 + 1 + 0 + 3) / 4)


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


def moving(speeds: list[float]) -> Trajectory:
    """A drive along a line with the given speeds, m/s, at a yaw of 0.7."""
    along = torch.tensor([0.0, *speeds]).cumsum(0) * 0.05
    angles = torch.tensor([[0.0, 0.0, 0.7]]).expand(len(along), 3)
    position = along[:, None] * torch.tensor([math.cos(0.7), math.sin(0.7), 0.0])
    return replace(line("time limit", steps=len(speeds)), position=position, angles=angles)


def test_jerk_is_the_root_mean_square_of_the_second_difference_of_the_speed() -> None:
    # Second differences of 0.2, -0.4 and 0.2 m/s.
    pulse = [0.0, 0.0, 0.2, 0.0, 0.0]
    expected = math.sqrt((0.2**2 + 0.4**2 + 0.2**2) / 3) / 0.05**2
    assert metrics.jerk([moving(pulse)]).value == pytest.approx(expected, rel=1e-3)
    assert metrics.jerk([moving([0.1, 0.2, 0.3, 0.4])]).value == pytest.approx(0, abs=0.02)
    # All steps of all episodes count equally.
    both = metrics.jerk([moving(pulse), moving([1.0] * 5)])
    assert both.value == pytest.approx(expected / math.sqrt(2), rel=1e-3)
    assert both.low <= both.value <= both.high

    # So is a reversal at the same pace. Second differences of -0.4 and 0.4 m/s.
    assert metrics.jerk([moving([0.2, 0.2, -0.2, -0.2])]).value == pytest.approx(0.4 / 0.05**2, rel=1e-3)


@pytest.mark.parametrize("steps", [1, 2])
def test_too_short_an_episode_has_no_jerk(steps: int) -> None:
    assert math.isnan(metrics.jerk([moving([1.0] * steps)]).value)
    assert metrics.jerk([moving([1.0] * steps), moving([0.5] * 4)]).value == pytest.approx(0, abs=0.02)


# --- endless mode


def test_endless_metrics() -> None:
    long, early = drive(steps=2000, goals=20, ending="time limit"), drive(steps=400, goals=4, ending="jammed")
    found = measured(long, early)
    assert found["goals_per_episode"] == 12
    assert found["seconds_per_goal"] == pytest.approx(5)
    assert found["episode_seconds"] == pytest.approx(60)
    assert found["ended_early"] == 0.5


# --- contacts of the body


@pytest.mark.parametrize(
    ("yaw", "reach"),
    [(0.0, 0.2635), (math.pi, 0.267), (math.pi / 2, 0.225), (-math.pi / 2, 0.225), (math.pi / 4, 0.3454)],
    ids=["front", "rear", "right", "left", "corner"],
)
def test_a_contact_is_where_the_outline_meets_a_wall(yaw: float, reach: float) -> None:
    near, far = at(1 - reach - 0.005, yaw=yaw), at(1 - reach - 0.02, yaw=yaw)
    assert find_body_contacts([near, far], WALL, ROVER)[0].all()
    assert not find_body_contacts([near, far], WALL, ROVER)[1].any()


def test_only_obstacles_at_the_height_of_the_wheel_hubs_are_touched() -> None:
    def touched(bottom: float, top: float) -> bool:
        obstacle = box((0.0, 0.0, (bottom + top) / 2), (1.0, 1.0, top - bottom))
        world = World("w", Terrain.flat((12.0, 12.0), 2.0), [obstacle])
        return bool(find_body_contacts([at(0.6, z=2.0)], world, ROVER)[0].any())

    assert touched(1.0, 3.0)
    assert not touched(2.5, 3.0)
    assert not touched(1.0, 2.1)


def test_a_rover_with_a_forward_tilt_touches_lower_obstacles() -> None:
    curb = World("curb", Terrain.flat((12.0, 12.0)), [box((1.0, 0.0, 0.0), (1.0, 4.0, 0.2))])
    assert not find_body_contacts([at(0.25)], curb, ROVER)[0].any()
    assert find_body_contacts([at(0.25, pitch=0.2)], curb, ROVER)[0].all()


def test_the_outline_is_that_of_the_robot(tmp_path: Path) -> None:
    urdf = tmp_path / "longer.urdf"
    urdf.write_text(ROVER.urdf.read_text().replace('"0.40 0.26 0.14"', '"0.74 0.26 0.14"'))
    longer = replace(ROVER, urdf=urdf, radius=0.5)
    assert not find_body_contacts([at(0.7)], WALL, ROVER)[0].any()
    assert find_body_contacts([at(0.7)], WALL, longer)[0].all()


def test_body_contacts_are_counted_per_run_and_per_episode() -> None:
    there_and_back = torch.cat([at(x).position for x in (0.0, 0.74, 0.0, 0.74, 0.0)])
    twice = replace(line("time limit", steps=len(there_and_back) - 1), position=there_and_back)
    trajectories = [twice, at(0.0)]
    contacts = find_body_contacts(trajectories, WALL, ROVER)
    found = metrics.goal_metrics(trajectories, torch.tensor([1.0, 1.0]), contacts)
    assert found["body_contacts"].value == 1
    assert found["body_contact_share"].value == 0.5


# --- all of them


ENDINGS = ["goal", metrics.TIME_LIMIT, *metrics.EARLY_ENDINGS]


@given(st.lists(st.sampled_from(ENDINGS), min_size=1, max_size=12))
@settings(deadline=None, max_examples=20)
def test_every_episode_has_exactly_one_ending(endings: list[str]) -> None:
    trajectories = [drive(steps=2, ending=ending) for ending in endings]
    contacts = find_body_contacts(trajectories, FIELD, ROVER)
    found = metrics.goal_metrics(trajectories, torch.ones(len(endings)), contacts)
    shares = [estimate.value for key, estimate in found.items() if key.startswith("ending_")]
    assert sum(shares) + found["success_rate"].value == pytest.approx(1)
    assert set(found) <= set(METRICS)
