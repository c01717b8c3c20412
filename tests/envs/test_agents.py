"""Rovers that share a world: they see, feel and avoid one another, and no other group."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from rover_rl import EnvConfig, RoverEnv, Terrain, World, make_env
from rover_rl.robots import Robot, get_robot
from rover_rl.sims.warp.simulator import WarpSimulator
from rover_rl.worlds.movers import Mover, Waypoints
from rover_rl.worlds.pool import WorldPool
from tests.extras import BACKENDS
from tests.robots.drives.vehicles import make_car, make_omni

FLAT = World("flat", Terrain.flat((24.0, 24.0)))
WALKS = Waypoints([(0, -3, 0, 0), (3, 3, 0, 0)], random_start=True)
OBSERVED = ("lidar", "pose", "imu", "target", "velocities", "reward", "done", ("outcome", "mover_contact"))


def make(num_envs: int, agents: int, world: World | WorldPool | str = FLAT, seed: int = 0, **settings) -> RoverEnv:
    defaults = {"backend": "warp", "lidar_beams": 64, "lidar_points": 32}
    return RoverEnv(world_n=world, num_envs=num_envs, agents=agents, seed=seed, **{**defaults, **settings})


def step(env: RoverEnv, td, *action: float):
    return env.step(td.set("action", torch.tensor([action]).reshape(-1, 2).expand(env.num_envs, 2)))["next"]


# Solids of the robot rover_zero: center, and half sides of a box, or radius and half width of a wheel.
BOXES = [((0.0, 0.0, 0.135), (0.2, 0.13, 0.07)), ((0.012, 0.0, 0.275), (0.1925, 0.1, 0.07))]
WHEEL = (0.122, 0.045)


def slab_ranges(origins: np.ndarray, rays: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where rays enter and leave the slabs ``|x_k| <= half_k``."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.stack(((-half - origins) / rays, (half - origins) / rays))
    return ends.min(0).max(-1), ends.max(0).min(-1)


def box_ranges(origins: np.ndarray, rays: np.ndarray, half: tuple[float, ...]) -> np.ndarray:
    enter, leave = slab_ranges(origins, rays, np.array(half))
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def wheel_ranges(origins: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Distances to a cylinder about y."""
    radius, half = WHEEL
    o, d = origins[..., ::2], rays[..., ::2]
    a, b, c = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1) - radius**2
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    low, high = slab_ranges(origins[..., 1:2], rays[..., 1:2], np.array((half,)))
    enter, leave = np.maximum((-b - root) / a, low), np.minimum((-b + root) / a, high)
    return np.where((b * b >= a * c) & (enter <= leave) & (enter > 0), enter, np.inf)


def ranges_to_others(env: RoverEnv) -> np.ndarray:
    """Distances of the beams of each rover to all others, computed here, ``[agents, beams]``, m."""
    robot, state = get_robot("rover_zero"), env.rover_state
    positions, frames = state.position.double().numpy(), Rotation.from_quat(state.orientation.double()).as_matrix()
    angles = 2 * np.pi * np.arange(env.scan.shape[1]) / env.scan.shape[1]
    beams = np.stack((np.cos(angles), np.sin(angles), 0 * angles), -1)
    found = np.full((env.num_envs, len(angles)), np.inf)
    for me in range(env.num_envs):
        origin, rays = positions[me] + frames[me] @ np.array(robot.lidar_position), beams @ frames[me].T
        for other in {*range(env.num_envs)} - {me}:
            start, local = (origin - positions[other]) @ frames[other], rays @ frames[other]
            hits = [box_ranges(start - np.array(center), local, half) for center, half in BOXES]
            hits += [wheel_ranges(np.array(start - np.array(hub))[None], local) for hub in robot.wheels.hubs]
            found[me] = np.minimum(found[me], np.min(hits, 0))
    return np.where(found < robot.lidar_range, found, np.inf)


@pytest.mark.parametrize("backend", BACKENDS)
def test_rovers_see_one_another_within_a_centimeter(backend: str) -> None:
    x, y = np.meshgrid(np.linspace(-6, 6, 49), np.linspace(-6, 6, 49))
    hills = World("hills", Terrain(0.25 * np.sin(0.9 * x) * np.cos(0.7 * y), cell=0.25))
    places = torch.tensor([(3.0 * i - 3, 3.0 * j - 3, 0.7 * i + 1.9 * j) for i in range(3) for j in range(3)])
    shared, alone = (make(9, agents, hills, backend=backend, lidar_beams=360) for agents in (9, 1))
    td, other = (env.reset(start=places, goal=torch.zeros(9, 2)) for env in (shared, alone))
    for number in range(9):
        if number % 4 == 0:
            # Rovers that do not touch drive as if alone, which tells what the beams meet besides the others.
            assert torch.equal(shared.rover_state.position, alone.rover_state.position)
            seen, actual = ranges_to_others(shared), shared.scan.numpy()
            expected = np.minimum(seen, alone.scan.numpy())
            both = np.isfinite(expected) & np.isfinite(actual)
            error = np.where(both, np.abs(np.nan_to_num(actual) - np.nan_to_num(expected)), expected != actual)
            assert (error < 0.01).mean() >= 0.999
            assert (seen < alone.scan.numpy()).mean() > 0.02
        td, other = step(shared, td, 0.8, 0.6), step(alone, other, 0.8, 0.6)
    assert shared.state.sensed.rover.orientation[:, :2].abs().amax() > 0.03


@pytest.mark.parametrize("backend", BACKENDS)
def test_two_rovers_stop_each_other_and_feel_it(backend: str) -> None:
    env = make(2, 2, backend=backend)
    start = torch.tensor([[-1.0, 0.0, 0.0], [1.0, 0.0, math.pi]])
    td = env.reset(start=start, goal=torch.tensor([[8.0, 0.0], [-8.0, 0.0]]))
    touched, places = [], []
    for _ in range(100):
        td = step(env, td, 1.0, 0.0)
        touched.append(td["outcome", "mover_contact"].squeeze(-1))
        places.append(env.rover_state.position[:, 0])
    touched, places = torch.stack(touched), torch.stack(places)
    gap, first = places[:, 1] - places[:, 0], int(touched.any(1).nonzero()[0])
    # Their fronts are the wheels, 0.267 m ahead of their centers.
    assert gap[first] == pytest.approx(0.534, abs=0.12)
    # They may turn until they stand side by side: the rover is 0.45 m wide.
    assert gap[first:].min() > 0.44
    assert gap[-30:].max() < 0.8
    assert touched[first:].float().mean(0).min() > 0.2
    assert places[-30:].abs().max() < 0.6
    assert env.rover_state.position[:, 2].abs().max() < 0.1


@pytest.mark.parametrize("make_robot", [make_car, make_omni])
def test_other_robots_see_and_stop_one_another(make_robot: Callable[[Path], Robot], tmp_path: Path) -> None:
    robot = make_robot(tmp_path)
    env, outline = make(2, 2, robot=robot), robot.footprint
    td = env.reset(start=torch.tensor([[-1.5, 0, 0], [1.5, 0, 0]]), goal=torch.tensor([[8.0, 0.0], [8.0, 2.0]]))
    near = [3.0 + outline.back, 3.0 - outline.front]
    assert td["outcome", "mover_distance"].flatten().tolist() == pytest.approx(near, abs=0.02)
    # The lidars are above the bodies. A ray of a sensor at their height meets the back of the other.
    origins, ahead = env.rover_state.position[:, None] + torch.tensor([0.0, 0.0, 0.2]), torch.tensor([[[1.0, 0, 0]]])
    assert env._simulation.surroundings.cast(origins, ahead.expand(2, 1, 3))[0].item() == pytest.approx(2.7, abs=0.01)
    felt = False
    for _ in range(80):
        td = step(env, td, 1.0, 0.0, 0.0, 0.0)
        felt = felt or bool(td["outcome", "mover_contact"].any())
        assert env.rover_state.position[1, 0] - env.rover_state.position[0, 0] > outline.front - outline.back - 0.12
    assert felt


def test_a_rover_is_pushed_out_of_the_way() -> None:
    env = make(2, 2)
    start = torch.tensor([[-0.6, 0.0, 0.0], [0.0, 0.0, math.pi / 2]])
    td = env.reset(start=start, goal=torch.tensor([[8.0, 0.0], [0.0, 8.0]]))
    for _ in range(40):
        td = step(env, td, 1.0, 0.0, 0.0, 0.0)
    assert env.rover_state.position[1, 0] > 0.05


def test_other_groups_are_neither_seen_nor_felt() -> None:
    env = make(4, 2)
    places = torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    td = env.reset(start=places, goal=torch.full((4, 2), 8.0))
    assert td["outcome", "mover_distance"].flatten().tolist() == pytest.approx([3.733, 3.733, 1.733, 1.733], abs=0.02)
    assert env.scan[::2, 0].tolist() == pytest.approx([4.0 - 0.174 - 0.1805, 2.0 - 0.174 - 0.1805], abs=0.02)


def records(env: RoverEnv, rows: slice, actions: Tensor) -> Tensor:
    """What is observed of rows over some steps and resets."""
    td, found = env.reset(), []
    for action in actions:
        result, td = env.step_and_maybe_reset(td.set("action", action))
        found.append(torch.cat([result["next"][key][rows].double() for key in OBSERVED], -1))
        found.append(torch.cat([td[key][rows].double() for key in OBSERVED[:5]], -1))
    return torch.cat(found, -1)


@pytest.mark.parametrize("world", [WorldPool("maze:0-4"), World("moving", FLAT.terrain, movers=[Mover(WALKS)])])
def test_a_group_depends_on_itself_alone(world: World | WorldPool) -> None:
    actions = 2 * torch.rand(24, 9, 2, generator=torch.Generator().manual_seed(0)) - 1
    settings = {"length": 10, "end_on_goal": True, "task": EnvConfig().task}
    several = records(make(9, 3, world, seed=4, **settings), slice(3, 6), actions)
    alone = records(make(3, 3, world, seed=7, **settings), slice(0, 3), actions[:, 3:6])
    assert torch.equal(several, alone)


@pytest.mark.parametrize("world", ["maze", "inspect"])
def test_starts_and_goals_are_apart(world: str) -> None:
    env = make(32, 4, world)
    for _ in range(3):
        env.reset()
        for places in (env.rover_state.position[:, :2], env.goal):
            groups = places.reshape(8, 4, 2)
            distances = torch.cdist(groups, groups).masked_fill(torch.eye(4).bool(), math.inf)
            assert distances.min() > 1.0 + 2 * env.robot.radius - 1e-3


def test_a_rover_starts_again_free_of_the_others_that_go_on() -> None:
    env = make(64, 4)
    td = env.reset()
    # The first rover of a group has no others before it.
    alone = make(8, 1)
    alone.reset()
    assert torch.equal(alone.rover_state.position[0], env.rover_state.position[0])
    for number in range(12):
        td = step(env, td, 1.0, 0.3)
        before = env.rover_state.position.clone()
        rows = torch.arange(64) % 4 == number % 4
        td = env.reset(td.set("_reset", rows[:, None]))
        after = env.rover_state.position
        assert torch.equal(after[~rows], before[~rows])
        groups = after[:, :2].reshape(16, 4, 2)
        distances = torch.cdist(groups, groups)[:, number % 4].index_fill(1, torch.tensor([number % 4]), math.inf)
        assert distances.min() > 1.0 + 2 * env.robot.radius - 1e-3
        assert not td["outcome", "mover_contact"][rows].any()


def test_groups_change_worlds_together() -> None:
    env = make(6, 3, WorldPool("maze:0-9"), length=10)
    td, changes = env.reset(), 0
    for number in range(35):
        before = td["outcome", "world"].reshape(2, 3)
        if number % 10 == 4:
            # One rover begins again alone.
            td = env.reset(td.set("_reset", torch.arange(6)[:, None] == 1))
            assert torch.equal(td["outcome", "world"].reshape(2, 3), before)
        result, td = env.step_and_maybe_reset(td.set("action", torch.zeros(6, 2)))
        assert (result["next", "done"].reshape(2, 3).sum(1) % 3 == 0).all()
        worlds = td["outcome", "world"].reshape(2, 3)
        assert (worlds == worlds[:, :1]).all()
        changes += int((worlds != before)[:, 0].sum())
    assert changes >= 3


def test_movers_are_the_same_for_the_rovers_of_a_group() -> None:
    env = make(6, 3, World("walk", FLAT.terrain, movers=[Mover(WALKS)]))
    td = env.reset()
    for number in range(8):
        td = step(env, td, 0.0, 0.0)
        if number == 5:
            td = env.reset(td.set("_reset", (torch.arange(6) == 1)[:, None]))
        course = env.movers.state.position.reshape(2, 3, 2)
        assert torch.equal(course, course[:, :1].expand_as(course))
    assert not torch.equal(course[0], course[1])


def test_worlds_are_shared_out_among_groups_and_make_env_adds_the_reward() -> None:
    env = make_env(world=[World(name, FLAT.terrain) for name in "abc"], num_envs=8, agents=2, backend="warp", seed=0)
    assert [world.name for world in env.base_env.worlds] == [*"aaaabbcc"]
    assert env.rollout(2)["next", "reward"].shape == (8, 2, 1)


TINY = World("tiny", Terrain.flat((10.0, 10.0)), spawn_range=((-1.0, 1.0), (-1.0, 1.0)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_envs": 6, "agents": 4}, "num_envs must be a multiple of agents=4, got 6"),
        ({"num_envs": None, "agents": 2}, "num_envs must be a multiple of agents=2, got 1"),
        ({"num_envs": 4, "agents": 0}, "agents must be a whole number of at least 1"),
        ({"num_envs": 4, "agents": 2, "world": [FLAT, "moon", "maze"]}, "between 1 and num_envs=4 / agents=2 worlds"),
        ({"num_envs": 8, "agents": 8, "world": TINY}, "the start area of world 'tiny' has room for . rovers 1 m apart"),
    ],
)
def test_wrong_numbers_are_told(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**settings).reset()


def test_a_backend_in_which_rovers_do_not_push_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(WarpSimulator, "features", WarpSimulator.features - {"movers"})
    with pytest.raises(ValueError, match="agents=2 need a backend in which rovers push one another"):
        make(2, 2)
