"""Baselines that know of motion: what the tracker sees, ORCA, and the planners among what moves."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.algos.policy.dwa import LIDAR, DynamicWindowPolicy, MovingDynamicWindowPolicy
from rover_rl.algos.policy.grid_planner import GridPlanner, MovingGridPlanner
from rover_rl.algos.policy.orca import OrcaPolicy, half_planes
from rover_rl.algos.policy.predictive import PredictivePolicy
from rover_rl.algos.policy.runner import sensors_for
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.mover_tracker import STATE, TRACKS, MoverTracker, Tracks
from rover_rl.envs.seen_map.scans import reading_directions
from rover_rl.robots.built_in import ROVER_ZERO
from rover_rl.worlds import Terrain, World, box
from rover_rl.worlds.movers import Cylinder, Mover, Waypoints
from tests.algos.policy.crossings import crossing, drive


def watched(world: World, steps: int, action: tuple[float, float], rows: int = 1) -> tuple[RoverEnv, list]:
    """Drives with a constant action, tracks at 10 Hz, and returns the environment and all tracks."""
    env = RoverEnv(EnvConfig(world=world, num_envs=rows, backend="warp", lidar=LIDAR, seed=3))
    tracker, state, seen = MoverTracker(ROVER_ZERO, LIDAR, 0.1), torch.zeros(rows, TRACKS * STATE), []
    tensordict = env.reset(start=torch.zeros(rows, 3), goal=torch.full((rows, 2), 6.0))
    for step in range(steps):
        if step % 2 == 0:
            state, tracks = tracker(state, tensordict)
            seen.append(tracks)
        tensordict = env.step(tensordict.set("action", torch.tensor([action]).repeat(rows, 1)))["next"]
    return env, seen


class Tracked:
    """Tracks of a rover that rests with its lidar at the origin, at 10 Hz."""

    def __init__(self) -> None:
        self.tracker, self.state = MoverTracker(ROVER_ZERO, LIDAR, 0.1), torch.zeros(1, TRACKS * STATE)
        self.pose = -torch.tensor([[*ROVER_ZERO.lidar_position[:2], 0.0]])

    def __call__(self, lidar: Tensor) -> Tracks:
        before = self.state.clone()
        mask = (lidar >= 0).float()
        observation = {"lidar": lidar, "lidar_mask": mask, "pose": self.pose, "imu": torch.zeros(1, 3)}
        state, tracks = self.tracker(self.state, observation)
        assert torch.equal(self.state, before)
        self.state = state
        return tracks


def scan_of(*discs: tuple[float, float, float], wall: float = 1e3) -> Tensor:
    """Readings from the origin among discs (x, y, radius) and a wall at some y, ``[1, 128]``."""
    directions = reading_directions(LIDAR)
    ranges = wall / directions[:, 1].clamp(min=1e-6)
    for x, y, radius in discs:
        along = x * directions[:, 0] + y * directions[:, 1]
        under = radius**2 - (x**2 + y**2 - along.square())
        ranges = torch.where(
            (under > 0) & (along > 0), torch.minimum(ranges, along - under.clamp(min=0).sqrt()), ranges
        )
    return ranges.clamp(max=12.0)[None]


@pytest.mark.parametrize("action", [(0.0, 0.0), (0.5, 0.3)])
def test_the_tracker_finds_what_moves_and_how(action: tuple[float, float]) -> None:
    passing = Mover(Waypoints([(0.0, 3.0, -3.0, 1.57), (6.0, 3.0, 3.0, 1.57)]), Cylinder(0.5, 1.0))
    fixed = [box((-3.0, 1.0, 0.5), (0.6, 0.6, 1.0)), box((0.0, -6.0, 0.5), (8.0, 0.4, 1.0))]
    env, seen = watched(World("passing", Terrain.flat((20.0, 20.0)), fixed, movers=[passing]), 41, action)
    tracks = seen[-1]
    assert tracks.moves.sum() == 1
    position, velocity = (value[tracks.moves][0] for value in (tracks.position, tracks.velocity))
    # Two seconds at 1 m/s; the scan is two steps old.
    assert position.tolist() == pytest.approx([3.0, -1.0], abs=0.1)
    assert velocity.tolist() == pytest.approx([0.0, 1.0], abs=0.15)
    assert 0.4 < tracks.radius[tracks.moves].item() < 0.6
    assert tracks.readings.sum() >= 3
    env.close()


def test_tracks_do_not_depend_on_other_rows() -> None:
    passing = Mover(Waypoints([(0.0, 3.0, -3.0, 1.57), (6.0, 3.0, 3.0, 1.57)]), Cylinder(0.5, 1.0))
    world = World("passing", Terrain.flat((20.0, 20.0)), movers=[passing])
    (one_env, one), (two_env, two) = (watched(world, 20, (0.4, 0.1), rows) for rows in (1, 3))
    for a, b in zip(one, two, strict=True):
        assert torch.equal(a.moves[0], b.moves[0])
        assert torch.equal(a.position[0], b.position[0])
    one_env.close(), two_env.close()


def test_predictive_passes_what_it_sees_moving() -> None:
    assert drive(PredictivePolicy(), [crossing(1.0)]) == ["goal_reached"]


@pytest.mark.parametrize("policy", [OrcaPolicy(), MovingDynamicWindowPolicy()], ids=["orca", "dwa-moving"])
def test_who_tracks_what_moves_reaches_the_goal_more_often(policy: torch.nn.Module) -> None:
    worlds = [crossing(speed, phase, gate=False) for speed in (0.6, 1.4) for phase in (0.0, 0.7)]
    reached = drive(policy, worlds).count("goal_reached")  # type: ignore[arg-type]
    assert reached > drive(DynamicWindowPolicy(), worlds).count("goal_reached")


def test_the_planner_closes_the_way_of_what_moves() -> None:
    crossing_ahead = Mover(Waypoints([(0.0, 3.0, -3.0, 1.57), (6.0, 3.0, 3.0, 1.57)]), Cylinder(0.5, 1.0))
    world = World("ahead", Terrain.flat((20.0, 20.0)), movers=[crossing_ahead])
    routes = []
    for policy in (GridPlanner(), MovingGridPlanner()):
        config = EnvConfig(world=world, num_envs=1, backend="warp", lidar=policy.made_for.lidar, seed=3)
        env = RoverEnv(sensors_for(policy, config))
        tensordict = env.reset(start=torch.zeros(1, 3), goal=torch.tensor([[8.0, 0.0]]))
        for _ in range(21):
            tensordict = env.step(tensordict.set("action", torch.zeros(1, 2)))["next"]
        routes.append(tensordict["route"])
        env.close()
    # Straight ahead, or around the place where it will be when the rover is there.
    assert routes[0][0, 1].abs() < 0.05
    assert routes[1][0, 1].abs() > 0.05


def test_what_goes_where_no_beam_covers_is_hidden_not_gone() -> None:
    moving, ahead = [], reading_directions(LIDAR)[:, 0] > 0
    for reading in (12.0, -1.0):
        track = Tracked()
        for step in range(24):
            # It passes ahead. In the last 0.8 s, nothing ahead is seen.
            lidar = scan_of((3.0, 0.1 * step - 1.5, 0.3))
            tracks = track(lidar.masked_fill(ahead, reading) if step >= 16 else lidar)
        moving.append(int(tracks.moves.sum()))
    assert moving == [0, 1]


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.5])
def test_the_center_of_a_disc_is_found_in_any_direction(angle: float) -> None:
    track = Tracked()
    for step in range(12):
        aside = 0.1 * step - 0.5
        center = (3 * math.cos(angle) - aside * math.sin(angle), 3 * math.sin(angle) + aside * math.cos(angle))
        tracks = track(scan_of((*center, 0.5)))
    assert tracks.moves.sum() == 1
    assert tracks.position[tracks.moves][0].tolist() == pytest.approx(center, abs=0.05)
    assert tracks.radius[tracks.moves].item() == pytest.approx(0.5, abs=0.1)


def test_who_walks_behind_a_column_is_known_there_and_comes_back_as_the_same() -> None:
    track, column = Tracked(), (2.0, 0.0, 0.25)
    numbers = []
    for step in range(40):
        y = 0.1 * step - 2.0
        tracks = track(scan_of((4.0, y, 0.3), column))
        if step > 5:
            assert tracks.moves.sum() == 1
            assert tracks.position[tracks.moves][0].tolist() == pytest.approx([4.0, y], abs=0.25)
            numbers.append(tracks.moves.nonzero()[0, 1].item())
    assert len(set(numbers)) == 1


def test_the_shadow_on_a_wall_behind_who_walks_does_not_move() -> None:
    track = Tracked()
    for step in range(30):
        x = 0.1 * step - 1.5
        # A wall 4 m to the left.
        tracks = track(scan_of((x, 2.0, 0.3), wall=4.0))
        if step > 5:
            assert tracks.moves.sum() == 1
            assert tracks.position[tracks.moves][0].tolist() == pytest.approx((x, 2.0), abs=0.15)


def test_an_empty_scan_ends_what_should_be_seen() -> None:
    track = Tracked()
    for step in range(10):
        tracks = track(scan_of((3.0, 0.1 * step - 0.5, 0.5)))
    assert tracks.moves.any()
    for _ in range(4):
        tracks = track(torch.full((1, 128), 12.0))
    assert not tracks.moves.any()
    assert not track.state.any()
    # A lidar that is covered measures nothing.
    assert track(torch.zeros(1, 128)).position.isfinite().all()


@pytest.mark.parametrize(
    ("position", "velocity", "own", "expected"),
    [
        # Nothing comes near: the own velocity is allowed.
        ((3.0, 0.0), (0.0, 0.0), (-1.0, 0.0), 0.0),
        ((3.0, 3.0), (1.0, 1.0), (0.0, 0.0), 0.0),
        # Straight at an obstacle with a radius of 1 m that is reached within the time: the cone's leg is 30 degrees
        # aside, whose distance is sin(30 degrees).
        ((2.0, 0.0), (0.0, 0.0), (1.0, 0.0), 0.5),
        # It comes as fast towards the rover.
        ((2.0, 0.0), (-1.0, 0.0), (0.0, 0.0), 0.5),
    ],
)
def test_half_planes_of_orca(
    position: tuple[float, float], velocity: tuple[float, float], own: tuple[float, float], expected: float
) -> None:
    point, normal = half_planes(
        torch.tensor([[position]]),
        torch.tensor([[velocity]]),
        torch.tensor([[1.0]]),
        torch.tensor([[4.0]]),
        torch.tensor([own]),
    )
    assert normal.norm().item() == pytest.approx(1.0)
    violation = ((point[0, 0] - torch.tensor(own)) * normal[0, 0]).sum().item()
    assert max(violation, 0.0) == pytest.approx(expected, abs=1e-5)


def test_orca_ends_a_contact_soon() -> None:
    point, normal = half_planes(
        torch.tensor([[(0.8, 0.0)]]), torch.zeros(1, 1, 2), torch.ones(1, 1), torch.ones(1, 1), torch.zeros(1, 2)
    )
    # Away from the obstacle, by 0.2 m in 0.2 s.
    assert normal[0, 0].tolist() == pytest.approx([-1.0, 0.0])
    assert (point[0, 0] * normal[0, 0]).sum().item() == pytest.approx(1.0)
    assert math.isfinite(point.sum().item())
