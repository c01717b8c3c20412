"""Rovers that share a world: they see, feel and avoid one another, and no other group."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from rover_rl import EnvConfig, RoverEnv, Terrain, World, make_env
from rover_rl.envs.placement import Placement
from rover_rl.robots import Robot, get_robot
from rover_rl.sims.warp.simulator import WarpSimulator
from rover_rl.worlds.movers import Mover, Waypoints
from rover_rl.worlds.pool import WorldPool
from tests.extras import needs_mujoco
from tests.robots.drives.vehicles import make_car, make_omni

FLAT = World("flat", Terrain.flat((24.0, 24.0)))
OBSERVED = ("lidar", "pose", "imu", "target", "velocities", "reward", "done", ("outcome", "mover_contact"))


@pytest.fixture(params=["warp", "bullet", pytest.param("mujoco", marks=needs_mujoco)])
def backend(request: pytest.FixtureRequest) -> str:
    """Name of a simulator in which rovers push one another."""
    return request.param


def make(num_envs: int, agents: int, world: World | WorldPool | str = FLAT, seed: int = 0, **settings) -> RoverEnv:
    defaults = {"backend": "warp", "lidar_beams": 64, "lidar_points": 32}
    return RoverEnv(world_n=world, num_envs=num_envs, agents=agents, seed=seed, **{**defaults, **settings})


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


def rotation(quaternion: np.ndarray) -> np.ndarray:
    x, y, z, w = quaternion
    return np.array(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
            (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
            (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
        )
    )


def ranges_to_others(env: RoverEnv, group: list[int]) -> np.ndarray:
    """Distances of the beams of each rover of a group to the others, computed here, ``[agents, beams]``, m."""
    robot = get_robot("rover_zero")
    positions = env.rover_state.position.double().numpy()
    frames = [rotation(q) for q in env.rover_state.orientation.double().numpy()]
    angles = 2 * np.pi * np.arange(env.scan.shape[1]) / env.scan.shape[1]
    beams = np.stack((np.cos(angles), np.sin(angles), 0 * angles), -1)
    found = np.full((len(group), len(angles)), np.inf)
    for row, me in enumerate(group):
        origin = positions[me] + frames[me] @ np.array(robot.lidar_position)
        rays = beams @ frames[me].T
        for other in group:
            if other == me:
                continue
            start = (origin - positions[other]) @ frames[other]
            local = rays @ frames[other]
            hits = [box_ranges(start - np.array(center), local, half) for center, half in BOXES]
            hits += [wheel_ranges(np.array(start - np.array(hub))[None], local) for hub in robot.wheels.hubs]
            found[row] = np.minimum(found[row], np.min(hits, 0))
    return np.where(found < robot.lidar_range, found, np.inf)


def test_sixteen_rovers_see_one_another_within_a_centimeter(backend: str) -> None:
    x, y = np.meshgrid(np.linspace(-12, 12, 97), np.linspace(-12, 12, 97))
    hills = World("hills", Terrain(0.25 * np.sin(0.9 * x) * np.cos(0.7 * y), cell=0.25))
    places = torch.tensor([(3.0 * i - 4.5, 3.0 * j - 4.5, 0.7 * i + 1.9 * j) for i in range(4) for j in range(4)])
    goals = torch.zeros(16, 2)
    shared, alone = (make(16, agents, hills, backend=backend, lidar_beams=360) for agents in (16, 1))
    td = shared.reset(start=places, goal=goals)
    alone.reset(start=places, goal=goals)
    action = torch.tensor([[0.8, 0.6]]).expand(16, 2)
    for step in range(12):
        if step % 4 == 0:
            # Rovers that do not touch drive as if alone, which tells what the beams meet besides the others.
            assert torch.equal(shared.rover_state.position, alone.rover_state.position)
            seen = ranges_to_others(shared, [*range(16)])
            expected = np.minimum(seen, alone.scan.numpy())
            actual = shared.scan.numpy()
            both = np.isfinite(expected) & np.isfinite(actual)
            error = np.where(
                both, np.abs(np.where(both, actual, 0.0) - np.where(both, expected, 0.0)), expected != actual
            )
            assert (error < 0.01).mean() >= 0.999
            assert (seen < alone.scan.numpy()).mean() > 0.02
        td = shared.step(td.set("action", action))["next"]
        alone.step(alone.rand_action().set("action", action))
    tilts = shared.state.sensed.rover.orientation[:, :2].abs().amax()
    assert tilts > 0.03


def test_a_sensor_of_rays_sees_the_others() -> None:
    env = make(2, 2)
    env.reset(start=torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]), goal=torch.tensor([[5.0, 5.0], [-5.0, 5.0]]))
    origins, directions = torch.tensor([[[0.0, 0.0, 0.135]], [[3.0, 0.0, 0.135]]]), torch.tensor([[[1.0, 0, 0]]])
    ranges = env._simulation.surroundings.cast(origins, torch.cat((directions, -directions)))
    # To the chassis of the other.
    assert ranges.flatten().tolist() == pytest.approx([2.8, 2.8], abs=0.01)


def test_two_rovers_stop_each_other_and_feel_it(backend: str) -> None:
    env = make(2, 2, backend=backend)
    start = torch.tensor([[-1.0, 0.0, 0.0], [1.0, 0.0, math.pi]])
    td = env.reset(start=start, goal=torch.tensor([[8.0, 0.0], [-8.0, 0.0]]))
    touched, places = [], []
    for _ in range(120):
        td = env.step(td.set("action", torch.tensor([[1.0, 0.0], [1.0, 0.0]])))["next"]
        touched.append(td["outcome", "mover_contact"].squeeze(-1))
        places.append(env.rover_state.position[:, 0])
    touched, places = torch.stack(touched), torch.stack(places)
    gap = places[:, 1] - places[:, 0]
    first = int(touched.any(1).nonzero()[0])
    # Their fronts are the wheels, 0.267 m ahead of their centers.
    assert gap[first] == pytest.approx(0.534, abs=0.12)
    assert not touched[:first].any()
    # They may turn until they stand side by side: the rover is 0.45 m wide.
    assert gap[first:].min() > 0.44
    assert gap[-40:].max() < 0.8
    assert touched[first:].float().mean(0).min() > 0.2
    assert places[-40:].abs().max() < 0.6
    assert env.rover_state.position[:, 2].abs().max() < 0.1


@pytest.mark.parametrize("make_robot", [make_car, make_omni])
def test_other_robots_see_and_stop_one_another(make_robot: Callable[[Path], Robot], tmp_path: Path) -> None:
    robot = make_robot(tmp_path)
    env = make(2, 2, robot=robot)
    td = env.reset(start=torch.tensor([[-1.5, 0, 0], [1.5, 0, 0]]), goal=torch.tensor([[8.0, 0.0], [8.0, 2.0]]))
    outline = robot.footprint
    assert td["outcome", "mover_distance"].flatten().tolist() == pytest.approx(
        [3.0 + outline.back, 3.0 - outline.front], abs=0.02
    )
    # The lidars are above the bodies. A ray at their height meets the back of the other.
    origins, ahead = env.rover_state.position[:, None] + torch.tensor([0.0, 0.0, 0.2]), torch.tensor([[[1.0, 0, 0]]])
    assert env._simulation.surroundings.cast(origins, ahead.expand(2, 1, 3))[0].item() == pytest.approx(2.7, abs=0.01)
    felt = False
    still = torch.tensor([[1.0, 0.0], [0.0, 0.0]])
    for _ in range(80):
        td = env.step(td.set("action", still))["next"]
        felt = felt or bool(td["outcome", "mover_contact"].any())
        assert env.rover_state.position[1, 0] - env.rover_state.position[0, 0] > outline.front - outline.back - 0.12
    assert felt


def test_a_rover_is_pushed_out_of_the_way() -> None:
    env = make(2, 2)
    start = torch.tensor([[-1.0, 0.0, 0.0], [0.0, 0.0, math.pi / 2]])
    td = env.reset(start=start, goal=torch.tensor([[8.0, 0.0], [0.0, 8.0]]))
    for _ in range(60):
        td = env.step(td.set("action", torch.tensor([[1.0, 0.0], [0.0, 0.0]])))["next"]
    assert env.rover_state.position[1, 0] > 0.05


def test_other_groups_are_neither_seen_nor_felt() -> None:
    env = make(4, 2)
    places = torch.tensor([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    td = env.reset(start=places, goal=torch.full((4, 2), 8.0))
    assert td["outcome", "mover_distance"].flatten().tolist() == pytest.approx([3.733, 3.733, 1.733, 1.733], abs=0.02)
    assert env.scan[0, 0] == pytest.approx(4.0 - 0.174 - 0.1805, abs=0.02)
    assert env.scan[2, 0] == pytest.approx(2.0 - 0.174 - 0.1805, abs=0.02)


def records(env: RoverEnv, rows: slice, actions: Tensor) -> Tensor:
    """What is observed of rows over some steps and resets."""
    td, found = env.reset(), []
    for action in actions:
        step, td = env.step_and_maybe_reset(td.set("action", action))
        found.append(torch.cat([step["next"][key][rows].double() for key in OBSERVED], -1))
        found.append(torch.cat([td[key][rows].double() for key in OBSERVED[:5]], -1))
    return torch.cat(found, -1)


@pytest.mark.parametrize("world", [FLAT, WorldPool("maze:0-4"), "moving"])
def test_a_group_depends_on_itself_alone(world: World | WorldPool | str) -> None:
    if world == "moving":
        world = World(
            "moving", FLAT.terrain, movers=[Mover(Waypoints([(0, -3, 0, 0), (3, 3, 0, 0)], random_start=True))]
        )
    actions = 2 * torch.rand(40, 9, 2, generator=torch.Generator().manual_seed(0)) - 1
    settings = {"length": 15, "end_on_goal": True, "task": EnvConfig().task}
    several = records(make(9, 3, world, seed=4, **settings), slice(3, 6), actions)
    alone = records(make(3, 3, world, seed=7, **settings), slice(0, 3), actions[:, 3:6])
    assert torch.equal(several, alone)


@pytest.mark.parametrize("world", ["maze", "moon", "inspect"])
def test_starts_and_goals_are_apart(world: str) -> None:
    env = make(32, 4, world)
    spacing = 1.0 + 2 * env.robot.radius
    apart = torch.eye(4).bool()
    for _ in range(5):
        env.reset()
        for places in (env.rover_state.position[:, :2], env.goal):
            groups = places.reshape(8, 4, 2)
            assert torch.cdist(groups, groups).masked_fill(apart, math.inf).min() > spacing - 1e-3


def test_a_rover_starts_again_free_of_the_others_that_go_on() -> None:
    env = make(64, 4)
    td = env.reset()
    for step in range(20):
        td = env.step(td.set("action", torch.tensor([[1.0, 0.3]]).expand(64, 2)))["next"]
        before = env.rover_state.position.clone()
        rows = torch.arange(64) % 4 == step % 4
        td = env.reset(td.set("_reset", rows[:, None]))
        after = env.rover_state.position
        assert torch.equal(after[~rows], before[~rows])
        groups = after[:, :2].reshape(16, 4, 2)
        distances = torch.cdist(groups, groups)[:, step % 4].index_fill(1, torch.tensor([step % 4]), math.inf)
        assert distances.min() > 1.0 + 2 * env.robot.radius - 1e-3
        assert not td["outcome", "mover_contact"][rows].any()


def test_first_candidates_are_those_of_single_rovers() -> None:
    alone, shared = make(8, 1), make(8, 8)
    assert isinstance(alone.placement, Placement)
    alone.reset()
    shared.reset()
    # The first rover of a group has no others before it.
    assert torch.equal(alone.rover_state.position[0], shared.rover_state.position[0])


def test_groups_change_worlds_together() -> None:
    env = make(6, 3, WorldPool("maze:0-9"), length=10)
    td, changes = env.reset(), 0
    for step in range(35):
        before = td["outcome", "world"].reshape(2, 3)
        reset = torch.zeros(6, 1, dtype=torch.bool)
        if step % 10 == 4:
            # One rover begins again alone.
            reset[1] = True
            td = env.reset(td.set("_reset", reset))
            assert torch.equal(td["outcome", "world"].reshape(2, 3), before)
        step_td, td = env.step_and_maybe_reset(td.set("action", torch.zeros(6, 2)))
        assert (step_td["next", "done"].reshape(2, 3).sum(1) % 3 == 0).all()
        worlds = td["outcome", "world"].reshape(2, 3)
        assert (worlds == worlds[:, :1]).all()
        changes += int((worlds != before)[:, 0].sum())
    assert changes >= 3


def test_movers_are_the_same_for_the_rovers_of_a_group() -> None:
    walks = Waypoints([(0, -3, 0, 0), (3, 3, 0, 0)], random_start=True)
    env = make(6, 3, World("walk", FLAT.terrain, movers=[Mover(walks)]))
    td = env.reset()
    for step in range(10):
        td = env.step(td.set("action", torch.zeros(6, 2)))["next"]
        if step == 5:
            reset = (torch.arange(6) == 1)[:, None]
            td = env.reset(td.set("_reset", reset))
        course = env.movers.state.position.reshape(2, 3, 2)
        assert torch.equal(course, course[:, :1].expand_as(course))
    assert not torch.equal(course[0], course[1])


def test_worlds_are_shared_out_among_groups() -> None:
    worlds = [World(name, FLAT.terrain) for name in "abc"]
    env = make(8, 2, worlds)
    assert [world.name for world in env.worlds] == [*"aaaabbcc"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"num_envs": 6, "agents": 4}, "num_envs must be a multiple of agents=4, got 6"),
        ({"num_envs": None, "agents": 2}, "num_envs must be a multiple of agents=2, got 1"),
        ({"num_envs": 4, "agents": 0}, "agents must be a whole number of at least 1"),
        ({"num_envs": 4, "agents": 2, "world": [FLAT, "moon", "maze"]}, "between 1 and num_envs=4 / agents=2 worlds"),
    ],
)
def test_wrong_numbers_are_told(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**settings)


def test_a_start_area_that_is_too_small_is_told() -> None:
    tiny = World("tiny", Terrain.flat((10.0, 10.0)), spawn_range=((-1.0, 1.0), (-1.0, 1.0)))
    env = make(8, 8, tiny)
    with pytest.raises(ValueError, match=r"the start area of world 'tiny' has room for . rovers 1 m apart"):
        env.reset()


def test_a_backend_in_which_rovers_do_not_push_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(WarpSimulator, "features", WarpSimulator.features - {"movers"})
    with pytest.raises(ValueError, match="agents=2 need a backend in which rovers push one another"):
        make(2, 2)


def test_make_env_adds_the_reward() -> None:
    env = make_env(world="maze", backend="warp", num_envs=4, agents=2, seed=0)
    assert env.rollout(3)["next", "reward"].shape == (4, 3, 1)
