"""Movers that walk keep off walls, paths are as given, and their statistics are as documented."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

from rover_rl.worlds import Terrain, World, box, get_world, movers
from rover_rl.worlds.movers import (
    Cross,
    Cylinder,
    Motion,
    Mover,
    Orca,
    Person,
    Rovers,
    SocialForce,
    Walk,
    Wander,
    Waypoints,
)
from tests.pages import documented
from tests.worlds.movers.crowds import DT, ROVER_RADIUS, begun, rovers_at, walk, yard

MOTIONS = [Wander(), Cross(), SocialForce(), Orca()]
CENTER = ((-4.0, 4.0), (-3.0, 3.0))


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
def test_movers_start_free_and_do_not_enter_walls(motion: Motion) -> None:
    maze = replace(get_world("maze"), movers=[Mover(motion, Cylinder(0.3))] * 20)
    rovers = torch.tensor([[-5.0, -5.0], [0.0, 0.0]]).repeat(8, 1)
    field = begun([maze] * 16, rovers=rovers)
    gaps = (field.state.position - rovers[:, None]).norm(dim=-1)
    assert gaps.min() > 1.5 + 0.3 + ROVER_RADIUS - 1e-4
    apart = torch.cdist(field.state.position, field.state.position) + torch.eye(20)
    assert apart.min() > 0.6 - 1e-4
    points = walk(begun([maze] * 2, 4), 300).reshape(-1, 2)
    angles = torch.arange(16) * math.pi / 8
    around = points[:, None] + 0.28 * torch.stack((angles.cos(), angles.sin()), -1)
    assert not maze.inside(torch.nn.functional.pad(around, (0, 1), value=0.5)).any()
    for k, (low, high) in enumerate(maze.bounds):
        assert (points[:, k] - (low + high) / 2).abs().max() < (high - low) / 2 - 0.28


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
def test_the_heading_turns_to_the_direction_of_walking_at_a_limited_rate(motion: Motion) -> None:
    yaws = walk(begun([yard([Mover(motion, Person())] * 8, 8.0)]), 200, keep="yaw")[:, 0]
    turns = torch.remainder(yaws.diff(dim=0) + math.pi, 2 * math.pi) - math.pi
    assert turns.abs().max() < math.pi * DT + 1e-4
    field = begun([yard([Mover(motion)] * 8, 100.0)] * 4)
    walk(field, 200)
    velocity, yaw = field.state.velocity, field.state.yaw
    along = (velocity * torch.stack((yaw.cos(), yaw.sin()), -1)).sum(-1) / velocity.norm(dim=-1)
    assert (along > 0.98).float().mean() > 0.7


def test_a_wanderer_keeps_its_speed_and_turns_as_often_as_set() -> None:
    field = begun([yard([Mover(Wander(speed=0.8, turn_time=2.0))] * 40, 400.0)] * 8)
    velocity = walk(field, 200, keep="velocity")
    assert (velocity.norm(dim=-1) - 0.8).abs().max() < 2e-3
    turns = (velocity.diff(dim=0).norm(dim=-1) > 0.02).sum().item()
    # 1592 turns are expected in 320 x 10 s: a standard deviation is 2.5 %.
    assert turns == pytest.approx(320 * 199 * DT / 2.0, rel=0.08)


def test_a_wanderer_bounces_off_walls_and_stays_in_its_area() -> None:
    field = begun([yard([Mover(Wander(speed=1.5, turn_time=1e5, area=CENTER))] * 32)] * 4)
    points = walk(field, 300)
    for k, (low, high) in enumerate(CENTER):
        assert low - 0.02 < points[..., k].min()
        assert points[..., k].max() < high + 0.02
    # It is everywhere in the area for as long.
    assert (points[..., 0] < -2.0).float().mean().item() == pytest.approx(0.25, abs=0.06)
    assert (points.diff(dim=0).norm(dim=-1) / DT).mean() == pytest.approx(1.5, rel=0.02)


def test_goals_are_uniform_in_their_area() -> None:
    goal = ((-2.0, 6.0), (-6.0, 2.0))
    field = begun([yard([Mover(Cross(speed=8.0, goal=goal))] * 32)] * 16)
    goals = walk(field, 100, keep="goal")
    drawn = goals[1:][(goals.diff(dim=0) != 0).any(-1)]
    assert len(drawn) > 1500
    assert drawn.mean(0).tolist() == pytest.approx([2.0, -2.0], abs=0.25)
    assert drawn.std(0).tolist() == pytest.approx([8 / math.sqrt(12)] * 2, rel=0.06)


def test_a_mover_goes_to_and_fro_between_its_places_and_rests_there() -> None:
    motion = Cross(speed=1.0, start=(-3.0, 0.0), goal=(3.0, 0.0), pause=2.0)
    field = begun([yard([Mover(motion)])], rovers=torch.tensor([[0.0, 5.0]]))
    assert field.state.position[0, 0].tolist() == [-3.0, 0.0]
    x = walk(field, 480)[:, 0, 0, 0]
    assert x.max() > 2.79
    assert x[x.argmax() :].min() < -2.79
    # It rests 2 s after each way of 5.6 to 5.8 m.
    assert (x.diff().abs() < 1e-6).float().mean().item() == pytest.approx(2.0 / 7.7, abs=0.06)
    # It walks around a pillar.
    motion, pillar = Cross(start=(-4.0, 0.0), goal=(4.0, 0.1)), box((0.0, 0.0, 0.5), (1.0, 1.5, 1.0))
    field = begun([yard([Mover(motion, Cylinder(0.3))], obstacles=[pillar])], rovers=torch.tensor([[0.0, 8.0]]))
    assert (walk(field, 200)[:, 0, 0] - torch.tensor([4.0, 0.1])).norm(dim=-1).min() < 0.21


def test_a_mover_that_makes_no_way_takes_another_goal() -> None:
    motion = Cross(goal=(0.0, 0.0), start=(-4.0, 0.0), patience=2.0)
    cell = [box((x, y, 0.5), size) for x, y, size in ((0, 2, (5, 1, 1)), (0, -2, (5, 1, 1)), (2, 0, (1, 5, 1)))]
    closed = [*cell, box((-2.0, 0.0, 0.5), (1.0, 5.0, 1.0))]
    field = begun([yard([Mover(motion, Cylinder(0.3))], obstacles=closed)], rovers=torch.tensor([[0.0, 8.0]]))
    draws = walk(field, 300, keep="draws")[:, 0, 0]
    assert draws[40] == 2
    assert draws[-1] >= 4


def test_a_path_there_and_back_keeps_its_speed_and_heading_and_rests() -> None:
    field = begun([yard([Mover(Waypoints.there_and_back((0.0, 2.0), (3.0, 2.0), speed=1.5, pause=1.0, yaw=0.5))])])
    points = walk(field, 120)[:, 0, 0]
    # 2 s there, 1 s of rest, 2 s back, 1 s of rest.
    for time, x in ((1.0, 1.5), (2.0, 3.0), (3.0, 3.0), (4.0, 1.5), (5.0, 0.0), (6.0, 0.0)):
        assert points[round(time / DT) - 1].tolist() == pytest.approx([x, 2.0], abs=1e-5)
    assert field.state.yaw.item() == 0.5


def test_random_starts_on_a_path_are_uniform() -> None:
    motion = Waypoints.there_and_back((0.0, 0.0), (1.0, 0.0), random_start=True)
    x = begun([yard([Mover(motion)] * 8)] * 100).state.position[..., 0]
    assert x.mean() == pytest.approx(0.5, abs=0.05)
    assert x.std() == pytest.approx(1 / math.sqrt(12), abs=0.03)


def test_the_edge_of_a_door_stays_at_the_hinge() -> None:
    motion = Waypoints.door(hinge=(1.0, 2.0), width=0.8, closed=0.3, opening=-1.5, period=4.0, pause=0.5)
    field = begun([yard([Mover(motion, movers.Box(0.8, 0.05, 2.0))])])
    angles = []
    for _ in range(80):
        walk(field, 1)
        yaw = field.state.yaw[0, 0]
        edge = field.state.position[0, 0] - 0.4 * torch.stack((yaw.cos(), yaw.sin()))
        assert edge.tolist() == pytest.approx([1.0, 2.0], abs=3e-4)
        angles.append(yaw.item())
    assert [angles[29], angles[39], angles[-1]] == pytest.approx([-1.2, -1.2, 0.3], abs=1e-5)


@dataclass(frozen=True)
class Circle(documented("movers.md", "Circle")):  # type: ignore[misc]
    """The motion of ``docs/movers.md``. Its goal is the direction away from the nearest wall."""

    has_walls: ClassVar[bool] = True

    @classmethod
    def at(cls, inputs: movers.MotionInput, first: Tensor) -> movers.MoverState:
        state = super().at(inputs, first)
        return replace(state, goal=inputs.walls.at(state.position)[1])


def test_an_own_motion_moves_beside_those_of_the_package_with_its_own_random_numbers() -> None:
    three = [Mover(Circle(radius=3.0, speed=0.5)), Mover(SocialForce(), Cylinder(0.3)), Mover(Circle())]
    field = begun([yard(three), yard(three[1:])], rovers=torch.full((2, 2), 8.0))
    points = walk(field, 100)[:, 0, 0]
    assert points.norm(dim=-1).tolist() == pytest.approx([3.0] * 100, abs=1e-4)
    assert (points.diff(dim=0).norm(dim=-1) / DT).mean() == pytest.approx(0.5, rel=1e-3)
    x, y = field.state.goal[0, 0].tolist()
    assert abs(x) + abs(y) == 0.0, "no wall is near"
    # Whatever types it returns.
    assert field.state.position.dtype == field.state.yaw.dtype == torch.float32
    assert field.state.clock[0, 0] != field.state.clock[0, 2]


@pytest.mark.parametrize(
    ("motion", "arguments", "message"),
    [
        (Cross, {"speed": math.nan}, "speed must be positive and at most 10, got nan"),
        (Cross, {"pause": -1.0}, "pause must be at least 0"),
        (Cross, {"patience": 0.0}, "patience must be positive"),
        (Cross, {"start": ((1.0, 0.0), (0.0, 1.0))}, "start must be a point"),
        (Cross, {"goal": (0.0, math.inf)}, "goal must be a point"),
        (Cross, {"goal": "here"}, "goal must be a point"),
        (Wander, {"turn_time": 0.0}, "turn_time must be positive"),
        (Wander, {"area": (0.0, 1.0)}, "area must be"),
        (Orca, {"horizon": 0.0}, "horizon must be positive"),
        (SocialForce, {"behind": 2.0}, "behind must be at least 0 and at most 1"),
        (Waypoints.there_and_back, {"start": (0.0, 0.0), "to": (0.0, 0.0)}, "start and to must be different"),
        (Waypoints.there_and_back, {"start": (0.0, 0.0), "to": (math.nan, 0.0)}, "keyframes must be finite"),
        (Waypoints.door, {"hinge": (0.0, 0.0), "period": 4.0, "pause": 2.0}, "period must be longer than two pauses"),
    ],
)
def test_wrong_settings_are_told_in_a_sentence(motion: Any, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        motion(**arguments)


def test_a_fixed_start_inside_an_obstacle_is_refused() -> None:
    with pytest.raises(ValueError, match="'mover' of world 'yard' starts at .* inside an obstacle"):
        yard([Mover(Cross(start=(0.0, 0.0)))], obstacles=[box((0.0, 0.0, 0.5), (1.0, 1.0, 1.0))])


# Independence, to the last bit


RESTLESS = [
    Wander(turn_time=1.0),
    Cross(patience=1.0, pause=0.3),
    SocialForce(patience=1.0, pause=0.3),
    Orca(patience=1.0, pause=0.3),
    Waypoints.there_and_back((0.0, 0.0), (4.0, 3.0), random_start=True),
]
PILLARS = [box((x, y, 0.5), (2.0, 1.0, 1.0)) for x in (-3.0, 3.0) for y in (-2.5, 2.5)]


def circling(rows: int, seed: int, step: int) -> Tensor:
    """Points of rovers that depend on the seed of the row and on the step, ``[rows, 2]``."""
    turn = torch.arange(seed, seed + rows) + 0.02 * step
    # Powers of the angle: sines may differ in the last bit.
    return torch.stack((torch.remainder(turn, 6) - 3, torch.remainder(0.5 * turn, 4) - 2), -1)


@pytest.mark.parametrize("motion", RESTLESS, ids=lambda motion: type(motion).__name__)
def test_a_row_alone_is_as_it_is_in_a_batch(motion: Motion) -> None:
    # Some rows fill the processor's vectors, and the last one is left over.
    rows = 33
    world = yard([Mover(motion, Cylinder(0.3))] * 5, 12.0, PILLARS)
    # Other rows have more movers, of other motions, too.
    crowded = yard([Mover(Waypoints([(0.0, 1.0, 1.0, 0.0)])), *[Mover(motion, Cylinder(0.2))] * 7], 14.0)
    row = rows - 3
    alone = begun([world], seed=row, rovers=circling(1, row, 0))
    batch = begun([crowded if k != row and k % 3 else world for k in range(rows)], rovers=circling(rows, 0, 0))
    again = (torch.arange(rows) % 2 == 0)[:, None]
    again[row] = False
    for step in range(80):
        if step == 40:
            batch.reset(again, torch.arange(rows)[:, None], circling(rows, 0, step))
        alone.advance(None, rovers_at(circling(1, row, step)))
        batch.advance(None, rovers_at(circling(rows, 0, step)))
    for name in ("position", "yaw", "velocity", "goal", "clock", "draws"):
        assert torch.equal(getattr(alone.state, name)[0], getattr(batch.state, name)[row, :5]), name
    assert torch.equal(alone.parts.position[0], batch.parts.position[row, :5])


@pytest.mark.parametrize("motion", RESTLESS, ids=lambda motion: type(motion).__name__)
def test_rows_in_which_no_time_passes_stay_and_all_movers_are_elsewhere(motion: Motion) -> None:
    field = begun([yard([Mover(motion)] * 3)] * 2)
    before = field.state.position
    for _ in range(30):
        field.advance(torch.tensor([[True], [False]]), rovers_at(torch.zeros(2, 2)))
    assert torch.equal(field.state.position[1], before[1])
    assert not torch.equal(field.state.position[0], before[0])
    points = walk(field, 20)[-1].reshape(-1, 2)
    assert len(points.unique(dim=0)) == 6


# Reactive motions: what their papers show


RADIUS = 0.3
AWAY = torch.tensor([[0.0, 9.0]])


def pairwise_gap(points: Tensor) -> float:
    """Returns the least distance between the surfaces of movers at ``points [steps, M, 2]``, m."""
    return (torch.cdist(points, points) + 10 * torch.eye(points.shape[1])).min().item() - 2 * RADIUS


@pytest.mark.parametrize(("motion", "least"), [(Orca, 0.0), (SocialForce, -0.02)])
def test_two_that_meet_head_on_pass(motion: type[Walk], least: float) -> None:
    ends = [(-4.0, 0.0), (4.0, 0.0)]
    movers = [Mover(motion(start=a, goal=b), Cylinder(RADIUS)) for a, b in (ends, ends[::-1])]
    field = begun([yard(movers)], rovers=AWAY)
    points = walk(field, 200, lambda _: rovers_at(AWAY))[:, 0]
    assert pairwise_gap(points) > least
    assert (points - torch.tensor(ends[::-1])).norm(dim=-1).min(0).values.max() < 0.21


def test_eight_on_a_circle_reach_the_other_side_without_contact() -> None:
    angles = [2 * math.pi * k / 8 for k in range(8)]
    starts = [(5 * math.cos(angle), 5 * math.sin(angle)) for angle in angles]
    movers = [Mover(Orca(start=(x, y), goal=(-x, -y)), Cylinder(RADIUS)) for x, y in starts]
    points = walk(begun([yard(movers)], 1, AWAY), 300, lambda _: rovers_at(AWAY))[:, 0]
    assert pairwise_gap(points) > 0.0
    assert (points + torch.tensor(starts)).norm(dim=-1).min(0).values.max() < 0.21


def oncoming(step: int) -> Rovers:
    """Returns a rover that drives from x = 5 toward -x at 1 m/s."""
    return rovers_at(torch.tensor([[5.0 - step * DT, 0.05]]), torch.tensor([[-1.0, 0.0]]))


def rover_gap(motion: Walk) -> float:
    """Returns the least distance between the surfaces of a mover that walks toward +x and the oncoming rover, m."""
    field = begun([yard([Mover(motion, Cylinder(RADIUS))])], rovers=AWAY)
    points = walk(field, 160, oncoming)[:, 0, 0]
    rovers = torch.cat([oncoming(step + 1).position[0] for step in range(160)])
    return (points - rovers).norm(dim=-1).min().item() - RADIUS - ROVER_RADIUS


@pytest.mark.parametrize("motion", [Orca, SocialForce])
def test_movers_evade_the_rover_that_they_see(motion: type[Walk]) -> None:
    assert rover_gap(motion(start=(-4.0, 0.0), goal=(4.0, 0.0))) > -1e-3
    assert rover_gap(motion(start=(-4.0, 0.0), goal=(4.0, 0.0), sees_rover=False)) < -0.3  # type: ignore[call-arg]


def lane_order(points: Tensor, directions: Tensor, length: float) -> float:
    """Returns the mean of ``((same - others) / (same + others))^2`` over walkers, 1 in perfect lanes.

    ``same`` and ``others`` count those in the same and in the opposite direction within 0.8 m to the sides and 6 m
    ahead and behind (as M. Rex and H. Loewen, "Lane formation in oppositely charged colloids driven by an electric
    field", Physical Review E 75 (2007) 051402).
    """
    offset = points[..., :, None, :] - points[..., None, :, :]
    x = torch.remainder(offset[..., 0] + length / 2, length) - length / 2
    near = (offset[..., 1].abs() < 0.8) & (x.abs() < 6.0) & ~torch.eye(len(directions), dtype=torch.bool)
    same = (near & (directions[:, None] == directions)).sum(-1)
    others = near.sum(-1) - same
    return ((same - others) / (same + others).clamp(min=1)).square().mean().item()


def test_lanes_form_in_a_corridor_with_two_directions() -> None:
    """As in figure 2 of Helbing and Molnar (1995): 0.3 persons per m^2 in a periodic corridor."""
    length, width, count = 40.0, 5.0, 60
    start = ((-length / 2, length / 2), (-width / 2 + 0.4, width / 2 - 0.4))
    motions = [
        SocialForce(speed=1.34, start=start, goal=((300 * s, 300 * s + 1), (-width / 2, width / 2)), patience=1e5)
        for s in (1.0, -1.0)
    ]
    movers = [Mover(motion, Cylinder(0.23)) for motion in motions for _ in range(count // 2)]
    corridor = World("corridor", Terrain.flat((length + 20, width)), movers=movers, spawn_range=start)
    away = torch.full((2, 2), 1000.0)
    field = begun([corridor] * 2, rovers=away)
    directions = torch.tensor([1.0, -1.0]).repeat_interleave(count // 2)
    before = lane_order(field.state.position, directions, length)
    slow = float(0)
    for step in range(800):
        field.advance(None, rovers_at(away))
        if step == 100:
            slow = (field.state.velocity[..., 0] * directions).mean().item()
        x, y = field.state.position.unbind(-1)
        x = torch.remainder(x + length / 2, length) - length / 2
        field.state = replace(field.state, position=torch.stack((x, y), -1))
    assert before < 0.3
    assert lane_order(field.state.position, directions, length) > 0.6
    # In lanes, they walk faster than while the directions are mixed.
    assert (field.state.velocity[..., 0] * directions).mean().item() > max(slow, 1.2)
