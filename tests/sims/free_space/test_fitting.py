"""Generated worlds are as wide as a robot needs them, and say so in their names."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from rover_rl import EnvConfig, RoverEnv, World
from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.robots import get_robot
from rover_rl.sims.free_space import free_space
from rover_rl.sims.free_space.fitting import fitting_worlds, passage_scale
from rover_rl.worlds import Terrain, get_world
from rover_rl.worlds.pool import WorldPool

ZERO, HUSKY, RACER, HUNTER = map(get_robot, ("rover_zero", "husky", "racer", "hunter"))


def wide(seed: int, scale: float = 1.0) -> World:
    return World(f"wide-{seed}", Terrain.flat((10 * scale, 10 * scale)))


def fixed(seed: int) -> World:
    return World(f"fixed-{seed}", Terrain.flat((10, 10)))


def test_a_robot_that_fits_rover_zeros_disc_needs_no_wider_world_and_others_as_much_as_they_need():
    assert passage_scale(ZERO) == 1
    assert [passage_scale(robot) for robot in (HUSKY, RACER, HUNTER)] == [1.8, 2.2, 2.0]
    with pytest.raises(ValueError, match="is too large for generated worlds"):
        passage_scale(replace(HUSKY, radius=4.0))


def test_names_get_the_scale_that_a_robot_needs_unless_they_state_one_or_have_none():
    given = ["maze", "maze:5", "maze:*", "rooms:0-9@0.2-0.8", "maze+walkers:3", f"{__name__}:wide:1"]
    assert fitting_worlds(given, HUSKY) == [f"{name}*1.8" for name in given]
    assert fitting_worlds(given, ZERO) is given
    stated = ("maze:5*1", "maze:**2", "yard.yaml", "worlds/yard.sdf", f"{__name__}:fixed:3", wide(0))
    assert fitting_worlds(stated, HUSKY) is stated
    pool = fitting_worlds(WorldPool("maze:0-9", wide(0)), HUSKY)
    assert (pool.name(3), len(pool)) == ("maze:3*1.8", 11)
    with pytest.raises(ValueError, match="unknown world 'mazes'"):
        fitting_worlds("mazes", HUSKY)


def test_environments_and_episodes_show_the_scale_and_starts_fit():
    env = RoverEnv(world_n="maze:10000", robot=HUSKY, backend="warp", num_envs=2, seed=0)
    assert (env.config.world, env.pool.name(0)) == ("maze:10000*1.8", "maze:10000*1.8")
    env.reset()
    assert not env.rover_state.contact.any()
    assert RoverEnv(world_n="maze:10000", backend="warp").config.world == "maze:10000"
    assert RoverEnv(EnvConfig(world="maze:1*1", robot=RACER, backend="warp")).config.world == "maze:1*1"
    episodes = draw_episodes("maze:10000-10001", 2, robot=RACER)
    assert (episodes.name, episodes.world_name(2)) == ("maze:10000-10001*2.2", "maze:10001*2.2")


def test_a_live_robot_is_in_the_world_that_is_named():
    assert EnvConfig(world="maze:5", robot=HUSKY, backend="ros2").fitted().world == "maze:5"


def test_a_large_robot_has_as_much_room_in_a_world_that_fits_as_rover_zero_has():
    def share(name, robot):
        place = get_world(name)
        (left, right), (low, high) = place.spawn_range
        return len(free_space(place, robot).spawn_cells) * 0.01 / ((right - left) * (high - low))

    name = fitting_worlds("forest:10000", HUSKY)
    assert share(name, HUSKY) > 0.8 * share("forest:10000", ZERO)


def test_a_car_starts_with_a_free_way_ahead_of_it():
    world = get_world(fitting_worlds("maze:10000", RACER))
    space, radius = free_space(world, RACER), RACER.drive.min_radius(RACER.wheels)
    env = RoverEnv(world_n="maze:10000", robot=RACER, num_envs=100, seed=0, backend="warp")
    yaw = env.reset()["imu"][:, 2]
    starts, ahead = env.rover_state.position[:, :2], torch.stack((yaw.cos(), yaw.sin()), -1)
    for share in (0.25, 0.5, 0.75, 1.0):
        # A start is up to half a cell from the cell's center.
        assert space.contains(starts + share * (radius - 0.1) * ahead).float().mean() > 0.97
    assert len(space.spawn_cells) > 0.5 * len(space.goal_cells)
