"""The sensor ``walls``: long things that move, their mirror image, and what the map leaves out."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl import RoverEnv
from rover_rl.algos.policy.dwa import LIDAR
from rover_rl.envs import EnvConfig
from rover_rl.envs.config import Randomization
from rover_rl.envs.seen_map.seen_map import SeenMap
from rover_rl.envs.sensors.walls import MovingWalls, belong_to_walls, walls_of
from rover_rl.worlds import Terrain, World, box
from rover_rl.worlds.movers import Box, Mover, Waypoints

SENSOR = MovingWalls(period=2)


def gate(side: float = 1.0) -> World:
    """A wall of 3 m whose middle passes 2.5 m ahead of the origin, along y at 1 m/s, beside one that rests."""
    path = Waypoints([(0.0, 2.5, -3.0 * side, 0.0), (6.0, 2.5, 3.0 * side, 0.0)])
    rests = box((0.0, 4.0 * side, 0.5), (10.0, 0.2, 1.0))
    return World("gate", Terrain.flat((20.0, 20.0)), [rests], movers=[Mover(path, Box(3.0, 0.1, 1.0))])


def driven(yaw: Tensor, world: World, action: tuple[float, float] = (0.0, 0.0), steps: int = 40) -> TensorDictBase:
    """Drives from the origin with given headings and returns the observation."""
    config = EnvConfig(world=world, num_envs=len(yaw), backend="warp", lidar=LIDAR, sensors=(SENSOR,), seed=3)
    env = RoverEnv(config)
    start = torch.cat((torch.zeros(len(yaw), 2), yaw[:, None]), -1)
    tensordict = env.reset(start=start, goal=torch.tensor([[8.0, 0.0]]).repeat(len(yaw), 1))
    for _ in range(steps):
        tensordict = env.step(tensordict.set("action", torch.tensor([action]).repeat(len(yaw), 1)))["next"]
    env.close()
    return tensordict


def test_a_wall_is_told_in_the_frame_of_each_rover_and_the_map_leaves_it_out() -> None:
    yaw = torch.tensor([0.0, 0.5, -2.0])
    tensordict = driven(yaw, gate())
    walls = walls_of(tensordict["walls"])
    # What rests is not told.
    assert ((walls[..., 4] > 0).sum(-1) == 1).all()
    place, along, half, velocity = walls[:, 0].split((2, 2, 1, 2), -1)
    # After two seconds at 1 m/s it is at (2.5, -1), and its face is at -0.95.
    cos, sin = yaw.cos(), yaw.sin()
    torch.testing.assert_close(place, torch.stack((2.5 * cos - sin, -2.5 * sin - cos), -1), atol=0.3, rtol=0)
    torch.testing.assert_close(velocity, torch.stack((sin, cos), -1), atol=0.15, rtol=0)
    heading = torch.stack((cos, -sin), -1)
    torch.testing.assert_close(along, torch.where(cos[:, None] < 0, -heading, heading), atol=0.05, rtol=0)
    assert ((half > 1.1) & (half < 1.7)).all()
    x, y = torch.tensor([[2.5, 2.5, 4.5]] * 3), torch.tensor([[-1.0, 0.0, -1.0]] * 3)
    points = cos[:, None] * x + sin[:, None] * y, cos[:, None] * y - sin[:, None] * x
    assert belong_to_walls(*points, tensordict["walls"]).tolist() == [[True, False, False]] * 3
    blocked = []
    for observation in (tensordict, tensordict.exclude("walls")):
        seen = SeenMap(3, LIDAR)
        seen(observation)
        blocked.append((seen.levels()[0] == 0).flatten(1).sum(-1))
    assert (blocked[0] > 0).all()
    assert (blocked[0] < blocked[1]).all()


def test_a_wall_does_not_depend_on_other_rows() -> None:
    yaw = torch.tensor([0.4, 1.4])
    both, alone = driven(yaw, gate(), (0.4, 0.2), 20), driven(yaw[:1], gate(), (0.4, 0.2), 20)
    assert both["walls"].any()
    assert torch.equal(both["walls"][:1], alone["walls"])


def test_the_mirror_image_is_what_a_rover_sees_in_a_mirrored_world() -> None:
    yaw = torch.tensor([0.5])
    value, image = driven(yaw, gate(), (0.4, 0.2), 30)["walls"], driven(-yaw, gate(-1.0), (0.4, -0.2), 30)["walls"]
    assert value.any()
    torch.testing.assert_close(SENSOR.mirror(value), image, atol=0.05, rtol=0)


def test_hardly_anything_is_told_where_walls_rest_and_where_the_ground_slopes() -> None:
    config = EnvConfig(
        world=("maze:0-7", "moon:0-7"),
        num_envs=16,
        robot="jackal",
        backend="warp",
        lidar=LIDAR,
        sensors=(SENSOR,),
        randomization=Randomization(range_noise=0.03),
        seed=1,
    )
    env, told = RoverEnv(config), 0
    tensordict, turn = env.reset(), torch.linspace(-1.5, 1.5, 8).repeat(2)
    for _ in range(60):
        tensordict = env.step(tensordict.set("action", torch.stack((0.8 - turn.abs() / 2, turn), -1)))["next"]
        told += int((walls_of(tensordict["walls"])[..., 4] > 0).sum())
    env.close()
    # Of 480 scans.
    assert told <= 4
