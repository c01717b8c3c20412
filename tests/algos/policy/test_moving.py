"""Baselines that know of motion: what the tracker sees, ORCA, and the planners among what moves."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.algos.policy.dwa import LIDAR, DynamicWindowPolicy, MovingDynamicWindowPolicy
from rover_rl.algos.policy.grid_actions import ACTIONS, TURNS
from rover_rl.algos.policy.grid_planner import GridPlanner, MovingGridPlanner
from rover_rl.algos.policy.networks import action_spec
from rover_rl.algos.policy.orca import OrcaPolicy, half_planes
from rover_rl.algos.policy.predictive import InformedPredictive, PredictivePolicy
from rover_rl.algos.policy.runner import sensors_for
from rover_rl.envs.config import EnvConfig
from rover_rl.envs.mover_tracker import STATE, TRACKS, MoverTracker, Tracks
from rover_rl.envs.seen_map.scans import reading_directions
from rover_rl.robots.built_in import ROVER_ZERO
from rover_rl.worlds import Terrain, World, box
from rover_rl.worlds.movers import Cylinder, Mover, Waypoints
from tests.algos.policy.crossings import across, crossing

PASSING = Mover(Waypoints([(0.0, 3.0, -3.0, 1.57), (6.0, 3.0, 3.0, 1.57)]), Cylinder(0.5, 1.0))
FIXED = [box((-3.0, 1.0, 0.5), (0.6, 0.6, 1.0)), box((0.0, -6.0, 0.5), (8.0, 0.4, 1.0))]
AHEAD = World("ahead", Terrain.flat((20.0, 20.0)), FIXED, movers=[PASSING])


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
        hit = torch.minimum(ranges, along - under.clamp(min=0).sqrt())
        ranges = torch.where((under > 0) & (along > 0), hit, ranges)
    return ranges.clamp(max=12.0)[None]


@pytest.mark.parametrize("action", [(0.0, 0.0), (0.5, 0.3)])
def test_the_tracker_finds_what_moves_and_how_whatever_the_other_rows(action: tuple[float, float]) -> None:
    found = []
    for rows in (1, 2):
        env = RoverEnv(EnvConfig(world=AHEAD, num_envs=rows, backend="warp", lidar=LIDAR, seed=3))
        tracker, state = MoverTracker(ROVER_ZERO, LIDAR, 0.1), torch.zeros(rows, TRACKS * STATE)
        observation = env.reset(start=torch.zeros(rows, 3), goal=torch.full((rows, 2), 6.0))
        for step in range(41):
            if step % 2 == 0:
                state, tracks = tracker(state, observation)
            observation = env.step(observation.set("action", torch.tensor([action]).repeat(rows, 1)))["next"]
        found.append(tracks)
    moves = found[0].moves[0]
    assert moves.sum() == 1
    for one, two in zip(*found, strict=True):
        assert torch.equal(one[0], two[0])
    position, velocity, radius = (value[0][moves][0] for value in found[0][:3])
    # Two seconds at 1 m/s; the scan is two steps old.
    assert position.tolist() == pytest.approx([3.0, -1.0], abs=0.1)
    assert velocity.tolist() == pytest.approx([0.0, 1.0], abs=0.15)
    assert 0.4 < radius.item() < 0.6
    assert found[0].readings.sum() >= 3


def test_predictive_passes_what_it_sees_moving() -> None:
    assert across(PredictivePolicy(), [crossing(1.0)], goal=(-1.5, 0.0)) == 1


def test_predictive_decides_the_same_in_any_batch_and_with_any_number_of_threads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    policy = PredictivePolicy()
    config = EnvConfig(world=AHEAD, num_envs=9, backend="warp", lidar=policy.made_for.lidar, seed=3)
    env = RoverEnv(sensors_for(policy, config, action_repeat=2))
    observation = env.reset()
    for _ in range(14):
        observation = env.step(observation.set("action", torch.tensor([[0.5, 0.3]] * 9)))["next"]
    assert observation["movers"].any()
    together = policy(observation.copy())["action"]
    for row in range(0, 9, 4):
        assert torch.equal(policy(observation[row : row + 1].copy())["action"], together[row : row + 1])
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    assert torch.equal(policy(observation.copy())["action"], together)


def test_the_informed_planner_labels_what_its_privileged_observation_allows() -> None:
    open_ground = World("open", Terrain.flat((20.0, 20.0)))
    env = RoverEnv(EnvConfig(world=open_ground, num_envs=3, backend="warp", privileged=True, seed=3))
    observation = env.reset(start=torch.zeros(3, 3), goal=torch.tensor([[8.0, 0.0]] * 3))
    # Something comes from ahead in the second row alone. No sensor has seen it.
    observation["privileged", "movers"][1, :5] = torch.tensor([2.0, 0.0, -1.0, 0.0, 0.5])
    expert, space = InformedPredictive(env.pool, "rover_zero"), action_spec(env.config.action).space
    labels = expert.labels(observation, space.low, space.high)
    torch.testing.assert_close(labels.sum(-1), torch.ones(3))
    assert torch.equal(labels[0], labels[2])
    assert labels[0].argmax() == ACTIONS - 1 - TURNS // 2  # straight ahead
    assert labels[1, ACTIONS - 1 - TURNS // 2] < 0.01
    assert torch.equal(expert.labels(observation[1:2], space.low, space.high), labels[1:2])
    # Without backward speeds, what they weigh goes to those that are left.
    forward = expert.labels(observation, torch.tensor([0.0, -math.pi]), space.high)
    torch.testing.assert_close(forward.sum(-1), torch.ones(3))


def test_who_tracks_what_moves_reaches_the_goal_more_often() -> None:
    worlds = [crossing(1.0, gate=False)]
    blind = across(DynamicWindowPolicy(), worlds)
    for policy in (OrcaPolicy(), MovingDynamicWindowPolicy()):
        assert across(policy, worlds) > blind


def test_the_planner_closes_the_way_of_what_moves() -> None:
    routes = []
    for policy in (GridPlanner(), MovingGridPlanner()):
        config = EnvConfig(world=AHEAD, num_envs=1, backend="warp", lidar=policy.made_for.lidar, seed=3)
        env = RoverEnv(sensors_for(policy, config))
        observation = env.reset(start=torch.zeros(1, 3), goal=torch.tensor([[8.0, 0.0]]))
        for _ in range(21):
            observation = env.step(observation.set("action", torch.zeros(1, 2)))["next"]
        routes.append(observation["route"])
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


@pytest.mark.parametrize("behind", [True, False], ids=["a column in front", "a wall behind"])
def test_who_walks_is_known_behind_a_column_and_in_front_of_a_wall_as_the_same(behind: bool) -> None:
    track, numbers = Tracked(), set()
    for step in range(40):
        x, y = (4.0, 0.1 * step - 2.0) if behind else (0.1 * step - 1.5, 2.0)
        # The shadow on the wall, 4 m to the left, does not move.
        tracks = track(scan_of((x, y, 0.3), (2.0, 0.0, 0.25)) if behind else scan_of((x, y, 0.3), wall=4.0))
        if 5 < step < (40 if behind else 30):
            assert tracks.moves.sum() == 1
            assert tracks.position[tracks.moves][0].tolist() == pytest.approx((x, y), abs=0.25 if behind else 0.15)
            numbers.add(tracks.moves.nonzero()[0, 1].item())
    assert len(numbers) == 1


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
        # A contact ends within 0.2 s, away from the obstacle by 0.2 m.
        ((0.8, 0.0), (0.0, 0.0), (0.0, 0.0), 1.0),
    ],
)
def test_half_planes_of_orca(position, velocity, own, expected: float) -> None:
    place, motion, radius, seconds = (torch.tensor([[value]]) for value in (position, velocity, 1.0, 4.0))
    point, normal = half_planes(place, motion, radius, seconds, torch.tensor([own]))
    assert normal.norm().item() == pytest.approx(1.0)
    violation = ((point[0, 0] - torch.tensor(own)) * normal[0, 0]).sum().item()
    assert max(violation, 0.0) == pytest.approx(expected, abs=1e-5)
    if position[0] < 1:
        assert normal[0, 0].tolist() == pytest.approx([-1.0, 0.0])
