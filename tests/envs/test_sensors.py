"""Sensors of one's own in an environment."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl import Bounds, EnvConfig, LidarConfig, Randomization, RoverEnv, Sensor, Terrain, World, box, make_env
from rover_rl.envs.config import plain_env, require_match
from rover_rl.envs.encoding import ObservationEncoder
from rover_rl.envs.gym import GymWrapper
from rover_rl.envs.sensors.base import SensorInput
from rover_rl.envs.sensors.suite import register_sensor
from tests.envs.scripted import ScriptedBackend, ScriptedSimulator
from tests.extras import BACKENDS
from tests.pages import documented

FLAT = World("flat", Terrain.flat((12.0, 12.0)), [box((3.0, 0.0, 0.5), (1.0, 2.0, 1.0))])


@dataclass(frozen=True, kw_only=True)
class RangeFinder(documented("extending.md", "RangeFinder")):  # type: ignore[misc]
    """The sensor of the page, which looks down and forward from a point ahead of the rover."""

    noise: float = 0.0
    mirror_signs = (-1.0,)


@dataclass(frozen=True, kw_only=True)
class Ground(Sensor):
    """Height of the ground 1 m east of the rover, a random number, and the number of the step."""

    name: str = "ground"
    columns: int = 3

    @property
    def bounds(self) -> Bounds:
        return Bounds((-100.0, 0.0, 0.0), (100.0, 1.0, 100.0))

    def read(self, inputs: SensorInput) -> Tensor:
        ahead = inputs.truth.position + torch.tensor([1.0, 0.0])
        height = inputs.surroundings.height_at(ahead)[:, None]
        return torch.cat((height, inputs.uniform(self, 1), inputs.steps.float()), -1)[:, : self.columns]


def no_sensor() -> int:
    return 3


def test_a_range_finder_measures_the_ground_and_the_obstacle_ahead_also_in_gymnasium() -> None:
    env = make_env(world=FLAT, num_envs=2, backend="warp", sensors=[RangeFinder()])
    start = torch.tensor([[-2.0, 3.0, 1.0], [2.1, 0.0, 0.0]])
    ground, wall = env.reset(start=start)["range"].flatten().tolist()
    # The rover stands on its wheels, so that its origin is on the ground.
    assert ground == pytest.approx(0.25 * math.sqrt(2), abs=0.01)
    assert wall == pytest.approx(0.1 * math.sqrt(2), abs=0.01)
    assert env.observation_spec["range"].space.high.tolist() == [[4.0], [4.0]]
    wrapped = GymWrapper(RoverEnv(world=FLAT, num_envs=None, backend="warp", sensors=[RangeFinder()]))
    assert wrapped.reset(seed=0)[0] in wrapped.observation_space
    assert wrapped.observation_space["range"].shape == (1,)


def test_noise_is_that_of_each_row_and_each_sensor_and_terrain_that_of_its_place() -> None:
    sensors = [RangeFinder(noise=0.1), RangeFinder(name="other", noise=0.1), Ground()]
    env = RoverEnv(world="moon", num_envs=5, seed=7, backend="warp", sensors=sensors)
    td = env.reset()
    xy = env.rover_state.position[:, :2] + torch.tensor([1.0, 0.0])
    torch.testing.assert_close(td["ground"][:, 0], env.worlds[0].height_at(xy))
    assert not torch.equal(td["range"], td["other"])
    assert len(set(td["ground"][:, 1].tolist())) == 5


@pytest.mark.parametrize("backend", BACKENDS)
def test_readings_and_scans_are_held_between_periods_and_are_those_of_every_step(backend: str) -> None:
    def drive(period: int) -> TensorDictBase:
        """Observations of the first state and of nine steps. Before the seventh, the second row is reset."""
        sensors, lidar = [RangeFinder(noise=0.1, period=period)], LidarConfig(period=period)
        noise = Randomization(range_noise=0.05, dropout=0.1)
        settings = {"sensors": sensors, "lidar": lidar, "randomization": noise, "backend": backend}
        env = RoverEnv(world="maze", num_envs=3, seed=2, **settings)
        seen = [env.reset()]
        for step in range(9):
            td = seen[-1].clone()
            if step == 6:
                td = env.reset(td.select("done").set("_reset", torch.tensor([[False], [True], [False]])))
            seen.append(env.step(td.set("action", torch.tensor([[0.6, 0.4]] * 3)))["next"])
        return torch.stack([each.select("lidar", "range", "pose", "outcome") for each in seen])

    sparse, every = drive(4), drive(1)
    steps = sparse["outcome", "steps"].squeeze(-1)
    assert torch.equal(sparse["pose"], every["pose"])
    assert steps[:, 1].tolist() == [0, 1, 2, 3, 4, 5, 6, 1, 2, 3], "each row counts its own steps"
    read = steps % 4 == 0
    kept = ~read[1:] & (steps[1:] > 1)
    for key in ("lidar", "range"):
        assert torch.equal(sparse[key][read], every[key][read])
        assert torch.equal(sparse[key][1:][kept], sparse[key][:-1][kept])
        assert not torch.equal(sparse[key][1:][kept], every[key][1:][kept])


def test_networks_read_and_mirror_the_entry() -> None:
    encoder = ObservationEncoder(("target", "range"), sensors=[RangeFinder()])
    assert encoder.features == 6
    assert encoder(torch.zeros(2, 2), torch.tensor([[0.0], [3.0]]))[:, -1].tolist() == [-1.0, 0.5]
    assert encoder.sensors["range"].mirror(torch.tensor([[2.0]])).tolist() == [[-2.0]]


@pytest.mark.parametrize(
    ("sensors", "message"),
    [
        (["sonar"], "unknown sensor 'sonar'"),
        (["tests.envs.test_sensors:no_sensor"], "a sensor must be a Sensor, or a function or class .*, got 3"),
        ([RangeFinder(name="lidar")], "sensors cannot add 'lidar'"),
        ([RangeFinder(), RangeFinder()], "sensors cannot add 'range'"),
        ("sonar", "sensors must be a list of names or Sensors, got 'sonar'"),
        ([Ground(columns=2)], r"sensor 'ground' must read float32 \(1, 3\) by its bounds, got .* \(1, 2\)"),
    ],
)
def test_what_is_no_sensor_is_refused(sensors: list[object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RoverEnv(world=FLAT, backend="warp", sensors=sensors).reset()


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (RangeFinder, {"period": 0}, "period must be"),
        (RangeFinder, {"name": "a b"}, "identifier"),
        (LidarConfig, {"period": 0}, "period must be at least 1 .*got 0"),
    ],
)
def test_settings_are_checked(kind: type, settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        kind(**settings)


def test_sensors_are_registered_and_written_by_name() -> None:
    register_sensor("test-range", RangeFinder)
    config = EnvConfig(world="maze", sensors=("test-range",), backend="warp")
    assert plain_env(config)["sensors"] == ["test-range"]
    assert RoverEnv(config).reset()["range"].shape == (1, 1)
    with pytest.raises(ValueError, match="a Sensor cannot be written to a file, and sensors is one"):
        plain_env(EnvConfig(sensors=(RangeFinder(),)))


def test_a_policy_needs_its_sensors() -> None:
    made_for = EnvConfig(sensors=("a:b",))
    require_match(made_for, EnvConfig(sensors=("c:d", "a:b")))
    require_match(EnvConfig(), made_for)
    with pytest.raises(ValueError, match=r"made for the sensors \('a:b',\), and the environment has \(\)"):
        require_match(made_for, EnvConfig())


class LiveSimulator(ScriptedSimulator):
    live = SimpleNamespace(segments=lambda points: None)


class LiveBackend(ScriptedBackend):
    def make(self, **arguments: Any) -> LiveSimulator:
        return LiveSimulator(arguments["worlds"])


def test_a_live_rover_has_heights_and_no_rays() -> None:
    assert RoverEnv(world=FLAT, backend=LiveBackend(), sensors=[Ground()]).reset()["ground"][0, 0] == 0
    with pytest.raises(ValueError, match="a sensor casts rays, .*: a live rover has none"):
        RoverEnv(world=FLAT, backend=LiveBackend(), sensors=[RangeFinder()]).reset()
