from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl import RoverEnv, Terrain, World, box
from rover_rl.algos.config import NetworkConfig, TrainingConfig
from rover_rl.algos.policy.networks import (
    ObservationEncoder,
    PrivilegedEncoder,
    actor_of,
    make_action_critic,
    make_actor,
    make_critic,
    mirrored,
    on_features,
)
from rover_rl.algos.policy.route_prior import RoutePrior
from rover_rl.envs.actions import ACTION
from rover_rl.envs.config import ActionConfig, EnvConfig, LidarConfig
from rover_rl.envs.privileged import FEATURES, MAP_BEARINGS, MAP_DISTANCES
from rover_rl.envs.sensors.robot import RobotNumbers
from rover_rl.envs.sensors.suite import ROBOT, ROUTE, environment_sensors
from rover_rl.robots import get_robot

LOW, HIGH = torch.tensor(ACTION.low), torch.tensor(ACTION.high)


def observations(*shape: int) -> TensorDict:
    generator, values = torch.Generator().manual_seed(0), {}
    for key, sensor in environment_sensors(LidarConfig()).items():
        low, high = sensor.bounds.tensors(None)
        values[key] = low + (high - low) * torch.rand(*shape, len(low), generator=generator)
    return TensorDict(values, batch_size=shape)


def test_encoding_of_an_observation() -> None:
    encoder = ObservationEncoder(lidar_points=2)
    entries = ([0.0, 12.0], [0.1, -0.2, 3.0], [5.0, math.pi / 2], [0.5, 1.5])
    features = encoder(*(torch.tensor([entry]) for entry in entries))
    lidar = [-1.0, math.log(13) / 1.3 - 1]
    expected = torch.tensor([[*lidar, 0.3, -0.6, 0.0, math.log(6) - 1, 1.0, 0.0, 0.5, 0.5, 0.5]])
    torch.testing.assert_close(features, expected, atol=1e-6, rtol=0)
    # That of a pose distinguishes positions and headings.
    encoder = ObservationEncoder(("imu", "pose"))
    imu = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, 0.0]])
    features = encoder(imu, torch.tensor([[1.0, 2.0, 0.5], [1.0, 2.0, 0.5], [9.0, 2.0, 0.5]]))
    assert features.shape == (3, encoder.features)
    for other in (1, 2):
        assert not torch.allclose(features[0], features[other], atol=0.1)


@pytest.mark.parametrize(
    ("shape", "keys"), [((), ("target",)), ((3, 5), ("pose", "imu", "target", "lidar", "velocities"))]
)
def test_networks_accept_any_batch_shape_and_keys(shape: tuple[int, ...], keys: tuple[str, ...]) -> None:
    encoder = ObservationEncoder(keys)
    td = make_actor(encoder)(observations(*shape).select(*keys))
    td["features"] = encoder(*(td[key] for key in keys))
    td = make_action_critic(encoder)(make_critic(encoder)(td))
    assert td["action"].shape == (*shape, 2)
    assert td["action_log_prob"].shape == shape
    assert td["state_value"].shape == td["state_action_value"].shape == (*shape, 1)


@pytest.mark.parametrize("action", [ActionConfig(), ActionConfig(min_speed=0.0)])
def test_actions_cover_their_bounds_and_without_exploration_are_the_center(action: ActionConfig) -> None:
    torch.manual_seed(0)
    actor, td, low = make_actor(action=action, max_std=2.0), observations(4000), LOW.clone()
    low[0] = action.for_robot("rover_zero").min_speed
    with set_exploration_type(ExplorationType.RANDOM):
        actions = actor(td.clone())["action"]
    assert ((actions >= low) & (actions <= HIGH)).all()
    assert (actions.amin(0) < low + 0.1).all()
    assert (actions.amax(0) > 0.9 * HIGH).all()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        center = actor(td)
    middle = (low + HIGH) / 2
    torch.testing.assert_close(center["action"], middle + center["loc"].tanh() * (HIGH - middle))


def test_the_standard_deviation_is_bounded() -> None:
    actor, td = make_actor(max_std=0.3), observations(50)
    with torch.no_grad():
        for weight in actor.parameters():
            weight.mul_(100.0)
    scale = actor(td)["scale"].detach()
    assert scale.max().item() == pytest.approx(0.3)
    assert 0 < scale.min() < 0.1


def test_an_actor_on_features_equals_the_actor_on_observations() -> None:
    torch.manual_seed(0)
    actor, encoder, td = make_actor(), ObservationEncoder(), observations(5)
    encoded = TensorDict({"features": encoder(*(td[key] for key in encoder.keys))}, batch_size=5)
    again = on_features(actor)
    torch.testing.assert_close(again(encoded)["action"], actor(td)["action"], rtol=0, atol=0)
    assert {id(weight) for weight in again.parameters()} == {id(weight) for weight in actor.parameters()}


def test_the_critic_scales_actions_by_their_bounds() -> None:
    torch.manual_seed(0)
    encoder = ObservationEncoder(("imu",))
    back, forward = make_action_critic(encoder), make_action_critic(encoder, action=ActionConfig(min_speed=0.0))
    forward.load_state_dict(back.state_dict())
    td = TensorDict({"features": torch.randn(5, encoder.features), "action": torch.zeros(5, 2)}, batch_size=5)
    slow = td.clone().set("action", torch.tensor([[-1.0, 0.0]] * 5))
    torch.testing.assert_close(forward(td)["state_action_value"], back(slow)["state_action_value"])


def test_map_orientation_does_not_change_when_the_rover_turns_in_place() -> None:
    encoder = ObservationEncoder(("lidar", "imu", "target"), lidar_points=8, north_up=True)
    ranges = torch.arange(1.0, 9.0)[None]
    for segments in range(-4, 5):
        yaw = segments * math.pi / 4
        seen = ranges.roll(-segments, -1), torch.tensor([[0.0, 0.0, yaw]]), torch.tensor([[3.0, 0.5 - yaw]])
        features = encoder(*seen)
        assert features.shape == (1, encoder.features)
        torch.testing.assert_close(features[:, -12:-4], ranges.log1p() / 1.3 - 1, atol=1e-5, rtol=0)
        direction = torch.tensor([[math.sin(0.5), math.cos(0.5)]])
        torch.testing.assert_close(features[:, -4:], torch.cat((direction, direction * 3 / 4), -1), atol=1e-5, rtol=0)
    with pytest.raises(ValueError, match="north_up needs lidar, imu and target"):
        ObservationEncoder(("lidar", "target"), north_up=True)


@pytest.mark.parametrize("north_up", [False, True])
def test_another_number_of_lidar_points_raises(north_up: bool) -> None:
    encoder = ObservationEncoder(lidar_points=24, north_up=north_up)
    with pytest.raises(ValueError, match="^the policy reads 24 lidar points, got 32"):
        make_actor(encoder)(observations(3))
    assert ObservationEncoder(("target",), lidar_points=24)(torch.zeros(2, 2)).shape == (2, 5)


def test_pose_and_yaw_are_ignored_by_default() -> None:
    actor, td = make_actor(), observations(8)
    moved = td.clone()
    moved["pose"] += 5.0
    moved["imu"][:, 2] += 1.0
    assert torch.equal(actor(td)["loc"], actor(moved)["loc"])


def test_the_mirror_image_swaps_left_and_right() -> None:
    now = {"lidar": [1.0, 2.0, 3.0], "imu": [0.1, 0.2, 0.3], "target": [5.0, 0.4], "velocities": [0.5, 0.6]}
    td = TensorDict({key: torch.tensor([value] * 2) for key, value in {**now, "action": [0.7, 0.8]}.items()}, [2])
    td["next"] = TensorDict({"target": torch.tensor([[4.0, -0.2]] * 2), "reward": torch.ones(2, 1)}, [2])
    image = mirrored(td, torch.tensor([True, False]))
    assert (image[1] == td[1]).all()
    assert image[0]["lidar"].tolist() == [3, 2, 1]
    expected = {"imu": [0.1, -0.2, -0.3], "target": [5.0, -0.4], "velocities": [0.5, -0.6], "action": [0.7, -0.8]}
    for key, value in expected.items():
        assert image[0][key].tolist() == pytest.approx(value)
    assert image[0]["next", "target"].tolist() == pytest.approx([4.0, 0.2])
    assert image[0]["next", "reward"] == 1
    assert (mirrored(image, torch.tensor([True, False])) == td).all()


WALL = World("wall", Terrain.flat((16.0, 16.0)), [box((2.0, 0.0, 0.5), (0.4, 6.0, 1.0))])


def seen(start: list[list[float]], goal: list[list[float]]) -> tuple[RoverEnv, TensorDict]:
    env = RoverEnv(world_n=WALL, num_envs=len(start), seed=0, privileged=True, backend="warp")
    return env, env.reset(start=torch.tensor(start), goal=torch.tensor(goal))


def test_the_mirror_image_agrees_with_the_simulation() -> None:
    """Two rovers with mirrored starts and actions have mirrored observations."""
    env, td = seen([[0.0, 0.5, 0.3], [0.0, -0.5, -0.3]], [[4.0, 2.0], [4.0, -2.0]])
    first, every = td["privileged"], torch.ones(2, dtype=torch.bool)
    image = mirrored(td, every)["privileged"]
    for key in FEATURES:
        torch.testing.assert_close(image[key][0], first[key][1], atol=0.3, rtol=0)
    assert not torch.allclose(first["local_map"][0], first["local_map"][1], atol=0.3)
    assert torch.equal(mirrored(mirrored(td, every), every)["privileged", "local_map"], first["local_map"])
    for _ in range(10):
        td = env.step_mdp(env.step(td.set("action", torch.tensor([[0.8, 0.5], [0.8, -0.5]]))))
    image = mirrored(td, every)
    for key in ("target", "velocities", "imu"):
        torch.testing.assert_close(image[0][key], td[1][key], atol=0.02, rtol=0)
    # Segments begin straight ahead, so that the mirror image of a segment differs from another segment by one beam.
    assert (image[0]["lidar"] - td[1]["lidar"]).abs().median() < 0.05


def test_the_local_map_tells_which_way_is_shorter_and_shows_walls() -> None:
    # The first rover faces the goal. The second one faces away from it. The third one has a wall to its right, and
    # both ways around it are equally long.
    starts = [[-5.0, 0.0, 0.0], [-5.0, 0.0, math.pi], [0.9, 0.0, math.pi / 2]]
    _, td = seen(starts, [[-1.0, 0.0], [-1.0, 0.0], [6.0, 0.0]])
    near, far = td["privileged", "local_map"].unflatten(-1, (len(MAP_DISTANCES), MAP_BEARINGS)).unbind(1)
    half = MAP_BEARINGS // 2
    for points, distance in ((near, MAP_DISTANCES[0]), (far, MAP_DISTANCES[1])):
        torch.testing.assert_close(points[0, 0].item(), distance, atol=0.15, rtol=0)
        torch.testing.assert_close(points[0, half].item(), -distance, atol=0.15, rtol=0)
        assert points.abs().max() <= distance
        torch.testing.assert_close(points[1], points[0].roll(half), atol=0.1, rtol=0)
    assert far[2, -half // 2] == -MAP_DISTANCES[1]
    assert far[2, 0] > 0.5
    assert far[2, half] > 0.5


def test_the_encoding_of_the_privileged_observation_is_about_one() -> None:
    encoder, (_, td) = PrivilegedEncoder(), seen([[-5.0, 0.0, 0.0], [5.0, 3.0, 1.0]], [[4.0, 3.0], [-3.0, 2.0]])
    features = encoder(*(td[key] for key in encoder.keys))
    assert features.shape == (2, encoder.features)
    assert features.abs().max() < 3
    # It does not tell where the rover is, nor where it faces.
    critic = make_critic(ObservationEncoder(), (8,), privileged=True)
    for key in FEATURES:
        changed = td.clone()
        changed["privileged", key] += 0.1
        assert torch.equal(critic(td.clone())["state_value"], critic(changed)["state_value"]) == (key == "position")
    moved = td.clone()
    moved["privileged", "attitude"][:, 2] += 1.0
    assert torch.equal(critic(td.clone())["state_value"], critic(moved)["state_value"])


def rows_of(*names: str) -> TensorDict:
    """Observations of different robots that see the same."""
    generator = torch.Generator().manual_seed(0)
    lidar = 0.6 + 3 * torch.rand(1, 64, generator=generator)
    route = torch.tensor([[1.5, 0.4, 3.0, 0.6, 4.0]])
    entries = {"lidar": lidar, "imu": torch.zeros(1, 3), "velocities": torch.tensor([[0.2, 0.0]]), ROUTE: route}
    td = TensorDict({name: value.expand(len(names), -1) for name, value in entries.items()}, batch_size=len(names))
    numbers = [RobotNumbers.of_robot(get_robot(name), lidar) for name in names]
    return td.set(ROBOT, torch.cat([torch.cat(number, -1) for number in numbers]))


@pytest.mark.parametrize(("reach", "stops"), [(1.0, False), (3.0, True)])
def test_the_reach_of_a_policy_bounds_what_it_takes_back_from_the_driver(reach: float, stops: bool) -> None:
    prior = RoutePrior(get_robot("rover_zero"), reach=reach, share=0.8)
    actor, observation = make_actor(ObservationEncoder(("lidar", "imu", ROUTE), 64), prior=prior), rows_of("rover_zero")
    # The driver goes at the share of full speed that it may use.
    assert actor(observation)["action"][0, 0].item() == pytest.approx(0.8, abs=0.05)
    with torch.no_grad():
        [layer for layer in actor.modules() if isinstance(layer, torch.nn.Linear)][-1].bias.fill_(-100.0)
    assert (actor(observation)["action"][0, 0] < 0) == stops


@pytest.mark.parametrize(
    ("kind", "network"),
    [("heading", {}), ("heading", {"memory": "gru", "distribution": "grid"}), ("twist", {"memory": "gru"})],
)
def test_actions_are_within_what_each_robot_can_do(kind: str, network: dict[str, Any]) -> None:
    torch.manual_seed(0)
    names = ("leo", "jackal")
    observation = ("lidar", "velocities", ROUTE, "imu", ROBOT)
    env = EnvConfig(
        robot=names,
        lidar=LidarConfig(points=64),
        sensors=(ROUTE, ROBOT),
        action=ActionConfig(kind=kind, min_speed=-0.5),
        backend="warp",
    )
    actor = actor_of(TrainingConfig(env=env, network=NetworkConfig(observation=observation, **network)))
    rows = rows_of(*(names * 300))
    rows["is_init"] = torch.ones(len(rows), 1, dtype=torch.bool)
    with set_exploration_type(ExplorationType.RANDOM):
        actions = actor(rows)["action"].unflatten(0, (300, 2))
    for column, name in enumerate(names):
        drive = get_robot(name).drive
        speed, turn = actions[:, column].unbind(-1)
        # The heading PID turns twice as fast as the heading offset is large.
        most = drive.max_yaw_rate / 2 if kind == "heading" else drive.max_yaw_rate
        assert 0.8 * drive.max_speed < speed.max() <= drive.max_speed
        assert 0.8 * most < turn.max() <= most + 1e-6
        assert speed.min() >= -min(0.5, drive.max_speed)
