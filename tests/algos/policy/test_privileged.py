"""The privileged observation, for critics."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict

from rover_rl import RoverEnv, Terrain, World, box
from rover_rl.algos.policy.networks import ObservationEncoder, make_critic, mirrored
from rover_rl.algos.policy.privileged import PrivilegedEncoder, mirrored_map
from rover_rl.envs.privileged import FEATURES, MAP_BEARINGS, MAP_DISTANCES

WALL = World("wall", Terrain.flat((16.0, 16.0)), [box((2.0, 0.0, 0.5), (0.4, 6.0, 1.0))])


def seen(start: list[list[float]], goal: list[list[float]]) -> TensorDict:
    env = RoverEnv(world_n=WALL, num_envs=len(start), seed=0, privileged=True)
    return env.reset(start=torch.tensor(start), goal=torch.tensor(goal))


def test_the_local_map_tells_which_way_is_shorter() -> None:
    # The first rover faces the goal. The second one faces away from it.
    td = seen([[-5.0, 0.0, 0.0], [-5.0, 0.0, math.pi]], [[-1.0, 0.0]] * 2)
    near, far = td["privileged", "local_map"].unflatten(-1, (len(MAP_DISTANCES), MAP_BEARINGS)).unbind(1)
    half = MAP_BEARINGS // 2
    for points, distance in ((near, MAP_DISTANCES[0]), (far, MAP_DISTANCES[1])):
        torch.testing.assert_close(points[0, 0].item(), distance, atol=0.15, rtol=0)
        torch.testing.assert_close(points[0, half].item(), -distance, atol=0.15, rtol=0)
        assert points.abs().max() <= distance
        torch.testing.assert_close(points[1], points[0].roll(half), atol=0.1, rtol=0)


def test_the_local_map_shows_walls() -> None:
    td = seen([[0.9, 0.0, math.pi / 2]], [[6.0, 0.0]])
    far = td["privileged", "local_map"][0, MAP_BEARINGS:]
    quarter = MAP_BEARINGS // 4
    # The wall is to the right, and both ways around it are equally long.
    assert far[-quarter] == -MAP_DISTANCES[1]
    assert far[0] > 0.5
    assert far[2 * quarter] > 0.5


def test_the_mirror_image_is_that_of_the_mirrored_world() -> None:
    td = seen([[0.0, 0.5, 0.3], [0.0, -0.5, -0.3]], [[4.0, 2.0], [4.0, -2.0]])
    image = mirrored(td, torch.tensor([True, False]))["privileged"]
    for key in FEATURES:
        torch.testing.assert_close(image[key][0], image[key][1], atol=0.3, rtol=0)
    assert not torch.allclose(td["privileged", "local_map"][0], td["privileged", "local_map"][1], atol=0.3)
    around = td["privileged", "local_map"]
    assert torch.equal(mirrored_map(mirrored_map(around)), around)


def test_the_encoding_of_the_privileged_observation_is_about_one() -> None:
    encoder, td = PrivilegedEncoder(), seen([[-5.0, 0.0, 0.0], [5.0, 3.0, 1.0]], [[4.0, 3.0], [-3.0, 2.0]])
    features = encoder(*(td[key] for key in encoder.keys))
    assert features.shape == (2, encoder.features)
    assert features.abs().max() < 3
    # It does not tell where the rover is, nor where it faces.
    moved = td.clone()
    moved["privileged", "position"] += 1.0
    moved["privileged", "attitude"][:, 2] += 1.0
    critic = make_critic(ObservationEncoder(), (8,), privileged=True)
    assert torch.equal(critic(td.clone())["state_value"], critic(moved)["state_value"])
    for key in FEATURES:
        if key != "position":
            changed = td.clone()
            changed["privileged", key] += 0.1
            assert not torch.equal(critic(td.clone())["state_value"], critic(changed)["state_value"]), key
